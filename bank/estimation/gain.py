"""Gain of a torque: how much it changes between recordings, and its correction by twists of known torque.

The same twist moves the gel differently in another grip, so the estimates of a recording have an error in common that
grows with the torque. Its size is a random effect: estimated where several recordings were given, with a prior that
counts as some recordings more. A correction is a regression with that prior (empirical Bayes): one twist moves the
gain only as far as twists of one recording agree.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.polynomial import TWO_SIDED_95

# Standard deviation of the logarithm of one fingertip's gain between recordings, and the recordings that it counts as.
# Cylinders and days recorded twice differ by factors of 0.44 to 1.4.
PRIOR_SPREAD, _PRIOR_RECORDINGS = 0.35, 3
# Twists of a recording differ at least by this; a few alike are chance.
_LEAST_WITHIN = 0.05
# A frame is loaded above this share of the largest torque.
LOADED_SHARE = 0.1
# A twist that is missed, or read the other way round, counts as one of these.
_LEAST_GAIN, _LARGEST_GAIN = 0.2, 5.0


@dataclass(frozen=True, slots=True)
class GainSpread:
    """Standard deviations of the gain's logarithm, and of a loaded frame in N·m beside the gain.

    `between` is of one recording to the next, `within` of one twist to the next.
    """

    between: float = 0.0
    within: float = _LEAST_WITHIN
    noise_nm: float = 0.0

    @classmethod
    def fit(
        cls, predicted: FloatArray, truth: FloatArray, twists: Sequence[IntArray], recordings: Sequence[float], m: int
    ) -> Self:
        """Return the spread from (n,) predictions of left-out frames, their truth, and the rows of each twist.

        `recordings` are the gains of recordings left out of the fit; m fingertips share the prior.
        """
        gains = [_gain(predicted[rows], truth[rows]) for rows in twists]
        residuals = [truth[rows] - gain * predicted[rows] for gain, rows in zip(gains, twists, strict=True)]
        noise_nm = float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))) if twists else 0.0
        within = float(np.std(np.log(gains))) if twists else 0.0
        prior = PRIOR_SPREAD**2 / m
        squares = sum(math.log(one) ** 2 for one in recordings)
        between = math.sqrt((_PRIOR_RECORDINGS * prior + squares) / (_PRIOR_RECORDINGS + len(recordings)))
        return cls(between, max(within, _LEAST_WITHIN), noise_nm)

    def reach(self, value: float) -> tuple[float, float]:
        """Return how far the truth may lie towards zero and away from it, at 95 %, because of the gain."""
        factor = math.exp(TWO_SIDED_95 * self.between)
        return abs(value) * (1.0 - 1.0 / factor), abs(value) * (factor - 1.0)

    def correct(
        self, parts: FloatArray, truth: FloatArray, twists: Sequence[IntArray]
    ) -> tuple[FloatArray, "GainSpread"]:
        """Return the (m,) factors on the parts (n, m) of predictions that m fingertips add, and the spread then.

        Frames of a twist share its gain, so a long twist determines the gain no better than twists agree.
        """
        m = parts.shape[1]
        information = np.eye(m) / (self.between**2 * m)
        towards = np.zeros(m)
        for rows in twists:
            own, total = parts[rows], parts[rows].sum(axis=1)
            error = self.noise_nm**2 * np.eye(len(rows)) + self.within**2 * np.outer(truth[rows], truth[rows])
            weighted = np.linalg.solve(error, own).T
            information += weighted @ own
            towards += weighted @ (truth[rows] - total)
        covariance = np.linalg.inv(information)
        factors = np.clip(1.0 + covariance @ towards, _LEAST_GAIN, _LARGEST_GAIN)
        loaded = parts[np.concatenate(twists)]
        relative = np.einsum("ni,ij,nj->n", loaded, covariance, loaded).mean() / ((loaded @ factors) ** 2).mean()
        return factors, replace(self, between=float(min(np.sqrt(relative), self.between)))


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
