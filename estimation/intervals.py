"""95 % prediction intervals from residuals on frames left out of a fit.

They are split-conformal in strata of the prediction (Vovk 2012), namely free of load, about to touch, loaded. In each
stratum the half width is the 95 % quantile of the absolute residuals with the correction for a finite sample, so that
many easy frames do not narrow the intervals of few hard ones.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.confidence import LEVEL, TWO_SIDED_95

MIN_IN_STRATUM = 20
_MIN_RESIDUALS = 5
# Narrowest interval as a fraction of the calibrated range: load cells are noisy too.
MIN_HALF_WIDTH = 1e-3
# Values further beyond the calibrated range, in spans of it, are refused as extrapolation.
_LARGEST_BEYOND = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class Intervals:
    """Half widths (s,) of the strata that the (s − 1,) edges divide the predictions into."""

    edges: FloatArray
    half_widths: FloatArray

    @classmethod
    def fit(
        cls,
        predicted: FloatArray,
        residuals: FloatArray,
        edges: tuple[float, ...],
        inflation: float,
        least_half_width: float = 0.0,
        inflation_of_loads: float | None = None,
    ) -> Self:
        """Fit to (n,) predictions and their residuals on data left out; a stratum with few of them joins the next.

        The uppermost stratum has an inflation of its own where it is given: loads are fewer.
        Raises CalibrationError for too few residuals.
        """
        if len(residuals) < _MIN_RESIDUALS:
            raise CalibrationError(
                f"too few frames left out of the fit to determine the error: {len(residuals)}; record more repeats"
            )
        kept: list[float] = []
        for edge in sorted(edges):
            low = kept[-1] if kept else -np.inf
            inside = np.count_nonzero((predicted > low) & (predicted <= edge))
            above = np.count_nonzero(predicted > edge)
            if inside >= MIN_IN_STRATUM and above >= MIN_IN_STRATUM:
                kept.append(float(edge))
        stratum = np.searchsorted(kept, predicted)
        widths = [_conformal_quantile(np.abs(residuals[stratum == i])) for i in range(len(kept) + 1)]
        widths[-1] *= (inflation_of_loads or inflation) / inflation
        return cls(np.array(kept), np.maximum(inflation * np.array(widths), least_half_width))

    def half_width(self, predicted: float) -> float:
        """Return half of the 95 % interval's width at this prediction."""
        return float(self.half_widths[self.edges.searchsorted(predicted)])


def _conformal_quantile(absolute: FloatArray) -> float:
    """Return the conformal quantile; of few residuals the Gaussian one, because their largest says too little."""
    n = len(absolute)
    if n < 2 * MIN_IN_STRATUM:
        return TWO_SIDED_95 * float(np.sqrt((absolute**2).mean()))
    return float(np.quantile(absolute, min(LEVEL * (n + 1) / n, 1.0), method="higher"))


@dataclass(frozen=True, slots=True)
class ValueRange:
    """The calibrated values, low to high."""

    low: float
    high: float

    def scaled(self, factor: float) -> "ValueRange":
        """Return the range of values larger by a factor."""
        return ValueRange(factor * self.low, factor * self.high)

    def reasons(self, value: float, quantity: str, unit: str) -> tuple[str, ...]:
        """Return the reason against a value far beyond the range, if there is one."""
        beyond = _LARGEST_BEYOND * (self.high - self.low)
        if self.low - beyond <= value <= self.high + beyond:
            return ()
        return (
            f"the {quantity} would be {value:.3g} {unit}, beyond the calibrated {self.low:.3g} to {self.high:.3g} "
            f"{unit}; tare with nothing gripped, or calibrate further",
        )
