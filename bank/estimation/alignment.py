"""Whether the load cell's clock goes with the frames': a torque that is stamped late teaches an estimator the past.

An estimator with a memory of seconds cannot tell by its error: what the load was a second ago, its frames still know.
But a load that changes moves the gel within the same frame. How far single frames move, along the directions in which
they move most, is regressed on the torque's change over the same time, which is shifted against it; where that explains
most, on stretches of time that were left out, is how late the torques are. Its uncertainty is that of stretches drawn
anew. Recorded twists say 0.25 to 0.28 s, wherever they are cut, ± 0.02 to 0.06 s; most of it is the filter of the load
cell's converter, whose output settles within 0.4 s (HX711 at ten samples a second). Played rigs, without that filter,
say −0.08 to 0.05 s.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.polynomial import TWO_SIDED_95
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.fingertip_validator import channel_noise
from shearloop.bank.estimation.grip_segmentation import gripped_part
from shearloop.bank.estimation.regressors import left_out_blocks
from shearloop.bank.estimation.values import FrameSeries

_STEP_S = 0.06
_SHIFTS_S = np.round(np.arange(-6.0, 6.01, _STEP_S), 2)
# A parabola through so much on both sides of the highest shift has the peak.
_PEAK_S = 0.18
_N_DIRECTIONS = 6
# Held back a little: on a stretch without load nothing but noise moves.
_STRENGTH = 1e-3
# A frame that moves further than so many times the median was knocked, and counts no more than that.
_LARGEST_MOVE = 4.0
# The peak must explain this much, and so much more than any shift this far from it: otherwise nothing is said. A minute
# with a single twist (`glitch_20241202_173837`) has a chance peak of 0.06 at five seconds.
_LEAST_EXPLAINED, _ABOVE_OTHERS, _APART_S = 0.1, 1.5, 1.1
# Fewer gripped frames than the first, and nothing is refused; of no fewer than the second, so high a peak is told. Of
# 1128 stretches of 50 to 59 frames of recordings that are stamped right one has such a peak elsewhere.
_SURE_FRAMES, _SUSPECT_FRAMES, _SUSPECT_EXPLAINED = 10 * _N_DIRECTIONS, 50, 0.45
# How late a load cell's reading is by itself, in its sampling periods: with a filter (an HX711 settles within four; the
# recorded ones are 2.7 late), without one (at most the mean over a period; early, where a gel goes on moving after the
# load: 0.9 on a played rig), and where its noise does not say which.
_PERIODS_LATE: dict[bool | None, tuple[float, float]] = {True: (1.6, 2.7), False: (-1.0, 1.0), None: (-1.0, 2.7)}
# So much may the stamps be off beside that.
_STAMPS_S = 0.05
# What is surely outside is refused: by so many standard errors, found by drawing stretches of so many frames anew.
_CERTAIN = 1.5
_STRETCH_FRAMES, _DRAWS = 16, 200
# Of times that could not be checked: half a second, and the quarter that a load cell's filter may be late by itself.
# With half a second alone one fingertip of a third of the recorded twists was still false-valid at 23 %.
_UNCHECKED_S = 0.75
# A standard error above this leaves the times open as far as its 95 % reach; recorded twists say 0.02 to 0.06 s.
_LARGE_ERROR_S = 0.1
# Readings of which the noise is told, and how many such stretches that takes.
_NOISE, _LEAST_QUIET = 64, 4


@dataclass(frozen=True, slots=True)
class Alignment:
    """How much later than the frames' motion the torques are stamped, in s, and what share of their change it tells.

    error_s is the standard error of late_s.
    """

    late_s: float
    error_s: float
    explained: float


def alignment(series: FrameSeries) -> Alignment | None:
    """Return how late the torques of raw frames are; None where no shift stands out, as with few changes of load."""
    part = gripped_part(series)[1]
    return _clearest(series, part) if len(series.t_s[part]) >= _SURE_FRAMES else None


# `alignment`, or the same with a memory of what it has found: for a recording it takes up to some tenths of a second.
Aligned: TypeAlias = Callable[[FrameSeries], Alignment | None]


def check_alignment(recordings: Sequence[FrameSeries], aligned: Aligned = alignment) -> None:
    """Raise CalibrationError for a recording whose torques are clearly stamped at other times than its frames."""
    for one in recordings:
        found = aligned(one)
        if found is not None and (beside := _beside(one, found)):
            order, usual_s = beside
            raise CalibrationError(
                f"the frames move {abs(found.late_s):.2f} ± {found.error_s:.2f} s {order} the load that moves them is "
                f"stamped, and this load cell is {usual_s:.2f} s late by itself: a calibration would learn another "
                "moment's torque; set the load cell's clock right and record again, or calibrate with --load-late "
                f"{found.late_s - usual_s:.2f}"
            )


def doubt(series: FrameSeries, aligned: Aligned = alignment) -> str:
    """Return what speaks against the times of a recording's torques, where there is anything; an empty text else.

    That may be too little to refuse it: with few gripped frames a peak elsewhere can be chance.
    """
    if series.kind != "raw" or not np.abs(series.torque_nm).any():
        return ""
    try:
        part = gripped_part(series)[1]
    except CalibrationError:
        return ""
    n = len(series.t_s[part])
    found = _clearest(series, part) if _SUSPECT_FRAMES <= n < _SURE_FRAMES else aligned(series)
    if found is None or (n < _SURE_FRAMES and found.explained < _SUSPECT_EXPLAINED):
        return ""
    if not (beside := _beside(series, found)):
        return ""
    order, usual_s = beside
    sure = "" if n >= _SURE_FRAMES else f" (though {n} gripped frames are too few to be sure)"
    return (
        f"the frames move {abs(found.late_s):.2f} ± {found.error_s:.2f} s {order} the load that moves them is "
        f"stamped{sure}; see the load cell's clock, or calibrate with --load-late {found.late_s - usual_s:.2f}"
    )


def telling(
    recordings: Sequence[FrameSeries], beside: Sequence[FrameSeries], aligned: Aligned = alignment
) -> Sequence[FrameSeries]:
    """Return by what the torques' times are told: recordings where any of them tells, else what was recorded beside.

    A board beside them may have been dead, garbled or away: then it says nothing, whatever is the matter with it.
    Raises CalibrationError for a recording without torque.
    """
    if any(aligned(one) is not None for one in recordings):
        return recordings
    return [one for one in beside if _tells(one, aligned)] or recordings


def _tells(beside: FrameSeries, aligned: Aligned) -> bool:
    if not np.isfinite(beside.channels).all():
        return False
    try:
        return aligned(beside) is not None
    except CalibrationError:
        return False


def unchecked_s(recordings: Sequence[FrameSeries], aligned: Aligned = alignment) -> float:
    """Return by how many seconds the torques of raw frames may be stamped beside the frames without anybody knowing.

    0 where the loads of any of the recordings, which one clock has stamped, tell. Raises CalibrationError for a
    recording without torque.
    """
    errors_s = [found.error_s for one in recordings if (found := aligned(one)) is not None]
    if not errors_s:
        return _UNCHECKED_S
    least_s = min(errors_s)
    return min(TWO_SIDED_95 * least_s, _UNCHECKED_S) if least_s > _LARGE_ERROR_S else 0.0


def torque_within(series: FrameSeries, unsure_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest torque (n,) in N·m within so many seconds before and after each frame."""
    steps = int(np.ceil(unsure_s / _STEP_S))
    shifts_s = np.linspace(-unsure_s, unsure_s, 2 * steps + 1)
    found = [np.interp(series.t_s + shift, series.torque_t_s, series.torque_nm) for shift in shifts_s]
    return np.min(found, axis=0), np.max(found, axis=0)


