"""Linear maps from features to a value.

`Ridge` is for features that contain the value linearly. `CensoredRidge` is for a load cell that a lever pushes from one
side only: where it reads nothing the twist may be anything below, so these frames bound the value.
"""

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray

# Readings below this fraction of the largest torque mean that the lever does not touch.
CENSORED_FRACTION = 0.02
# Their bound lies this fraction of it below zero. Of 0 to 0.3 this has the least error on recorded twists left out.
_MARGIN_FRACTION = 0.05
_MIN_SIGMA_FRACTION, _HINGE_ROUNDS = 0.01, 50
# Penalties to choose from, in units of the features' sum of squares.
STRENGTHS = tuple(10.0**power for power in range(-6, 1))


class Predictor(Protocol):
    """Predicts a value from features."""

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the values of (…, d) features."""


@dataclass(frozen=True, slots=True, eq=False)
class Ridge:
    """value = offset + (features − mean) · weights; strength is the chosen penalty."""

    mean: FloatArray
    weights: FloatArray
    offset: float
    strength: float

    @classmethod
    def fit(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit to (n, d) features of one unit and (n,) values; strength is in units of the features' sum of squares."""
        mean, offset = features.mean(axis=0), float(values.mean())
        centred, errors = features - mean, values - offset
        penalty = strength * float((centred**2).sum())
        if len(features) < features.shape[1]:
            # The n × n products of n frames give the same weights, for a tenth of the work.
            within = centred @ centred.T + penalty * np.eye(len(features))
            return cls(mean, centred.T @ np.linalg.solve(within, errors), offset, strength)
        u, s, vt = np.linalg.svd(centred, full_matrices=False)
        return cls(mean, vt.T @ (s / (s**2 + penalty) * (u.T @ errors)), offset, strength)

    @classmethod
    def fit_scaled(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit with each feature in units of its own spread: for features of different kinds."""
        spread = features.std(axis=0)
        spread = np.where(spread > 0, spread, 1.0)
        scaled = cls.fit(features / spread, values, strength)
        return cls(scaled.mean * spread, scaled.weights / spread, scaled.offset, strength)

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the values of (…, d) features."""
        return np.asarray(self.offset + (features - self.mean) @ self.weights)

    def scaled(self, factor: float) -> Self:
        """Return the ridge of values larger by a factor."""
        return replace(self, weights=factor * self.weights, offset=factor * self.offset)


@dataclass(frozen=True, slots=True, eq=False)
class CensoredRidge(Ridge):
    """A ridge with readings of no load as upper bounds; `sign` is the direction of the lever's push.

    It predicts a latent value along the sign. If the value is below zero, the lever does not touch: no torque.
    """

    sigma: float
    sign: float

    @classmethod
    def fit(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit to (n, d) features and (n,) values of one sign; `sigma` is the error of frames with load.

        A frame without load counts only while it is predicted above its bound (squared hinge loss, by Newton steps).
        """
        sign = sign_of_loads(values)
        y = sign * values
        touching = y >= CENSORED_FRACTION * y.max()
        bound = -_MARGIN_FRACTION * float(y.max())
        y, centred = np.where(touching, y, bound), features - features.mean(axis=0)
        penalty = strength * float((centred**2).sum()) * np.eye(features.shape[1])
        counting: BoolArray = np.ones(len(y), dtype=np.bool_)
        for _ in range(_HINGE_ROUNDS):
            mean, offset = features[counting].mean(axis=0), float(y[counting].mean())
            moved = features[counting] - mean
            weights = np.linalg.solve(moved.T @ moved + penalty, moved.T @ (y[counting] - offset))
            predicted = offset + (features - mean) @ weights
            before, counting = counting, touching | (predicted > bound)
            if (counting == before).all():
                break
        error = float(np.sqrt(((y - predicted)[touching] ** 2).mean()))
        return cls(mean, weights, offset, strength, max(error, _MIN_SIGMA_FRACTION * float(y.max())), sign)

    def scaled(self, factor: float) -> Self:
        """Return the ridge of values larger by a factor."""
        return replace(Ridge.scaled(self, factor), sigma=factor * self.sigma)


def sign_of_loads(torque_nm: FloatArray) -> float:
    """Return the sign of the largest of (n,) torques, 1 or −1."""
    return 1.0 if torque_nm[np.argmax(np.abs(torque_nm))] > 0 else -1.0


def is_one_sided(torque_nm: FloatArray) -> bool:
    """Return whether a load cell was pushed from one side only, and was free of load for much of the time."""
    along = sign_of_loads(torque_nm) * torque_nm
    largest = float(along.max())
    return bool(along.min() > -0.05 * largest and (along < 0.02 * largest).mean() > 0.2)
