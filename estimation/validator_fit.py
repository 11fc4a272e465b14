"""Fits what recognises a fingertip and its grip to recordings of one grip each."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.fingertip_validator import (
    MIN_NOISE_V,
    SMALL_V,
    STEP_FRAMES,
    FingertipValidator,
    relative_change,
)
from shearloop.estimation.grip_strength import CalibratedStrength

# Directions of motion while gripped or idle that the grip's discriminant ignores.
_N_NUISANCE = 2
# Closing and opening move further than twisting under load by this factor.
_STEP_MARGIN = 1.25
# A grip scores above the idle frames by this many standard deviations, and by at least this fraction of the calibrated
# grip. Idle frames of other sessions score at most 0.06, their grips at least 0.12 (docs/decisions/0042).
_IDLE_DEVIATIONS, _MIN_RISE = 3.0, 0.08
MIN_IDLE, _MIN_GRIPPED = 5, 20
# A channel that reads 0 in more of a part's frames is dead at calibration.
_SILENT_FRACTION = 0.05
# The least noise of a relative change, as a fraction of the median of all channels.
_MIN_NOISE_FRACTION = 0.3
# The threshold's largest fraction of the way from idle to the weakest grip.
_LARGEST_RISE = 1 / 3


class GripParts(NamedTuple):
    """A recording's (n, c) frames before its grip, in it, and after it; of the last there may be none."""

    idle: FloatArray
    gripped: FloatArray
    released: FloatArray

    def changes(self, base: FloatArray) -> "GripParts":
        """Return the relative changes from an idle frame (c,)."""
        return GripParts(*(relative_change(part, base) for part in self))


def fit_validator(side: str, *recordings: GripParts) -> FingertipValidator:
    """Return the validator of a side, fitted to recordings of one grip each.

    Each is compared with its own idle frames, because the gel drifts between recordings. Raises CalibrationError
    where the frames are too few, and where the grip does not show.
    """
    n_idle = min(len(recording.idle) for recording in recordings)
    n_gripped = min(len(recording.gripped) for recording in recordings)
    if few := too_few_frames(n_idle, n_gripped):
        raise CalibrationError(f"side {side}: {few}")
    bases = [np.median(recording.idle, axis=0) for recording in recordings]
    base = np.mean(bases, axis=0)
    noise = _noise_of(recordings)
    scale = _noise_of_changes(noise, base)
    changes = [recording.changes(idle_frame) for recording, idle_frame in zip(recordings, bases, strict=True)]
    if not _is_separable(changes, scale):
        raise CalibrationError(
            f"side {side}: gripped frames look like idle ones; did the fingertip touch the tool, and was the torque "
            "0 until then?"
        )
    weights = _grip_weights(changes, scale)
    step_limit = fall_limit = np.inf
    if not any(len(recording.released) for recording in recordings):
        scores = [change.gripped @ weights for change in changes]
        step_limit = _STEP_MARGIN * max(float(frame_steps(recording.gripped, noise).max()) for recording in recordings)
        fall_limit = _STEP_MARGIN * max(
            float((grip_scores[:-STEP_FRAMES] - grip_scores[STEP_FRAMES:]).max()) for grip_scores in scores
        )
    return FingertipValidator(
        side,
        base,
        np.concatenate([recording.gripped for recording in recordings]).mean(axis=0),
        noise,
        weights,
        _grip_threshold(changes, weights),
        step_limit,
        fall_limit,
        CalibratedStrength.fit(_strength_weights(changes, scale), [change.gripped for change in changes]),
    )


def too_few_frames(n_idle: int, n_gripped: int) -> str:
    """Return why the frames before a grip and in it are too few to define a grip; empty if they are enough."""
    if n_idle >= MIN_IDLE and n_gripped >= _MIN_GRIPPED:
        return ""
    return (
        f"{n_idle} idle and {n_gripped} gripped frames are too few to detect a grip; start the recording some seconds "
        "before gripping, and let the gripped tool rest for some seconds before its first twist"
    )


def channel_noise(frames: FloatArray) -> FloatArray:
    """Return the (c,) standard deviation of fast noise in (n, c) frames, from their second differences.

    Slow signals cancel. It is at least the converter's rounding, and infinite for a channel that never changes.
    """
    noise = np.sqrt((np.diff(frames, 2, axis=0) ** 2).mean(axis=0) / 6.0)
    still = np.ptp(frames, axis=0) == 0
    return np.where(still, np.inf, np.maximum(noise, MIN_NOISE_V))


