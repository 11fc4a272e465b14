"""Novelty detection for calibrations of slices: which differences the calibration covers.

Differences vary about their mean along a few directions. The mean squared residual off these directions is the Q
residual, the squared distance along them is Hotelling's T² (principal component analysis for process monitoring). Both
are in units of each channel's own spread: on recorded slices some channels vary ten times as much as others. The
limits come from stretches of time that were left out in turn (docs/charts.md).
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.channels import ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.fingertip_validator import LARGEST_UNUSABLE_FRACTION
from shearloop.estimation.left_out import later_origins, left_out_blocks
from shearloop.estimation.values import LEVEL

# Margins beyond the largest Q and T² of blocks left out. Later recorded slices stay within 1.37 and 1.5 times of them
# after two repeats, and within once after four.
_Q_MARGIN, _T2_MARGIN = 1.45, 1.65
_MIN_OUTLYING, _OUTLYING_SPREADS = 0.05, 5.0
_MIN_DIFFERENCES = 8
_MAX_DIRECTIONS = 4
# T² uses value and main drift. Single calibration frames extend far along the shorter directions.
_T2_DIRECTIONS = 2
# A frame with less than half of its fingertip's own response counts as one with half.
_MAX_MISSING = 0.5
# Directions of slices that the reciprocity check ignores, and its margin beyond the largest residual of blocks left
# out: later slices stay within 1.39 times of it after two repeats, and within 0.8 times after four.
_RECIPROCITY_DIRECTIONS, _RECIPROCITY_MARGIN = 12, 1.5
# Less than this fraction of a slice is rounding: a board's converter alone makes thousands of times as much.
_MIN_NOISE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class ReciprocityCheck:
    """Checks the voltages that a frame has twice (`ChannelTable.twins`).

    Their means have half of the noise, so other errors stand out. A gel's drift is large in some channels, a foreign
    frame differs in all: the median of the channels separates the two better than their mean.
    mean (c/2,) and spread (c/2,) of the means are in volts; directions (r, c/2) in units of the spread.
    """

    table: ChannelTable
    mean: FloatArray
    spread: FloatArray
    directions: FloatArray
    largest_residual: float

    @classmethod
    def fit(cls, differences: FloatArray, table: ChannelTable) -> Self:
        """Fit to (n, c) differences in time order; the limit comes from blocks of time left out in turn."""
        residuals, every = [], np.ones(table.n_channels, dtype=np.bool_)
        for rest, block in left_out_blocks(len(differences)):
            part = cls._model(differences[rest], table, np.inf)
            residuals += [part.residual(difference, every) for difference in differences[block]]
        return cls._model(differences, table, _RECIPROCITY_MARGIN * max(residuals))

    @classmethod
    def _model(cls, differences: FloatArray, table: ChannelTable, largest_residual: float) -> Self:
        mean, spread, _, directions = _principal_components(table.twin_means(differences))
        return cls(
            table, mean, spread, directions[: min(_RECIPROCITY_DIRECTIONS, len(differences) // 2)], largest_residual
        )

    def residual(self, difference: FloatArray, usable: BoolArray) -> float:
        """Return the median squared residual of a (c,) difference off the directions."""
        first, second = self.table.twins
        both = np.asarray(usable[first] & usable[second])
        x = np.asarray((self.table.twin_means(difference) - self.mean) / self.spread)
        return float(np.median((x - _coordinates(self.directions, x, both) @ self.directions)[both] ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class NoveltyDetector:
    """Mean (c,) and spread (c,) in volts, directions (r, c) in units of spread with their variances (r,).

    typical_response is the response share at LEVEL of differences left out.
    """

    mean: FloatArray
    spread: FloatArray
    directions: FloatArray
    variances: FloatArray
    least_norm: float
    largest_q: float
    largest_outlying: float
    largest_t2: float
    reciprocity: ReciprocityCheck | None
    typical_response: float

    @classmethod
    def fit(cls, differences: FloatArray, table: ChannelTable) -> Self:
        """Fit to (n, c) differences in time order; the limits come from blocks of time left out in turn."""
        n, every = len(differences), np.ones(table.n_channels, dtype=np.bool_)
        if n < _MIN_DIFFERENCES:
            raise CalibrationError(f"too few slices to calibrate on: {n}; record {_MIN_DIFFERENCES}")
        _check_slices(differences)
        q_and_outlying, t2, responses = [], [], []
        for rest, block in left_out_blocks(n):
            part = cls._model(differences[rest])
            q_and_outlying += [part.q_residual(difference, every) for difference in differences[block]]
            t2 += [part.t2(difference, every) for difference in differences[block]]
            responses += [part.response_share(difference, every) for difference in differences[block]]
        largest_q, outlying = np.array(q_and_outlying).max(axis=0)
        whole = cls._model(differences)
        largest_t2 = max(*t2, *(whole.t2(difference, every) for difference in differences))
        least = 0.5 * float(np.linalg.norm(differences, axis=1).min() / np.sqrt(table.n_channels))
        return replace(
            whole,
            least_norm=least,
            largest_q=_Q_MARGIN * float(largest_q),
            largest_outlying=max(_Q_MARGIN * float(outlying), _MIN_OUTLYING),
            largest_t2=_T2_MARGIN * largest_t2,
            reciprocity=ReciprocityCheck.fit(differences, table),
            typical_response=float(np.quantile(responses, LEVEL)),
        )

    @classmethod
    def _model(cls, differences: FloatArray) -> Self:
        mean, spread, s, vt = _principal_components(differences)
        rank = min(_MAX_DIRECTIONS, len(differences) // 4)
        if np.sqrt((s[rank:] ** 2).sum()) <= _MIN_NOISE * s[0]:
            raise CalibrationError(
                "the slices have no noise: they are multiples or sums of a few; record slices as they come"
            )
        variances = s[:rank] ** 2 / (len(differences) - 1)
        return cls(mean, spread, vt[:rank], variances, 0.0, np.inf, np.inf, np.inf, None, 0.0)

    def q_residual(self, difference: FloatArray, usable: BoolArray) -> tuple[float, float]:
        """Return the mean squared residual of a (c,) difference, and the fraction of outlying channels."""
        x = self._scale(difference)
        residual = (x - _coordinates(self.directions, x, usable) @ self.directions)[usable]
        return float((residual**2).mean()), float((np.abs(residual) > _OUTLYING_SPREADS).mean())

    def t2(self, difference: FloatArray, usable: BoolArray) -> float:
        """Return Hotelling's T² of a (c,) difference along the main directions."""
        scores = _coordinates(self.directions[:_T2_DIRECTIONS], self._scale(difference), usable)
        return float((scores**2 / self.variances[:_T2_DIRECTIONS]).sum())

    def response_share(self, difference: FloatArray, usable: BoolArray) -> float:
        """Return the fraction of the mean in a (c,) difference, by its part off the main directions.

        A smaller response, as where a foreign signal replaces it, moves a difference along the main directions like
        another torque. A torque leaves the other part alone (partial regression, Frisch–Waugh).
        """
        mean = self.mean / self.spread
        rest = (mean - _coordinates(self.directions, mean, usable) @ self.directions)[usable]
        return float((difference / self.spread)[usable] @ rest / (mean[usable] @ rest))

    def impute(self, difference: FloatArray, usable: BoolArray) -> FloatArray:
        """Return a (c,) difference with unusable channels estimated along the main directions."""
        scores = _coordinates(self.directions, self._scale(difference), usable)
        return np.where(usable, difference, np.maximum(self.mean + self.spread * (scores @ self.directions), 0.0))

    def _scale(self, difference: FloatArray) -> FloatArray:
        return np.asarray((difference - self.mean) / self.spread)

    def reasons(self, difference: FloatArray, usable: BoolArray) -> tuple[str, ...]:
        """Return the reason against a (c,) difference, by its usable channels, if there is one."""
        if 1.0 - usable.mean() > LARGEST_UNUSABLE_FRACTION:
            return (f"{100 * (1 - usable.mean()):.0f} % of the channels are dead or saturated; check the ribbon cable",)
        size = float(np.sqrt((difference[usable] ** 2).mean()))
        if size < self.least_norm:
            return (
                f"no grip: the difference to the idle frame is {1e3 * size:.1f} mV a channel, and gripping "
                f"makes at least {1e3 * self.least_norm:.1f} mV",
            )
        q, outlying = self.q_residual(difference, usable)
        if q > self.largest_q or outlying > self.largest_outlying:
            return (
                f"outside the calibration: the Q residual is {q:.1f} (limit {self.largest_q:.1f}), with "
                f"{100 * outlying:.0f} % of the channels far off (limit {100 * self.largest_outlying:.0f} %)",
            )
        if self.reciprocity is not None:
            residual = self.reciprocity.residual(difference, usable)
            if residual > self.reciprocity.largest_residual:
                return (
                    f"outside the calibration: two measurements of the same voltages differ by {residual:.2f} (limit "
                    f"{self.reciprocity.largest_residual:.2f}); part of the frame may be another fingertip's",
                )
        t2 = self.t2(difference, usable)
        if t2 > self.largest_t2:
            return (
                f"outside the calibration: the frame lies {np.sqrt(t2):.1f} standard deviations from the calibrated "
                f"ones (limit {np.sqrt(self.largest_t2):.1f})",
            )
        return ()

    def missing_share(self, difference: FloatArray, usable: BoolArray) -> float:
        """Return the fraction of the fingertip's own response that foreign signals may have replaced."""
        if self.typical_response <= 0:
            return 0.0
        left = self.response_share(difference, usable) / self.typical_response
        return min(max(1.0 - left, 0.0), _MAX_MISSING)


