"""Delay of the load cell's torques against the frames: late torques teach an estimator the past.

An estimator with a memory of seconds cannot find the delay from its error, because its frames still know the load of a
second ago. A changing load moves the gel within the same frame. So the motion between single frames, along its main
directions, is regressed on the torque's change over the same time at various shifts. The shift that explains most, on
stretches of time left out, is the delay; its uncertainty comes from resampled stretches. Recorded twists give 0.25 to
0.28 s ± 0.02 to 0.06 s, most of it from the load cell's filter, which settles within 0.4 s (HX711 at ten samples a
second). Emulated rigs without the filter give −0.08 to 0.05 s.
"""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.grips import segment_grip
from shearloop.estimation.left_out import left_out_blocks
from shearloop.estimation.series import FrameSeries, check_finite
from shearloop.estimation.twists import find_twists
from shearloop.estimation.validator_fit import channel_noise
from shearloop.estimation.values import TWO_SIDED_95

_STEP_S = 0.06
_SHIFTS_S = np.round(np.arange(-6.0, 6.01, _STEP_S), 2)
# Half width of the parabola through the peak.
_PEAK_S = 0.18
_N_DIRECTIONS = 6
# Ridge penalty: on a stretch without load nothing but noise moves.
_STRENGTH = 1e-3
# Moves are clipped to this many times the median: larger ones come from knocks.
_LARGEST_MOVE = 4.0
# The peak must explain this fraction, and this factor more than any shift this far away. A minute with a single twist
# (`glitch_20241202_173837`) has a chance peak of 0.06 at five seconds.
_MIN_EXPLAINED, _PROMINENCE, _APART_S = 0.1, 1.5, 1.1
# With fewer gripped frames than the first nothing is refused. From the second on a peak this high gives a warning: of
# 1128 stretches of 50 to 59 frames of recordings with correct times one has such a peak elsewhere.
_SURE_FRAMES, _WARN_FRAMES, _WARN_EXPLAINED = 10 * _N_DIRECTIONS, 50, 0.45
# Usual delay of a load cell in its sampling periods: with a filter (an HX711 settles within four; the recorded ones
# have 2.7), without one (at most the mean over a period; negative where a gel moves on after the load, −0.9 on a
# emulated rig), and unknown.
_USUAL_PERIODS: dict[bool | None, tuple[float, float]] = {True: (1.6, 2.7), False: (-1.0, 1.0), None: (-1.0, 2.7)}
# Tolerance of the time stamps.
_STAMPS_S = 0.05
# Standard errors outside of the usual delay that are refused, and the resampling behind them.
_CERTAIN = 1.5
_STRETCH_FRAMES, _DRAWS = 16, 200
# A board never sends faster than its period. In recordings of busy computers 5 to 20 % of the steps are shorter than
# half of the median, in others at most 1.5 %.
_MOST_SHORT = 0.03
# Assumed uncertainty of unchecked times: half a second and the quarter of a filter. With half a second alone, one
# fingertip of a third of the recorded twists still had 23 % of its intervals wrong.
_UNCHECKED_S = 0.75
# The same where one loop read all boards and values waited in a buffer: the paper's loops were 2.4 to 2.8 s late.
_BUFFERED_S = 3.0
# A larger standard error leaves the times open within its 95 % interval; recorded twists have 0.02 to 0.06 s.
_LARGE_ERROR_S = 0.1
# A clock that was set forward leaves a gap that is this much longer than a period, in s; this many gaps are tried.
_GAP_S, _GAPS = 0.3, 5
# Relative rates of the load cell's clock that are tried. A microcontroller's resonator is off by up to 0.5 %.
_RATES = np.round(np.concatenate([np.arange(-0.02, 0.0, 0.001), np.arange(0.001, 0.0201, 0.001)]), 3)
# Corrected times explain the moves better by this factor. With fewer changes of load that can be chance.
_FAULT_PROMINENCE, _MIN_CHANGES = 1.15, 4
# This number of load changes shows a delay where the tool moves the fingertip.
MANY_CHANGES = 10
# Readings per stretch for the load cell's noise, and the least number of stretches.
_NOISE_READINGS, _MIN_QUIET = 64, 4


@dataclass(frozen=True, slots=True)
class LoadDelay:
    """Delay of the torques after the frames' motion in s, its standard error, and the explained fraction of change.

    late_s is the delay beyond the load cell's own one, 0 where that is usual. few_frames is the number of gripped
    frames where they are too few to be sure, else 0.
    """

    delay_s: float
    error_s: float
    explained: float
    late_s: float = 0.0
    few_frames: int = 0

    @property
    def text(self) -> str:
        """The delay as a part of a sentence."""
        apart = f"{abs(self.delay_s):.2f} ± {self.error_s:.2f} s {'before' if self.delay_s > 0 else 'after'}"
        return f"the frames move {apart} the load that moves them is stamped"


