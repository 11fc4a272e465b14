import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import loadmat

from shearloop.drivers.connection import AWAY_NS
from shearloop.drivers.frame_clock import FrameClock, slope_below

PERIOD_NS = 541_200_000


def straightened(arrivals_ns: np.ndarray, clock: FrameClock | None = None) -> np.ndarray:
    clock = clock or FrameClock(PERIOD_NS)
    return np.array([clock.arrived(arrival) for arrival in arrivals_ns.tolist()])


def sent(n: int, period_ns: int = PERIOD_NS) -> np.ndarray:
    return 7_000_000_000 + np.arange(n) * period_ns


@pytest.mark.parametrize("period_ns", [PERIOD_NS, PERIOD_NS // 100, PERIOD_NS * 4])
def test_the_jitter_of_a_busy_reader_is_taken_out_at_any_speed(period_ns):
    truth = sent(400, period_ns)
    late = np.random.default_rng(0).exponential(0.03 * period_ns, 400).astype(np.int64)
    clock = FrameClock(PERIOD_NS)
    error = straightened(truth + late, clock) - truth
    assert clock.learned_from
    assert clock.period_ns == pytest.approx(period_ns, rel=1e-3)
    settled = error[40:]
    assert settled.std() < 0.25 * late[40:].std()
    assert abs(settled).max() < 0.25 * late[40:].max()


def test_a_reader_that_was_away_is_late_once_and_then_on_time_again():
    truth = sent(60)
    arrivals = truth.copy()
    # Frames 40 and 41 wait until shortly after frame 41 was sent, and are then read one after the other.
    arrivals[40:42] = truth[41] + np.array([1, 2]) * 1_000_000
    error = straightened(arrivals) - truth
    assert abs(error).max() < 4_000_000


def test_a_refused_line_takes_a_period_too():
    truth = sent(80)
    clock = FrameClock(PERIOD_NS)
    errors = [clock.arrived(int(t), rejected=int(n == 51)) - t for n, t in enumerate(truth) if n != 50]
    assert max(map(abs, errors)) < 1_000_000


@pytest.mark.parametrize(
    ("pause_periods", "wrong_frames"),
    [(0.25, 11), (0.35, 3), (0.6, 3), (0.8, 3), (0.95, 1), (1.4, 1), (2.1, 1), (7.3, 0)],
)
def test_a_board_that_paused_is_followed(pause_periods, wrong_frames):
    truth = sent(80)
    truth[40:] += int(pause_periods * PERIOD_NS)
    error = straightened(truth) - truth
    assert abs(error[:40]).max() < 1_000_000
    assert abs(error[40 + wrong_frames :]).max() < 1_000_000


def test_frames_that_an_emulated_board_sends_late_are_late_and_none_is_missing():
    truth = sent(80)
    arrivals = truth.copy()
    # The computer was busy for five periods; then each waiting frame is read by itself.
    arrivals[40:45] = truth[45] + np.arange(-5, 0) * 1_000_000
    patient = FrameClock(PERIOD_NS, longest_gap=25.0)
    assert abs(straightened(arrivals, patient) - truth).max() < 1_000_000
    assert np.diff(straightened(arrivals)).max() > 5 * PERIOD_NS, "of a real board they may be missing"


def read_between_absences(truth: np.ndarray, absences: list[tuple[int, int]]) -> list[tuple[int, int | None]]:
    """Return when each frame is read, one by one, and since when it may have waited, as a port says it.

    An absence begins at a time in ns and lasts for so long.
    """
    found: list[tuple[int, int | None]] = []
    read_ns = waited_until_ns = empty_ns = since_ns = 0
    for sent_ns in truth.tolist():
        if sent_ns > read_ns:
            # The port is empty: the reader looks until the frame comes, or until it is kept from looking.
            read_ns = sent_ns
            empty_ns = min(
                [sent_ns, *(begin_ns for begin_ns, for_ns in absences if begin_ns <= sent_ns < begin_ns + for_ns)]
            )
        for begin_ns, for_ns in absences:
            if begin_ns <= read_ns < begin_ns + for_ns:
                read_ns = begin_ns + for_ns
        if read_ns - empty_ns > AWAY_NS:
            since_ns, waited_until_ns = empty_ns, read_ns + AWAY_NS
        found.append((read_ns, since_ns if read_ns <= waited_until_ns else None))
        read_ns += 10_000_000
    return found


@given(st.lists(st.tuples(st.integers(25, 60), st.floats(0.25, 20.0)), min_size=1, max_size=4))
def test_frames_that_waited_for_their_reader_keep_the_times_of_a_board_that_was_never_late(stalls):
    """However long the reader was away, and however often: after 1.3 s it counted as a pause of the board."""
    truth = sent(90)
    absences, free_ns = [], 0
    for after, periods in sorted(stalls):
        begin_ns = max(free_ns, int(truth[after]) + 100_000_000)
        free_ns = begin_ns + int(periods * PERIOD_NS)
        absences.append((begin_ns, free_ns - begin_ns))
    clock = FrameClock(PERIOD_NS)
    read = read_between_absences(truth, absences)
    errors_ns = [clock.arrived(t_ns, 0, since) - t for (t_ns, since), t in zip(read, truth.tolist(), strict=True)]
    assert max(map(abs, errors_ns)) < 1_000_000


def test_a_line_that_was_refused_while_the_reader_was_away_takes_one_period():
    truth = sent(80)
    clock = FrameClock(PERIOD_NS)
    read = read_between_absences(truth, [(int(truth[40]) + 100_000_000, 6 * PERIOD_NS)])
    errors_ns = [clock.arrived(t_ns, int(n == 43), since) - truth[n] for n, (t_ns, since) in enumerate(read) if n != 42]
    assert max(map(abs, errors_ns)) < 1_000_000


@pytest.mark.parametrize("periods", [3.3, 5.5, 30.0])
def test_a_board_that_stopped_while_its_reader_was_away_is_followed(periods):
    """A board that is not read blocks once the buffers are full, and goes on when it is read again."""
    truth, capacity = sent(80), 2
    away_ns = int(truth[40]) + 100_000_000
    blocked = truth[40 + capacity] + int(periods * PERIOD_NS)
    truth[41 + capacity :] = blocked + np.arange(80 - 41 - capacity) * PERIOD_NS
    read = read_between_absences(truth, [(away_ns, int(blocked - PERIOD_NS - away_ns))])
    clock = FrameClock(PERIOD_NS)
    errors_ns = [clock.arrived(t_ns, 0, since) - t for (t_ns, since), t in zip(read, truth.tolist(), strict=True)]
    assert max(map(abs, errors_ns)) < 1_000_000


def test_a_board_that_sends_one_frame_after_each_opening_is_stamped():
    """As with a loose cable. Its later connections are of the same clock."""
    clock, t_ns = FrameClock(PERIOD_NS), 0
    for _ in range(20):
        clock.restart()
        t_ns += 3 * PERIOD_NS
        assert clock.arrived(t_ns) == t_ns
    truth = t_ns + np.arange(1, 60) * PERIOD_NS
    assert abs(straightened(truth, clock) - truth)[20:].max() < 4_000_000


def test_the_period_is_learned_although_every_fourth_frame_waits():
    """A search that takes longer than the reader may be away."""
    period_ns = round(1.02 * PERIOD_NS)
    truth = sent(200, period_ns).tolist()
    clock = FrameClock(PERIOD_NS)
    errors_ns = [
        clock.arrived(t_ns + 250_000_000, 0, t_ns) - t_ns if n % 4 == 3 else clock.arrived(t_ns) - t_ns
        for n, t_ns in enumerate(truth)
    ]
    assert clock.learned_from
    assert max(map(abs, errors_ns[80:])) < 1_000_000


def test_frames_that_all_wait_are_stamped_by_their_arrivals_in_the_end():
    period_ns = round(1.02 * PERIOD_NS)
    truth = sent(300, period_ns).tolist()
    clock = FrameClock(PERIOD_NS)
    errors_ns = [clock.arrived(t_ns + 250_000_000, 0, t_ns - 10_000_000) - t_ns for t_ns in truth]
    assert max(map(abs, errors_ns[150:])) < 260_000_000


def test_a_frame_after_lost_bytes_has_the_time_of_its_arrival():
    """A full buffer joins two lines, and the number of lines between them is unknown."""
    truth = sent(80).tolist()
    clock = FrameClock(PERIOD_NS)
    for t_ns in truth[:40]:
        clock.arrived(t_ns)
    back_ns = truth[60] - 1_000_000
    for n in range(40, 48):
        assert clock.arrived(back_ns, 0, truth[39]) == pytest.approx(truth[n], abs=1_000_000)
    assert clock.arrived(truth[60], None, truth[39]) == truth[60]
    assert clock.arrived(truth[61]) == truth[61]


def test_frames_queued_before_the_first_read_do_not_spoil_the_period():
    truth = sent(80)
    arrivals = np.maximum(truth, truth[5] + 50_000_000 * np.arange(80))
    arrivals[6:] = truth[6:]
    clock = FrameClock(PERIOD_NS)
    error = straightened(arrivals, clock) - truth
    assert clock.period_ns == pytest.approx(PERIOD_NS, rel=1e-3)
    assert abs(error[30:]).max() < 4_000_000


def test_bursts_teach_no_period():
    """A board that is plugged in again and again, with a queue of nine frames each time."""
    clock, t_ns = FrameClock(PERIOD_NS), 0
    for _ in range(8):
        clock.restart()
        for _ in range(9):
            clock.arrived(t_ns := t_ns + 30_000_000)
            assert clock.period_ns == pytest.approx(PERIOD_NS, rel=0.06)
        for _ in range(2):
            clock.arrived(t_ns := t_ns + PERIOD_NS)
            assert clock.period_ns == pytest.approx(PERIOD_NS, rel=0.06)


def test_late_frames_that_are_read_together_are_late_and_the_board_has_not_paused():
    truth = sent(80)
    clock = FrameClock(PERIOD_NS, longest_gap=25.0)
    straightened(truth[:40], clock)
    # The emulated board was kept waiting for five periods; then two frames are read at a time.
    times = [clock.arrived(int(truth[45]) - 1_000_000, behind=1 - n % 2) for n in range(40, 46)]
    times += straightened(truth[46:], clock).tolist()
    assert np.abs(np.array(times) - truth[40:]).max() < 2_000_000


def test_another_speed_after_a_restart_is_learned():
    clock = FrameClock(PERIOD_NS)
    straightened(sent(50), clock)
    clock.restart()
    fast = 100_000_000_000 + np.arange(60) * 5_412_000
    error = straightened(fast, clock) - fast
    assert clock.period_ns == pytest.approx(5_412_000, rel=1e-3)
    assert abs(error[30:]).max() < 100_000


@pytest.mark.parametrize("ratio", [0.9, 1.02, 1.03, 1.05, 1.1, 1.2])
def test_a_slightly_slower_or_faster_board_after_a_restart_is_learned(ratio):
    """With the period of before, the slower board seems to pause again and again."""
    clock = FrameClock(PERIOD_NS)
    straightened(sent(100), clock)
    clock.restart()
    truth = 100_000_000_000 + round(ratio * PERIOD_NS) * np.arange(200)
    error = straightened(truth + np.random.default_rng(0).integers(0, 4_000_000, 200), clock) - truth
    assert clock.period_ns == pytest.approx(ratio * PERIOD_NS, rel=1e-3)
    assert abs(error[150:]).max() < 4_000_000


@given(st.lists(st.integers(0, 5_000_000_000), min_size=1, max_size=120))
def test_whatever_comes_a_stamp_is_never_after_the_arrival_and_never_before_the_board_could(gaps):
    clock = FrameClock(PERIOD_NS)
    for arrival in np.cumsum(gaps).tolist():
        stamp = clock.arrived(arrival)
        assert arrival - 3 * max(PERIOD_NS, clock.period_ns) <= stamp <= arrival
        assert clock.period_ns >= 0


@given(st.lists(st.floats(0, 1e9), min_size=2, max_size=60))
def test_the_slope_is_that_of_the_best_line_below(heights):
    points = list(enumerate(round(height) for height in heights))
    n, t = np.array(points, float).T
    slope = slope_below(points)
    # The oracle: of all lines through two points and below the rest, the one with the least total distance.
    best = min(
        (t - s * n - (t - s * n).min()).sum()
        for (a, ta) in points
        for (b, tb) in points[a + 1 :]
        for s in [(tb - ta) / (b - a)]
    )
    assert (t - slope * n - (t - slope * n).min()).sum() == pytest.approx(best, rel=1e-6, abs=1e-2)


def test_the_stamps_of_a_recording_are_straightened(shared):
    folder = shared / "recordings" / "streams" / "2024-12-03_16-09"
    for name, variable in (("device1.mat", "Right_Data"), ("device2.mat", "Left_Data")):
        days = loadmat(folder / name)[variable][:, 0]
        arrivals = np.round((days - days[0]) * 86_400e9).astype(np.int64)
        points = [(n, int(t)) for n, t in enumerate(arrivals)]
        board = slope_below(points) * np.arange(len(points))
        stamps = straightened(arrivals)
        before = (arrivals - board)[16:] / 1e6
        after = (stamps - board)[16:] / 1e6
        assert before.std() > 15, "as recorded: milliseconds off the board's steady pace"
        assert after.std() < 2.1
        assert np.ptp(before) > 300
        assert np.ptp(after) < 12
        assert np.diff(before).std() > 20
        assert np.diff(after).std() < 1
