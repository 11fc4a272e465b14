"""Finds where the fingertips are idle, gripped and released in a recording, from the torque and the frames.

A recording may hold several grips. Between two grips the fingers open: within a few frames the frames become idle, and
they stay idle for a while, without torque.
"""

import itertools
from typing import NamedTuple

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.fingertip_validator import STEP_FRAMES
from shearloop.estimation.series import FrameSeries
from shearloop.estimation.twists import LOADED_FRACTION, runs
from shearloop.estimation.validator_fit import channel_noise, frame_steps

# A large step exceeds the steps of twisting under load by this factor.
_LARGE_STEP = 1.4
# Frames below this fraction of the way from idle to loaded, in this running median, are idle. Gripped and not twisted
# they are at 0.57 and more, in recovery from a touch or a release at 0.41 and less.
_IDLE_FRACTION, _MEDIAN_FRAMES = 0.45, 5
# Fewer loaded frames have no second differences to show the noise.
_MIN_LOADED = 3
# Fewer frames after a step are still its transient.
_MIN_RELEASED = 10
# The minimum of idle frames of a release: the shortest pause in which the fingers open and close.
_MIN_OPEN = 5


class Grip(NamedTuple):
    """The frames before a grip, in it, and after it; frames of the closing and the opening belong to none."""

    idle: slice
    gripped: slice
    released: slice


def segment_grip(series: FrameSeries) -> Grip:
    """Return the frames before the first grip, from its begin to the end of the last one, and after that.

    Raises CalibrationError as `find_grips`.
    """
    grips = find_grips(series)
    first, last = grips[0], grips[-1]
    return Grip(first.idle, slice(first.gripped.start, last.gripped.stop), last.released)


def find_grips(series: FrameSeries) -> list[Grip]:
    """Return the grips of a recording, one or more.

    Raises CalibrationError for a recording without torque, and for too few loaded frames.
    """
    known = series.torque_at_frames()
    if len(known) == 0:
        sides = f"the side {series.sides[0]}" if len(series.sides) == 1 else f"{' and '.join(series.sides)} together"
        raise CalibrationError(f"the recording holds no frames of {sides}; record some frames")
    if not np.isfinite(known).any():
        if series.left_out:
            raise CalibrationError(
                f"no torque is known for these frames, and left out: {'; '.join(series.left_out)}; "
                "record again with a load cell that measures"
            )
        raise CalibrationError("no torque is known for these frames; record the load cell with them")
    torque = np.abs(np.nan_to_num(known))
    is_loaded = torque > LOADED_FRACTION * torque.max(initial=np.finfo(np.float64).tiny)
    loaded = np.flatnonzero(is_loaded)
    if len(loaded) == 0:
        raise CalibrationError("the torque is 0 at all of these frames; record twists that the load cell measures")
    n_loaded = int(loaded[-1] - loaded[0]) + 1
    if n_loaded < _MIN_LOADED:
        raise CalibrationError(
            f"from the first torque to the last there are {n_loaded} frames, too few to detect a grip; "
            "record several twists"
        )
    edges = [0, *_find_openings(series.channels, is_loaded), len(known)]
    parts = [slice(start, stop) for start, stop in itertools.pairwise(edges)]
    # A recording may end as its last grip begins.
    held = [part for part in parts if np.ptp(np.flatnonzero(is_loaded[part])) >= _MIN_LOADED - 1]
    is_known = np.isfinite(known)
    return [_segment_one(series.channels, is_loaded, is_known, part) for part in held or [slice(0, len(known))]]