@dataclass(frozen=True, slots=True)
class LoadTiming:
    """The series that show the torques' delay, the delay in each, and how far in s the torques may be off unnoticed.

    warnings are doubts about each series' times, empty without any. Without references the user guarantees the timing.
    """

    references: Sequence[FrameSeries] = ()
    delays: Sequence[LoadDelay | None] = ()
    warnings: Sequence[str] = ()
    uncertainty_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class ClockFault:
    """A fault of one clock: its description, its cure, and the corrected times (p,) of the load cell's readings."""

    text: str
    cure: str
    torque_t_s: FloatArray
    is_jump: bool = False


TRUSTED = LoadTiming()


def measure_timing(recordings: Sequence[FrameSeries], others: Sequence[FrameSeries] = ()) -> LoadTiming:
    """Return the timing of the torques of raw recordings: by themselves if any shows it, else by other fingertips'.

    One clock has stamped them all. Another fingertip's board may have been dead, garbled or away: then it shows
    nothing. Raises CalibrationError for a recording without torque, with values that are not finite, or with torques
    clearly stamped at other times than its frames.
    """
    if not recordings:
        return TRUSTED
    check_finite(recordings)
    timed: Sequence[tuple[FrameSeries, LoadDelay | None]] = [
        (recording, find_load_delay(recording)) for recording in recordings
    ]
    if all(delay is None or delay.few_frames for _, delay in timed):
        timed = _sure_delays(others) or timed
    unseen = [] if any(delay for _, delay in timed) else [(other, None) for other in others]
    for recording, delay in [*timed, *unseen]:
        if (fault := find_clock_fault(recording, delay)) is not None:
            raise CalibrationError(
                f"{fault.text}: a calibration would learn the torque of another moment; {fault.cure}"
            )
    sure = [None if delay is None or delay.few_frames else delay for _, delay in timed]
    for (recording, _), delay in zip(timed, sure, strict=True):
        if delay is not None and delay.late_s:
            raise CalibrationError(
                f"{delay.text}, and this load cell's own delay is {delay.delay_s - delay.late_s:.2f} s: a calibration "
                f"would learn the torque of another moment; {_cure(recording, delay)}"
            )
    error_s = min((delay.error_s for delay in sure if delay is not None), default=np.inf)
    uncertainty_s = min(TWO_SIDED_95 * error_s, _UNCHECKED_S) if error_s > _LARGE_ERROR_S else 0.0
    if any(recording.load_doubt for recording in recordings):
        # Another recording's delay says nothing of how long these values waited.
        uncertainty_s = _BUFFERED_S
    return LoadTiming([recording for recording, _ in timed], sure, [_doubt(*pair) for pair in timed], uncertainty_s)


def find_load_delay(series: FrameSeries) -> LoadDelay | None:
    """Return the delay of the torques of raw frames; None where no shift stands out, as with few changes of load.

    It takes up to some tenths of a second. Raises CalibrationError for a recording without torque.
    """
    part = segment_grip(series)[1]
    if (n := len(series.t_s[part])) < _WARN_FRAMES:
        return None
    best = _delay_of(series, part)
    if best is None:
        return None
    return replace(best, late_s=_lateness(series, best), few_frames=0 if n >= _SURE_FRAMES else n)


def _delay_of(series: FrameSeries, part: slice) -> LoadDelay | None:
    """Return the delay in a part of the frames, by the side that shows it best; None where none does."""
    sides = (_delay_of_side(series, part, layer) for layer in range(len(series.sides)))
    return max((delay for delay in sides if delay is not None), key=lambda delay: delay.explained, default=None)


def measured_delay(fingertips: Sequence[FrameSeries]) -> LoadDelay | None:
    """Return the delay in the series of the fingertip that shows it best, None where none is sure."""
    return max((delay for _, delay in _sure_delays(fingertips)), key=lambda one: one.explained, default=None)


def _sure_delays(recordings: Sequence[FrameSeries]) -> list[tuple[FrameSeries, LoadDelay]]:
    """Return the recordings that show a sure delay; others, as of a dead board, are left out."""
    found = []
    for recording in recordings:
        with contextlib.suppress(CalibrationError):
            if (
                np.isfinite(recording.channels).all()
                and (delay := find_load_delay(recording)) is not None
                and not delay.few_frames
            ):
                found.append((recording, delay))
    return found


