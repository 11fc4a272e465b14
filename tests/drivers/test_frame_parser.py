from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.io import loadmat

from shearloop.bank.channels import PAPER_TABLE
from shearloop.drivers import eit_kit
from shearloop.drivers.eit_kit import ADC_STEP_V, FULL_SCALE_SINE_RMS_V, Frame, FrameErrorKind, FrameParser
from shearloop.drivers.frame_clock import LATE_NS, PERIOD_WINDOW
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.emulators.boards import format_line
from tests.slices import slices

PERIOD_NS = eit_kit.NOMINAL_PERIOD_NS


def noisy(n: int) -> list[NDArray[np.float64]]:
    steps = np.random.default_rng(0).integers(1, 300, (n, len(PAPER_TABLE.line_slots)))
    return [PAPER_TABLE.line_of_channels(row * ADC_STEP_V) for row in steps]


LINES = [format_line(line) for line in noisy(4)]
GOOD = LINES[0]


def with_value(position: int, value: bytes) -> bytes:
    values = GOOD.split(b", ")
    values[position] = value
    return b", ".join(values)


# Each kind of refusal, and a way to earn it.
CHANNEL, SLOT = int(PAPER_TABLE.line_slots[500]), int(np.flatnonzero(PAPER_TABLE.zero_slots)[60])
BROKEN = [
    (FrameErrorKind.TOO_LONG, b"0.1234, " * 5000 + b"\n"),
    (FrameErrorKind.WRONG_COUNT, GOOD[:4321] + b"\n"),
    (FrameErrorKind.WRONG_COUNT, GOOD[8:]),
    (FrameErrorKind.WRONG_COUNT, b"0.1234, " + GOOD),
    (FrameErrorKind.WRONG_COUNT, GOOD[:-3] + b"\n"),
    (FrameErrorKind.WRONG_COUNT, b"Board Initialized\n"),
    (FrameErrorKind.WRONG_COUNT, b"\n"),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, b"0.1x34")),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, b"1_0.00")),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, b" 0.123")),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, b"0.12")),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, b"1.2e-1")),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, b"inf")),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, "0.١٢٣٤".encode())),
    (FrameErrorKind.NAN, with_value(CHANNEL, b"nan")),
    (FrameErrorKind.NAN, with_value(CHANNEL, b"-NaN")),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, b"-0.1234")),
    (FrameErrorKind.OUT_OF_RANGE, with_value(CHANNEL, b"9.1234")),
    (FrameErrorKind.NOT_A_NUMBER, with_value(CHANNEL, b"10.1234")),
    (FrameErrorKind.NONZERO_SLOT, with_value(SLOT, b"0.0021")),
]


def test_a_line_is_read_to_the_last_digit():
    frame, other = FrameParser(PAPER_TABLE.zero_slots).feed(GOOD + LINES[1], 5_000_000_000)
    expected = [float(value) for value in GOOD.decode().split(", ")[:-1]]
    assert frame.raw.tolist() == expected, "the same doubles that float() reads"
    np.testing.assert_array_equal(frame.channels, PAPER_TABLE.channels_of_line(frame.raw))
    assert (frame.seq, other.seq) == (0, 1)
    assert frame.t_arrival_ns == other.t_arrival_ns == 5_000_000_000
    assert other.t_mid_ns == 5_000_000_000 - eit_kit.TRANSFER_NS - PERIOD_NS // 2
    assert frame.t_mid_ns == other.t_mid_ns - PERIOD_NS
    assert not frame.saturated.any()
    assert not frame.dead.any()
    with pytest.raises(ValueError, match="read-only"):
        frame.channels[0] = 1.0


def test_carriage_returns_are_taken_as_part_of_the_line_end():
    frames = FrameParser(PAPER_TABLE.zero_slots).feed(GOOD.replace(b"\n", b"\r\n") * 2, 0)
    assert [format_line(frame.raw) for frame in frames] == [GOOD, GOOD]


