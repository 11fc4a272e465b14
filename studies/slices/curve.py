"""Frames as a curve over the value, with correlated drift: classical calibration by generalised least squares.

Unlike a ridge it does not pull estimates towards the mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.bank_match import parabola_top
from shearloop.estimation.values import INLINE
from shearloop.words import counted

# Penalties of the curve's higher terms and of the trend, as this many frames without them. From 10 to 100 for the trend
# the error on later slices is nearly the same; without a trend it is a sixth larger (docs/decisions/0042).
_CURVATURE, _TREND, N_TREND = 3.0, 30.0, 2
# The paper's number: with this many of the 896 channels its regression was four fifths as good as with all.
N_RANKED = 272


@dataclass(frozen=True, slots=True, eq=False)
class Ageing:
    """Changes (2, q) of offset and slope by e-foldings of the age from last_t on."""

    trend: FloatArray
    first_t: float
    last_t: float

    def log_age(self, t: FloatArray) -> FloatArray:
        """Return the age of frames since last_t in e-foldings of the time since first_t; negative before last_t."""
        return np.asarray(np.log((1.0 + np.maximum(t - self.first_t, 0.0)) / (1.0 + self.last_t - self.first_t)))


@dataclass(frozen=True, slots=True, eq=False)
class InverseCalibration:
    """Frames as a polynomial of the value, coefficients (degree + 1, q), with drift along `drift` (r, q) and noise.

    It uses the q of a frame's d channels that correlate best with the value; others bring more drift. Each is in units
    of its own `spread` (q,) about the curve, drawn half towards the spread of all. Offset and slope change with age.

    The value of a frame minimises (x − curve)ᵀ Σ⁻¹ (x − curve), Σ = driftᵀ diag(drift_variance) drift + noise² I.
    """

    channels: IntArray
    spread: FloatArray
    coefficients: FloatArray
    ageing: Ageing = field(metadata=INLINE)
    drift: FloatArray
    drift_variance: FloatArray
    noise: float
    centre: float
    scale: float
    low: float
    high: float

    @classmethod
    def fit(cls, frames: FloatArray, values: FloatArray, degree: int, n_drift: int, *, trend: bool = False) -> Self:
        """Fit to (n, d + 1) frames of (n,) values in time order; the last column is each frame's time.

        Frames should be about one unit of time apart.
        """
        frames, t = frames[:, :-1], frames[:, -1]
        n, n_trend = len(values), N_TREND * trend
        centre, scale = float(values.mean()), float(values.std())
        n_distinct = len(np.unique(values))
        least_values, least_frames = degree + 1, degree + n_trend + n_drift + 3
        if n_distinct < least_values or n < least_frames or scale == 0:
            raise CalibrationError(
                f"{counted(n, 'frame')} at {counted(n_distinct, 'distinct value')} cannot determine a curve of "
                f"degree {degree} and its noise; record more, at more values: {least_values} values and {least_frames} "
                "frames must remain where some are left out for validation"
            )
        z = (values - centre) / scale
        spread = _spread_about_parabola(frames, z)
        channels = np.sort(ranked_channels(frames / spread, values)[:N_RANKED])
        frames, spread = (frames / spread)[:, channels], spread[channels]
        ageing = Ageing(np.zeros((0, len(channels))), float(t[0]), float(t[-1]))
        age = ageing.log_age(t)
        powers = np.vander(z, degree + 1, increasing=True)
        columns = np.hstack([powers, powers[:, :n_trend] * age[:, None]])
        # The trend's penalty is in units of its own spread.
        penalties = np.diag([0.0, 0.0] + [_CURVATURE] * (degree - 1) + [_TREND * float(age.var())] * n_trend)
        penalties[1, 1] = _slope_penalty(frames, columns, penalties)
        coefficients = np.linalg.solve(columns.T @ columns + penalties, columns.T @ frames)
        _, s, vt = np.linalg.svd(frames - columns @ coefficients, full_matrices=False)
        freedom = n - columns.shape[1]
        noise = float(np.sqrt((s[n_drift:freedom] ** 2).sum() / (freedom - n_drift) / frames.shape[1]))
        if noise == 0:
            raise CalibrationError("the frames have no noise: no real board sent them")
        span = float(np.ptp(values))
        return cls(
            channels, spread, coefficients[: degree + 1], replace(ageing, trend=coefficients[degree + 1 :]),
            vt[:n_drift], s[:n_drift] ** 2 / freedom, noise, centre, scale,
            float(values.min()) - 0.5 * span, float(values.max()) + 0.5 * span,
        )  # fmt: skip

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the values of (…, d + 1) frames; the last column is the time, and NaN channels are ignored.

        A time before the last fitted one counts as that one: the user started counting again.
        """
        values = [self._value(frame) for frame in features.reshape(-1, features.shape[-1])]
        return np.array(values).reshape(features.shape[:-1])

    def _value(self, frame: FloatArray) -> float:
        """Return the value of least cost on a grid, refined by a parabola through the least three."""
        x, t = frame[self.channels] / self.spread, float(frame[-1])
        keep = np.isfinite(x)
        b, v = self.coefficients[:, keep], self.drift[:, keep]
        ageing = self.ageing
        age = float(ageing.log_age(np.array([max(t, ageing.last_t)]))[0])
        b[: len(ageing.trend)] += age * ageing.trend[:, keep]
        inner = np.linalg.inv(np.diag(self.noise**2 / self.drift_variance) + v @ v.T)
        weights = (b - (b @ v.T) @ inner @ v) / self.noise**2
        grid = np.linspace(self.low, self.high, 401)
        powers = np.vander((grid - self.centre) / self.scale, len(b), increasing=True)
        cost = np.einsum("ij,jk,ik->i", powers, weights @ b.T, powers) - 2 * powers @ (weights @ x[keep])
        return parabola_top(-cost, int(np.argmin(cost)), grid)


