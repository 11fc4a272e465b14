"""Which differences a calibration of slices can speak of: `NoveltyDetector`.

Differences lie about their mean along a few directions. What is off to the side of them is the misfit, how far out
along them is the reach; both in units of each channel's own spread, since on recorded slices some channels vary ten
times as much as others and drown the rest in volts. How much of either is still familiar comes from stretches of time
that were left out in turn (docs/charts.md).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.directions import coordinates
from shearloop.bank.estimation.fingertip_validator import LARGEST_UNUSABLE_SHARE
from shearloop.bank.estimation.intervals import LEVEL
from shearloop.bank.estimation.reciprocity import ReciprocityCheck
from shearloop.bank.estimation.regressors import left_out_blocks
from shearloop.bank.estimation.soundness import LEAST_NOISE, check_slices

# Beyond the largest misfit and reach of blocks left out: on the recorded slices the later ones stay within 1.37 and 1.5
# times of them after two repeats, and within once after four.
_MISFIT_MARGIN, _REACH_MARGIN = 1.45, 1.65
_LEAST_OUTLYING, _OUTLYING_SPREADS = 0.05, 5.0
_LEAST_DIFFERENCES = 8
_MOST_DIRECTIONS = 4
# Value and main drift. Further directions are so short that single frames of the calibration reach far along them.
_REACHING = 2
# A frame that holds less than half of what the own fingertip makes is taken for one that holds half.
_MOST_MISSING = 0.5
# Intervals grow by this power of the misfit. White noise alone would ask for a half; but what moves many channels
# together moves the estimate with them. Of 1, 1.5 and 2 this parted later slices best from those with a fifth of a
# foreign frame, at the same width for the good ones.
_POWER = 2
_ALL = np.ones(N_CHANNELS, dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class Judgement:
    """The reasons against a difference, none for a familiar one, and what its interval has to hold.

    widening is by how much that grows because the difference is explained less well than is typical. nearness is how
    near it is to being refused by what it says twice: 1 at the limit, 0 without twins. What is foreign in it moves this
    by the square of its share; up to the limit most of that may be hidden. missing is what share of the fingertip's own
    response may have been taken away by it.
    """

    why: tuple[str, ...]
    widening: float = 1.0
    nearness: float = 0.0
    missing: float = 0.0


FAMILIAR = Judgement(())


@dataclass(frozen=True, slots=True, eq=False)
class NoveltyDetector:
    """The mean (896,) in volts, each channel's spread (896,) in volts, and directions (r, 896) in units of spread.

    variances (r,) are those along the directions. typical_misfit is the median of what was left out; of an estimate
    from more, the interval is as much wider. largest_own is as much of the mean as a difference holds, but for one in
    twenty of those left out. Calibrations that were made before there were twins have none, nor have they a largest_own
    (0).
    """

    mean: FloatArray
    spread: FloatArray
    directions: FloatArray
    variances: FloatArray
    least_norm: float
    typical_misfit: float
    largest_misfit: float
    largest_outlying: float
    largest_reach: float
    twins: ReciprocityCheck | None = None
    largest_own: float = 0.0

    @classmethod
    def fit(cls, differences: FloatArray) -> Self:
        """Fit to (n, 896) differences in time order; the limits come from blocks of time that were left out in turn."""
        n = len(differences)
        if n < _LEAST_DIFFERENCES:
            raise CalibrationError(f"{n} slices are too few to know what is familiar; record {_LEAST_DIFFERENCES}")
        check_slices(differences)
        misfits, reaches, own = [], [], []
        for rest, block in left_out_blocks(n):
            part = cls._explaining(differences[rest])
            misfits += [part.misfit(one, _ALL) for one in differences[block]]
            reaches += [part.reach(one, _ALL) for one in differences[block]]
            own += [part.own_share(one, _ALL) for one in differences[block]]
        misfit, outlying = np.array(misfits).max(axis=0)
        whole = cls._explaining(differences)
        reach = max(*reaches, *(whole.reach(one, _ALL) for one in differences))
        least = 0.5 * float(np.linalg.norm(differences, axis=1).min() / np.sqrt(N_CHANNELS))
        return cls(
            whole.mean, whole.spread, whole.directions, whole.variances, least,
            float(np.median(misfits, axis=0)[0]), _MISFIT_MARGIN * float(misfit),
            max(_MISFIT_MARGIN * float(outlying), _LEAST_OUTLYING), _REACH_MARGIN * reach,
            ReciprocityCheck.fit(differences),
            float(np.quantile(own, LEVEL)),
        )  # fmt: skip

    @classmethod
    def _explaining(cls, differences: FloatArray) -> Self:
        mean, rank = differences.mean(axis=0), min(_MOST_DIRECTIONS, len(differences) // 4)
        variance = differences.var(axis=0)
        # Half is everybody's: of few frames a channel's own variance says little.
        spread = np.sqrt(0.5 * variance + 0.5 * np.median(variance))
        _, s, vt = np.linalg.svd((differences - mean) / spread, full_matrices=False)
        if np.sqrt((s[rank:] ** 2).sum()) <= LEAST_NOISE * s[0]:
            raise CalibrationError(
                "the slices have no noise: they are multiples or sums of a few; record slices as they come"
            )
        variances = s[:rank] ** 2 / (len(differences) - 1)
        return cls(mean, spread, vt[:rank], variances, 0.0, 1.0, np.inf, np.inf, np.inf)

    def misfit(self, difference: FloatArray, usable: BoolArray) -> tuple[float, float]:
        """Return the mean squared residual of a (896,) difference, and the share of channels that are far off."""
        x = self._scaled(difference)
        residual = (x - coordinates(self.directions, x, usable) @ self.directions)[usable]
        return float((residual**2).mean()), float((np.abs(residual) > _OUTLYING_SPREADS).mean())

    def reach(self, difference: FloatArray, usable: BoolArray) -> float:
        """Return how far out a (896,) difference lies along the main directions: a sum of squares of unit variance."""
        scores = coordinates(self.directions[:_REACHING], self._scaled(difference), usable)
        return float((scores**2 / self.variances[:_REACHING]).sum())

    def own_share(self, difference: FloatArray, usable: BoolArray) -> float:
        """Return how many times a (896,) difference holds the mean, by what the main directions do not explain of it.

        A response that is smaller, as where something foreign has taken its place, moves a difference along the main
        directions as another torque does; but a torque leaves alone what is beside them, which then is smaller too.
        """
        mean = self.mean / self.spread
        # Partial regression (Frisch–Waugh): what it leaves of the mean, a torque does not move.
        beside = (mean - coordinates(self.directions, mean, usable) @ self.directions)[usable]
        return float((difference / self.spread)[usable] @ beside / (mean[usable] @ beside))

    def _missing(self, difference: FloatArray, usable: BoolArray) -> float:
        if self.largest_own <= 0:
            return 0.0
        left = self.own_share(difference, usable) / self.largest_own
        return min(max(1.0 - left, 0.0), _MOST_MISSING)

    def filled(self, difference: FloatArray, usable: BoolArray) -> FloatArray:
        """Return a (896,) difference with unusable channels where the usable ones say, along the main directions."""
        scores = coordinates(self.directions, self._scaled(difference), usable)
        return np.where(usable, difference, np.maximum(self.mean + self.spread * (scores @ self.directions), 0.0))

    def _scaled(self, difference: FloatArray) -> FloatArray:
        return np.asarray((difference - self.mean) / self.spread)

    def widening(self, difference: FloatArray, usable: BoolArray) -> float:
        """Return by how much an interval grows because a difference is explained less well than is typical."""
        return self._widening(self.misfit(difference, usable)[0])

    def _widening(self, misfit: float) -> float:
        return max(misfit / self.typical_misfit, 1.0) ** _POWER

    def judge(self, difference: FloatArray, usable: BoolArray) -> Judgement:
        """Return what is to be thought of a (896,) difference, by its usable channels."""
        if 1.0 - usable.mean() > LARGEST_UNUSABLE_SHARE:
            return _refused(
                f"{100 * (1 - usable.mean()):.0f} % of the channels are dead or saturated; look at the ribbon cable"
            )
        size = float(np.sqrt((difference[usable] ** 2).mean()))
        if size < self.least_norm:
            return _refused(
                f"no grip: the difference to the homogeneous frame is {1e3 * size:.1f} mV a channel, and gripping "
                f"makes at least {1e3 * self.least_norm:.1f} mV"
            )
        misfit, outlying = self.misfit(difference, usable)
        if misfit > self.largest_misfit or outlying > self.largest_outlying:
            return _refused(
                f"outside of the calibration: the misfit is {misfit:.1f} (at most {self.largest_misfit:.1f}), with "
                f"{100 * outlying:.0f} % of the channels far off (at most {100 * self.largest_outlying:.0f} %)"
            )
        nearness = 0.0
        if self.twins is not None:
            twins = self.twins.misfit(difference, usable)
            if twins > self.twins.largest_misfit:
                return _refused(
                    f"outside of the calibration: what opposite injections say twice is off by {twins:.2f} (at most "
                    f"{self.twins.largest_misfit:.2f}); part of the frame may be another fingertip's"
                )
            nearness = twins / self.twins.largest_misfit
        reach = self.reach(difference, usable)
        if reach > self.largest_reach:
            return _refused(
                f"outside of the calibration: the frame lies {np.sqrt(reach):.1f} standard deviations from those "
                f"calibrated on (at most {np.sqrt(self.largest_reach):.1f})"
            )
        return Judgement((), self._widening(misfit), nearness, self._missing(difference, usable))


def _refused(why: str) -> Judgement:
    return Judgement((why,))
