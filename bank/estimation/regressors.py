"""From features to a value: three regressions, each with its strength chosen on data later than what it was fitted to.

`Ridge` for features that hold the value linearly. `TobitRidge` for a load cell that a lever pushes from one side only:
where it reads nothing the twist may be anything below, so those frames bound the value instead of fixing it (Tobin
1958). `InverseCalibration` the other way round, frames as a smooth curve over the value with correlated drift beside
it (classical
calibration by generalised least squares): it does not pull estimates towards the mean as a ridge does.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.special import log_ndtr

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import CalibrationError

# Readings below this share of the largest torque count as "the lever does not touch".
CENSORED_SHARE = 0.02
_LEAST_SIGMA_SHARE = 0.01
_EM_ROUNDS = 100
N_BLOCKS = 5
FIRST_ORIGIN, N_ORIGINS, LEAST_BEFORE_ORIGIN = 0.6, 20, 12
# Terms beyond the linear one are held back as by so many frames that do not have them.
_CURVATURE = 3.0
# The same for how offset and slope drift with age. From 10 to 100 the error on later slices is nearly the same; without
# a trend it is a sixth larger (docs/decisions/0042).
_TREND, N_TREND = 30.0, 2
# The paper's own number: with so many of the 896 channels its regression was four fifths as good as with all.
N_RANKED = 272


@dataclass(frozen=True, slots=True, eq=False)
class Ridge:
    """value = offset + (features − mean) · weights, clipped to nothing; strength is the penalty that was chosen."""

    mean: FloatArray
    weights: FloatArray
    offset: float
    strength: float

    @classmethod
    def fit(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit to (n, d) features of one unit and (n,) values; strength is in units of the features' sum of squares."""
        mean, offset = features.mean(axis=0), float(values.mean())
        u, s, vt = np.linalg.svd(features - mean, full_matrices=False)
        penalty = strength * float((s**2).sum())
        weights = vt.T @ (s / (s**2 + penalty) * (u.T @ (values - offset)))
        return cls(mean, weights, offset, strength)

    @classmethod
    def fit_scaled(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit as `fit` does, with each feature in units of its own spread: for features of different kinds."""
        spread = features.std(axis=0)
        spread = np.where(spread > 0, spread, 1.0)
        scaled = cls.fit(features / spread, values, strength)
        return cls(scaled.mean * spread, scaled.weights / spread, scaled.offset, strength)

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the (n,) values of (n, d) features."""
        return np.asarray(self.offset + (features - self.mean) @ self.weights)

    def value(self, features: FloatArray) -> float:
        """Return the value of (d,) features."""
        return self.offset + float((features - self.mean) @ self.weights)


@dataclass(frozen=True, slots=True, eq=False)
class TobitRidge:
    """As a ridge, fitted with readings of no load as bounds; `sign` is the direction the lever is pushed in.

    The prediction is the latent value: beyond zero against the sign the lever does not touch, and the torque is zero.
    """

    mean: FloatArray
    weights: FloatArray
    offset: float
    strength: float
    sigma: float
    sign: float

    @classmethod
    def fit(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit by expectation–maximisation to (n, d) features and (n,) values of one sign."""
        largest = float(values[np.argmax(np.abs(values))])
        sign = 1.0 if largest > 0 else -1.0
        y = sign * values
        touching = y >= CENSORED_SHARE * y.max()
        mean = features.mean(axis=0)
        u, s, vt = np.linalg.svd(features - mean, full_matrices=False)
        gain = s / (s**2 + strength * float((s**2).sum()))
        latent, sigma = y.copy(), max(float(y[touching].std()), _LEAST_SIGMA_SHARE * y.max())
        for _ in range(_EM_ROUNDS):
            offset = float(latent.mean())
            coefficients = gain * (u.T @ (latent - offset))
            predicted = offset + u @ (s * coefficients)
            expected, variance = _below_zero(predicted[~touching], sigma)
            latent = y.copy()
            latent[~touching] = expected
            sigma = max(
                float(np.sqrt((((latent - predicted) ** 2).sum() + variance.sum()) / len(y))),
                _LEAST_SIGMA_SHARE * float(y.max()),
            )
        offset = float(latent.mean())
        weights = vt.T @ (gain * (u.T @ (latent - offset)))
        return cls(mean, weights, offset, strength, sigma, sign)

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the (n,) latent values of (n, d) features, in the direction of the lever's push."""
        return np.asarray(self.offset + (features - self.mean) @ self.weights)

    def value(self, features: FloatArray) -> float:
        """Return the latent value of (d,) features."""
        return self.offset + float((features - self.mean) @ self.weights)


def _below_zero(mean: FloatArray, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of Gaussians of this mean and sigma, given that they are below zero."""
    u = -mean / sigma
    ratio = np.exp(-0.5 * u**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(u))
    return mean - sigma * ratio, sigma**2 * np.clip(1 - u * ratio - ratio**2, 0.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class InverseCalibration:
    """Frames as a polynomial of the value, coefficients (degree + 1, q), with drift along `drift` (r, q) and noise.

    Of a frame's d channels only the q `channels` count that go best with the value: the others bring more drift. Each
    is in units of its own `spread` (q,) about the curve, drawn half towards that of all. What a value makes of a frame
    changes from repeat to repeat: offset and slope move by `trend` (2, q) as the logarithm of the age does, counted in
    e-foldings from `last_t` on.

    The value of a frame minimises (x − curve)ᵀ Σ⁻¹ (x − curve), Σ = driftᵀ diag(drift_variance) drift + noise² I.
    """

    channels: IntArray
    spread: FloatArray
    coefficients: FloatArray
    trend: FloatArray
    first_t: float
    last_t: float
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

        Any unit of time in which frames come about one apart. The terms beyond the linear one are held back as by three
        frames without them, the trend as by thirty.
        """
        frames, t = frames[:, :-1], frames[:, -1]
        n, n_trend = len(values), N_TREND * trend
        centre, scale = float(values.mean()), float(values.std())
        distinct = len(np.unique(values))
        least_values, least_frames = degree + 1, degree + n_trend + n_drift + 3
        if distinct < least_values or n < least_frames or scale == 0:
            # Of what was recorded these may be the rest, as without the largest fifth of the values.
            raise CalibrationError(
                f"{n} frames at {distinct} distinct values do not determine a curve of degree {degree} and its noise; "
                f"record more, at more different values: where some are left out and told by the rest, {least_values} "
                f"values and {least_frames} frames have to be left"
            )
        z = (values - centre) / scale
        spread = _spread_about_parabola(frames, z)
        channels = np.sort(ranked_channels(frames / spread, values)[:N_RANKED])
        frames, spread = (frames / spread)[:, channels], spread[channels]
        first_t, last_t = float(t[0]), float(t[-1])
        age = _age(t, first_t, last_t)
        powers = np.vander(z, degree + 1, increasing=True)
        columns = np.hstack([powers, powers[:, :n_trend] * age[:, None]])
        # A trend is held back in units of its own spread, as the values are in theirs.
        held_back = [0.0, 0.0] + [_CURVATURE] * (degree - 1) + [_TREND * float(age.var())] * n_trend
        coefficients = np.linalg.solve(columns.T @ columns + np.diag(held_back), columns.T @ frames)
        _, s, vt = np.linalg.svd(frames - columns @ coefficients, full_matrices=False)
        freedom = n - columns.shape[1]
        noise = float(np.sqrt((s[n_drift:freedom] ** 2).sum() / (freedom - n_drift) / frames.shape[1]))
        if noise == 0:
            raise CalibrationError("the frames have no noise at all: this is no recording of a real board")
        span = float(np.ptp(values))
        return cls(
            channels, spread, coefficients[: degree + 1], coefficients[degree + 1 :], first_t, last_t,
            vt[:n_drift], s[:n_drift] ** 2 / freedom, noise, centre, scale,
            float(values.min()) - 0.5 * span, float(values.max()) + 0.5 * span,
        )  # fmt: skip

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the (n,) values of (n, d + 1) frames, the last column being their times; NaN channels are left out.

        A time before the last one that was fitted to is taken for that one: somebody counts from the beginning again.
        """
        costs: dict[tuple[float, bytes], _Cost] = {}
        values = []
        for frame in features:
            x, t = frame[self.channels] / self.spread, float(frame[-1])
            keep = np.isfinite(x)
            # Mixtures are of a few times, with hundreds of frames each.
            key = t, keep.tobytes()
            if key not in costs:
                costs[key] = self._cost(keep, t)
            values.append(costs[key].least(x[keep]))
        return np.array(values)

    def value(self, features: FloatArray) -> float:
        """Return the value of a (d + 1,) frame, its time last; NaN channels are left out."""
        return float(self.predict(features[None])[0])

    def _cost(self, keep: BoolArray, t: float) -> "_Cost":
        """Return what a value costs at the time t, by a frame's (q,) channels to keep."""
        b, v = self.coefficients[:, keep], self.drift[:, keep]
        later = float(_age(np.array([max(t, self.last_t)]), self.first_t, self.last_t)[0])
        b[: len(self.trend)] += later * self.trend[:, keep]
        inner = np.linalg.inv(np.diag(self.noise**2 / self.drift_variance) + v @ v.T)

        def whitened(rows: FloatArray) -> FloatArray:
            return np.asarray((rows - (rows @ v.T) @ inner @ v) / self.noise**2)

        grid = np.linspace(self.low, self.high, 401)
        powers = np.vander((grid - self.centre) / self.scale, len(b), increasing=True)
        weights = whitened(b)
        return _Cost(grid, powers, weights, np.einsum("ij,jk,ik->i", powers, weights @ b.T, powers))


@dataclass(frozen=True, slots=True, eq=False)
class _Cost:
    """What values on a grid (g,) cost: of themselves (g,), and by powers (g, p) with weights (p, q) of a frame."""

    grid: FloatArray
    powers: FloatArray
    weights: FloatArray
    of_itself: FloatArray

    def least(self, x: FloatArray) -> float:
        """Return the value of a scaled frame (q,), which costs least."""
        return _refined(self.grid, self.of_itself - 2 * self.powers @ (self.weights @ x))


def _age(t: FloatArray, first_t: float, last_t: float) -> FloatArray:
    """Return how much older than at last_t frames are, in e-foldings of the time since the first; negative: younger."""
    return np.asarray(np.log((1.0 + np.maximum(t - first_t, 0.0)) / (1.0 + last_t - first_t)))


def _spread_about_parabola(frames: FloatArray, z: FloatArray) -> FloatArray:
    """Return the (d,) root mean square of each channel about its parabola, half of it from the median of all."""
    degree = min(2, len(np.unique(z)) - 1)
    powers = np.vander(z, degree + 1, increasing=True)
    penalty = np.diag([0.0, 0.0] + [_CURVATURE] * (degree - 1))
    squares = ((frames - powers @ np.linalg.solve(powers.T @ powers + penalty, powers.T @ frames)) ** 2).mean(axis=0)
    # A channel that never changed brings no infinity: half is everybody's.
    return np.asarray(np.sqrt(0.5 * squares + 0.5 * np.median(squares) + np.finfo(np.float64).tiny))


def _refined(grid: FloatArray, cost: FloatArray) -> float:
    """Return the minimum of a smooth cost on an even grid, by a parabola through the least three."""
    i = int(np.argmin(cost))
    if i in (0, len(grid) - 1):
        return float(grid[i])
    before, here, after = cost[i - 1 : i + 2]
    bend = before - 2 * here + after
    return float(grid[i] + (0.5 * (before - after) / bend if bend > 0 else 0.0) * (grid[1] - grid[0]))


def left_out_blocks(n: int) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield pairs of (rest, block) for N_BLOCKS blocks of n rows, each of them one stretch of time."""
    block = np.arange(n) * N_BLOCKS // n
    for one in range(N_BLOCKS):
        yield np.flatnonzero(block != one), np.flatnonzero(block == one)


def later_origins(n: int) -> list[tuple[IntArray, IntArray]]:
    """Return pairs of (earlier, all later) parts of n rows, from six tenths of the time on: what is yet to come.

    There are none where the first has fewer rows than tell how good this calibration is.
    """
    first = round(FIRST_ORIGIN * n)
    if first < LEAST_BEFORE_ORIGIN:
        return []
    return [(np.arange(cut), np.arange(cut, n)) for cut in range(first, n - 1, max(1, n // N_ORIGINS))]


def ranked_channels(frames: FloatArray, values: FloatArray) -> IntArray:
    """Return the numbers of the (n, d) frames' channels by falling |correlation| with the (n,) values."""
    spread = frames.std(axis=0)
    covariance = np.abs((frames - frames.mean(axis=0)).T @ (values - values.mean()))
    return np.argsort(-covariance / np.where(spread > 0, spread, np.inf), kind="stable")


def later_splits(n: int) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield pairs of (earlier, later) parts of n rows in time order: fit on the one, judge on the other."""
    for share in (0.4, 0.6, 0.8):
        cut, end = round(n * share), round(n * min(share + 0.2, 1.0))
        if cut >= 2 and end > cut:
            yield np.arange(cut), np.arange(cut, end)


def best_strength(
    strengths: Sequence[float],
    error_of: Callable[[float, IntArray, IntArray], float],
    splits: Sequence[tuple[IntArray, IntArray]],
) -> float:
    """Return the strength with the least mean squared error on the later parts; of equals, the strongest."""
    if not splits:
        raise CalibrationError("the values do not change within the earlier part; begin with the calibration's loads")
    errors = [float(np.mean([error_of(strength, *split) for split in splits])) for strength in strengths]
    return max(strength for strength, error in zip(strengths, errors, strict=True) if error <= min(errors) * 1.001)