def load_delay_warning(series: FrameSeries) -> str:
    """Return a doubt about the times of a recording's torques, empty without any."""
    if not np.abs(series.torque_nm).any():
        return ""
    try:
        return _doubt(series, find_load_delay(series))
    except CalibrationError:
        return series.load_doubt


def count_load_changes(series: FrameSeries) -> int:
    """Return how many times the load came and went within the frames."""
    return len(find_twists(np.nan_to_num(series.torque_at_frames())))


def find_clock_fault(series: FrameSeries, found: LoadDelay | None) -> ClockFault | None:
    """Return the jump or the wrong rate of a clock that hides the delay of raw frames, None without one.

    `found` is the delay by `find_load_delay`, without a fault. A fault counts if its corrected times show a delay
    clearly. Frames without a grip, as of a dead board, show none. It takes up to a second.
    """
    if found is not None and found.error_s <= _LARGE_ERROR_S and not found.late_s:
        return None
    if not np.isfinite(series.channels).all() or count_load_changes(series) < _MIN_CHANGES:
        return None
    moves = _moves_in_grip(series)
    best, most = None, _FAULT_PROMINENCE * _most_explained(series, moves)
    for fault in _possible_faults(series):
        timed = replace(series, torque_t_s=fault.torque_t_s)
        # A wrong rate hardly moves the grip that the load shows. A jump may.
        explained = _most_explained(timed, _moves_in_grip(timed) if fault.is_jump else moves)
        if explained > most:
            best, most = fault, explained
    if best is None:
        return None
    delay = measured_delay([replace(series, torque_t_s=best.torque_t_s)])
    return best if delay is not None and delay.error_s <= _LARGE_ERROR_S else None


def _moves_in_grip(series: FrameSeries) -> list[tuple[FloatArray, FloatArray, float]]:
    """Return the frames' moves in the grip by side, as `_moves` does; none without a grip of enough frames."""
    try:
        part = segment_grip(series)[1]
    except CalibrationError:
        return []
    if len(series.t_s[part]) < _SURE_FRAMES:
        return []
    return [_moves(series.t_s[part], series.channels[part, layer]) for layer in range(len(series.sides))]


def _most_explained(series: FrameSeries, moves: Sequence[tuple[FloatArray, FloatArray, float]]) -> float:
    """Return the largest fraction of the load's changes that the moves of a side explain at any delay."""
    found = 0.0
    for of_side in moves:
        total, rest = _squares(series, *of_side, _SHIFTS_S[::2])
        found = max(found, float(_explained(total.sum(axis=0), rest.sum(axis=0)).max()))
    return found


def _possible_faults(series: FrameSeries) -> Iterator[ClockFault]:
    """Yield the faults that are tried: one clock was set forward at a gap of its times, or the clocks' rates differ."""
    times_s = series.torque_t_s
    cure = "use the part before or after that (--time-range), or record again with one clock for both"
    for clock, own_s, sign in (("the load cell's", times_s, -1.0), ("the frames'", series.t_s, 1.0)):
        steps_s = np.diff(own_s)
        period_s = float(np.median(steps_s))
        gaps = np.flatnonzero(steps_s > period_s + _GAP_S)
        for gap in gaps[np.argsort(steps_s[gaps])[::-1][:_GAPS]].tolist():
            jump_s, after_s = float(steps_s[gap]) - period_s, float(own_s[gap] - series.t_s[0])
            text = f"{clock} clock was set forward by {jump_s:.1f} s, {after_s:.0f} s after the first frame"
            moved_s = np.where(times_s > own_s[gap], times_s + sign * jump_s, times_s)
            yield ClockFault(text, cure, moved_s, is_jump=True)
    for rate in _RATES.tolist():
        yield ClockFault(
            f"the load cell's times run {abs(rate):.1%} too {'fast' if rate > 0 else 'slow'} for the frames'",
            "its clock has another rate, or was set on the way, and no delay corrects that: record again with one "
            "clock for both",
            times_s[0] + (times_s - times_s[0]) / (1.0 + rate),
        )


def _doubt(series: FrameSeries, found: LoadDelay | None) -> str:
    """Return why a delay is unusual. With few gripped frames it can be chance: a warning and not a refusal."""
    if (fault := find_clock_fault(series, found)) is not None:
        return f"{fault.text}; {fault.cure}"
    if found is None or (found.few_frames and found.explained < _WARN_EXPLAINED):
        return series.load_doubt
    if not found.late_s:
        return ""
    sure = f" (though {found.few_frames} gripped frames are too few to be sure)" if found.few_frames else ""
    return f"{found.text}{sure}; {_cure(series, found)}"


