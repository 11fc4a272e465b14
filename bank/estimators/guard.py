"""Whether a frame is one that a calibration can speak of: the right fingertip, gripping, undisturbed.

`SideGuard` for raw frames knows a fingertip by its pattern of voltages: the same one keeps it from day to day but for
a common gain and a few per cent, another does not (median deviation 0.03–0.07 against 0.15–0.19 between recordings of
two fingertips on two days). A grip is told by a linear discriminant that looks away from what twisting and the gel's
slow recovery change.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from bank.channels import N_CHANNELS
from bank.errors import CalibrationError
from bank.estimators.values import BoolArray, FloatArray

# One step of the board's converter, as measured on recorded frames; its rounding is the least noise there is.
_CONVERTER_STEP_V = 0.00215
LEAST_NOISE_V = float(_CONVERTER_STEP_V / np.sqrt(12.0))

# Median relative deviation, after the common gain, beyond which this is not the fingertip of the calibration.
LARGEST_DEVIATION = 0.12
# Added to voltages that others are divided by: below it a channel's relative change is noise.
_SMALL_V = 0.01
# Channels whose shape a fingertip is known by.
_WELL_ABOVE_NOISE_V = 0.03
# A channel that jumps from frame to frame by more than this many times its noise, and this much, is disturbed.
JUMP_NOISES, JUMP_V = 6.0, 0.008
LARGEST_JUMPING_SHARE = 0.12
LARGEST_UNUSABLE_SHARE = 0.25
# Directions in which frames move while gripped or idle, which the grip's discriminant looks away from.
_N_NUISANCE = 2
# A channel that is off by more than this share of what it should read, beyond the common gain, has lost its electrode.
# Recorded frames stay within 0.4, but for single channels while the grip closes.
_LOST_SHARE = 0.6
# No recorded frame has more than two channels at its largest value: so many are at an amplifier's rail.
_FEWEST_AT_RAIL = 9
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
class SideGuard:
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
        scale = np.where(np.isfinite(noise), noise, 1.0) / (base + _SMALL_V)
        floor = 0.3 * float(np.median(scale))
        scale = np.where(np.isfinite(noise), np.maximum(scale, floor), np.inf)
        relative = [
            tuple((part - own) / (own + _SMALL_V) for part in one) for own, one in zip(bases, recordings, strict=True)
        ]

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

    def seen(self, frame: FloatArray, usable: BoolArray) -> tuple[str | None, BoolArray]:
        """Return why a (896,) frame is not of the fingertip of the calibration, or None, and which channels are lost.

        Lost ones read what neither grip nor twist explains: a lost electrode, a crossed wire.
        """
        compared = [_compared(frame, known, usable) for known in (self.idle, self.gripped)]
        lost = np.ones(N_CHANNELS, dtype=np.bool_)
        for known, (judged, gain) in zip((self.idle, self.gripped), compared, strict=True):
            lost &= judged & (np.abs(frame - gain * known) > _LOST_SHARE * gain * known)
        deviation = min(
            _deviation(frame, known, *one) for known, one in zip((self.idle, self.gripped), compared, strict=True)
        )
        if deviation <= LARGEST_DEVIATION:
            return None, lost
        return (
            f"{self.side} fingertip: the voltages deviate by {100 * deviation:.0f} % from those at calibration, more "
            f"than {100 * LARGEST_DEVIATION:.0f} %; this is another fingertip or another gel, calibrate it",
            lost,
        )

    def idle_like(self, frame: FloatArray) -> bool:
        """Return whether a session's first frame is idle: not clearly nearer to the calibration's gripped frame."""
        known = np.isfinite(self.noise)
        from_idle, from_gripped = (
            _deviation(frame, one, *_compared(frame, one, known)) for one in (self.idle, self.gripped)
        )
        even = frame / self.gain(frame)
        if min(from_idle, from_gripped) < _SAME_HOUR and self.grip(even, self.idle) > _GRIPPED_SCORE:
            return False
        return _CLEARLY_NEARER * from_idle <= from_gripped

    def gain(self, idle: FloatArray) -> float:
        """Return how much larger all voltages of an idle frame are than at calibration: no grip, but the gel's age."""
        _, found = _compared(idle, self.idle, np.True_)
        return found if found > 0 else 1.0

    def grip(self, frame: FloatArray, idle: FloatArray) -> float:
        """Return the grip's score, about 0 when idle and 1 as gripped at calibration; idle is this session's frame."""
        return float((frame - idle) / (idle + _SMALL_V) @ self.grip_weights)

    def released(self, frame: FloatArray, earlier: FloatArray, idle: FloatArray) -> bool | None:
        """Return whether the grip opened (True) or closed (False) since a frame STEP_FRAMES ago; None for neither."""
        fall = self.grip(earlier, idle) - self.grip(frame, idle)
        if float((np.abs(frame - earlier) / self.noise).mean()) <= self.step_limit or abs(fall) <= self.fall_limit:
            return None
        return fall > 0

    def jumping_share(self, frame: FloatArray, before: FloatArray, usable: BoolArray) -> float:
        """Return the share of usable channels that jump between two frames further than their noise explains."""
        limit = np.maximum(JUMP_NOISES * np.sqrt(2.0) * self.noise, JUMP_V)
        return float(np.mean(np.abs(frame - before)[usable] > limit[usable])) if usable.any() else 1.0


def at_rail(channels: FloatArray, usable: BoolArray) -> BoolArray:
    """Return which usable (896,) channels share the largest value with too many others to be chance: saturated."""
    top = usable & (channels >= channels.max(initial=-np.inf, where=usable))
    return top if np.count_nonzero(top) >= _FEWEST_AT_RAIL else np.zeros_like(top)


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


def _compared(frame: FloatArray, known: FloatArray, usable: BoolArray | np.bool_) -> tuple[BoolArray, float]:
    """Return the (896,) channels that a frame is compared with a known one by, and the gain that they have in common.

    The gain is 0 without such channels.
    """
    judged = usable & (known > _WELL_ABOVE_NOISE_V)
    return judged, _median(frame[judged] / known[judged])


def _deviation(frame: FloatArray, known: FloatArray, judged: BoolArray, gain: float) -> float:
    """Return the median relative deviation of a frame from a known one after the common gain."""
    x, reference = frame[judged], known[judged]
    if len(x) < N_CHANNELS // 4 or gain <= 0:
        return np.inf
    return _median(np.abs(x / gain - reference) / reference)


def _median(values: FloatArray) -> float:
    """Return the median of (n,) numbers that are finite, at a third of the price of NumPy's; 0 of none."""
    middle, n = len(values) // 2, len(values)
    if n == 0:
        return 0.0
    if n % 2:
        return float(np.partition(values, middle)[middle])
    halves = np.partition(values, (middle - 1, middle))
    return float((halves[middle - 1] + halves[middle]) / 2)
