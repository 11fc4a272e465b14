"""Values beyond the calibrated ones, which a prediction within them may hide."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.estimation.interval_fit import MIN_FRAMES
from shearloop.estimation.interval_regressor import ValueRange
from shearloop.estimation.ridge import Ridge
from shearloop.studies.slices.curve import CurveMean

# Fraction of values left out at either end of the range to test extrapolation. It fails if the prediction covers less
# than half of the way beyond.
_AT_END, _LARGEST_SHORTFALL = 0.2, 0.5
# Left-out values count as at least this far beyond the rest, in spans: noise would dominate a shorter distance.
_MIN_DISTANCE = 0.05
# Values up to this many spans beyond the range can look familiar. Slices of 0.14 N·m do after a calibration below
# 0.06, 1.6 spans beyond, and no slice lies further (`extrapolation-torque-slices` of docs/charts.md).
_UNSEEN = 2.0
# Distance beyond the range that decides from where on a prediction may hide a value beyond: more doubts more good ones.
_LIKELY_UNSEEN = 0.5

SlicePoint: TypeAlias = Ridge | CurveMean
Refit: TypeAlias = Callable[[IntArray], SlicePoint]


@dataclass(frozen=True, slots=True)
class SliceRange(ValueRange):
    """The calibrated values, low to high, and what predictions at their ends may hide.

    Predictions at or below low_end may hide any lower value, those at or above high_end any higher one (−∞ and ∞ where
    none is hidden); lowest and highest are the furthest values that may occur.
    """

    lowest: float = -math.inf
    highest: float = math.inf
    low_end: float = -math.inf
    high_end: float = math.inf


def range_of_slices(
    point: SlicePoint, features: FloatArray, values: FloatArray, refit: Refit, refit_line: Refit | None
) -> tuple[SliceRange, SlicePoint | None]:
    """Return the range of slices and the line that reads values beyond it, if any can occur.

    Peaks of twists one way are of one sign, and no load is always possible.
    """
    low, high, beyond = float(values.min()), float(values.max()), _UNSEEN * float(np.ptp(values))
    span = SliceRange(low, high, 0.0 if low >= 0 else low - beyond, 0.0 if high <= 0 else high + beyond)
    if refit_line is None:
        return span, None
    low_end, high_end = (_range_end(point, features, values, refit, refit_line, sign) for sign in (1, -1))
    if low_end > high_end:
        # Every prediction may hide a value beyond either end.
        low_end, high_end = math.inf, -math.inf
    return replace(span, low_end=low_end, high_end=high_end), refit_line(np.arange(len(values)))


def _range_end(
    point: SlicePoint, features: FloatArray, values: FloatArray, refit: Refit, refit_line: Refit, sign: int
) -> float:
    """Return the prediction at or below which (sign −1: above which) the truth may lie anywhere further out.

    The outermost values are left out and predicted from the rest. If a line predicts them at its end or even within it,
    values beyond the whole range hide too, the more the further out they are; the end is then moved inwards for values
    `_LIKELY_UNSEEN` spans beyond. Otherwise nothing hides: the end is infinite.
    """
    outward = sign * values
    order = np.argsort(outward, kind="stable")
    # Equal values stay together, else those that remain would reveal the others.
    n_out = int((outward <= outward[order[round(_AT_END * len(values)) - 1]]).sum())
    out, kept = order[:n_out], np.sort(order[n_out:])

    def median(by: SlicePoint, rows: IntArray) -> float:
        return float(np.median(sign * by.predict(features[rows])))

    end, outermost = float(outward.min()), median(point, order[: max(n_out // 2, 1)])
    if len(kept) < MIN_FRAMES or np.ptp(values[kept]) == 0:
        # Untestable: no prediction as far out as the outermost ones now is known to be right.
        return sign * max(end, outermost)
    inside, true = float(outward[kept].min()), float(np.median(outward[out]))
    if not median(refit_line(kept), out) - true > _LARGEST_SHORTFALL * (inside - true) > 0:
        return -sign * math.inf
    span = float(np.ptp(values))
    shortfall = (median(refit(kept), out) - inside) / max(inside - true, _MIN_DISTANCE * span)
    return sign * max(end, end + shortfall * _LIKELY_UNSEEN * span, outermost)
