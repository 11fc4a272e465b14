"""When the next cycle is due: at the rate, at ease, late, and when something comes meanwhile."""

import dataclasses

import pytest

from shearloop.drivers.ur.messages import Ease, Enable, Heartbeat, Message, Stop
from shearloop.drivers.ur.pace import Pace
from tests.drivers.ur.flight import SETTINGS

PERIOD_S = 1.0 / SETTINGS.rate_hz


class Cycles:
    """A pace and its time."""

    def __init__(self, **changes: float) -> None:
        self.now_s = 100.0
        self.pace = Pace(dataclasses.replace(SETTINGS, **changes), self.now_s)

    def work(self, seconds: float = 0.0, *, rests: bool = True) -> float:
        """Begin a cycle that is due, work for so long, and return what is left until the next one."""
        self.pace.begin()
        self.now_s += seconds
        self.pace.plan(self.now_s, rests=rests)
        return self.pace.left_s(self.now_s)

    def wait(self) -> None:
        self.now_s += max(0.0, self.pace.left_s(self.now_s))

    def numbers(self, count: int, *, rests: bool = True) -> list[int]:
        """Go through so many cycles, and return their numbers and check their times."""
        numbers = []
        for _ in range(count):
            self.work(0.001, rests=rests)
            numbers.append(self.pace.cycle)
            self.wait()
            assert self.now_s == pytest.approx(100.0 + self.pace._next * PERIOD_S)
        return numbers

    def told(self, count: int, *, rests: bool, news_in: int | None = None) -> list[int]:
        """Go through so many cycles, and return the numbers of those that are told; one of them brings news."""
        told = []
        for _ in range(count):
            self.work(rests=rests)
            if self.pace.tells(rests=rests, news=self.pace.cycle == news_in):
                told.append(self.pace.cycle)
            self.wait()
        return told


def test_cycles_come_at_the_rate() -> None:
    assert Cycles().numbers(4) == [0, 1, 2, 3]


def test_cycles_at_ease_are_the_multiples() -> None:
    cycles = Cycles()
    assert cycles.numbers(3) == [0, 1, 2]
    cycles.pace.hear(Ease(5))
    assert cycles.numbers(4) == [3, 6, 9, 12]


@pytest.mark.parametrize("message", [Heartbeat(), Enable(), Stop(4.0), Ease(1), Ease(0)])
def test_whatever_else_is_heard_ends_the_ease(message: Message) -> None:
    cycles = Cycles()
    cycles.pace.hear(Ease(5))
    cycles.pace.hear(message)
    assert not cycles.pace.at_ease
    assert cycles.numbers(3) == [0, 1, 2]


def test_while_something_moves_there_is_no_ease() -> None:
    cycles = Cycles()
    cycles.pace.hear(Ease(5))
    assert cycles.numbers(3, rests=False) == [0, 1, 2]
    assert cycles.numbers(3) == [3, 6, 9]


def test_a_late_cycle_begins_at_once_and_is_not_caught_up_with() -> None:
    cycles = Cycles()
    assert cycles.work(5.5 * PERIOD_S) <= 0
    assert cycles.work() == pytest.approx(PERIOD_S)
    assert cycles.pace.cycle == 1


@pytest.mark.parametrize(("after", "cycle"), [(0.1, 1), (0.9, 1), (1.1, 2), (1.9, 2), (2.1, 3)])
def test_who_hurries_at_ease_gets_the_next_cycle_of_the_rate(after: float, cycle: int) -> None:
    cycles = Cycles()
    cycles.pace.hear(Ease(5))
    assert cycles.work() == pytest.approx(3 * PERIOD_S)
    cycles.now_s += after * PERIOD_S
    cycles.pace.hear(Stop(4.0))
    cycles.pace.hurry(cycles.now_s)
    assert cycles.pace.left_s(cycles.now_s) == pytest.approx((cycle - after) * PERIOD_S)
    cycles.wait()
    cycles.work()
    assert cycles.pace.cycle == cycle


def test_who_hurries_after_a_late_cycle_gets_none_that_is_later() -> None:
    cycles = Cycles()
    cycles.work(1.5 * PERIOD_S)
    cycles.pace.hurry(cycles.now_s)
    assert cycles.pace.left_s(cycles.now_s) == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("rate_hz", "watchdog_hz", "most"), [(125.0, 10.0, 3), (125.0, 15.0, 2), (125.0, 20.0, 1), (500.0, 10.0, 12)]
)
def test_at_ease_most_of_the_watchdogs_patience_is_left_for_a_busy_computer(
    rate_hz: float, watchdog_hz: float, most: int
) -> None:
    cycles = Cycles(rate_hz=rate_hz, watchdog_hz=watchdog_hz)
    cycles.pace.hear(Ease(1000))
    cycles.pace.begin()
    cycles.pace.plan(cycles.now_s, rests=True)
    left_s = cycles.pace.left_s(cycles.now_s)
    assert left_s == pytest.approx(most / rate_hz)
    assert most == 1 or left_s <= 0.25 / watchdog_hz


# With news in cycle 7; every fifth is told in any case.
EVERY = {
    1: [*range(20)],
    2: [0, 2, 4, 5, 7, 9, 10, 12, 14, 15, 17, 19],
    3: [0, 3, 5, 7, 10, 13, 15, 18],
}


@pytest.mark.parametrize(("rate_hz", "every"), [(500.0, 3), (125.0, 3), (100.0, 2), (30.0, 1)])
def test_of_states_that_say_nothing_new_one_is_told_in_time(rate_hz: float, every: int) -> None:
    assert Cycles(rate_hz=rate_hz).told(20, rests=False, news_in=7) == EVERY[every]


def test_at_ease_news_are_told_though_another_state_was() -> None:
    cycles = Cycles()
    cycles.pace.hear(Ease(5))
    # Of 0, 3, 6 … the first in each five, and 9.
    assert cycles.told(8, rests=True, news_in=9) == [0, 6, 9, 12, 15, 21]


@pytest.mark.parametrize(("timeout_s", "every"), [(0.3, 3), (0.1, 2), (0.05, 1), (0.02, 1)])
def test_states_are_told_often_enough_to_renew_a_speed_that_holds_shortly(timeout_s: float, every: int) -> None:
    told = Cycles(command_timeout_s=timeout_s).told(12, rests=False)
    # Every fifth is told in any case.
    assert told == {1: [*range(12)], 2: [0, 2, 4, 5, 7, 9, 10], 3: [0, 3, 5, 8, 10]}[every]