@dataclass(frozen=True, slots=True, eq=False)
class CurveMean:
    """The mean value of several curves, whose single errors differ most between the levels of the values."""

    curves: tuple[InverseCalibration, ...]

    @classmethod
    def fit(
        cls, frames: FloatArray, values: FloatArray, degrees: Sequence[int], n_drift: int, *, trend: bool = False
    ) -> Self:
        """Fit a curve of each degree as `InverseCalibration.fit` does."""
        return cls(tuple(InverseCalibration.fit(frames, values, degree, n_drift, trend=trend) for degree in degrees))

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the values of (…, d + 1) frames; the last column is the time."""
        return np.asarray(np.mean([curve.predict(features) for curve in self.curves], axis=0))


def _slope_penalty(frames: FloatArray, columns: FloatArray, penalties: FloatArray) -> float:
    """Return the penalty of the slopes of (n, q) frames over the second of (n, p) columns (empirical Bayes).

    The channels that correlate best have slopes that are too steep by chance. The penalty is the variance of the noise
    over the variance of the true slopes.
    """
    inverse = np.linalg.inv(columns.T @ columns + penalties)
    coefficients = inverse @ columns.T @ frames
    n, p = columns.shape
    variance = float(((frames - columns @ coefficients) ** 2).mean()) * n / (n - p)
    error = variance * float(inverse[1, 1])
    return float(variance / max((coefficients[1] ** 2).mean() - error, error))


def _spread_about_parabola(frames: FloatArray, z: FloatArray) -> FloatArray:
    """Return the (d,) root mean square of each channel about its parabola, half of it from the median of all."""
    degree = min(2, len(np.unique(z)) - 1)
    powers = np.vander(z, degree + 1, increasing=True)
    penalty = np.diag([0.0, 0.0] + [_CURVATURE] * (degree - 1))
    squares = ((frames - powers @ np.linalg.solve(powers.T @ powers + penalty, powers.T @ frames)) ** 2).mean(axis=0)
    # The median keeps channels that never change finite.
    return np.asarray(np.sqrt(0.5 * squares + 0.5 * np.median(squares) + np.finfo(np.float64).tiny))


def ranked_channels(frames: FloatArray, values: FloatArray) -> IntArray:
    """Return the numbers of the (n, d) frames' channels by falling |correlation| with the (n,) values."""
    spread = frames.std(axis=0)
    covariance = np.abs((frames - frames.mean(axis=0)).T @ (values - values.mean()))
    return np.argsort(-covariance / np.where(spread > 0, spread, np.inf), kind="stable")
