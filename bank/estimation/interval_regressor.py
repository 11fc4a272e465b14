"""A reader turns the features of a frame into one value with its interval."""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.polynomial import TWO_SIDED_95
from shearloop.bank.estimation.intervals import Intervals
from shearloop.bank.estimation.regressors import InverseCalibration, Ridge, TobitRidge

Head: TypeAlias = Ridge | TobitRidge | InverseCalibration

# No interval is narrower than this share of the calibrated range: a load cell has noise too.
LEAST_HALF_WIDTH = 1e-3
# Values this far beyond the calibrated range, in spans of it, are extrapolated and not believed.
_LARGEST_BEYOND = 0.35
# Features this many times larger than any at calibration are of something else.
_LARGEST_REACH = 1.6


@dataclass(frozen=True, slots=True, eq=False)
class IntervalRegressor:
    """A head with its intervals, the range of values and the reach of features that it was calibrated on.

    Values at or below low_end may be read of anything lower, those at or above high_end of anything higher (−∞ and ∞
    where that was not looked at). One that misses_loads did not see too many of those left out: of what it says, an
    interval reaches over all values that it was calibrated on. hidden_below and hidden_above are how far below and
    above what is read the truth may lie for what is foreign in a frame unseen, at a nearness of 1 (0 where that was
    not looked at, as in older calibrations). widened is by how many times the intervals of loads are wider because
    nobody knows when they were measured. lowest and highest are the furthest values that may be read at the ends
    (NaN in older calibrations: half a range beyond it).
    """

    head: Head
    intervals: Intervals
    low: float
    high: float
    low_end: float
    high_end: float
    misses_loads: bool
    mean_feature: FloatArray
    reach: FloatArray
    hidden_below: float = 0.0
    hidden_above: float = 0.0
    widened: float = 1.0
    lowest: float = math.nan
    highest: float = math.nan

    def read(
        self,
        features: FloatArray,
        usable_share: float = 1.0,
        widening: float = 1.0,
        nearness: float = 0.0,
        whole: FloatArray | None = None,
    ) -> tuple[float, float, float]:
        """Return the value of (d,) features and how far its 95 % interval reaches below and above it.

        With a share of the channels unusable the rest have to carry the noise of all: the interval grows by the root.
        What may be foreign in the frame is the more, the nearer it is to being refused (`nearness`, 1 at the limit).
        Where part of the own response may be missing, `whole` (d,) is what would be seen with it: the interval reaches
        to what that says, with an error of its own.
        Where the lever of the calibration did not touch, the tool may have been twisted the other way as far as the
        frames say: nothing that was read then denies it.
        """
        raw, grown = self._raw(features, whole)
        widening /= math.sqrt(max(usable_share, 0.1))
        half = widening * self.intervals.half_width(raw)
        value = shown(self.head, raw)
        moved = shown(self.head, grown) - value
        below = max(half + max(-moved, 0.0), nearness * self.hidden_below)
        above = max(half + max(moved, 0.0), nearness * self.hidden_above)
        if self.misses_loads:
            below, above = below + max(value - self.low, 0.0), above + max(self.high - value, 0.0)
        if isinstance(self.head, TobitRidge) and raw < 0:
            other_way = widening * TWO_SIDED_95 * self.head.sigma - raw
            below, above = (max(below, other_way), above) if self.head.sign > 0 else (below, max(above, other_way))
        if value <= self.low_end:
            below = max(below, value - self._or_half_beyond(self.lowest, self.low, -1))
        if value >= self.high_end:
            above = max(above, self._or_half_beyond(self.highest, self.high, 1) - value)
        return value, below, above

    def _or_half_beyond(self, furthest: float, end: float, sign: int) -> float:
        return end + sign * 0.5 * (self.high - self.low) if math.isnan(furthest) else furthest

    def _raw(self, features: FloatArray, whole: FloatArray | None) -> tuple[float, float]:
        """Return what the head says of (d,) features, and of them with what may be missing: the same where none is."""
        if whole is None:
            raw = self.head.value(features)
            return raw, raw
        raw, grown = self.head.predict(np.array([features, whole])).tolist()
        return raw, grown

    def refuse(self, value: float, features: FloatArray, name: str, unit: str) -> tuple[str, ...]:
        """Return the reasons why a value is beyond what was calibrated."""
        beyond = _LARGEST_BEYOND * (self.high - self.low)
        if not self.low - beyond <= value <= self.high + beyond:
            return (
                f"the {name} would be {value:.3g} {unit}, beyond the calibrated {self.low:.3g} to "
                f"{self.high:.3g} {unit}",
            )
        if len(self.reach) and bool((np.abs(features - self.mean_feature) > _LARGEST_REACH * self.reach).any()):
            return ("the frame moves further or faster than any at calibration",)
        return ()


def shown(head: Head, raw: float) -> float:
    """Return the value that a head's prediction means: no torque where the lever would not touch."""
    return head.sign * max(raw, 0.0) if isinstance(head, TobitRidge) else raw
