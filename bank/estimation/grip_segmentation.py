"""Segments a recording into idle, gripped and released frames for calibration."""

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.fingertip_validator import STEP_FRAMES, channel_noise, frame_steps
from shearloop.bank.estimation.values import FrameSeries

# A large step exceeds the steps of twisting under load by this factor.
_LARGE_STEP = 1.4
# Frames below this share of the way from idle to loaded, in this running median, are idle. Gripped and not twisted they
# are at 0.57 and more, in recovery from a touch or a release at 0.41 and less.
_IDLE_SHARE, _MEDIAN_FRAMES = 0.45, 5
# Fewer loaded frames have no second differences to show the noise.
_LEAST_LOADED = 3
# Fewer frames after a step are still its transient.
_LEAST_RELEASED = 10


def segment_grip(series: FrameSeries) -> tuple[slice, slice, slice]:
    """Return the frames before the grip, in it, and after it, from the torque, the steps, and the positions.

    Loaded frames are gripped; frames before the first large step are not. The grip begins at the last large step before
    the first torque, or later where the frames become more like the loaded ones than the idle ones. It ends likewise.
    Frames of unknown torque belong to neither. Raises CalibrationError for a recording without torque.
    """
    known = series.torque_at_frames()
    if len(known) == 0:
        sides = f"the side {series.sides[0]}" if len(series.sides) == 1 else f"{' and '.join(series.sides)} together"
        raise CalibrationError(f"the recording holds no frames of {sides}; record some frames")
    if not np.isfinite(known).any():
        raise CalibrationError("no torque is known for these frames; record the load cell with them")
    torque = np.abs(np.nan_to_num(known))
    loaded = np.flatnonzero(torque > 0.1 * torque.max(initial=np.finfo(np.float64).tiny))
    if len(loaded) == 0:
        raise CalibrationError("the torque is 0 at all of these frames; record twists that the load cell measures")
    n, span = len(series.t_s), slice(int(loaded[0]), int(loaded[-1]) + 1)
    if span.stop - span.start < _LEAST_LOADED:
        raise CalibrationError(
            f"from the first torque to the last there are {span.stop - span.start} frames, too few to detect a grip; "
            "record several twists"
        )
    step = np.zeros(n)
    for layer in range(len(series.sides)):
        frames = series.channels[:, layer]
        step[STEP_FRAMES:] = np.maximum(step[STEP_FRAMES:], frame_steps(frames, channel_noise(frames[span])))
    large = np.flatnonzero(step > _LARGE_STEP * float(np.quantile(step[span], 0.99)))
    before, after = large[large < loaded[0]], large[large > loaded[-1]]
    begin = int(before[-1]) + 1 if len(before) else 0
    end = int(after[0]) - 1 if len(after) else n
    # The transients of closing and opening belong to neither side.
    idle_end = int(before[0]) - 1 if len(before) else _idle_end_without_step(series.channels, span)
    let_go = 0
    for layer in range(len(series.sides)):
        like_idle = _is_like_idle(series.channels[:, layer], slice(0, idle_end), span)
        earlier, later = np.flatnonzero(like_idle[: loaded[0]]), np.flatnonzero(like_idle[loaded[-1] :])
        let_go = max(let_go, int(np.flatnonzero(~like_idle)[-1]) + _MEDIAN_FRAMES // 2)
        if len(earlier):
            begin = max(begin, int(earlier[-1]) + _MEDIAN_FRAMES // 2)
        if len(later):
            end = min(end, int(loaded[-1] + later[0]) - _MEDIAN_FRAMES // 2)
    end = min(end, int(np.flatnonzero(np.isfinite(known))[-1]) + 1)
    released = int(after[-1]) + 1 if len(after) else let_go
    if n - released < _LEAST_RELEASED:
        released = n
    return slice(0, idle_end), slice(begin, end), slice(released, n)


def _idle_end_without_step(frames: FloatArray, loaded: slice) -> int:
    """Return how many of (n, m, 896) frames are like the first ones, where no step shows the grip.

    0 where frames between the twists are like the first ones too: then the recording began gripped.
    """
    first = slice(0, min(_LEAST_RELEASED, loaded.start // 2))
    like = np.all([_is_like_idle(frames[:, layer], first, loaded) for layer in range(frames.shape[1])], axis=0)
    if like[: loaded.start].all() or like[loaded].any():
        return 0
    return max(int(np.argmin(like)) - _MEDIAN_FRAMES // 2, 0)


def _is_like_idle(frames: FloatArray, idle: slice, loaded: slice) -> BoolArray:
    """Return which (n, 896) frames are nearer to the idle ones than to the loaded ones, along their difference."""
    if idle.stop == 0:
        return np.zeros(len(frames), dtype=np.bool_)
    # Imported here because the daemon does not calibrate: it would slow its start.
    from scipy.ndimage import median_filter

    base, noise = np.median(frames[idle], axis=0), channel_noise(frames[loaded])
    moved = (np.median(frames[loaded], axis=0) - base) / noise
    along = median_filter((frames - base) / noise @ moved, _MEDIAN_FRAMES, mode="nearest")
    return np.asarray(along < _IDLE_SHARE * float(moved @ moved))