def test_each_kind_of_broken_line_is_refused_and_named_and_the_next_is_unaffected():
    # A whole frame that comes too soon has a test of its own.
    assert {kind for kind, _ in BROKEN} == {*FrameErrorKind} - {FrameErrorKind.TOO_SOON}
    for kind, broken in BROKEN:
        parser = FrameParser(PAPER_TABLE.zero_slots)
        frames = parser.feed(GOOD + broken + LINES[1], 0)
        assert dict(parser.errors) == {kind: 1}, broken[:20]
        assert [format_line(frame.raw) for frame in frames] == [GOOD, LINES[1]]
        assert kind.value in parser.refusal.cause
        assert len(parser.refusal.clause) < 600


@pytest.mark.parametrize("silent", [[500], range(56), range(896)])
def test_a_channel_that_reads_0_is_dead_in_that_frame_and_refuses_no_other(silent):
    line = noisy(1)[0]
    line[PAPER_TABLE.line_slots[list(silent)]] = 0.0
    parser = FrameParser(PAPER_TABLE.zero_slots)
    before, frame, after = parser.feed(LINES[1] + format_line(line) + LINES[2], 0)
    assert not parser.errors
    assert np.flatnonzero(frame.dead).tolist() == list(silent)
    assert format_line(frame.raw) == format_line(line)
    assert not before.dead.any()
    assert not after.dead.any()


def test_a_refusal_says_which_value_it_was():
    refusal = eit_kit.read_line(with_value(CHANNEL, b"-0.1234").rstrip(b"\n"), PAPER_TABLE.zero_slots)
    assert refusal.position == CHANNEL
    assert f"refused '-0.1234' at value {CHANNEL + 1}" in refusal.hint(1).cause


@given(st.data())
def test_a_line_with_any_one_byte_changed_is_refused_or_reads_as_another_number(data):
    position = data.draw(st.integers(0, len(GOOD) - 2))
    byte = data.draw(st.integers(0, 255).filter(lambda byte: byte != GOOD[position] and byte != ord("\n")))
    changed = GOOD[:position] + bytes([byte]) + GOOD[position + 1 :]
    parser = FrameParser(PAPER_TABLE.zero_slots)
    frames = parser.feed(LINES[1] + changed + LINES[2], 0)
    eit_kit.read_line(changed.rstrip(b"\n"), PAPER_TABLE.zero_slots)
    is_digit = chr(byte).isdigit() and byte < 128 and chr(GOOD[position]).isdigit()
    assert len(frames) + parser.errors.total() == 3
    assert [format_line(frames[0].raw), format_line(frames[-1].raw)] == LINES[1:3]
    assert is_digit or parser.errors.total() == 1


@given(st.lists(st.one_of(st.sampled_from(LINES), st.sampled_from([b for _, b in BROKEN])), max_size=12), st.data())
def test_every_good_line_among_broken_ones_arrives_and_every_broken_one_is_counted(lines, data):
    stream = GOOD + b"".join(lines)
    cuts = data.draw(st.lists(st.integers(0, len(stream)), max_size=10))
    parser = FrameParser(PAPER_TABLE.zero_slots)
    # Each part is read when all of its frames can have been sent.
    frames = [frame for n, part in enumerate(slices(stream, cuts)) for frame in parser.feed(part, 20 * n * PERIOD_NS)]
    assert [format_line(frame.raw) for frame in frames] == [GOOD, *[line for line in lines if line in LINES]]
    assert parser.errors.total() == len(lines) + 1 - len(frames)


@given(st.binary(max_size=3000), st.integers(1, 300))
def test_garbage_never_yields_a_frame_nor_grows_the_parser(garbage, times):
    parser = FrameParser(PAPER_TABLE.zero_slots)
    for _ in range(times):
        assert parser.feed(garbage, 0) == []
        assert len(parser.unfinished) <= eit_kit.MAX_LINE_BYTES
    parser.feed(b"\n", 0)
    assert [format_line(frame.raw) for frame in parser.feed(GOOD, 0)] == [GOOD]