def _cure(series: FrameSeries, found: LoadDelay) -> str:
    """Return what to do about a delay: a number corrects only one that is the same in all of the recording."""
    if (short := _read_late(series)) > _MOST_SHORT:
        seen = f"{short:.0%} of its frames or readings came in bursts, as they do on a computer that is too busy"
        return f"{seen}, and no delay corrects that: record again while nothing else runs on the computer"
    begin, end, _ = segment_grip(series)[1].indices(len(series.t_s))
    middle = (begin + end) // 2
    halves = [_delay_of(series, half) for half in (slice(begin, middle), slice(middle, end))]
    shown = [half for half in halves if half is not None]
    if found.error_s > _LARGE_ERROR_S or not shown or not all(_agree(half, found) for half in shown):
        differ = " and ".join("none" if half is None else f"{half.delay_s:.2f} s" for half in halves)
        return (
            f"its halves show other delays ({differ}), so that none corrects it: the computer was too busy, or "
            "a clock jumped; record again while nothing else runs on the computer"
        )
    return f"correct the load cell's clock and record again, or calibrate with --load-cell-delay-s {found.late_s:.2f}"


def _agree(one: LoadDelay, other: LoadDelay) -> bool:
    return abs(one.delay_s - other.delay_s) <= _STAMPS_S + TWO_SIDED_95 * float(np.hypot(one.error_s, other.error_s))


def _read_late(series: FrameSeries) -> float:
    """Return the larger fraction of short steps, of the frames or of the readings: what waited is read in bursts.

    They are those of the whole recording: in a quiet part of it the clocks may be off by what waited before.
    """
    t_s = series.t_s if series.whole_t_s is None else series.whole_t_s
    steps = [np.diff(times_s) for times_s in (t_s, series.torque_t_s)]
    return max(float(np.mean(step < 0.5 * np.median(step))) for step in steps if len(step))


