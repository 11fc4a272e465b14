"""Gain of a torque: how much it changes between recordings, and its correction by twists of known torque.

The same twist moves the gel differently in another grip, so the estimates of a recording have an error in common that
grows with the torque. Its size is a random effect: estimated where several recordings were given, with a prior that
counts as some recordings more. A correction is a regression with that prior (empirical Bayes): one twist moves the
gain only as far as twists of one recording agree.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.estimation.confidence import TWO_SIDED_95

# Standard deviation of the logarithm of one fingertip's gain between recordings, and the recordings that it counts as.
# Cylinders and days recorded twice differ by factors of 0.44 to 1.4.
PRIOR_SPREAD, _PRIOR_RECORDINGS = 0.28, 3
# Twists of a recording differ at least by this; a few alike are chance.
_LEAST_WITHIN = 0.05
_LEAST_NOISE, _LEAST_ZERO, _ROUNDS = 1e-3, 1e-6, 200
# Furthest diameter beyond the calibrated ones, as a ratio, and rounds that the gains of recordings need to settle.
_REACH, _GAIN_ROUNDS = 1.5, 8
# A frame is loaded above this share of the largest torque.
LOADED_SHARE = 0.1
# Gains outside these mean a twist that was missed or has the wrong sign, and are clipped.
_LEAST_GAIN, _LARGEST_GAIN = 0.2, 5.0


@dataclass(frozen=True, slots=True)
class GainSpread:
    """Standard deviations of the gain's logarithm, and of the rest of a loaded frame's error in N·m.

    `between` is of one recording to the next, and as certain as from this number of `recordings`; `within` is of one
    twist to the next. `zero` is of the torque without motion, as a share of the load: 0 for the calibration's tool.
    """

    between: float = 0.0
    within: float = _LEAST_WITHIN
    noise_nm: float = 0.0
    recordings: int = _PRIOR_RECORDINGS
    zero: float = 0.0

    @classmethod
    def fit(cls, predicted: FloatArray, truth: FloatArray, recordings: Sequence[float], m: int) -> Self:
        """Return the spread from (n,) predictions of left-out frames and their truth.

        `recordings` are the gains of recordings left out of the fit; m fingertips share the prior.
        """
        twists = find_twists(truth)
        gains = [_gain(predicted[rows], truth[rows]) for rows in twists]
        residuals = [truth[rows] - gain * predicted[rows] for gain, rows in zip(gains, twists, strict=True)]
        noise_nm = float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))) if twists else 0.0
        noise_nm = max(noise_nm, _LEAST_NOISE * float(np.abs(truth).max(initial=0.0)))
        within = float(np.std(np.log(gains))) if twists else 0.0
        prior = cls(PRIOR_SPREAD / math.sqrt(m), max(within, _LEAST_WITHIN), noise_nm)
        return prior._with_recordings([math.log(one) ** 2 for one in recordings])

    def _with_recordings(self, squares: Sequence[float]) -> Self:
        """Return the spread after recordings with these squares of the gain's logarithm."""
        n = self.recordings + len(squares)
        return replace(self, between=math.sqrt((self.recordings * self.between**2 + sum(squares)) / n), recordings=n)

    def reach(self, value: float) -> tuple[float, float]:
        """Return how far the truth may lie below and above a value, at 95 %, because of the gain."""
        factor = math.exp(TWO_SIDED_95 * self.between)
        inward, outward = abs(value) * (1.0 - 1.0 / factor), abs(value) * (factor - 1.0)
        return (inward, outward) if value > 0 else (outward, inward)

    def correct(
        self, parts: FloatArray, truth: FloatArray, twists: Sequence[IntArray], *, bounded: bool
    ) -> "GainCorrection":
        """Return the factors on the parts (n, m) of predictions that m fingertips add, and the offset.

        Frames of a twist share its gain, so a long twist determines the gain no better than twists agree. With
        `bounded` a frame without load counts only while it is predicted above zero.
        """
        m, loaded, total = parts.shape[1], np.concatenate(twists), parts.sum(axis=1)
        load_nm = float(np.sqrt((truth[loaded] ** 2).mean()))
        # This recording's gain counts for the spread too, less the part that noise and twists explain.
        excess = math.log(_gain(total[loaded], truth[loaded])) ** 2 - self.within**2 / len(twists)
        excess -= self.noise_nm**2 / max(float(total[loaded] @ total[loaded]), self.noise_nm**2)
        spread = self._with_recordings([max(excess, 0.0)])
        columns = np.column_stack([parts, np.ones(len(parts))])
        unloaded = np.setdiff1d(np.arange(len(truth)), loaded)
        prior = np.append(np.full(m, m * spread.between**2), (max(self.zero, _LEAST_ZERO) * load_nm) ** 2)
        weighted, information = np.zeros((len(truth), m + 1)), np.diag(1.0 / prior)
        for rows in twists:
            # One equation per twist, along its torque: errors of its shape come from delays, not from the gain.
            along, power = truth[rows], float(truth[rows] @ truth[rows])
            variance = power * (self.noise_nm**2 + self.within**2 * power)
            weighted[rows] = np.outer(along, along @ columns[rows]) / variance
        # The unloaded frames before a twist have one error in common.
        weighted[unloaded] = columns[unloaded] * len(twists) / (max(len(unloaded), 1) * self.noise_nm**2)
        covariance = np.linalg.inv(information + weighted.T @ columns)
        change, target = np.zeros(m + 1), truth.copy()
        for _ in range(_ROUNDS):
            if bounded:
                target[unloaded] = np.minimum(total + columns @ change, 0.0)[unloaded]
            change = covariance @ (weighted.T @ (target - total))
        # Unloaded frames predicted below zero carry no information about a bound.
        informative = np.union1d(loaded, np.flatnonzero((total + columns @ change > 0) | (not bounded)))
        covariance = np.linalg.inv(information + weighted[informative].T @ columns[informative])
        factors = np.clip(1.0 + change[:m], _LEAST_GAIN, _LARGEST_GAIN)
        corrected = parts @ factors + change[m]
        spread_nm2 = np.einsum("ni,ij,nj->n", columns[loaded], covariance, columns[loaded]).mean()
        relative = float(np.sqrt(spread_nm2 / (corrected[loaded] ** 2).mean()))
        spread = replace(spread, between=min(relative, spread.between))
        return GainCorrection(factors, np.sqrt(np.diag(covariance))[:m], float(change[m]), spread, len(twists))