@given(st.integers(1, 1024 * eit_kit.CELL_BYTES))
def test_the_rest_of_a_line_that_was_under_way_is_no_error(start):
    parser = FrameParser(PAPER_TABLE.zero_slots)
    assert len(parser.feed(GOOD[start:] + LINES[1], 0)) == 1
    assert not parser.errors


def test_a_whole_line_that_is_broken_is_refused_even_as_the_first():
    parser = FrameParser(PAPER_TABLE.zero_slots)
    parser.feed(with_value(CHANNEL, b"nan"), 0)
    assert dict(parser.errors) == {FrameErrorKind.NAN: 1}


def test_another_port_drops_the_line_that_was_cut_off():
    parser = FrameParser(PAPER_TABLE.zero_slots)
    parser.feed(GOOD + LINES[1][:3000], 0)
    parser.handle(RawEvent(InputKind.OPENED, PERIOD_NS))
    frames = parser.feed(LINES[2], 2 * PERIOD_NS)
    assert [(format_line(frame.raw), frame.seq) for frame in frames] == [(LINES[2], 1)]
    assert not parser.errors


def test_frames_that_waited_together_are_stamped_a_period_apart():
    parser = FrameParser(PAPER_TABLE.zero_slots)
    for number in range(30):
        parser.feed(LINES[number % 2], number * PERIOD_NS)
    # The reader was away from frame 30 to shortly after frame 34.
    late = parser.feed(b"".join(LINES) + LINES[0], 34 * PERIOD_NS + 1_000_000)
    assert {frame.t_arrival_ns for frame in late} == {34 * PERIOD_NS + 1_000_000}
    middles = [(frame.t_mid_ns + eit_kit.TRANSFER_NS) / PERIOD_NS for frame in late]
    assert middles == pytest.approx([29.5, 30.5, 31.5, 32.5, 33.5], abs=0.01)


def test_frames_that_waited_and_are_read_one_by_one_are_stamped_a_period_apart():
    parser = FrameParser(PAPER_TABLE.zero_slots)
    for number in range(30):
        parser.feed(LINES[number % 2], number * PERIOD_NS)
    middles = []
    # The reader was away from frame 30 to shortly after frame 35; then all is as before.
    for number in range(30, 40):
        t_ns = max(number * PERIOD_NS, 35 * PERIOD_NS + number * 1_000_000)
        if number < 36:
            parser.handle(RawEvent(InputKind.WAITED, t_ns, str(29 * PERIOD_NS + 1).encode()))
        (frame,) = parser.handle(RawEvent(InputKind.DATA, t_ns, LINES[number % 2]))
        middles.append((frame.t_mid_ns + eit_kit.TRANSFER_NS) / PERIOD_NS)
    assert middles == pytest.approx(np.arange(29.5, 39.5), abs=0.01)


def opened_at(t_ns: int) -> FrameParser:
    parser = FrameParser(PAPER_TABLE.zero_slots)
    parser.handle(RawEvent(InputKind.OPENED, t_ns))
    return parser


@pytest.mark.parametrize("apart_ns", [0, 1_000_000, 34_000_000])
def test_frames_that_waited_before_the_port_was_opened_are_dropped(apart_ns):
    """Nine frames of a sender's full queue came within 0.3 s. Each had the age of a new one, and they made a period."""
    opened_ns = 1_000 * PERIOD_NS
    parser = opened_at(opened_ns)
    frames = parser.feed(GOOD[5000:], opened_ns + 500_000)
    for number in range(9):
        frames += parser.feed(LINES[number % 4], opened_ns + 1_000_000 + number * apart_ns)
    assert frames == []
    assert not parser.errors, "as a cut line at the opening is none"
    # The first one that is sent now comes at most a period after the last one that waited.
    first_ns = opened_ns + round(0.9 * PERIOD_NS)
    for number in range(60):
        frames += parser.feed(LINES[number % 4], first_ns + number * PERIOD_NS)
    assert np.diff([frame.t_mid_ns for frame in frames]) == pytest.approx(PERIOD_NS, abs=100)
    assert frames[0].t_arrival_ns <= first_ns + PERIOD_NS
    assert parser.clock.period_ns == pytest.approx(PERIOD_NS, rel=1e-6)


