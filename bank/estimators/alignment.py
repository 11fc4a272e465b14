"""Whether the load cell's clock goes with the frames': a torque that is stamped late teaches an estimator the past.

An estimator with a memory of seconds cannot tell by its error: what the load was a second ago, its frames still know.
But a load that changes moves the gel within the same frame. How far single frames move, along the directions in which
they move most, is regressed on the torque's change over the same time, which is shifted against it; where that explains
most, on stretches of time that were left out, is how late the torques are. Recorded twists say 0.12 to 0.24 s, wherever
they are cut, with a peak half a frame wide; half of it is the filter of the load cell's converter, whose output settles
within 0.4 s (HX711 at ten samples a second).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bank.errors import CalibrationError
from bank.estimators.gripped import gripped_part
from bank.estimators.guard import channel_noise
from bank.estimators.heads import left_out_blocks
from bank.estimators.values import FloatArray, FrameSeries

_SHIFTS_S = np.round(np.arange(-6.0, 6.01, 0.12), 2)
_N_DIRECTIONS = 6
# Held back a little: on a stretch without load nothing but noise moves.
_STRENGTH = 1e-3
# A frame that moves further than so many times the median was knocked, and counts no more than that.
_LARGEST_MOVE = 4.0
# The peak must explain this much, and so much more than any shift this far from it: otherwise nothing is said. A minute
# with a single twist (`glitch_20241202_173837`) has a chance peak of 0.06 at five seconds.
_LEAST_EXPLAINED, _ABOVE_OTHERS, _APART_S = 0.1, 1.5, 1.1
# The filter's delay, and two thirds of a frame around it.
_EXPECTED_S, _TOLERANCE_S = 0.2, 0.36


@dataclass(frozen=True, slots=True)
class Alignment:
    """How much later than the frames' motion the torques are stamped, in s, and what share of their change it tells."""

    late_s: float
    explained: float


def check_alignment(recordings: Sequence[FrameSeries]) -> None:
    """Raise CalibrationError for a recording whose torques are clearly stamped at other times than its frames."""
    for one in recordings:
        found = alignment(one)
        if found is not None and abs(found.late_s - _EXPECTED_S) > _TOLERANCE_S:
            order = "before" if found.late_s > 0 else "after"
            raise CalibrationError(
                f"the frames move {abs(found.late_s):.1f} s {order} the load that moves them is stamped: a calibration "
                "would learn another moment's torque; set the load cell's clock right and record again, or calibrate "
                f"with --load-late {found.late_s - _EXPECTED_S:.2f}"
            )


def alignment(series: FrameSeries) -> Alignment | None:
    """Return how late the torques of raw frames are; None where no shift stands out, as with few changes of load."""
    part = gripped_part(series)[1]
    t_s = series.t_s[part]
    if len(t_s) < 10 * _N_DIRECTIONS:
        return None
    found = [one for layer in range(len(series.sides)) if (one := _of_side(series, part, layer)) is not None]
    return max(found, key=lambda one: one.explained, default=None)


def _of_side(series: FrameSeries, part: slice, layer: int) -> Alignment | None:
    moves, middles, span_s = _moves(series.t_s[part], series.channels[part, layer])
    explained = _explained(moves, np.array([_changes(series, middles + late, span_s) for late in _SHIFTS_S]).T)
    best = int(np.argmax(explained))
    others = explained[np.abs(_SHIFTS_S - _SHIFTS_S[best]) > _APART_S]
    if not explained[best] >= max(_LEAST_EXPLAINED, _ABOVE_OTHERS * float(others.max())):
        return None
    return Alignment(float(_SHIFTS_S[best]), float(explained[best]))


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


def _explained(moves: FloatArray, changes: FloatArray) -> FloatArray:
    """Return the (s,) shares of the (n, s) changes' variance that a ridge on the (n, p) moves explains.

    On blocks of time left out in turn; 0 for a shift at which no load changes.
    """
    left = np.zeros(changes.shape[1])
    for rest, block in left_out_blocks(len(moves)):
        gram = moves[rest].T @ moves[rest]
        penalty = _STRENGTH * float(np.trace(gram)) / len(gram) * np.eye(len(gram))
        weights = np.linalg.solve(gram + penalty, moves[rest].T @ changes[rest])
        left += ((changes[block] - moves[block] @ weights) ** 2).sum(axis=0)
    whole = (changes**2).sum(axis=0)
    return np.where(whole > 0, 1.0 - left / np.where(whole > 0, whole, 1.0), 0.0)
