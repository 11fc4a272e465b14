"""Which cycles the robot's own process goes through, and of which it tells, in a time of its own."""

from itertools import pairwise

import pytest

from shearloop.drivers.ur import worker as child
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.messages import (
    CommandReply,
    Disconnect,
    Ease,
    Enable,
    Heartbeat,
    RobotState,
    RtdeSample,
    Stop,
    Unlock,
    WristSpeed,
)
from tests.drivers.ur.process import Daemon, Eased, TimedArm


def test_at_ease_every_third_cycle_is_gone_through_until_the_daemon_says_something(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    eased = Eased(daemon, monkeypatch, (0.101, Ease(5)), (0.225, Heartbeat()), (0.301, Ease(5)), (0.405, Disconnect()))
    assert eased.cycles_between(-0.001, 0.101) == [*range(13)]
    assert eased.cycles_between(0.101, 0.225) == [13, 15, 18, 21, 24, 27]
    assert eased.cycles_between(0.225, 0.301) == [*range(29, 38)]
    assert eased.cycles_between(0.301, 0.405) == [38, 39, 42, 45, 48]
    assert eased.cycles_between(0.405, 1.0) == [51]


def test_at_ease_one_state_is_told_of_so_many_cycles_as_the_daemon_says(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    eased = Eased(daemon, monkeypatch, (0.101, Ease(5)), (0.225, Heartbeat()), (0.301, Ease(5)), (0.405, Disconnect()))
    # While the robot is made ready something happens in each cycle, then nothing: every third, and every fifth.
    assert eased.told_between(-0.001, 0.101) == [0, 1, 2, 5, 8, 10]
    # Of those that are gone through the first in each five; then as before.
    assert eased.told_between(0.101, 0.225) == [15, 21, 27]
    assert eased.told_between(0.225, 0.301) == [30, 33, 35]
    assert eased.told_between(0.301, 0.405) == [42, 45]
    assert eased.told_between(0.405, 1.0) == [51]


def test_a_command_at_ease_is_carried_out_when_it_comes_and_ends_the_ease(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    told_s: list[float] = []

    class Told(TimedArm):
        def wrist(self, command: WristSpeed) -> bool:
            told_s.append(child.time.monotonic())
            return super().wrist(command)

    eased = Eased(
        daemon, monkeypatch,
        (0.1, Enable()), (0.101, Ease(5)), (0.203, WristSpeed(0.1, 4.0)), (0.204, Ease(5)), (0.3, Disconnect()),
        arm=Told(),
    )  # fmt: skip
    assert told_s[0] == pytest.approx(1000.203, abs=1e-9)
    # It turns: at ease or not, each cycle is gone through, but slow as it is not each is told.
    assert eased.cycles_between(0.201, 0.3) == [*range(26, 38)]
    assert eased.told_between(0.201, 0.3) == [26, 29, 30, 33, 35]
    assert all(state.motion == "wrist" for state in eased.states if 26 <= state.cycle < 38)


def test_for_a_command_soon_after_a_cycle_the_arm_is_not_read_again(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    eased = Eased(daemon, monkeypatch, (0.041, Enable()), (0.051, Enable()), (0.065, Disconnect()))
    assert eased.arm.read_s[5:9] == pytest.approx([0.04, 0.048, 0.051, 0.056])


@pytest.mark.parametrize("eased_s", [0.301 + 0.008 * number for number in range(6)])
def test_at_ease_the_robot_is_told_something_within_a_quarter_of_its_watchdogs_patience(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, eased_s: float
) -> None:
    """Whichever cycle was the last one before: the next that is gone through may be three away."""
    told_s: list[float] = []

    class Told(TimedArm):
        def hear(self, call: str) -> None:
            told_s.append(child.time.monotonic())
            super().hear(call)

    said = (0.1, Enable()), (0.105, WristSpeed(0.1, 4.0)), (0.2, Stop(4.0)), (eased_s, Ease(5)), (0.6, Disconnect())
    Eased(daemon, monkeypatch, *said, arm=Told())
    assert max(later - earlier for earlier, later in pairwise(told_s)) < 0.0241


@pytest.mark.parametrize("stopped_s", [0.2001, 0.2005, 0.2079])
def test_a_stop_that_the_readings_tell_later_than_the_commands_is_told_as_what_it_is(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, stopped_s: float
) -> None:
    class Late(TimedArm):
        def wrist(self, command: WristSpeed) -> bool:
            self.takes = child.time.monotonic() < 1000.0 + stopped_s
            return super().wrist(command)

        def read(self) -> RtdeSample:
            if child.time.monotonic() > 1000.003 + stopped_s and self.reading.safety_mode == 1:
                self.protective_stop()
            return super().read()

    speeds = [(0.1005 + 0.008 * number, WristSpeed(0.1, 4.0)) for number in range(20)]
    eased = Eased(daemon, monkeypatch, (0.1, Enable()), *speeds, (0.3, Disconnect()), arm=Late())
    assert {state.blocked[:15] for state in eased.states if state.cycle > 15} == {"", "Protective stop"}
    assert {state.motion for state in eased.states if state.blocked} == {"idle"}


def test_an_arm_that_is_moved_is_watched_in_every_cycle(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever moves it: at ease it takes one of the fewer cycles to be seen, and each one from then on."""

    class Moved(TimedArm):
        def cycle(self) -> None:
            super().cycle()
            self.be(qd_rad_per_s=(0.0,) * 5 + (0.01 * (child.time.monotonic() > 1000.201),))

    eased = Eased(daemon, monkeypatch, (0.101, Ease(5)), (0.301, Disconnect()), arm=Moved())
    assert eased.cycles_between(0.101, 0.301) == [13, 15, 18, 21, 24, *range(27, 38)]
    assert eased.told_between(0.101, 0.301) == [15, 21, 27, 30, 33, 35]


@pytest.mark.parametrize(("rad_per_s", "gaps"), [(0.5, {1}), (0.2, {1, 2}), (0.05, {2, 3})])
def test_the_faster_a_wrist_turns_the_more_of_its_cycles_are_told(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, rad_per_s: float, gaps: set[int]
) -> None:
    eased = Eased(daemon, monkeypatch, (0.1, Enable()), (0.2, WristSpeed(rad_per_s, 4.0)), (0.5, Disconnect()))
    # As fast as it was told, until the command has to be given anew.
    turning = [state for state in eased.states if 1000.35 < state.t_mono_ns / 1e9 < 1000.48]
    assert {round(state.qd_rad_per_s[5], 9) for state in turning} == {rad_per_s}
    assert {later.cycle - earlier.cycle for earlier, later in pairwise(turning)} == gaps


@pytest.mark.parametrize("cycle", [31, 32, 34])
def test_what_happens_is_told_in_the_cycle_that_sees_it(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, cycle: int
) -> None:
    """Of a wrist so slow that not each is told."""

    class Stopping(TimedArm):
        def read(self) -> RtdeSample:
            if child.time.monotonic() > 1000.0 + 0.008 * cycle - 1e-6 and self.reading.safety_mode == 1:
                self.protective_stop()
            return super().read()

    said = (0.1, Enable()), (0.2, WristSpeed(0.01, 4.0)), (0.3, Disconnect())
    eased = Eased(daemon, monkeypatch, *said, arm=Stopping())
    assert next(state.cycle for state in eased.states if state.protective_stop) == cycle


def test_what_happened_while_the_daemon_did_not_read_is_told_as_soon_as_it_does(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the cycles that see it first two cannot be told; then the next is, and not only the third one."""
    send, lost = daemon.pipe.send_latest, list[int]()

    class Reduced(TimedArm):
        def read(self) -> RtdeSample:
            super().read()
            if self.reading.t_mono_ns > 1000.24e9 - 1e3:
                self.be(safety_mode=2)
            return self.reading

    def send_latest(state: RobotState) -> bool:
        if state.safety_mode == 2 and len(lost) < 2:
            lost.append(state.cycle)
            return False
        return send(state)

    monkeypatch.setattr(daemon.pipe, "send_latest", send_latest)
    said = (0.1, Enable()), (0.2, WristSpeed(0.01, 4.0)), (0.4, Disconnect())
    eased = Eased(daemon, monkeypatch, *said, arm=Reduced())
    assert lost == [30, 31]
    assert next(state.cycle for state in eased.states if state.safety_mode == 2) == 32


def test_robot_that_is_made_ready_no_more_is_told_at_once_however_soon(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Announced as being made ready, and given up in the same cycle: all is as before the announcement."""
    arm = TimedArm()
    arm.be(robot_mode=3)
    given_up = CommandHandler.tick

    def tick(pilot: CommandHandler, reading: RtdeSample, now_ns: int) -> tuple[int, CommandReply] | None:
        if now_ns > 1000.1e9 and pilot._recovery is not None:
            pilot._recovery.give_up("Nobody waits for it.")
        return given_up(pilot, reading, now_ns)

    monkeypatch.setattr("shearloop.drivers.ur.command_handler.CommandHandler.tick", tick)
    eased = Eased(daemon, monkeypatch, (0.201, Unlock()), (0.4, Disconnect()), arm=arm)
    ready = [state for state in eased.states if 1000.195 < state.t_mono_ns / 1e9 < 1000.3]
    announced = next(number for number, state in enumerate(ready) if state.recovering)
    assert not ready[announced + 1].recovering
    assert ready[announced + 1].cycle == ready[announced].cycle