@dataclass(frozen=True, slots=True, eq=False)
class GainCorrection:
    """Factors (m,) on the torques of m fingertips with their standard errors, and the offset of their sum.

    `spread` is the gain's spread that remains, `twists` their number. Where an estimator combines its fingertips
    otherwise, m is 1.
    """

    factors: FloatArray
    errors: FloatArray
    offset_nm: float
    spread: GainSpread
    twists: int


@dataclass(frozen=True, slots=True)
class ToolLaw:
    """Gain over the tool's diameter: ln gain = intercept + slope · ln diameter, and its error on a diameter left out.

    The diameters in mm reach from low_mm to high_mm.
    """

    intercept: float
    slope: float
    spread: float
    low_mm: float
    high_mm: float

    @classmethod
    def fit(cls, diameters_mm: FloatArray, gains: FloatArray) -> Self:
        """Fit to (n,) gains of tools of three diameters or more."""
        x, y = np.log(diameters_mm), np.log(gains)
        slope, intercept = np.polyfit(x, y, 1)
        errors = [
            y[x == one] - np.polyval(np.polyfit(x[x != one], y[x != one], 1), one) for one in np.unique(x).tolist()
        ]
        spread = float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
        return cls(float(intercept), float(slope), spread, float(diameters_mm.min()), float(diameters_mm.max()))

    def gain(self, diameter_mm: float) -> float | None:
        """Return the gain on a tool, None too far from the calibrated ones."""
        if not self.low_mm / _REACH <= diameter_mm <= self.high_mm * _REACH:
            return None
        return math.exp(self.intercept + self.slope * math.log(diameter_mm))


def gains_of_recordings(
    numbers: IntArray, torque_nm: FloatArray, predict: Callable[[IntArray, IntArray, FloatArray], FloatArray]
) -> FloatArray:
    """Return the gain of each recording in one unit of motion, from the recording's number of each of (n,) rows.

    predict(kept, out, values (n,)) fits values on some rows and predicts them on others. The gains are those that make
    each recording's torque predictable from the others'.
    """
    each = [np.flatnonzero(numbers == one) for one in np.unique(numbers)]
    gains = np.array([np.sqrt((torque_nm[rows] ** 2).mean()) for rows in each])
    for _ in range(_GAIN_ROUNDS):
        values = torque_nm / gains[numbers]
        found = [
            loaded_gain(predict(np.flatnonzero(numbers != one), rows, values), values[rows])
            for one, rows in enumerate(each)
        ]
        gains *= found / np.exp(np.log(found).mean())
    return gains


def find_twists(torque_nm: FloatArray) -> list[IntArray]:
    """Return the rows of each stretch of loaded frames in (n,) torques."""
    loaded = np.abs(torque_nm) > LOADED_SHARE * float(np.abs(torque_nm).max(initial=0.0))
    rows = np.flatnonzero(loaded)
    return [one for one in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(one)]


def loaded_gain(predicted: FloatArray, truth: FloatArray) -> float:
    """Return the factor on (n,) predictions that fits the truth of the loaded frames best."""
    rows = np.abs(truth) > LOADED_SHARE * float(np.abs(truth).max())
    return _gain(predicted[rows], truth[rows])


def _gain(predicted: FloatArray, truth: FloatArray) -> float:
    squares = float(predicted @ predicted)
    gain = float(predicted @ truth) / squares if squares else _LARGEST_GAIN
    return min(max(gain, _LEAST_GAIN), _LARGEST_GAIN)