def test_what_waited_before_the_opening_is_dropped_when_it_is_read_late_and_at_once():
    opened_ns = 1_000 * PERIOD_NS
    parser, read_ns = opened_at(opened_ns), opened_ns + round(0.7 * PERIOD_NS)
    parser.handle(RawEvent(InputKind.WAITED, read_ns, str(opened_ns).encode()))
    assert parser.handle(RawEvent(InputKind.DATA, read_ns, GOOD + LINES[1])) == []
    parser = opened_at(opened_ns)
    assert parser.feed(b"".join(LINES), opened_ns + 3 * PERIOD_NS) == [], "four frames take four periods"


def test_the_first_frame_of_a_board_that_was_just_started_counts():
    parser = opened_at(0)
    assert len(parser.feed(GOOD, PERIOD_NS)) == 1


@pytest.mark.parametrize("late_s", [0.0, 0.19])
@pytest.mark.parametrize("period_s", [0.027, 0.05, 0.1, 0.2, 0.26])
def test_a_board_that_is_faster_than_configured_loses_no_frame(period_s, late_s):
    """Its period is learned also where its reader is late at times: a frame cannot arrive before it was sent."""
    chance = np.random.default_rng(1)
    parser, period_ns = opened_at(0), round(period_s * 1e9)
    sent_ns = period_ns * np.arange(1, 400)
    read_ns = np.maximum.accumulate(sent_ns + (chance.uniform(0.0, late_s, len(sent_ns)) * 1e9).astype(int))
    frames = [frame for n, t_ns in enumerate(read_ns) for frame in parser.feed(LINES[n % 4], int(t_ns))]
    dropped = parser.dropped_at_opening
    assert len(frames) + dropped + parser.errors.total() == len(sent_ns)
    assert parser.errors.total() <= 0.05 * len(sent_ns)
    if late_s == 0.0:
        assert parser.clock.period_ns == pytest.approx(period_ns, rel=1e-3)
        assert np.diff([frame.t_mid_ns for frame in frames[50:]]) == pytest.approx(period_ns, rel=0.01)


def test_frames_of_one_board_are_never_closer_than_half_a_period():
    """A burst of frames after a standstill of their sender: four had one time, and the next was 0.03 s later."""
    parser, frames = FrameParser(PAPER_TABLE.zero_slots), []
    for number in range(30):
        frames += parser.feed(LINES[number % 2], number * PERIOD_NS)
    back_ns = 60 * PERIOD_NS
    for number in range(5):
        frames += parser.feed(LINES[number % 4], back_ns + number * 1_000_000)
    for number in range(30):
        frames += parser.feed(LINES[number % 2], back_ns + 31_000_000 + number * PERIOD_NS)
    assert np.diff([frame.t_mid_ns for frame in frames]).min() > 0.5 * PERIOD_NS
    assert parser.errors == {FrameErrorKind.TOO_SOON: 5}
    assert "refused a frame less than half a period after the one before" in parser.refusal.cause
    assert f"where one comes every {PERIOD_NS / 1e9:.2g} s" in parser.refusal.cause
    assert [frame.seq for frame in frames] == list(range(len(frames)))
    assert parser.clock.period_ns == pytest.approx(PERIOD_NS, rel=1e-6)


def settled(period_ns: int = PERIOD_NS, n: int = 40) -> FrameParser:
    """Return a parser that has learned a board's period, from frames 0 to n - 1."""
    parser = FrameParser(PAPER_TABLE.zero_slots, nominal_period_ns=period_ns)
    for number in range(n):
        parser.feed(LINES[number % 4], number * period_ns)
    assert parser.clock.learned_from
    return parser


