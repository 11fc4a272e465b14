"""Whether a frame is one that a calibration can speak of: the right fingertip, gripping, undisturbed.

`FingertipValidator` for raw frames knows a fingertip by its pattern of voltages: the same one keeps it from day to
day but for
a common gain and a few per cent, another does not (median deviation 0.03–0.07 against 0.15–0.19 between recordings of
two fingertips on two days). A grip is told by a linear discriminant that looks away from what twisting and the gel's
slow recovery change.
"""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.values import everywhere

# One step of the board's converter, as measured on recorded frames; its rounding is the least noise there is.
_CONVERTER_STEP_V = 0.00215
LEAST_NOISE_V = float(_CONVERTER_STEP_V / np.sqrt(12.0))

# Median relative deviation, after the common gain, beyond which this is not the fingertip of the calibration.
LARGEST_DEVIATION = 0.12
# Added to voltages that others are divided by: below it a channel's relative change is noise.
SMALL_V = 0.01
# Channels whose shape a fingertip is known by, and how many of them at least.
_WELL_ABOVE_NOISE_V, FEWEST_COMPARED = 0.03, N_CHANNELS // 4
LARGEST_JUMPING_SHARE = 0.12
LARGEST_UNUSABLE_SHARE = 0.25
# Directions in which frames move while gripped or idle, which the grip's discriminant looks away from.
_N_NUISANCE = 2
# No recorded frame has more than two channels at its largest value: so many are at an amplifier's rail.
FEWEST_AT_RAIL = 9
# Closing and opening take this many frames, and move the frame so much further than twisting under load.
STEP_FRAMES, _STEP_MARGIN = 4, 1.25
# A grip scores more than the idle frames did, by this many times their scatter, and at least by this share of the
# calibration's grip: idle frames of other sessions score 0.06 at most, their grips from 0.12 on (docs/decisions/0042).
_FREE_SCATTERS, _LEAST_RISE = 3.0, 0.08
_LEAST_IDLE, _LEAST_GRIPPED = 5, 20
# A session that begins on another day is a little off from both of the calibration's frames. One that deviates as
# little as this is of the same hour, and its score tells.
_CLEARLY_NEARER, _SAME_HOUR, _GRIPPED_SCORE = 0.8, 0.01, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class FingertipValidator:
    """One fingertip as it was at calibration: idle and gripped mean frames, noise (896,) in volts, grip discriminant.

    Channels that were dead then have infinite noise. Where no frame after a release was among them, the slow recovery
    of the gel could pass for a grip; a release is then known by its step: further than step_limit (in noises) within
    STEP_FRAMES frames, with a grip score that falls by more than fall_limit. Both are infinite otherwise.
    """

    side: str
    idle: FloatArray
    gripped: FloatArray
    noise: FloatArray
    grip_weights: FloatArray
    grip_threshold: float
    step_limit: float
    fall_limit: float

    @classmethod
    def fit(cls, side: str, *recordings: tuple[FloatArray, FloatArray, FloatArray]) -> Self:
        """Fit to the (n, 896) frames before the grip, in it, and after it (which may be none) of each recording.

        Each recording is seen from its own idle frames, for a gel drifts from one to the next.
        """
        n_idle, n_gripped = (min(len(one[i]) for one in recordings) for i in (0, 1))
        if n_idle < _LEAST_IDLE or n_gripped < _LEAST_GRIPPED:
            raise CalibrationError(
                f"side {side}: {n_idle} idle and {n_gripped} gripped frames are too few to tell a grip; "
                "begin the recording some seconds before gripping"
            )
        bases = [np.median(idle, axis=0) for idle, _, _ in recordings]
        noise = np.sqrt(np.mean([channel_noise(gripped) ** 2 for _, gripped, _ in recordings], axis=0))
        base = np.mean(bases, axis=0)
        scale = np.where(np.isfinite(noise), noise, 1.0) / (base + SMALL_V)
        floor = 0.3 * float(np.median(scale))
        scale = np.where(np.isfinite(noise), np.maximum(scale, floor), np.inf)
        relative = [tuple(relative_to(part, own) for part in one) for own, one in zip(bases, recordings, strict=True)]

        def discriminant(rows: slice) -> FloatArray:
            parts = [np.concatenate([one[i][rows] for one in relative]) / scale for i in range(3)]
            return _discriminant([part for part in parts if len(part)]) / scale

        # Of 896 channels some combination parts any frames: whether they differ shows on those it was not made from.
        half = discriminant(slice(0, None, 2))
        for one in relative:
            low, high = _apart([part[1::2] @ half for part in one])
            if high <= low:
                raise CalibrationError(
                    f"side {side}: gripped frames cannot be told from idle ones; did the fingertip touch the tool?"
                )
        weights = discriminant(slice(None))
        free = np.concatenate([one[0] @ weights for one in relative])
        threshold = float(np.quantile(free, 0.99)) + max(_FREE_SCATTERS * float(free.std()), _LEAST_RISE)
        step_limit = fall_limit = np.inf
        if not any(len(released) for _, _, released in recordings):
            gripped = [frames for _, frames, _ in recordings]
            score = [one[1] @ weights for one in relative]
            step_limit = _STEP_MARGIN * max(float(steps(frames, noise).max()) for frames in gripped)
            fall_limit = _STEP_MARGIN * max(float((one[:-STEP_FRAMES] - one[STEP_FRAMES:]).max()) for one in score)
        mean = np.concatenate([gripped for _, gripped, _ in recordings]).mean(axis=0)
        return cls(side, base, mean, noise, weights, threshold, step_limit, fall_limit)

    def idle_like(self, frame: FloatArray) -> bool:
        """Return whether a session's first frame is idle: not clearly nearer to the calibration's gripped frame."""
        known = Known(np.array([self.idle, self.gripped]), np.isfinite(self.noise))
        _, (from_idle, from_gripped) = known.compare(frame)
        even = frame / self.gain(frame)
        if min(from_idle, from_gripped) < _SAME_HOUR and self.grip(even, self.idle) > _GRIPPED_SCORE:
            return False
        return _CLEARLY_NEARER * from_idle <= from_gripped

    def gain(self, idle: FloatArray) -> float:
        """Return how much larger all voltages of an idle frame are than at calibration: no grip, but the gel's age."""
        found = float(Known(self.idle).gains(idle)[0])
        return found if found > 0 else 1.0

    def grip(self, frame: FloatArray, idle: FloatArray) -> float:
        """Return the grip's score, about 0 when idle and 1 as gripped at calibration; idle is this session's frame."""
        return float(relative_to(frame, idle) @ self.grip_weights)

    def released(self, frame: FloatArray, earlier: FloatArray, idle: FloatArray) -> bool | None:
        """Return whether the grip opened (True) or closed (False) since a frame STEP_FRAMES ago; None for neither."""
        if float((np.abs(frame - earlier) / self.noise).mean()) <= self.step_limit:
            return None
        fall = self.grip(earlier, idle) - self.grip(frame, idle)
        return fall > 0 if abs(fall) > self.fall_limit else None


