"""Boards that send a line each period: late lines are none missing and keep their times, and lost ones are counted."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.line_clock import LATE_ARRIVALS, LEARN_FROM, PHASE_ARRIVALS, LineClock
from shearloop.drivers.load_cell import LoadCalibration, LoadParser
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.drivers.shear_skin.instruments import PairParser

PERIOD_NS = 100_000_000
STALL = st.tuples(st.floats(0.0, 12.0), st.floats(0.0, 8.0))


def sent(n: int, period: float = 1.0) -> list[int]:
    return [7_000_000_000 + round(number * period * PERIOD_NS) for number in range(n)]


def read_between(sent_ns: Sequence[int], stalls: Sequence[tuple[float, float]]) -> list[int]:
    """Return when a process reads each line that stands still now and then.

    A stall follows the one before by a number of periods, and lasts for some.
    """
    read_ns, begin_ns = list(sent_ns), sent_ns[0]
    for after, periods in stalls:
        begin_ns += int(after * PERIOD_NS)
        end_ns = begin_ns + int(periods * PERIOD_NS)
        read_ns = [end_ns if begin_ns <= t_ns < end_ns else t_ns for t_ns in read_ns]
        begin_ns = end_ns
    return read_ns


def straightened(clock: LineClock, read_ns: Sequence[int]) -> tuple[list[int], list[int]]:
    """Return the times and the missing lines of lines that are read then; those of one time are read together."""
    found = [
        clock.arrived(t_ns, waiting)
        for t_ns, together in groupby(read_ns)
        for waiting in reversed(range(len(list(together))))
    ]
    times_ns, missing = zip(*found, strict=True)
    return list(times_ns), list(missing)


@given(st.lists(STALL, max_size=40), st.sampled_from([0.9, 1.0, 1.004, 1.3]))
def test_lines_that_wait_for_a_busy_process_are_none_missing(stalls, period):
    _, missing = straightened(LineClock(PERIOD_NS), read_between(sent(300, period), stalls))
    assert sum(missing) == 0


@pytest.mark.long
@given(st.lists(st.floats(0.0, 5.0), min_size=300, max_size=300))
def test_lines_that_any_delay_holds_up_in_their_order_are_none_missing(delays):
    arrivals = [t_ns + round(late * PERIOD_NS) for t_ns, late in zip(sent(300), delays, strict=True)]
    _, missing = straightened(LineClock(PERIOD_NS), np.maximum.accumulate(arrivals).tolist())
    assert sum(missing) == 0


@pytest.mark.parametrize("longest", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("seed", range(5))
def test_lines_with_random_delays_are_none_missing(longest, seed):
    late_ns = np.random.default_rng(seed).uniform(0.0, longest * PERIOD_NS, 600).astype(np.int64)
    _, missing = straightened(LineClock(PERIOD_NS), np.maximum.accumulate(np.array(sent(600)) + late_ns).tolist())
    assert sum(missing) == 0


def test_a_stall_within_a_period_moves_no_time():
    truth = sent(300)
    read_ns = read_between(truth, [(8.13, 0.85)] * 25)
    assert sum(t_ns != truth_ns for t_ns, truth_ns in zip(read_ns, truth, strict=True)) >= 15
    times_ns, _ = straightened(LineClock(PERIOD_NS), read_ns)
    assert times_ns == truth


@pytest.mark.long
@given(
    st.lists(st.integers(LEARN_FROM, 460), min_size=1, max_size=4, unique=True),
    st.integers(1, 40),
    st.lists(st.tuples(st.floats(6.0, 30.0), st.floats(0.0, 0.95)), max_size=20),
    st.sampled_from([1.0, 1.05]),
)
def test_lost_lines_are_counted_once_the_schedule_shows_it_also_between_stalls(places, lost, stalls, period):
    gone = {place + number for place in places for number in range(lost)}
    kept = [number for number in range(600) if number not in gone]
    truth = sent(600, period)
    read_ns = read_between(truth, stalls)
    times_ns, missing = straightened(LineClock(PERIOD_NS), [read_ns[number] for number in kept])
    assert sum(missing) == len(gone)
    late = [kept[place] for place, count in enumerate(missing) if count]
    assert all(number - max(one for one in gone if one < number) <= 3 * LATE_ARRIVALS for number in late)
    errors_ns = np.array(times_ns) - [truth[number] for number in kept]
    assert max(abs(errors_ns[-LATE_ARRIVALS:])) < 0.01 * PERIOD_NS


def test_the_time_of_a_line_follows_a_loss_within_a_few_lines():
    truth = sent(100)
    kept = [number for number in range(100) if number != 50]
    times_ns, _ = straightened(LineClock(PERIOD_NS), [truth[number] for number in kept])
    wrong = [number for t_ns, number in zip(times_ns, kept, strict=True) if t_ns != truth[number]]
    assert wrong == list(range(51, 50 + PHASE_ARRIVALS))


def test_lines_are_missing_while_the_port_is_closed_and_no_more_than_that():
    clock = LineClock(PERIOD_NS)
    truth = sent(200)
    straightened(clock, truth[:60])
    clock.restart()
    _, missing = straightened(clock, truth[75:])
    assert (missing[0], sum(missing)) == (15, 15)


def test_before_the_first_line_none_is_missing():
    clock = LineClock(PERIOD_NS)
    clock.restart()
    _, missing = straightened(clock, sent(100))
    assert sum(missing) == 0


@pytest.mark.parametrize("refused", [b"-0.1234\n", b"%%%\n", b"0.12x,0.13\n", b"0.1\n0.2\n"])
def test_a_refused_line_takes_its_period_and_its_reading_is_missing(refused):
    """Also one that was broken in two: two lines are refused, and one reading is missing."""
    parser, found = PairParser(1e9 / PERIOD_NS), []
    for number, t_ns in enumerate(sent(100)):
        data = refused if number == 50 else f"0.123{number % 10},0.126\n".encode()
        found += parser.feed(data, t_ns)
    assert sum(voltages.missed for voltages in found) == 1
    spacings = np.diff([voltages.t_mid_ns for voltages in found])
    assert max(spacings) == pytest.approx(2 * PERIOD_NS, rel=1e-3)
    assert sorted(spacings)[-2] == pytest.approx(PERIOD_NS, rel=1e-3)


def test_a_late_line_of_a_load_cell_has_the_time_of_its_measurement():
    truth = sent(120)
    read_ns = list(truth)
    read_ns[80] += 85_000_000
    calibration = LoadCalibration.of_torque_lines()
    parser = LoadParser(calibration, 1e9 / PERIOD_NS)
    samples = [one for n, t_ns in enumerate(read_ns) for one in parser.feed(f"0.0{10 + n % 7}\n".encode(), t_ns)]
    assert np.ptp(np.array([one.t_mid_ns for one in samples]) - truth) < 1_000


@pytest.mark.parametrize("waited", [False, True])
def test_lines_that_a_late_reader_finds_after_an_opening_may_be_older_than_it(waited):
    """Three lines after a second and a half: without the note that their reader was away, they came just now."""
    parser = LoadParser(LoadCalibration.of_torque_lines(), 1e9 / PERIOD_NS)
    parser.handle(RawEvent(InputKind.OPENED, 0))
    read_ns = 16 * PERIOD_NS
    if waited:
        parser.handle(RawEvent(InputKind.WAITED, read_ns, b"0"))
    found = parser.handle(RawEvent(InputKind.DATA, read_ns, b"0.51\n0.52\n0.53\n"))
    assert (len(found), parser.dropped_at_opening) == ((0, 3) if waited else (3, 0))
    assert len(parser.handle(RawEvent(InputKind.DATA, read_ns + PERIOD_NS, b"0.01\n"))) == 1


def test_lines_that_waited_before_the_port_was_opened_are_dropped():
    """The queue of their sender comes at once. Its lines had the time of the opening."""
    parser = LoadParser(LoadCalibration.of_torque_lines(), 1e9 / PERIOD_NS)
    opened_ns = 5 * PERIOD_NS
    parser.handle(RawEvent(InputKind.OPENED, opened_ns))
    for n in range(9):
        assert parser.feed(b"0.5%d\n" % n, opened_ns + 1_000_000 + n * 5_000_000) == []
    # Four lines take four periods.
    assert parser.feed(b"0.60\n0.61\n0.62\n0.63\n", opened_ns + 2 * PERIOD_NS) == []
    live = [one for n in range(1, 10) for one in parser.feed(b"0.0%d\n" % n, opened_ns + (n + 2) * PERIOD_NS)]
    assert [sample.raw for sample in live] == [n / 100 for n in range(1, 10)]
    assert set(np.diff([sample.t_mid_ns for sample in live])) == {PERIOD_NS}
    assert parser.errors == {}
    # So it is when the board was unplugged and is there again.
    parser.handle(RawEvent(InputKind.OPENED, opened_ns + 20 * PERIOD_NS))
    assert parser.feed(b"0.5\n", opened_ns + 20 * PERIOD_NS + 1_000_000) == []
