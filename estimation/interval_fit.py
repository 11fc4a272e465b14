"""Fits a regressor with its 95 % prediction intervals, by residuals on frames left out of the fit.

The intervals are split-conformal in strata of the prediction (Vovk 2012), namely free of load, about to touch, loaded.
In each stratum the half width is the 95 % quantile of the absolute residuals with the correction for a finite sample,
so that many easy frames do not narrow the intervals of few hard ones.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Self, TypeAlias

import numpy as np
from scipy.special import stdtrit

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.gain import GainSpread
from shearloop.estimation.gain_fit import fit_gain_spread
from shearloop.estimation.interval_regressor import IntervalRegressor, Intervals, Regressor, ValueRange, reported_values
from shearloop.estimation.left_out import LeftOut, later_splits, left_out_blocks, left_out_groups
from shearloop.estimation.ridge import STRENGTHS, CensoredRidge, Predictor
from shearloop.estimation.twists import LOADED_FRACTION, find_twists, first_twists, loaded_log_gain, log_gain
from shearloop.estimation.values import LEVEL, TWO_SIDED_95
from shearloop.words import counted

# The future differs from the past more than one part of a recording from the next.
INFLATION = 1.05
MIN_FRAMES = 8
# Narrowest interval as a fraction of the calibrated range: load cells are noisy too.
MIN_HALF_WIDTH = 1e-3
_MIN_RESIDUALS, _MIN_IN_STRATUM = 5, 20
# This share of the loads must lie within their intervals.
_MIN_COVERED = 0.75
# Twists in each half of a grip that shows how the gain drifts: fewer do not determine a fit of the motion.
_MIN_IN_HALF = 3

RegressorFit: TypeAlias = Callable[[FloatArray, FloatArray, float], Regressor]
Refit: TypeAlias = Callable[[IntArray], Regressor]


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """Rows that are left out of a fit in turn, and the factors from their residuals to intervals.

    `pairs` are rows to fit to and rows to validate on. `inflation_of_loads` is of the uppermost stratum, where it has
    one of its own, `inflation_of_unknown_times` of residuals from bounds.
    """

    pairs: LeftOut
    inflation: float
    inflation_of_unknown_times: float
    inflation_of_loads: float | None = None

    @classmethod
    def by_blocks(cls, n: int) -> Self:
        """Leave out blocks of time of n rows."""
        pairs = left_out_blocks(n)
        # Unknown times mean few loads, in a block or two each.
        return cls(pairs, INFLATION, student_inflation(len(pairs)))

    @classmethod
    def by_parts(cls, pairs: LeftOut, n: int) -> Self:
        """Leave out parts of n rows, each row as one error; blocks of time where there are no pairs."""
        if not pairs:
            return cls.by_blocks(n)
        inflation = student_inflation(len(np.unique(np.concatenate([part for _, part in pairs]))))
        return cls(pairs, inflation, inflation)

    @classmethod
    def by_twists(cls, pairs: LeftOut, values: FloatArray) -> Self:
        """Leave out twists of (n,) values; blocks of time where there are no pairs.

        Each part with a load counts as one error, because the frames of a twist err alike.
        """
        if not pairs:
            return cls.by_blocks(len(values))
        loads = np.concatenate(find_twists(values))
        n_loaded = sum(bool(np.isin(part, loads).any()) for _, part in pairs)
        return cls(pairs, INFLATION, INFLATION, student_inflation(n_loaded))


def check_values(values: FloatArray) -> None:
    """Raise CalibrationError for (n,) values that are few, or all alike."""
    if len(values) < MIN_FRAMES or np.ptp(values) == 0:
        raise CalibrationError(
            f"{counted(len(values), 'frame')} with values between {np.min(values, initial=np.inf):.3g} and "
            f"{np.max(values, initial=-np.inf):.3g} cannot determine a calibration; record more, at different loads"
        )


def fit_interval_regressor(
    features: FloatArray,
    values: FloatArray,
    fit: RegressorFit,
    *,
    strengths: tuple[float, ...] = STRENGTHS,
    limit_features: bool = False,
    validation: "Validation | None" = None,
    bounds: tuple[FloatArray, FloatArray] | None = None,
    grips: IntArray | None = None,
    fingertips: int = 1,
) -> IntervalRegressor:
    """Fit to (n, d) features and (n,) values in time order.

    The `validation` is by blocks of time if it is not given. `bounds` are the least and largest value (n,) that each
    frame may have: intervals extend to the further one. With the number of each row's grip, `grips` (n,), intervals
    allow for the gain of another grip of as many `fingertips`. Raises CalibrationError where the data does not
    determine the fit.
    """
    check_values(values)
    strength = strengths[0] if len(strengths) == 1 else best_strength(features, values, fit, strengths)[0]
    validation = validation or Validation.by_blocks(len(values))
    blocks = validation.pairs

    def refit(rows: IntArray) -> Regressor:
        return fit(features[rows], values[rows], strength)

    parts = [refit(past) for past, _ in blocks]
    raw = [part.predict(features[future]) for part, (_, future) in zip(parts, blocks, strict=True)]
    reported = np.concatenate([reported_values(part, prediction) for part, prediction in zip(parts, raw, strict=True)])
    predicted, rows = np.concatenate(raw), np.concatenate([future for _, future in blocks])
    point, truth = fit(features, values, strength), values[rows]
    residuals = reported - truth
    edges = (-point.sigma, 0.0, 0.4 * float(np.abs(values).max())) if isinstance(point, CensoredRidge) else ()
    inflation, of_loads = validation.inflation, validation.inflation_of_loads
    centre = features.mean(axis=0)
    deviation = np.abs(features - centre).max(axis=0) if limit_features else np.zeros(0)
    least = MIN_HALF_WIDTH * float(np.ptp(values))
    intervals, widening = fit_intervals(predicted, residuals, edges, inflation, least, of_loads), 1.0
    # Before widening for unknown times: a load that is not seen is not seen at any time.
    half = np.array([intervals.half_width(prediction) for prediction in predicted])
    misses_loads = _misses_loads(truth, np.abs(residuals) <= half)
    if bounds is not None:
        inflation = validation.inflation_of_unknown_times
        errors = np.max([np.abs(truth + residuals - end[rows]) for end in bounds], axis=0)
        known = intervals.half_widths[-1]
        intervals = fit_intervals(predicted, errors, edges, inflation, least, of_loads)
        widening = float(intervals.half_widths[-1] / known)
    span = ValueRange(float(values.min()), float(values.max()))
    gain = GainSpread()
    if grips is not None:
        gains = _gains_of_grips(features, values, grips, refit)
        halves = _gains_of_halves(features, values, grips, refit)
        gain = _spread_of_gain(values, grips, rows, reported, gains, halves, fingertips)
    return IntervalRegressor(point, intervals, span, centre, deviation, misses_loads, widening, gain)


def fit_intervals(
    predicted: FloatArray,
    residuals: FloatArray,
    edges: tuple[float, ...],
    inflation: float,
    least_half_width: float = 0.0,
    inflation_of_loads: float | None = None,
) -> Intervals:
    """Return intervals of (n,) predictions from their residuals on data left out.

    A stratum between two of the edges with few residuals joins the next. The uppermost stratum has an inflation of its
    own where it is given: loads are fewer. Raises CalibrationError for too few residuals.
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
        if inside >= _MIN_IN_STRATUM and above >= _MIN_IN_STRATUM:
            kept.append(float(edge))
    stratum = np.searchsorted(kept, predicted)
    widths = [_conformal_quantile(np.abs(residuals[stratum == i])) for i in range(len(kept) + 1)]
    widths[-1] *= (inflation_of_loads or inflation) / inflation
    return Intervals(np.array(kept), np.maximum(inflation * np.array(widths), least_half_width))