def sent_ns_of(frame: Frame, parser: FrameParser) -> int:
    return frame.t_mid_ns + eit_kit.TRANSFER_NS + parser.clock.period_ns // 2


@pytest.mark.parametrize("reopened", [False, True])
@given(st.lists(st.floats(0.0, 0.9), min_size=1, max_size=40), st.sampled_from([0.027, 0.1, 0.26, 0.5412, 2.0]))
@example([0.75] * 2 + [0.5] * 4 + [0.25] * 2 + [0.0] * 8, 0.5412)
@example([0.9] * 4 + [0.6] * 4 + [0.3] * 4 + [0.0] * 28, 2.0)
def test_no_frame_is_lost_that_comes_late_by_what_a_busy_computer_delays_it(reopened, delays, period_s):
    """Its reader was not away. Two frames that were late by more than half a period counted as a board that paused."""
    period_ns, first = round(period_s * 1e9), PERIOD_WINDOW
    parser = settled(period_ns, first)
    if reopened:
        first += 20
        # The first frame is as new as it seems: it comes half a period after the opening.
        parser.handle(RawEvent(InputKind.OPENED, (first - 1) * period_ns))
    truth = period_ns * np.arange(first, first + len(delays))
    read = np.maximum.accumulate(truth + (np.array(delays) * LATE_NS).astype(int))
    frames = [frame for n, t_ns in enumerate(read.tolist()) for frame in parser.feed(LINES[n % 4], t_ns)]
    assert not parser.errors
    assert len(frames) + parser.dropped_at_opening == len(delays)
    sent = np.array([sent_ns_of(frame, parser) for frame in frames])
    late = sent - truth[len(truth) - len(sent) :]
    assert late.min() > -0.06 * LATE_NS, "as the period is learned from late frames"
    assert late.max() < LATE_NS


@pytest.mark.parametrize("seed", range(5))
def test_frames_that_a_busy_computer_delivers_late_have_the_times_of_their_board(seed):
    """At most 0.5 s late: one in thirty was refused, and its neighbour had the time of its delivery."""
    truth = PERIOD_NS * np.arange(40, 240)
    late_ns = np.random.default_rng(seed).uniform(0.0, LATE_NS, len(truth)).astype(int)
    parser = settled()
    read = np.maximum.accumulate(truth + late_ns)
    frames = [frame for n, t_ns in enumerate(read.tolist()) for frame in parser.feed(LINES[n % 4], t_ns)]
    assert (len(frames), dict(parser.errors)) == (len(truth), {})
    sent = np.array([sent_ns_of(frame, parser) for frame in frames])
    assert abs(sent - truth).max() < 0.5 * LATE_NS
    assert np.diff(sent).min() > 0.5 * PERIOD_NS


@given(st.integers(3, 30), st.lists(st.floats(0.0, 0.49), min_size=1, max_size=9))
def test_of_frames_that_waited_at_their_sender_for_long_none_passes_for_a_new_one(periods, gaps):
    """None that tells: the first one comes as after a pause, and a second one may follow a first one that was late."""
    parser = settled()
    t_ns = (40 + periods) * PERIOD_NS
    passed = len(parser.feed(GOOD, t_ns))
    for number, gap in enumerate(gaps):
        t_ns += int(gap * PERIOD_NS)
        passed += len(parser.feed(LINES[number % 4], t_ns))
    fast = not gaps or gaps[0] * PERIOD_NS < PERIOD_NS - LATE_NS
    assert passed == 1 + (not fast)
    # The board goes on: what comes more than half a period later is new.
    live = [len(parser.feed(LINES[n % 4], t_ns + round((n + 0.6) * PERIOD_NS))) for n in range(30)]
    assert live == [1] * 30
    assert parser.refused == len(gaps) + 1 - passed
    assert parser.clock.period_ns == pytest.approx(PERIOD_NS, rel=0.01)


