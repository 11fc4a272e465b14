"""A regressor of slices with 95 % prediction intervals, and its fit.

The interval of a value y is y ± h: h is the half width of the residuals on slices left out. It is widened for a
response that is missing, and for values beyond the calibrated ones that the prediction may hide.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.estimation.interval_fit import (
    INFLATION,
    MIN_HALF_WIDTH,
    best_strength,
    check_values,
    fit_intervals,
    student_inflation,
)
from shearloop.estimation.interval_regressor import Intervals, Predicted
from shearloop.estimation.left_out import LeftOut, left_out_blocks
from shearloop.estimation.values import INLINE
from shearloop.studies.slices.curve import CurveMean
from shearloop.studies.slices.hidden_values import SlicePoint, SliceRange, range_of_slices

SliceFit: TypeAlias = Callable[[FloatArray, FloatArray, float], SlicePoint]


@dataclass(frozen=True, slots=True, eq=False)
class SliceRegressor:
    """A point regressor with intervals, the range of values, and the mean (d,) of the features that it was fitted to.

    `line` reads values beyond the range.
    """

    point: SlicePoint
    intervals: Intervals
    range: SliceRange = field(metadata=INLINE)
    mean_feature: FloatArray
    line: SlicePoint | None = None

    def predict(self, features: FloatArray, usable_share: float = 1.0, complete: FloatArray | None = None) -> Predicted:
        """Return the value of (d,) features with its interval.

        With a fraction of the channels unusable, the interval grows by the root of it. `complete` (d,) are the features
        with a response that may be missing: the interval extends to their value.
        """
        rows = features[None] if complete is None else np.array([features, complete])
        value, *others = self.point.predict(rows).tolist()
        widening = 1.0 / math.sqrt(max(usable_share, 0.1))
        half = widening * self.intervals.half_width(value)
        moved = others[0] - value if others else 0.0
        below, above = self._guarded(features, value, half + max(-moved, 0.0), half + max(moved, 0.0))
        return Predicted(value, below, above)

    def _guarded(self, features: FloatArray, value: float, below: float, above: float) -> tuple[float, float]:
        """Return the interval's reach below and above a value, widened for values that the prediction may hide."""
        span = self.range
        if value <= span.low_end:
            below = math.inf
        if value >= span.high_end:
            above = math.inf
        if self.line is not None:
            # A line reads at least half of the way beyond the range.
            read = float(self.line.predict(features))
            below = max(below, value - 2 * read + span.low if read < span.low else 0.0)
            above = max(above, 2 * read - span.high - value if read > span.high else 0.0)
        return min(below, max(value - span.lowest, 0.0)), min(above, max(span.highest - value, 0.0))


def fit_slice_regressor(
    features: FloatArray,
    values: FloatArray,
    fit: SliceFit,
    *,
    strengths: tuple[float, ...],
    left_out: LeftOut = (),
    fit_line: SliceFit | None = None,
    full_range: bool = False,
) -> SliceRegressor:
    """Fit to (n, d) features and (n,) values in time order.

    `left_out` are pairs of rows to fit to and rows to validate on; by default blocks of time in turn. Torques come with
    `fit_line`: they keep their sign, and unless they cover the `full_range` that will ever occur, it fits what reads
    values beyond it. Raises CalibrationError where the data does not determine the fit.
    """
    check_values(values)
    strength = strengths[0] if len(strengths) == 1 else best_strength(features, values, fit, strengths)[0]
    blocks = list(left_out or left_out_blocks(len(values)))

    def refit(rows: IntArray) -> SlicePoint:
        return fit(features[rows], values[rows], strength)

    def refit_line(rows: IntArray) -> SlicePoint:
        return fit_line(features[rows], values[rows], strength) if fit_line is not None else refit(rows)

    parts = [refit(past) for past, _ in blocks]
    predicted = np.concatenate([part.predict(features[later]) for part, (_, later) in zip(parts, blocks, strict=True)])
    rows = np.concatenate([later for _, later in blocks])
    point, centre = fit(features, values, strength), features.mean(axis=0)
    least = MIN_HALF_WIDTH * float(np.ptp(values))
    intervals = fit_intervals(predicted, predicted - values[rows], (), _inflation(point, rows, left_out), least)
    if fit_line is None:
        return SliceRegressor(point, intervals, SliceRange(float(values.min()), float(values.max())), centre)
    span, line = range_of_slices(point, features, values, refit, None if full_range else refit_line)
    return SliceRegressor(point, intervals, span, centre, line)


def _inflation(point: SlicePoint, rows: IntArray, left_out: LeftOut) -> float:
    """Return the factor that widens the residuals of the left-out rows."""
    if left_out:
        return student_inflation(len(np.unique(rows)))
    return 1.0 if isinstance(point, CurveMean) else INFLATION
