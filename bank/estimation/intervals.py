"""95 % intervals from what went wrong on later data: residuals of frames that came after those fitted to.

Split-conformal in strata of the prediction (Vovk 2012): free of load, about to touch, loaded. In each stratum the half
width is the 95 % quantile of the absolute residuals with the correction for a finite sample, so that the many easy
frames without load do not pay for the few hard ones. Drift makes the future worse than the past: `inflation`.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.special import stdtrit

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.polynomial import TWO_SIDED_95
from shearloop.bank.errors import CalibrationError

LEVEL = 0.95
LEAST_IN_STRATUM = 20
_LEAST_RESIDUALS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Intervals:
    """Half widths (s,) of the strata that the (s − 1,) edges part the predictions into."""

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
    ) -> Self:
        """Fit to (n,) predictions and their residuals on later data; a stratum with few of them joins the next.

        Raises CalibrationError for so few that no quantile can be told.
        """
        if len(residuals) < _LEAST_RESIDUALS:
            raise CalibrationError(
                f"{len(residuals)} later frames cannot tell how far estimates go astray; record more repeats"
            )
        kept: list[float] = []
        for edge in sorted(edges):
            low = kept[-1] if kept else -np.inf
            inside = np.count_nonzero((predicted > low) & (predicted <= edge))
            above = np.count_nonzero(predicted > edge)
            if inside >= LEAST_IN_STRATUM and above >= LEAST_IN_STRATUM:
                kept.append(float(edge))
        stratum = np.searchsorted(kept, predicted)
        widths = [_quantile(np.abs(residuals[stratum == i])) for i in range(len(kept) + 1)]
        return cls(np.array(kept), np.maximum(inflation * np.array(widths), least_half_width))

    def half_width(self, predicted: float) -> float:
        """Return half of the 95 % interval's width at this prediction."""
        return float(self.half_widths[self.edges.searchsorted(predicted)])


def for_few(n: int) -> float:
    """Return by how much wider a 95 % interval is because its width was told by n values alone (Student 1908)."""
    return float(stdtrit(n - 1, (1 + LEVEL) / 2)) / TWO_SIDED_95


def _quantile(absolute: FloatArray) -> float:
    """Return the conformal quantile; of few residuals the Gaussian one, since the largest of them says too little."""
    n = len(absolute)
    gaussian = TWO_SIDED_95 * float(np.sqrt((absolute**2).mean()))
    if n < 2 * LEAST_IN_STRATUM:
        return gaussian
    return float(np.quantile(absolute, min(LEVEL * (n + 1) / n, 1.0), method="higher"))