class Known:
    """Frames (…, 896) that others are compared with, NaN at channels that are not usable or hardly above the noise."""

    def __init__(self, frames: FloatArray, usable: BoolArray | np.bool_ = np.True_) -> None:
        """Take the known frames, and which channels may be compared."""
        self.frames: FloatArray = np.where(usable & (frames > _WELL_ABOVE_NOISE_V), frames, np.nan)
        self.counts = np.isfinite(self.frames).sum(axis=-1).ravel()

    def gains(self, frame: FloatArray) -> FloatArray:
        """Return the gains (…, 1) that a frame has in common with each of the known ones, NaN where there is none."""
        found = [gain if gain > 0 else math.nan for gain in _medians(frame / self.frames, self.counts)]
        return np.array(found).reshape(*self.frames.shape[:-1], 1)

    def compare(self, frame: FloatArray) -> tuple[FloatArray, list[float]]:
        """Return by which shares (…, k, 896) a (…, 896) frame is off from k known ones, and a flat list of the medians.

        After the gain in common; NaN at channels that are not compared, and where there is no gain. The medians are
        infinite there, and where too few channels are compared.
        """
        off = np.abs(frame[..., None, :] / self.gains(frame[..., None, :]) - self.frames) / self.frames
        found = _medians(off, self.counts)
        return off, [
            one if n >= FEWEST_COMPARED and not math.isnan(one) else math.inf
            for one, n in zip(found, self.counts.tolist(), strict=True)
        ]


