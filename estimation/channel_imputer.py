"""Imputes channels that died after the calibration."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.estimation.fingertip_validator import FingertipValidator

# Filled frames of the emulated rig, the recorded stream and formulas give estimates within a tenth of their error for
# 2 to 16 directions.
_MAX_DIRECTIONS = 4


@dataclass(frozen=True, slots=True, eq=False)
class ChannelImputer:
    """Gaussian model of gripped differences, to impute channels that died after the calibration.

    mean (m, c) in volts; modes (k, m, c) in volts, each one standard deviation; precision (m, c) in V⁻² is one
    over each channel's remaining variance, 0 for channels that were dead at calibration.
    """

    mean: FloatArray
    modes: FloatArray
    precision: FloatArray

    def check_shapes(self, sides: int, channels: int) -> None:
        """Raise ValueError where its arrays are not of these sides and channels."""
        one = (sides, channels)
        if self.mean.shape != one or self.precision.shape != one or self.modes.ndim != 3 or self.modes.shape[1:] != one:
            raise ValueError(f"the arrays for dead channels are not of {sides} sides of {channels} channels")

    @classmethod
    def fit(cls, positions: FloatArray, validators: tuple[FingertipValidator, ...]) -> Self:
        """Fit to the (n, m·c) differences of gripped frames in units of the validators' noises."""
        noise = np.array([validator.noise for validator in validators])
        alive = np.isfinite(noise)
        mean = positions.mean(axis=0)
        moved = positions - mean
        _, s, vt = np.linalg.svd(moved, full_matrices=False)
        directions = vt[:_MAX_DIRECTIONS]
        # No channel is known better than its own noise, the unit here.
        rest = np.maximum((moved - moved @ directions.T @ directions).std(axis=0), 1.0).reshape(noise.shape)
        scale = np.where(alive, noise, 0.0)
        spreads = s[:_MAX_DIRECTIONS] / np.sqrt(len(positions))
        modes = (spreads[:, None] * directions).reshape(-1, *noise.shape) * scale
        precision = np.where(alive, (rest * noise) ** -2.0, 0.0)
        return cls(mean.reshape(noise.shape) * scale, modes, precision)

    def impute(self, difference: FloatArray, usable: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return a (m, c) difference in volts with unusable channels at their conditional mean.

        Also return the (k, m, c) independent errors of the imputed channels, one standard deviation each.
        """
        k = len(self.modes)
        modes = self.modes.reshape(k, -1)
        weighted = modes * np.where(usable, self.precision, 0.0).ravel()
        # Condition the Gaussian in the modes: a (k, k) system instead of one of all channels.
        covariance = np.linalg.inv(np.eye(k) + weighted @ modes.T)
        moved = (covariance @ (weighted @ (difference - self.mean).ravel()) @ modes).reshape(difference.shape)
        errors = (np.linalg.cholesky(covariance).T @ modes).reshape(self.modes.shape)
        return np.where(usable, difference, self.mean + moved), np.where(usable, 0.0, errors)