def test_a_recording_that_is_played_fast_to_a_late_reader_loses_no_frame():
    """Its sender waits, and then sends all that waited, one frame after the other."""
    period_ns = round(PERIOD_NS / 100)
    parser = settled(period_ns)
    back_ns = 40 * period_ns + 2 * LATE_NS
    frames = [frame for n in range(300) for frame in parser.feed(LINES[n % 4], back_ns + n * 1_000_000)]
    assert (len(frames), dict(parser.errors)) == (300, {})


def test_a_frame_that_is_too_soon_counts_as_refused_and_does_not_accuse_another_board():
    parser = settled()
    back_ns = 60 * PERIOD_NS
    parser.feed(GOOD, back_ns)
    for number in range(5):
        parser.feed(LINES[number % 4], back_ns + number)
    assert (parser.refused, dict(parser.errors)) == (5, {FrameErrorKind.TOO_SOON: 5})
    parser.feed(b"1.0\n", back_ns + 10)
    assert "A single line like this has lost bytes" in parser.refusal.cause


@given(st.lists(st.tuples(st.integers(1, 3), st.integers(0, 3 * PERIOD_NS)), max_size=25))
def test_the_middles_of_frames_are_in_order_and_before_their_arrival(bursts):
    parser, now_ns, middles = FrameParser(PAPER_TABLE.zero_slots), 0, []
    for number, pause_ns in bursts:
        now_ns += pause_ns
        frames = parser.feed(GOOD * number, now_ns)
        assert all(frame.t_mid_ns < frame.t_arrival_ns for frame in frames)
        middles += [frame.t_mid_ns for frame in frames]
    assert all(a < b for a, b in pairwise(middles))


def flagged(lines: list[NDArray[np.float64]]) -> list[Frame]:
    parser = FrameParser(PAPER_TABLE.zero_slots)
    return [frame for n, line in enumerate(lines) for frame in parser.feed(format_line(line), n * PERIOD_NS)]


def test_a_channel_above_the_largest_sine_the_adc_follows_is_saturated():
    line = noisy(1)[0]
    line[PAPER_TABLE.line_slots[[3, 7]]] = [FULL_SCALE_SINE_RMS_V + ADC_STEP_V, FULL_SCALE_SINE_RMS_V - ADC_STEP_V]
    (frame,) = flagged([line])
    assert np.flatnonzero(frame.saturated).tolist() == [3]


def test_a_channel_that_has_not_changed_for_n_frames_is_dead_until_it_changes(monkeypatch):
    monkeypatch.setattr(eit_kit, "DEAD_AFTER_FRAMES", 4)
    lines = noisy(8)
    for line in lines[:6]:
        line[PAPER_TABLE.line_slots[10]] = 0.5
    frames = flagged(lines)
    dead = [frame.dead[10] for frame in frames]
    assert dead == [False, False, False, True, True, True, False, False]


def test_a_repeated_line_is_flagged_and_makes_no_channel_dead(monkeypatch):
    monkeypatch.setattr(eit_kit, "DEAD_AFTER_FRAMES", 3)
    first, second = noisy(2)
    frames = flagged([first, first, first, first, second])
    assert [frame.repeated for frame in frames] == [False, True, True, True, False]
    assert not any(frame.dead.any() for frame in frames)


def test_the_recorded_frames_pass_and_show_what_the_flags_are_for(shared):
    folder = shared / "recordings" / "streams" / "2024-12-03_16-09"
    right = loadmat(folder / "device1.mat")["Right_Data"][:100, 1:]
    left = loadmat(folder / "device2.mat")["Left_Data"][:, 1:]
    for lines, n_saturated in ((right, 0), (left, 4)):
        frames = flagged(list(lines))
        np.testing.assert_array_equal([frame.raw for frame in frames], lines)
        assert not any(frame.repeated or frame.dead.any() for frame in frames)
        # On the left fingertip both pairs at electrode 4, driven from 4 and from 20, exceed what the ADC can follow.
        assert {int(frame.saturated.sum()) for frame in frames} == {n_saturated}