def _medians(rows: FloatArray, counts: IntArray) -> list[float]:
    """Return the median of the first `counts` (n,) sorted values of each (…, 896) row; NaN sorts last; 0 of none."""
    # Half the price of np.partition.
    ordered = np.sort(rows, axis=-1).reshape(-1, N_CHANNELS)
    return [
        (one.item((n - 1) // 2) + one.item(n // 2)) / 2 if n else 0.0
        for one, n in zip(ordered, counts.tolist(), strict=True)
    ]


def relative_to(frame: FloatArray, idle: FloatArray) -> FloatArray:
    """Return how far (…, 896) channels are from idle, relative to it."""
    return np.asarray((frame - idle) / (idle + SMALL_V))


def unsaturated(channels: FloatArray, usable: BoolArray) -> BoolArray:
    """Return which (m, 896) channels are usable still: too many that share a side's largest value are at the rail."""
    heights = channels if everywhere(usable) else np.where(usable, channels, -np.inf)
    counts = [int(np.count_nonzero(one == one.max())) for one in heights]
    if max(counts) < FEWEST_AT_RAIL:
        return usable
    largest = heights == heights.max(axis=-1, keepdims=True)
    return np.asarray(usable & ~(largest & (np.array(counts) >= FEWEST_AT_RAIL)[:, None]))


def _discriminant(parts: list[FloatArray]) -> FloatArray:
    """Return the weights of idle, gripped and maybe released frames: 0 for the mean idle frame, 1 for the gripped one.

    Directions in which the parts vary, and the one from idle to released, have no weight.
    """
    means = [part.mean(axis=0) for part in parts]
    spread = np.linalg.svd(np.vstack([part - mean for part, mean in zip(parts, means, strict=True)]), False)[2]
    nuisance = list(spread[:_N_NUISANCE])
    step = means[1] - means[0]
    if len(parts) == 3:
        nuisance.append(means[2] - means[0])
        step = means[1] - 0.5 * (means[0] + means[2])
    q = np.linalg.qr(np.array(nuisance).T)[0]
    direction = step - q @ (q.T @ step)
    return np.asarray(direction / float(direction @ step))


def _apart(scores: list[FloatArray]) -> tuple[float, float]:
    """Return the highest score of idle and released frames and the lowest of gripped ones, but for one in a hundred."""
    free = np.concatenate([scores[0], *scores[2:]])
    return float(np.quantile(free, 0.99)), float(np.quantile(scores[1], 0.01))


def channel_noise(frames: FloatArray) -> FloatArray:
    """Return the (896,) standard deviation of fast noise in (n, 896) frames, from their second differences.

    Slow signals cancel there. At least the converter's rounding; infinite for a channel that never changes at all.
    """
    noise = np.sqrt((np.diff(frames, 2, axis=0) ** 2).mean(axis=0) / 6.0)
    still = np.ptp(frames, axis=0) == 0
    return np.where(still, np.inf, np.maximum(noise, LEAST_NOISE_V))


def steps(frames: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the (n − STEP_FRAMES,) mean distances in noises that (n, 896) frames move within STEP_FRAMES frames."""
    return np.asarray((np.abs(frames[STEP_FRAMES:] - frames[:-STEP_FRAMES]) / noise).mean(axis=1))
