"""What channels would have said that died after the calibration, by those that are left: for what reads them all."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.estimation.fingertip_validator import FingertipValidator

# On the emulated rig, the recorded stream and formulas, from 2 to 16 of them, what is read of filled frames stays the
# same within a tenth of its error.
_MOST_DIRECTIONS = 4


@dataclass(frozen=True, slots=True, eq=False)
class ChannelImputer:
    """Gripped differences as a Gaussian: the mean (m, 896), in volts, and how they move together about it.

    shapes (k, m, 896) in volts each move by a standard deviation; weights (m, 896) in V⁻² are one over the variance of
    what is left of each channel, 0 of those that were dead already.
    """

    mean: FloatArray
    shapes: FloatArray
    weights: FloatArray

    @classmethod
    def fit(cls, places: FloatArray, guards: tuple[FingertipValidator, ...]) -> Self:
        """Fit to the (n, m·896) differences of gripped frames in units of the guards' noises."""
        noise = np.array([guard.noise for guard in guards])
        alive = np.isfinite(noise)
        mean = places.mean(axis=0)
        moved = places - mean
        _, s, vt = np.linalg.svd(moved, full_matrices=False)
        directions = vt[:_MOST_DIRECTIONS]
        # No channel is known better than its own noise, in whose units it is.
        rest = np.maximum((moved - moved @ directions.T @ directions).std(axis=0), 1.0).reshape(noise.shape)
        scale = np.where(alive, noise, 0.0)
        spreads = s[:_MOST_DIRECTIONS] / np.sqrt(len(places))
        shapes = (spreads[:, None] * directions).reshape(-1, *noise.shape) * scale
        weights = np.where(alive, (rest * noise) ** -2.0, 0.0)
        return cls(mean.reshape(noise.shape) * scale, shapes, weights)

    def filled(self, difference: FloatArray, usable: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return a (m, 896) difference in volts with unusable channels at their mean, given the usable ones.

        And (k, m, 896) independent ways in which it may be off, each by a standard deviation: the dead channels may be
        those that told.
        """
        k = len(self.shapes)
        shapes = self.shapes.reshape(k, -1)
        weighed = shapes * np.where(usable, self.weights, 0.0).ravel()
        # Conditioning of a Gaussian, by the directions: a (k, k) system instead of one of all channels.
        left = np.linalg.inv(np.eye(k) + weighed @ shapes.T)
        moved = (left @ (weighed @ (difference - self.mean).ravel()) @ shapes).reshape(difference.shape)
        ways = (np.linalg.cholesky(left).T @ shapes).reshape(self.shapes.shape)
        return np.where(usable, difference, self.mean + moved), np.where(usable, 0.0, ways)


def died(guards: tuple[FingertipValidator, ...], usable: BoolArray) -> tuple[str, ...]:
    """Return which fingertips lack channels that were read at calibration, as why nothing is read without these."""
    missing = [np.count_nonzero(~one & np.isfinite(guard.noise)) for guard, one in zip(guards, usable, strict=True)]
    return tuple(
        f"{guard.side} fingertip: channels that were read at calibration are dead or saturated, {n} of them, and this "
        "calibration cannot do without; look at the ribbon cable, or calibrate again as it is, or the estimator fused"
        for guard, n in zip(guards, missing, strict=True)
        if n
    )
