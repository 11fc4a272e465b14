"""A polynomial through measurements with its prediction interval, and the constants of 95 % intervals."""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from scipy.special import stdtrit

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError

CONFIDENCE = 0.95
# Standard deviations to either side of a Gaussian's mean that hold 95 %.
TWO_SIDED_95 = 1.96


class Interval(NamedTuple):
    """A value and the limits of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Polynomial:
    """y = Σ coefficients[i] (x − centre)^i, fitted by least squares to n points between x_low and x_high.

    residual_std has n − len(coefficients) degrees of freedom. spread is the inverse of the normal matrix, by rows: the
    curve's own uncertainty.
    """

    coefficients: tuple[float, ...]
    centre: float
    n: int
    residual_std: float
    x_low: float
    x_high: float
    spread: tuple[tuple[float, ...], ...]

    @classmethod
    def fit(cls, x: FloatArray, y: FloatArray, degree: int) -> Self:
        """Fit a polynomial to (n,) points; raises CalibrationError when they do not determine it and its residual."""
        if x.shape != y.shape or x.ndim != 1 or not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise CalibrationError(f"a fit needs as many finite x as y, not shapes {x.shape} and {y.shape}")
        distinct = len(np.unique(x))
        if distinct <= degree or len(x) < degree + 2:
            raise CalibrationError(
                f"{len(x)} measurements at {distinct} distinct places do not determine a curve of degree {degree}: "
                f"at least {degree + 2} at {degree + 1} places are needed"
            )
        centre = float(x.mean())
        powers = np.vander(x - centre, degree + 1, increasing=True)
        # By orthogonal columns: the normal matrix itself would lose half of the digits.
        q, r = np.linalg.qr(powers)
        coefficients = np.linalg.solve(r, q.T @ y)
        inverse = np.linalg.inv(r)
        residuals = y - powers @ coefficients
        return cls(
            coefficients=tuple(coefficients.tolist()),
            centre=centre,
            n=len(x),
            residual_std=float(np.sqrt(residuals @ residuals / (len(x) - degree - 1))),
            x_low=float(x.min()),
            x_high=float(x.max()),
            spread=tuple(tuple(row) for row in (inverse @ inverse.T).tolist()),
        )

    def __call__(self, x: float) -> float:
        """Return y at x."""
        return float(np.polynomial.polynomial.polyval(x - self.centre, self.coefficients))

    def interval(self, x: float) -> Interval:
        """Return y at x with the 95 % prediction interval of a single new measurement.

        y ± t s √(1 + pᵀ S p), with p the powers of x − centre, S the spread, s the residual_std, and t Student's
        quantile at 97.5 % with n − len(coefficients) degrees of freedom. It assumes independent Gaussian residuals of
        one size.
        """
        powers = (x - self.centre) ** np.arange(len(self.coefficients))
        t = float(stdtrit(self.n - len(powers), (1 + CONFIDENCE) / 2))
        half = t * self.residual_std * float(np.sqrt(1.0 + powers @ np.array(self.spread) @ powers))
        y = self(x)
        return Interval(y, y - half, y + half)