def _principal_components(rows: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return mean (c,), spread (c,), singular values and directions of (n, c) rows, the latter in units of spread."""
    mean, variance = rows.mean(axis=0), rows.var(axis=0)
    # Shrink towards the median: few frames determine a channel's own variance badly.
    spread = np.sqrt(0.5 * variance + 0.5 * np.median(variance) + np.finfo(np.float64).tiny)
    _, s, directions = np.linalg.svd((rows - mean) / spread, full_matrices=False)
    return mean, spread, s, directions


def _coordinates(directions: FloatArray, values: FloatArray, usable: BoolArray) -> FloatArray:
    """Return the (r,) least-squares coordinates of (n,) values along (r, n) orthonormal directions."""
    if usable.all():
        return np.asarray(directions @ values)
    return np.asarray(np.linalg.lstsq(directions[:, usable].T, values[usable], rcond=None)[0], dtype=np.float64)


def _check_slices(differences: FloatArray) -> None:
    """Raise CalibrationError for (n, c) differences that are alike, or with too many constant channels."""
    n = len(differences)
    with np.errstate(over="ignore"):
        rounding_v = _MIN_NOISE * np.sqrt((differences**2).mean())
    for rows in fitted_parts(n):
        still = np.ptp(differences[rows], axis=0) <= rounding_v
        if still.all():
            raise CalibrationError(f"{len(rows)} of the {n} slices are all alike; record slices as they come")
        if still.mean() > LARGEST_UNUSABLE_FRACTION:
            raise CalibrationError(
                f"in {len(rows)} of the {n} slices {100 * still.mean():.0f} % of the channels never change: they are "
                "dead or saturated; check the ribbon cable and the gel's contact with the electrodes, and record again"
            )


def fitted_parts(n: int) -> list[IntArray]:
    """Return the rows of all slices, then of each part that is fitted separately."""
    # All later origins contain the first.
    return [np.arange(n), *(earlier for earlier, _ in (*left_out_blocks(n), *later_origins(n)[:1]))]