def torque_bounds(series: FrameSeries, uncertainty_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest torque (n,) in N·m within the uncertainty before and after each frame."""
    steps = int(np.ceil(uncertainty_s / _STEP_S))
    shifts_s = np.linspace(-uncertainty_s, uncertainty_s, 2 * steps + 1)
    found = [np.interp(series.t_s + shift, series.torque_t_s, series.torque_nm) for shift in shifts_s]
    return np.min(found, axis=0), np.max(found, axis=0)


def _lateness(series: FrameSeries, found: LoadDelay) -> float:
    """Return the delay beyond the load cell's own one in s, 0 for a usual delay."""
    period_s = float(np.median(np.diff(series.torque_t_s)))
    earliest_s, latest_s = (periods * period_s for periods in _USUAL_PERIODS[is_filtered(series.torque_nm)])
    tolerance_s = _STAMPS_S + _CERTAIN * found.error_s
    if earliest_s - tolerance_s <= found.delay_s <= latest_s + tolerance_s:
        return 0.0
    return found.delay_s - (earliest_s + latest_s) / 2


def is_filtered(torque_nm: FloatArray) -> bool | None:
    """Return whether a load cell's noise is filtered, from the quietest quarter of (p,) readings; None if unclear.

    Differences of independent readings correlate by −½ with the next difference. If each reading has half of its time
    in common with the previous reading, they correlate with the difference after the next one. Recorded HX711s have
    −0.07 and −0.34, emulated ones, which have no filter, −0.45 and 0.
    """
    differences = np.diff(torque_nm)
    stretches = differences[: len(differences) // _NOISE_READINGS * _NOISE_READINGS].reshape(-1, _NOISE_READINGS)
    stretches = stretches - stretches.mean(axis=1, keepdims=True)
    power = (stretches**2).mean(axis=1)
    quietest = np.argsort(power)[np.count_nonzero(power == 0) :][: np.count_nonzero(power) // 4]
    if len(quietest) < _MIN_QUIET:
        return None
    quiet = stretches[quietest]
    next_one, one_after = (
        float(np.median((quiet[:, :-k] * quiet[:, k:]).mean(axis=1) / power[quietest])) for k in (1, 2)
    )
    if next_one > -0.25 and -0.6 < one_after < -0.15:  # a lever that rings has a lower one_after
        return True
    return False if next_one < -0.35 and one_after > -0.15 else None


def _delay_of_side(series: FrameSeries, part: slice, layer: int) -> LoadDelay | None:
    moves, middles, span_s = _moves(series.t_s[part], series.channels[part, layer])
    total, rest = _squares(series, moves, middles, span_s, _SHIFTS_S)
    explained = _explained(total.sum(axis=0), rest.sum(axis=0))
    best = int(np.argmax(explained))
    others = explained[np.abs(_SHIFTS_S - _SHIFTS_S[best]) > _APART_S]
    if not explained[best] >= max(_MIN_EXPLAINED, _PROMINENCE * float(others.max())):
        return None
    near = np.abs(_SHIFTS_S - _SHIFTS_S[best]) <= _APART_S / 2
    shifts_s = _SHIFTS_S[near]
    parts = [np.add.reduceat(squares[:, near], np.arange(0, len(moves), _STRETCH_FRAMES)) for squares in (total, rest)]
    drawn = np.random.default_rng(0).integers(0, len(parts[0]), (_DRAWS, len(parts[0])))
    peaks = [_peak(shifts_s, _explained(*(squares[some].sum(axis=0) for squares in parts))) for some in drawn]
    # Half of the central two thirds: a few draws find another peak.
    error_s = float(np.diff(np.quantile(peaks, [0.16, 0.84]))[0]) / 2
    return LoadDelay(_peak(shifts_s, explained[near]), error_s, float(explained[best]))


def _squares(
    series: FrameSeries, moves: FloatArray, middles: FloatArray, span_s: float, shifts_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the squares (n, s) of the load's changes at (s,) shifts, and of what the frames' moves do not explain."""
    changes = np.array([_changes(series, middles + shift_s, span_s) for shift_s in shifts_s]).T
    return changes**2, _cross_validated_residual(moves, changes) ** 2


def _peak(shifts_s: FloatArray, explained: FloatArray) -> float:
    """Return the position of the highest of (s,) shares, between the shifts."""
    best = shifts_s[np.argmax(explained)]
    near = np.abs(shifts_s - best) <= _PEAK_S + 1e-9
    bend, slope, _ = np.polyfit(shifts_s[near] - best, explained[near], 2)
    offset = -slope / (2 * bend) if bend < 0 else 0.0
    return float(best + np.clip(offset, -_PEAK_S, _PEAK_S))


def _moves(t_s: FloatArray, channels: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return the motion of (n, c) frames from each to the next, (n − 1, p), its times, and its duration."""
    frames = channels / np.where(np.isfinite(noise := channel_noise(channels)), noise, 1e9)
    moved = np.diff(frames, axis=0)
    size = np.linalg.norm(moved, axis=1)
    limit = _LARGEST_MOVE * float(np.median(size))
    if limit > 0:  # else most frames repeat the one before
        moved *= np.minimum(1.0, limit / np.maximum(size, limit * 1e-9))[:, None]
    moved -= moved.mean(axis=0)
    # The n × n products of n frames have the same directions, for a tenth of the work.
    values, vectors = np.linalg.eigh(moved @ moved.T)
    scores = vectors[:, -_N_DIRECTIONS:] * np.sqrt(np.maximum(values[-_N_DIRECTIONS:], 0.0))
    return scores, (t_s[1:] + t_s[:-1]) / 2, float(np.median(np.diff(t_s)))


def _changes(series: FrameSeries, middles: FloatArray, span_s: float) -> FloatArray:
    ends = [np.interp(middles + sign * span_s / 2, series.torque_t_s, series.torque_nm) for sign in (1, -1)]
    change = ends[0] - ends[1]
    return np.asarray(change - change.mean())


def _cross_validated_residual(moves: FloatArray, changes: FloatArray) -> FloatArray:
    """Return the residual (n, s) of a ridge from (n, p) moves to (n, s) changes, on blocks of time left out."""
    left = np.zeros_like(changes)
    for rest, block in left_out_blocks(len(moves)):
        gram = moves[rest].T @ moves[rest]
        if not gram.any():  # a board that repeats one frame
            left[block] = changes[block]
            continue
        penalty = _STRENGTH * float(np.trace(gram)) / len(gram) * np.eye(len(gram))
        left[block] = changes[block] - moves[block] @ np.linalg.solve(gram + penalty, moves[rest].T @ changes[rest])
    return left


def _explained(total: FloatArray, rest: FloatArray) -> FloatArray:
    """Return the explained fractions of (s,) sums of squares; 0 for a shift without a change of load."""
    return np.where(total > 0, 1.0 - rest / np.where(total > 0, total, 1.0), 0.0)
