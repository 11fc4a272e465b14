"""A regressor with 95 % prediction intervals.

The interval of a value y is y ± hypot(h, r): h is the half width of the residuals on frames left out
(`interval_fit.py`), and r the reach of the gain's error, which grows with the torque (`gain.py`). Guards widen it where
a prediction may be wrong by more.
"""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.estimation.gain import GainSpread
from shearloop.estimation.ridge import CensoredRidge, Predictor, Ridge
from shearloop.estimation.values import INLINE, TWO_SIDED_95

Regressor: TypeAlias = Ridge | CensoredRidge
# Features larger than any at calibration by this factor are refused.
_LARGEST_DEVIATION = 1.6
# Values further beyond the calibrated range, in spans of it, are refused as extrapolation.
_LARGEST_BEYOND = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class Intervals:
    """Half widths (s,) of the strata that the (s − 1,) edges divide the predictions into."""

    edges: FloatArray
    half_widths: FloatArray

    def half_width(self, predicted: float) -> float:
        """Return half of the 95 % interval's width at this prediction."""
        return float(self.half_widths[self.edges.searchsorted(predicted)])


@dataclass(frozen=True, slots=True)
class ValueRange:
    """The calibrated values, low to high."""

    low: float
    high: float

    def scaled(self, factor: float) -> "ValueRange":
        """Return the range of values larger by a factor."""
        return ValueRange(factor * self.low, factor * self.high)

    @property
    def ends(self) -> tuple[float, float]:
        """The smallest and the largest value that is not too far beyond the calibrated ones."""
        beyond = _LARGEST_BEYOND * (self.high - self.low)
        return self.low - beyond, self.high + beyond

    def reasons(self, value: float, quantity: str, unit: str) -> tuple[str, ...]:
        """Return the reason against a value far beyond the range, if there is one."""
        low, high = self.ends
        if low <= value <= high:
            return ()
        return (
            f"the {quantity} would be {value:.3g} {unit}, beyond the calibrated {self.low:.3g} to {self.high:.3g} "
            f"{unit}; tare with nothing gripped, or calibrate further",
        )


class Predicted(NamedTuple):
    """A value, and how far its 95 % interval extends below and above it."""

    value: float
    below: float
    above: float

    @property
    def ends(self) -> tuple[float, float]:
        """The lower and the upper end of the interval."""
        return self.value - self.below, self.value + self.above

    def widened(self, error: float) -> "Predicted":
        """Return the value with a further 95 % error, which is independent of the others."""
        return Predicted(self.value, math.hypot(self.below, error), math.hypot(self.above, error))


@dataclass(frozen=True, slots=True, eq=False)
class IntervalRegressor:
    """A point regressor with intervals, the range of values, and the range of features that it was calibrated on.

    Features are limited to largest_deviation from mean_feature unless that is empty. With misses_loads, too many
    left-out loads lay outside their intervals, so every interval spans the calibrated range. timing_widening is the
    factor on the loads' intervals for unknown load timing. `gain` is how much a torque's gain changes between
    recordings.
    """

    point: Regressor
    intervals: Intervals
    range: ValueRange = field(metadata=INLINE)
    mean_feature: FloatArray
    largest_deviation: FloatArray
    misses_loads: bool = False
    timing_widening: float = 1.0
    gain: GainSpread = field(default=GainSpread(), metadata=INLINE)

    def predict(self, features: FloatArray, usable_share: float = 1.0) -> Predicted:
        """Return the value of (d,) features with its interval.

        With a fraction of the channels unusable, the interval grows by the root of it.
        """
        raw = float(self.point.predict(features[None])[0])
        value = float(reported_values(self.point, np.array(raw)))
        widening = 1.0 / math.sqrt(max(usable_share, 0.1))
        half = widening * self.intervals.half_width(raw)
        down, up = self.gain.reach(value)
        below, above = self._guarded(raw, value, widening, math.hypot(half, down), math.hypot(half, up))
        return Predicted(value, below, above)

    def _guarded(self, raw: float, value: float, widening: float, below: float, above: float) -> tuple[float, float]:
        """Return the interval's reach below and above a value, widened where the prediction may be wrong by more.

        Loads that are not seen can have any calibrated value. Where the lever does not touch, the tool may be twisted
        the other way as far as the frames allow.
        """
        if self.misses_loads:
            below, above = below + max(value - self.range.low, 0.0), above + max(self.range.high - value, 0.0)
        if isinstance(self.point, CensoredRidge) and raw < 0:
            other_way = widening * TWO_SIDED_95 * self.point.sigma - raw
            below, above = (max(below, other_way), above) if self.point.sign > 0 else (below, max(above, other_way))
        return below, above

    def scaled(self, factor: float, spread: float) -> "IntervalRegressor":
        """Return the regressor of values larger by a factor; its gain and zero have this spread."""
        return replace(
            self,
            point=self.point.scaled(factor),
            intervals=Intervals(factor * self.intervals.edges, factor * self.intervals.half_widths),
            range=self.range.scaled(factor),
            gain=replace(self.gain, between=spread, zero=spread, noise_nm=factor * self.gain.noise_nm),
        )

    def range_reasons(self, value: float, features: FloatArray, quantity: str, unit: str) -> tuple[str, ...]:
        """Return the reason against a value or features beyond the calibration, if there is one."""
        if reasons := self.range.reasons(value, quantity, unit):
            return reasons
        limits = _LARGEST_DEVIATION * self.largest_deviation
        if len(limits) and (np.abs(features - self.mean_feature) > limits).any():
            return ("the frame moves further or faster than any at calibration",)
        return ()


def reported_values(point: Predictor, raw: FloatArray) -> FloatArray:
    """Return the values that (n,) raw predictions mean: no torque where the lever would not touch."""
    return point.sign * np.maximum(raw, 0.0) if isinstance(point, CensoredRidge) else raw