def frame_steps(frames: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the (n − STEP_FRAMES,) mean distances in noises that (n, c) frames move within STEP_FRAMES frames."""
    return np.asarray((np.abs(frames[STEP_FRAMES:] - frames[:-STEP_FRAMES]) / noise).mean(axis=1))


def _noise_of(recordings: Sequence[GripParts]) -> FloatArray:
    """Return the (c,) noise of gripped frames in volts, infinite for channels that were dead before or in a grip."""
    noise = np.sqrt(np.mean([channel_noise(recording.gripped) ** 2 for recording in recordings], axis=0))
    silent = np.max(
        [(part == 0.0).mean(axis=0) for recording in recordings for part in (recording.idle, recording.gripped)], axis=0
    )
    return np.where(silent > _SILENT_FRACTION, np.inf, noise)


def _noise_of_changes(noise: FloatArray, base: FloatArray) -> FloatArray:
    """Return the (c,) noise of relative changes from the idle frame `base`, infinite for dead channels.

    No channel counts as much less noisy than the others.
    """
    alive = np.isfinite(noise)
    scale = np.where(alive, noise, 1.0) / (base + SMALL_V)
    least = _MIN_NOISE_FRACTION * float(np.median(scale))
    return np.where(alive, np.maximum(scale, least), np.inf)


def _is_separable(changes: Sequence[GripParts], scale: FloatArray) -> bool:
    """Return whether the grip shows in each second frame, by weights that were fitted to the frames between.

    Some combination of c channels separates any frames from any others that it was fitted to.
    """
    weights = _grip_weights(changes, scale, slice(0, None, 2))
    for change in changes:
        idle, gripped, released = (part[1::2] @ weights for part in change)
        if np.quantile(gripped, 0.01) <= np.quantile(np.concatenate([idle, released]), 0.99):
            return False
    return True


def _grip_weights(changes: Sequence[GripParts], scale: FloatArray, rows: slice = slice(None)) -> FloatArray:
    """Return the (c,) weights of a grip's score, fitted to these rows of each part."""
    parts = [np.concatenate([change[i][rows] for change in changes]) / scale for i in range(3)]
    return _discriminant([part for part in parts if len(part)]) / scale


def _grip_threshold(changes: Sequence[GripParts], weights: FloatArray) -> float:
    """Return the score above which a fingertip is gripped."""
    idle_scores = np.concatenate([change.idle @ weights for change in changes])
    rise = max(_IDLE_DEVIATIONS * float(idle_scores.std()), _MIN_RISE)
    highest_idle = float(np.quantile(idle_scores, 0.99))
    weakest_grip = min(float(np.quantile(change.gripped @ weights, 0.01)) for change in changes)
    # Idle scores of different tools scatter further than the weakest grip of them.
    return highest_idle + min(rise, _LARGEST_RISE * max(weakest_grip - highest_idle, 0.0))


def _strength_weights(changes: Sequence[GripParts], scale: FloatArray) -> FloatArray:
    """Return the grip's discriminant of recordings with (n, c) relative changes idle, gripped and perhaps released.

    It ignores motion within each grip. A discriminant of all of them together would ignore how strong they are too.
    """
    scaled = [[part / scale for part in change] for change in changes]
    within = np.vstack([part - part.mean(axis=0) for change in scaled for part in change if len(part)])
    parts = [np.concatenate([change[i] for change in scaled]) for i in range(3)]
    return _discriminant([part for part in parts if len(part)], within) / scale


def _discriminant(parts: list[FloatArray], within: FloatArray | None = None) -> FloatArray:
    """Return weights of idle, gripped and perhaps released frames: 0 for the mean idle frame, 1 for the gripped one.

    Directions of variation within the parts, and the one from idle to released, have no weight. `within` (n, c) is the
    variation, by default the frames' differences to the mean of their part.
    """
    means = [part.mean(axis=0) for part in parts]
    if within is None:
        within = np.vstack([part - mean for part, mean in zip(parts, means, strict=True)])
    # The first right singular vectors, by the smaller of the two Gram matrices: np.linalg.svd would find all.
    few = len(within) < within.shape[1]
    gram = within @ within.T if few else within.T @ within
    vectors = linalg.eigh(gram, subset_by_index=(len(gram) - _N_NUISANCE, len(gram) - 1))[1]
    nuisance = list((within.T @ vectors if few else vectors).T)
    step = means[1] - means[0]
    if len(parts) == 3:
        nuisance.append(means[2] - means[0])
        step = means[1] - 0.5 * (means[0] + means[2])
    q = np.linalg.qr(np.array(nuisance).T)[0]
    direction = step - q @ (q.T @ step)
    return np.asarray(direction / float(direction @ step))