def _beside(series: FrameSeries, found: Alignment) -> tuple[str, float] | None:
    """Return how the frames stand to torques that are surely beside them, and how late the load cell is by itself.

    None where that, and the uncertainty, may be all there is.
    """
    period_s = float(np.median(np.diff(series.torque_t_s)))
    earliest_s, latest_s = (each * period_s for each in _PERIODS_LATE[is_filtered(series.torque_nm)])
    surely_s = _STAMPS_S + _CERTAIN * found.error_s
    if earliest_s - surely_s <= found.late_s <= latest_s + surely_s:
        return None
    return "before" if found.late_s > 0 else "after", (earliest_s + latest_s) / 2


def is_filtered(torque_nm: FloatArray) -> bool | None:
    """Return whether a load cell's noise, in the quietest quarter of (p,) readings, has gone through a filter.

    Where the noise of each reading is its own, the differences from one to the next correlate by −½ with those before
    them. Where a reading shares half of its time with the one before, they correlate so with those before that.
    Recorded HX711s say −0.07 and −0.34, played ones, which have no filter, −0.45 and 0. None where it is neither.
    """
    differences = np.diff(torque_nm)
    stretches = differences[: len(differences) // _NOISE * _NOISE].reshape(-1, _NOISE)
    stretches = stretches - stretches.mean(axis=1, keepdims=True)
    power = (stretches**2).mean(axis=1)
    quietest = np.argsort(power)[np.count_nonzero(power == 0) :][: np.count_nonzero(power) // 4]
    if len(quietest) < _LEAST_QUIET:
        return None
    quiet = stretches[quietest]
    next_one, one_after = (
        float(np.median((quiet[:, :-k] * quiet[:, k:]).mean(axis=1) / power[quietest])) for k in (1, 2)
    )
    if next_one > -0.25 and -0.6 < one_after < -0.15:  # a lever that rings takes back more than half
        return True
    return False if next_one < -0.35 and one_after > -0.15 else None


def _clearest(series: FrameSeries, part: slice) -> Alignment | None:
    found = [one for layer in range(len(series.sides)) if (one := _of_side(series, part, layer)) is not None]
    return max(found, key=lambda one: one.explained, default=None)


def _of_side(series: FrameSeries, part: slice, layer: int) -> Alignment | None:
    moves, middles, span_s = _moves(series.t_s[part], series.channels[part, layer])
    changes = np.array([_changes(series, middles + late, span_s) for late in _SHIFTS_S]).T
    whole, left = changes**2, _left_over(moves, changes) ** 2
    explained = _explained(whole.sum(axis=0), left.sum(axis=0))
    best = int(np.argmax(explained))
    others = explained[np.abs(_SHIFTS_S - _SHIFTS_S[best]) > _APART_S]
    if not explained[best] >= max(_LEAST_EXPLAINED, _ABOVE_OTHERS * float(others.max())):
        return None
    near = np.abs(_SHIFTS_S - _SHIFTS_S[best]) <= _APART_S / 2
    shifts_s = _SHIFTS_S[near]
    parts = [np.add.reduceat(each[:, near], np.arange(0, len(moves), _STRETCH_FRAMES)) for each in (whole, left)]
    drawn = np.random.default_rng(0).integers(0, len(parts[0]), (_DRAWS, len(parts[0])))
    peaks = [_peak(shifts_s, _explained(*(each[some].sum(axis=0) for each in parts))) for some in drawn]
    # Half of what two thirds of the draws span: a few find another peak.
    error_s = float(np.diff(np.quantile(peaks, [0.16, 0.84]))[0]) / 2
    return Alignment(_peak(shifts_s, explained[near]), error_s, float(explained[best]))


def _peak(shifts_s: FloatArray, explained: FloatArray) -> float:
    """Return the place of the highest of (s,) shares, between the shifts."""
    best = shifts_s[np.argmax(explained)]
    near = np.abs(shifts_s - best) <= _PEAK_S + 1e-9
    bend, slope, _ = np.polyfit(shifts_s[near] - best, explained[near], 2)
    beside = -slope / (2 * bend) if bend < 0 else 0.0
    return float(best + np.clip(beside, -_PEAK_S, _PEAK_S))


def _moves(t_s: FloatArray, channels: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return how far (n, 896) frames move from each to the next, (n − 1, p), when, and the time that it takes."""
    frames = channels / np.where(np.isfinite(noise := channel_noise(channels)), noise, 1e9)
    moved = np.diff(frames, axis=0)
    size = np.linalg.norm(moved, axis=1)
    limit = _LARGEST_MOVE * float(np.median(size))
    if limit > 0:  # else most frames repeat the one before
        moved *= np.minimum(1.0, limit / np.maximum(size, limit * 1e-9))[:, None]
    moved -= moved.mean(axis=0)
    # Of n frames the n × n products have the same directions, for a tenth of the work.
    values, vectors = np.linalg.eigh(moved @ moved.T)
    scores = vectors[:, -_N_DIRECTIONS:] * np.sqrt(np.maximum(values[-_N_DIRECTIONS:], 0.0))
    return scores, (t_s[1:] + t_s[:-1]) / 2, float(np.median(np.diff(t_s)))


def _changes(series: FrameSeries, middles: FloatArray, span_s: float) -> FloatArray:
    ends = [np.interp(middles + sign * span_s / 2, series.torque_t_s, series.torque_nm) for sign in (1, -1)]
    change = ends[0] - ends[1]
    return np.asarray(change - change.mean())


def _left_over(moves: FloatArray, changes: FloatArray) -> FloatArray:
    """Return what a ridge on the (n, p) moves leaves of the (n, s) changes, on blocks of time left out in turn."""
    left = np.zeros_like(changes)
    for rest, block in left_out_blocks(len(moves)):
        gram = moves[rest].T @ moves[rest]
        if not gram.any():  # a board that sends the same again and again
            left[block] = changes[block]
            continue
        penalty = _STRENGTH * float(np.trace(gram)) / len(gram) * np.eye(len(gram))
        left[block] = changes[block] - moves[block] @ np.linalg.solve(gram + penalty, moves[rest].T @ changes[rest])
    return left


def _explained(whole: FloatArray, left: FloatArray) -> FloatArray:
    """Return the explained shares of (s,) sums of squares; 0 for a shift at which no load changes."""
    return np.where(whole > 0, 1.0 - left / np.where(whole > 0, whole, 1.0), 0.0)