def _segment_one(channels: FloatArray, is_loaded: BoolArray, is_known: BoolArray, part: slice) -> Grip:
    """Return the only grip in a part of (n, m, c) frames, from the loads, the steps, and the positions.

    Loaded frames are gripped; frames before the first large step are not. The grip begins at the last large step before
    the first torque, or later where the frames become more like the loaded ones than the idle ones. It ends likewise.
    Frames of unknown torque belong to neither.
    """
    channels, loaded = channels[part], np.flatnonzero(is_loaded[part])
    n, span = len(channels), slice(int(loaded[0]), int(loaded[-1]) + 1)
    step = np.zeros(n)
    for layer in range(channels.shape[1]):
        frames = channels[:, layer]
        step[STEP_FRAMES:] = np.maximum(step[STEP_FRAMES:], frame_steps(frames, channel_noise(frames[span])))
    large = np.flatnonzero(step > _LARGE_STEP * float(np.quantile(step[span], 0.99)))
    before, after = large[large < loaded[0]], large[large > loaded[-1]]
    begin = int(before[-1]) + 1 if len(before) else 0
    end = int(after[0]) - 1 if len(after) else n
    # The transients of closing and opening belong to neither side.
    idle_end = int(before[0]) - 1 if len(before) else _idle_end_without_step(channels, span)
    let_go = 0
    for layer in range(channels.shape[1]):
        like_idle = _way_to_loaded(channels[:, layer], slice(0, idle_end), span) < _IDLE_FRACTION
        earlier, later = np.flatnonzero(like_idle[: loaded[0]]), np.flatnonzero(like_idle[loaded[-1] :])
        let_go = max(let_go, int(np.flatnonzero(~like_idle)[-1]) + _MEDIAN_FRAMES // 2)
        if len(earlier):
            begin = max(begin, int(earlier[-1]) + _MEDIAN_FRAMES // 2)
        if len(later):
            end = min(end, int(loaded[-1] + later[0]) - _MEDIAN_FRAMES // 2)
    end = min(end, int(np.flatnonzero(is_known[part])[-1]) + 1)
    released = int(after[-1]) + 1 if len(after) else let_go
    if n - released < _MIN_RELEASED:
        released = n
    at = part.start
    return Grip(slice(at, at + idle_end), slice(at + begin, at + end), slice(at + released, at + n))


def _find_openings(channels: FloatArray, is_loaded: BoolArray) -> list[int]:
    """Return the frames between grips at which (n, m, c) frames are cut, so that each part holds one grip.

    If the recording began gripped, the frames between two twists may be like the first ones too. But a twist is slower
    than an opening or a closing, and it moves the gel under load. At a release the frames differ from the idle ones
    without a load, before the fingers open or after they close.
    """
    loaded = np.flatnonzero(is_loaded)
    span = slice(int(loaded[0]), int(loaded[-1]) + 1)
    first = slice(0, min(_MIN_RELEASED, span.start // 2))
    ways = np.array([_way_to_loaded(channels[:, layer], first, span) for layer in range(channels.shape[1])])
    is_idle: BoolArray = np.all(ways < _IDLE_FRACTION, axis=0)
    way, half = ways.mean(axis=0), STEP_FRAMES // 2
    # By how much each frame's surroundings move along the way.
    padded = np.pad(way, half, mode="edge")
    moved = np.abs(padded[2 * half :] - padded[: -2 * half])
    is_held = ~np.convolve(is_idle, np.ones(2 * STEP_FRAMES + 1, dtype=np.bool_), mode="same")
    held = moved[span][is_held[span]]
    if not len(held):
        return []
    sudden = _LARGE_STEP * float(np.quantile(held, 0.99))

    def is_opening(start: int, stop: int) -> bool:
        between_twists = span.start < start and stop < span.stop
        if not between_twists or stop - start < _MIN_OPEN:
            return False
        if is_loaded[start:stop].any() or (is_loaded[start - 1] and is_loaded[stop]):
            return False
        return bool(min(moved[start], moved[stop]) > sudden)

    openings = [(start, stop) for start, stop in runs(is_idle) if is_opening(start, stop)]
    # The next grip is compared with its own idle frames, so it gets enough of them.
    return [max(start, min((start + stop) // 2, stop - _MIN_RELEASED)) for start, stop in openings]


def _idle_end_without_step(frames: FloatArray, loaded: slice) -> int:
    """Return how many of (n, m, c) frames are like the first ones, where no step shows the grip.

    0 where frames between the twists are like the first ones too: then the recording began gripped.
    """
    first = slice(0, min(_MIN_RELEASED, loaded.start // 2))
    ways = [_way_to_loaded(frames[:, layer], first, loaded) for layer in range(frames.shape[1])]
    like = np.all([way < _IDLE_FRACTION for way in ways], axis=0)
    if like[: loaded.start].all() or like[loaded].any():
        return 0
    return max(int(np.argmin(like)) - _MEDIAN_FRAMES // 2, 0)


def _way_to_loaded(frames: FloatArray, idle: slice, loaded: slice) -> FloatArray:
    """Return where (n, c) frames are along the way from the idle ones, 0, to the loaded ones, 1; 1 without a way."""
    if idle.stop == 0:
        return np.ones(len(frames))
    # Imported here because the daemon does not calibrate: it would slow its start.
    from scipy.ndimage import median_filter

    base, noise = np.median(frames[idle], axis=0), channel_noise(frames[loaded])
    moved = (np.median(frames[loaded], axis=0) - base) / noise
    length = float(moved @ moved)
    if not length:
        return np.ones(len(frames))
    along = median_filter((frames - base) / noise @ moved, _MEDIAN_FRAMES, mode="nearest")
    return np.asarray(along / length)