def student_inflation(n: int) -> float:
    """Return the factor on a 95 % interval's width if n values determine it (Student 1908)."""
    return float(stdtrit(n - 1, (1 + LEVEL) / 2)) / TWO_SIDED_95


def _conformal_quantile(absolute: FloatArray) -> float:
    """Return the conformal quantile; of few residuals the Gaussian one, because their largest says too little."""
    n = len(absolute)
    if n < 2 * _MIN_IN_STRATUM:
        return TWO_SIDED_95 * float(np.sqrt((absolute**2).mean()))
    return float(np.quantile(absolute, min(LEVEL * (n + 1) / n, 1.0), method="higher"))


def _gains_of_grips(features: FloatArray, values: FloatArray, grips: IntArray, refit: Refit) -> list[float]:
    """Return the logarithm of the gain of each grip that the others can predict."""
    gains: list[float] = []
    least = LOADED_FRACTION * float(np.abs(values).max())
    for kept, out in left_out_groups(grips):
        if len(kept) and np.ptp(values[kept]) > 0 and np.abs(values[out]).max() > least:
            part = refit(kept)
            gain = loaded_log_gain(reported_values(part, part.predict(features[out])), values[out])
            if gain is not None:
                gains.append(gain)
    return gains


def _gains_of_halves(features: FloatArray, values: FloatArray, grips: IntArray, refit: Refit) -> list[float]:
    """Return the logarithm of the gain of each half of a grip's twists, as the rest predicts it.

    `grips` (n,) is the number of each row's grip. Grips with fewer than three twists in a half have none.
    """
    gains: list[float] = []
    for grip_rows in (np.flatnonzero(grips == grip) for grip in np.unique(grips)):
        twists = [grip_rows[rows] for rows in find_twists(values[grip_rows])]
        for half, out in _halves(grip_rows, twists):
            part = refit(np.setdiff1d(np.arange(len(values)), out))
            gain = log_gain(reported_values(part, part.predict(features[half])), values[half])
            if gain is not None:
                gains.append(gain)
    return gains


