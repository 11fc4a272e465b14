"""Which frames of a recording are idle, gripped and let go: what a calibration learns a grip from. No I/O."""

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.fingertip_validator import STEP_FRAMES, channel_noise, steps
from shearloop.bank.estimation.values import FrameSeries

# A large step is so much more than what twisting under load makes.
_LARGE_STEP = 1.4
# Frames that are less than this share of the way from the idle to the loaded ones, in the median of so many, are idle.
# Gripped and not twisted they are at 0.57 and more, in recovery from a touch or a release at 0.41 and less.
_LIKE_IDLE_SHARE, _LIKE_IDLE_FRAMES = 0.45, 5
# From the first torque to the last: of fewer frames there are no second differences to tell the noise by.
_LEAST_SPAN = 3
# Fewer frames than this after a step are not yet the gel let go.
_LEAST_RELEASED = 10


def gripped_part(series: FrameSeries) -> tuple[slice, slice, slice]:
    """Return which frames came before the grip, in it, and after it, going by the torque, the steps, and the place.

    Loaded frames are gripped, and those before the first large step are not. The grip begins with the last large step
    before the first torque, or later, where the frames begin to look more like the loaded ones than like the idle ones;
    it ends in the same way. What no torque is known of is in neither. Raises CalibrationError for a recording without
    torque.
    """
    known = series.torque_at_frames()
    if len(known) == 0:
        sides = f"the side {series.sides[0]}" if len(series.sides) == 1 else f"{' and '.join(series.sides)} at one time"
        raise CalibrationError(f"the recording holds no frames of {sides}; record some frames")
    if not np.isfinite(known).any():
        raise CalibrationError("the torque is known at none of these frames; record the load cell beside them")
    torque = np.abs(np.nan_to_num(known))
    loaded = np.flatnonzero(torque > 0.1 * torque.max(initial=np.finfo(np.float64).tiny))
    if len(loaded) == 0:
        raise CalibrationError("the torque is 0 at all of these frames; record twists that the load cell feels")
    n, span = len(series.t_s), slice(int(loaded[0]), int(loaded[-1]) + 1)
    if span.stop - span.start < _LEAST_SPAN:
        raise CalibrationError(
            f"from the first torque to the last there are {span.stop - span.start} frames, too few to tell a grip; "
            "record several twists"
        )
    step = np.zeros(n)
    for layer in range(len(series.sides)):
        frames = series.channels[:, layer]
        step[STEP_FRAMES:] = np.maximum(step[STEP_FRAMES:], steps(frames, channel_noise(frames[span])))
    large = np.flatnonzero(step > _LARGE_STEP * float(np.quantile(step[span], 0.99)))
    before, after = large[large < loaded[0]], large[large > loaded[-1]]
    begin = int(before[-1]) + 1 if len(before) else 0
    end = int(after[0]) - 1 if len(after) else n
    # The transients of closing and opening belong to neither side.
    idle_end = int(before[0]) - 1 if len(before) else _idle_before_a_slow_grip(series.channels, span)
    let_go = 0
    for layer in range(len(series.sides)):
        like_idle = _like_idle(series.channels[:, layer], slice(0, idle_end), span)
        earlier, later = np.flatnonzero(like_idle[: loaded[0]]), np.flatnonzero(like_idle[loaded[-1] :])
        let_go = max(let_go, int(np.flatnonzero(~like_idle)[-1]) + _LIKE_IDLE_FRAMES // 2)
        if len(earlier):
            begin = max(begin, int(earlier[-1]) + _LIKE_IDLE_FRAMES // 2)
        if len(later):
            end = min(end, int(loaded[-1] + later[0]) - _LIKE_IDLE_FRAMES // 2)
    end = min(end, int(np.flatnonzero(np.isfinite(known))[-1]) + 1)
    released = int(after[-1]) + 1 if len(after) else let_go
    if n - released < _LEAST_RELEASED:
        released = n
    return slice(0, idle_end), slice(begin, end), slice(released, n)


def _idle_before_a_slow_grip(frames: FloatArray, loaded: slice) -> int:
    """Return how many of (n, m, 896) frames are like the first ones, where no step tells of the grip that follows.

    None, where frames between the twists are like the first ones too: then the recording began gripped.
    """
    first = slice(0, min(_LEAST_RELEASED, loaded.start // 2))
    like = np.all([_like_idle(frames[:, layer], first, loaded) for layer in range(frames.shape[1])], axis=0)
    if like[: loaded.start].all() or like[loaded].any():
        return 0
    return max(int(np.argmin(like)) - _LIKE_IDLE_FRAMES // 2, 0)


def _like_idle(frames: FloatArray, idle: slice, loaded: slice) -> BoolArray:
    """Return which (n, 896) frames are nearer to the idle ones than to the loaded ones, along what parts the two."""
    if idle.stop == 0:
        return np.zeros(len(frames), dtype=np.bool_)
    # Here, for the daemon calibrates nothing, and would be ready later.
    from scipy.ndimage import median_filter

    base, noise = np.median(frames[idle], axis=0), channel_noise(frames[loaded])
    moved = (np.median(frames[loaded], axis=0) - base) / noise
    along = median_filter((frames - base) / noise @ moved, _LIKE_IDLE_FRAMES, mode="nearest")
    return np.asarray(along < _LIKE_IDLE_SHARE * float(moved @ moved))