def _halves(rows: IntArray, twists: Sequence[IntArray]) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the loaded rows and all rows of each half of a grip's twists; an odd number is cut both ways."""
    n = len(twists)
    for middle in sorted({n // 2, (n + 1) // 2}):
        if min(middle, n - middle) < _MIN_IN_HALF:
            continue
        first_of_second = (twists[middle - 1][-1] + twists[middle][0] + 1) // 2
        yield np.concatenate(twists[:middle]), rows[rows < first_of_second]
        yield np.concatenate(twists[middle:]), rows[rows >= first_of_second]


def _spread_of_gain(
    values: FloatArray,
    grips: IntArray,
    rows: IntArray,
    predicted: FloatArray,
    gains: Sequence[float],
    halves: Sequence[float],
    fingertips: int,
) -> GainSpread:
    """Return the spread of the gain from the predictions of left-out rows, and the gains of grips and half grips."""
    order = np.argsort(rows, kind="stable")
    rows, predicted = rows[order], predicted[order]
    is_first = first_twists(values, grips)
    return fit_gain_spread(predicted, values[rows], grips[rows], is_first[rows], gains, halves, fingertips)


def _misses_loads(truth: FloatArray, inside: BoolArray) -> bool:
    """Return whether too many loads lie outside their intervals.

    Most frames of a stream are free of load. Their small residuals say nothing of a load that an estimator misses, so
    loads are a stratum of their own, by their truth (label-conditional, Vovk 2012).
    """
    loaded = np.abs(truth) > LOADED_FRACTION * float(np.abs(truth).max())
    return bool(loaded.any() and not loaded.all() and inside[loaded].mean() < _MIN_COVERED)


def best_strength(
    features: FloatArray,
    values: FloatArray,
    fit: Callable[[FloatArray, FloatArray, float], Predictor],
    strengths: Sequence[float],
    left_out: Iterable[tuple[IntArray, IntArray]] = (),
) -> tuple[float, float]:
    """Return the strength with the least mean squared error on rows left out, and that error; of equals, the strongest.

    By default these are later parts. Raises CalibrationError where the values do not change within the rest.
    """
    pairs = list(left_out) or later_splits(len(values))
    splits = [(past, future) for past, future in pairs if np.ptp(values[past]) > 0]
    if not splits:
        raise CalibrationError("the values do not change within the earlier part; begin with the calibration's loads")

    def squared_error(strength: float, past: IntArray, future: IntArray) -> float:
        point = fit(features[past], values[past], strength)
        return float(((reported_values(point, point.predict(features[future])) - values[future]) ** 2).mean())

    errors = {strength: float(np.mean([squared_error(strength, *split) for split in splits])) for strength in strengths}
    best = max(strength for strength, error in errors.items() if error <= min(errors.values()) * 1.001)
    return best, errors[best]
