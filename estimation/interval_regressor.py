"""Ridges from features to a value, with 95 % prediction intervals, and their fit.

`Ridge` is for features that contain the value linearly. `CensoredRidge` is for a load cell that a lever pushes from one
side only: where it reads nothing the twist may be anything below, so these frames bound the value.

Intervals come from residuals on frames left out of the fit: split-conformal in strata of the prediction (Vovk 2012),
namely free of load, about to touch, loaded. In each stratum the half width is the 95 % quantile of the absolute
residuals with the correction for a finite sample, so that many easy frames do not narrow the intervals of few hard
ones. On torques of another recording the error of the gain is added, which grows with the torque.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self, TypeAlias

import numpy as np
from scipy.special import stdtrit

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.confidence import LEVEL, TWO_SIDED_95
from shearloop.estimation.gain import (
    LOADED_SHARE,
    GainCorrection,
    GainSpread,
    find_twists,
    first_twists,
    loaded_log_gain,
)
from shearloop.estimation.regressors import CurveMean, later_splits, left_out_blocks, left_out_groups
from shearloop.estimation.values import INLINE
from shearloop.words import counted

# Readings below this share of the largest torque mean that the lever does not touch.
CENSORED_SHARE = 0.02
# Their bound lies this share of it below zero. Of 0 to 0.3 this has the least error on recorded twists left out.
_MARGIN_SHARE = 0.05
_LEAST_SIGMA_SHARE, _HINGE_ROUNDS = 0.01, 50
LEAST_IN_STRATUM = 20
_LEAST_RESIDUALS = 5
# Narrowest interval as a share of the calibrated range: load cells are noisy too.
LEAST_HALF_WIDTH = 1e-3
# Values further beyond the calibrated range, in spans of it, are refused as extrapolation.
_LARGEST_BEYOND = 0.35
# Features larger than any at calibration by this factor are refused.
_LARGEST_DEVIATION = 1.6
# Penalties to choose from, in units of the features' sum of squares.
STRENGTHS = tuple(10.0**power for power in range(-6, 1))
# The future differs from the past more than one part of a recording from the next.
_INFLATION = 1.05
_LEAST_FRAMES = 8
# Share of values left out at either end of the range to test extrapolation. It fails if the prediction covers less
# than half of the way beyond.
_AT_END, _LARGEST_SHORTFALL = 0.2, 0.5
# Left-out values count as at least this far beyond the rest, in spans: noise would dominate a shorter distance.
_LEAST_DISTANCE = 0.05
# Values up to this many spans beyond the range can look familiar. Slices of 0.14 N·m do after a calibration below
# 0.06, 1.6 spans beyond, and no slice lies further (`extrapolation-torque-slices` of docs/charts.md).
_UNSEEN = 2.0
# Distance beyond the range that decides from where on a prediction may hide a value beyond: more doubts more good ones.
_LIKELY_UNSEEN = 0.5
# This share of the loads must lie within their intervals.
_LEAST_COVERED = 0.75


@dataclass(frozen=True, slots=True, eq=False)
class Ridge:
    """value = offset + (features − mean) · weights; strength is the chosen penalty."""

    mean: FloatArray
    weights: FloatArray
    offset: float
    strength: float

    @classmethod
    def fit(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit to (n, d) features of one unit and (n,) values; strength is in units of the features' sum of squares."""
        mean, offset = features.mean(axis=0), float(values.mean())
        u, s, vt = np.linalg.svd(features - mean, full_matrices=False)
        penalty = strength * float((s**2).sum())
        weights = vt.T @ (s / (s**2 + penalty) * (u.T @ (values - offset)))
        return cls(mean, weights, offset, strength)

    @classmethod
    def fit_scaled(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit with each feature in units of its own spread: for features of different kinds."""
        spread = features.std(axis=0)
        spread = np.where(spread > 0, spread, 1.0)
        scaled = cls.fit(features / spread, values, strength)
        return cls(scaled.mean * spread, scaled.weights / spread, scaled.offset, strength)

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the values of (…, d) features."""
        return np.asarray(self.offset + (features - self.mean) @ self.weights)

    def scaled(self, factor: float) -> Self:
        """Return the ridge of values larger by a factor."""
        return replace(self, weights=factor * self.weights, offset=factor * self.offset)


@dataclass(frozen=True, slots=True, eq=False)
class CensoredRidge(Ridge):
    """A ridge with readings of no load as upper bounds; `sign` is the direction of the lever's push.

    It predicts a latent value along the sign. Where that is below zero, the lever does not touch: no torque.
    """

    sigma: float
    sign: float

    @classmethod
    def fit(cls, features: FloatArray, values: FloatArray, strength: float) -> Self:
        """Fit to (n, d) features and (n,) values of one sign; `sigma` is the error of frames with load.

        A frame without load counts only while it is predicted above its bound (squared hinge loss, by Newton steps).
        """
        largest = float(values[np.argmax(np.abs(values))])
        sign = 1.0 if largest > 0 else -1.0
        y = sign * values
        touching = y >= CENSORED_SHARE * y.max()
        bound = -_MARGIN_SHARE * float(y.max())
        y, centred = np.where(touching, y, bound), features - features.mean(axis=0)
        penalty = strength * float((centred**2).sum()) * np.eye(features.shape[1])
        counting: BoolArray = np.ones(len(y), dtype=np.bool_)
        for _ in range(_HINGE_ROUNDS):
            mean, offset = features[counting].mean(axis=0), float(y[counting].mean())
            moved = features[counting] - mean
            weights = np.linalg.solve(moved.T @ moved + penalty, moved.T @ (y[counting] - offset))
            predicted = offset + (features - mean) @ weights
            before, counting = counting, touching | (predicted > bound)
            if (counting == before).all():
                break
        error = float(np.sqrt(((y - predicted)[touching] ** 2).mean()))
        return cls(mean, weights, offset, strength, max(error, _LEAST_SIGMA_SHARE * float(y.max())), sign)

    def scaled(self, factor: float) -> Self:
        """Return the ridge of values larger by a factor."""
        return replace(Ridge.scaled(self, factor), sigma=factor * self.sigma)


Regressor: TypeAlias = Ridge | CensoredRidge | CurveMean
RegressorFit: TypeAlias = Callable[[FloatArray, FloatArray, float], Regressor]
Refit: TypeAlias = Callable[[IntArray], Regressor]
# Pairs of rows to fit to and rows to validate on.
LeftOut: TypeAlias = Sequence[tuple[IntArray, IntArray]]


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
        if len(residuals) < _LEAST_RESIDUALS:
            raise CalibrationError(
                f"too few frames left out of the fit to determine the error: {len(residuals)}; record more repeats"
            )
        kept: list[float] = []
        for edge in sorted(edges):
            low = kept[-1] if kept else -np.inf
            inside = np.count_nonzero((predicted > low) & (predicted <= edge))
            above = np.count_nonzero(predicted > edge)
            if inside >= LEAST_IN_STRATUM and above >= LEAST_IN_STRATUM:
                kept.append(float(edge))
        stratum = np.searchsorted(kept, predicted)
        widths = [_conformal_quantile(np.abs(residuals[stratum == i])) for i in range(len(kept) + 1)]
        widths[-1] *= (inflation_of_loads or inflation) / inflation
        return cls(np.array(kept), np.maximum(inflation * np.array(widths), least_half_width))

    def half_width(self, predicted: float) -> float:
        """Return half of the 95 % interval's width at this prediction."""
        return float(self.half_widths[self.edges.searchsorted(predicted)])


def student_inflation(n: int) -> float:
    """Return the factor on a 95 % interval's width if n values determine it (Student 1908)."""
    return float(stdtrit(n - 1, (1 + LEVEL) / 2)) / TWO_SIDED_95


def _conformal_quantile(absolute: FloatArray) -> float:
    """Return the conformal quantile; of few residuals the Gaussian one, because their largest says too little."""
    n = len(absolute)
    if n < 2 * LEAST_IN_STRATUM:
        return TWO_SIDED_95 * float(np.sqrt((absolute**2).mean()))
    return float(np.quantile(absolute, min(LEVEL * (n + 1) / n, 1.0), method="higher"))


@dataclass(frozen=True, slots=True)
class ValueRange:
    """The calibrated values, low to high, and what predictions at their ends may hide.

    Predictions at or below low_end may hide any lower value, those at or above high_end any higher one (−∞ and ∞ where
    none is hidden); lowest and highest are the furthest values that may occur.
    """

    low: float
    high: float
    lowest: float = -math.inf
    highest: float = math.inf
    low_end: float = -math.inf
    high_end: float = math.inf

    def scaled(self, factor: float) -> "ValueRange":
        """Return the range of values larger by a factor, where no prediction hides a value."""
        return ValueRange(*(factor * end for end in (self.low, self.high, self.lowest, self.highest)))


@dataclass(frozen=True, slots=True, eq=False)
class IntervalRegressor:
    """A point regressor with intervals, the range of values, and the range of features that it was calibrated on.

    Features are limited to largest_deviation from mean_feature unless that is empty. With misses_loads, too many
    left-out loads lay outside their intervals, so every interval spans the calibrated range. timing_widening is the
    factor on the loads' intervals for unknown load timing. `gain` is how much a torque's gain changes between
    recordings. `line` reads values beyond the range.
    """

    point: Regressor
    intervals: Intervals
    range: ValueRange = field(metadata=INLINE)
    mean_feature: FloatArray
    largest_deviation: FloatArray
    misses_loads: bool = False
    timing_widening: float = 1.0
    gain: GainSpread = field(default=GainSpread(), metadata=INLINE)
    line: Regressor | None = None

    def predict(
        self, features: FloatArray, usable_share: float = 1.0, complete: FloatArray | None = None
    ) -> tuple[float, float, float]:
        """Return the value of (d,) features and how far its 95 % interval extends below and above it.

        With a share of the channels unusable, the interval grows by the root of it. `complete` (d,) are the features
        with a response that may be missing: the interval extends to their value. Where the lever does not touch, the
        tool may be twisted the other way as far as the frames allow.
        """
        rows = features[None] if complete is None else np.array([features, complete])
        raws = self.point.predict(rows)
        raw, (value, *others) = float(raws[0]), reported_values(self.point, raws).tolist()
        widening = 1.0 / math.sqrt(max(usable_share, 0.1))
        half = widening * self.intervals.half_width(raw)
        moved = others[0] - value if others else 0.0
        down, up = self.gain.reach(value)
        below, above = math.hypot(half, down) + max(-moved, 0.0), math.hypot(half, up) + max(moved, 0.0)
        if self.misses_loads:
            below, above = below + max(value - self.range.low, 0.0), above + max(self.range.high - value, 0.0)
        if isinstance(self.point, CensoredRidge) and raw < 0:
            other_way = widening * TWO_SIDED_95 * self.point.sigma - raw
            below, above = (max(below, other_way), above) if self.point.sign > 0 else (below, max(above, other_way))
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
        return value, min(below, max(value - span.lowest, 0.0)), min(above, max(span.highest - value, 0.0))

    def scaled(self, factor: float, spread: float) -> "IntervalRegressor":
        """Return the regressor of values larger by a factor; its gain and zero have this spread."""
        if isinstance(self.point, CurveMean):
            raise CalibrationError("a curve of slices has no gain")
        return replace(
            self,
            point=self.point.scaled(factor),
            intervals=Intervals(factor * self.intervals.edges, factor * self.intervals.half_widths),
            range=self.range.scaled(factor),
            gain=replace(self.gain, between=spread, zero=spread, noise_nm=factor * self.gain.noise_nm),
        )

    def adapt(
        self, features: FloatArray, torque_nm: FloatArray, sides: IntArray, first: BoolArray | None = None
    ) -> "tuple[IntervalRegressor, GainCorrection]":
        """Return the regressor with each side's gain corrected by (n, d) features of known torques (n,).

        `sides` (d,) is the side of each feature, `first` (n,) marks frames of the first twist after a grip. Raises
        CalibrationError without a load that is large enough to show the gain.
        """
        point = self.point
        least_nm = LOADED_SHARE * max(abs(self.range.low), abs(self.range.high))
        twists = [one for one in find_twists(torque_nm) if np.abs(torque_nm[one]).max() >= least_nm]
        if isinstance(point, CurveMean) or not twists:
            raise CalibrationError(
                f"no twist reaches {least_nm:.3g} N·m while an estimate is possible; twist further, some seconds "
                "after the grip"
            )
        sign = point.sign if isinstance(point, CensoredRidge) else 1.0
        m, weighted = int(sides.max()) + 1, features * point.weights
        constant = point.offset - float(point.mean @ point.weights)
        parts = np.array([weighted[:, sides == side].sum(axis=1) + constant / m for side in range(m)]).T
        correction = self.gain.correct(
            parts, sign * torque_nm, twists, first=first, bounded=isinstance(point, CensoredRidge)
        )
        factors, loaded = correction.factors, np.concatenate(twists)
        # Torques of both directions would cancel in a sum.
        before = parts[loaded].sum(axis=1)
        total = float(parts[loaded] @ factors @ before / (before @ before))
        weights, larger = point.weights * factors[sides], max(total, 1.0)
        offset = constant * float(factors.mean()) + float(point.mean @ weights) + correction.offset_nm
        adapted = replace(
            self,
            point=replace(point, weights=weights, offset=offset),
            intervals=Intervals(self.intervals.edges * total, self.intervals.half_widths * larger),
            range=self.range.scaled(larger),
            gain=correction.spread,
        )
        return adapted, correction

    def range_reasons(self, value: float, features: FloatArray, quantity: str, unit: str) -> tuple[str, ...]:
        """Return the reason against a value or features beyond the calibration, if there is one."""
        beyond = _LARGEST_BEYOND * (self.range.high - self.range.low)
        if not self.range.low - beyond <= value <= self.range.high + beyond:
            return (
                f"the {quantity} would be {value:.3g} {unit}, beyond the calibrated {self.range.low:.3g} to "
                f"{self.range.high:.3g} {unit}",
            )
        limits = _LARGEST_DEVIATION * self.largest_deviation
        if len(limits) and (np.abs(features - self.mean_feature) > limits).any():
            return ("the frame moves further or faster than any at calibration",)
        return ()


def reported_values(point: Regressor, raw: FloatArray) -> FloatArray:
    """Return the values that (n,) raw predictions mean: no torque where the lever would not touch."""
    return point.sign * np.maximum(raw, 0.0) if isinstance(point, CensoredRidge) else raw


def fit_interval_regressor(
    features: FloatArray,
    values: FloatArray,
    fit: RegressorFit,
    *,
    strengths: tuple[float, ...] = STRENGTHS,
    limit_features: bool = False,
    left_out: LeftOut = (),
    twists: LeftOut = (),
    fit_line: RegressorFit | None = None,
    bounds: tuple[FloatArray, FloatArray] | None = None,
    full_range: bool = False,
    recordings: IntArray | None = None,
    fingertips: int = 1,
) -> IntervalRegressor:
    """Fit to (n, d) features and (n,) values in time order.

    `left_out` are pairs of rows to fit to and rows to validate on; by default blocks of time in turn. With `twists`
    instead each pair with a load counts as one error, because the frames of a twist err alike. Torques of slices
    come with `fit_line`: they keep their sign, and unless they cover the `full_range` that will ever occur, it fits
    what reads values beyond it. `bounds` are the least and largest value (n,) that each frame may have: intervals
    extend to the further one. With the number of each row's recording, `recordings` (n,), intervals allow for the gain
    of another recording of as many `fingertips`. Raises CalibrationError where the data does not determine the fit.
    """
    if len(values) < _LEAST_FRAMES or np.ptp(values) == 0:
        raise CalibrationError(
            f"{counted(len(values), 'frame')} with values between {np.min(values, initial=np.inf):.3g} and "
            f"{np.max(values, initial=-np.inf):.3g} cannot determine a calibration; record more, at different loads"
        )
    strength = strengths[0] if len(strengths) == 1 else best_strength(features, values, fit, strengths)[0]
    blocks = list(twists or left_out or left_out_blocks(len(values)))

    def refit(rows: IntArray, by: RegressorFit = fit) -> Regressor:
        return by(features[rows], values[rows], strength)

    parts = [refit(past) for past, _ in blocks]
    raw = [part.predict(features[future]) for part, (_, future) in zip(parts, blocks, strict=True)]
    reported = np.concatenate([reported_values(part, one) for part, one in zip(parts, raw, strict=True)])
    predicted, rows = np.concatenate(raw), np.concatenate([future for _, future in blocks])
    point, truth = fit(features, values, strength), values[rows]
    residuals = reported - truth
    edges = (-point.sigma, 0.0, 0.4 * float(np.abs(values).max())) if isinstance(point, CensoredRidge) else ()
    inflation = _inflation(point, rows, left_out)
    of_loads = _inflation_of_twists(values, twists) if twists else None
    centre = features.mean(axis=0)
    deviation = np.abs(features - centre).max(axis=0) if limit_features else np.zeros(0)
    least = LEAST_HALF_WIDTH * float(np.ptp(values))
    intervals, widening = Intervals.fit(predicted, residuals, edges, inflation, least, of_loads), 1.0
    # Before widening for unknown times: a load that is not seen is not seen at any time.
    half = np.array([intervals.half_width(one) for one in predicted])
    misses_loads = fit_line is None and _misses_loads(truth, np.abs(residuals) <= half)
    if bounds is not None:
        if not (twists or left_out):
            # Unknown times mean few loads, in a block or two each.
            inflation = student_inflation(len(blocks))
        errors = np.max([np.abs(truth + residuals - end[rows]) for end in bounds], axis=0)
        known = intervals.half_widths[-1]
        intervals = Intervals.fit(predicted, errors, edges, inflation, least, of_loads)
        widening = float(intervals.half_widths[-1] / known)
    span, line = ValueRange(float(values.min()), float(values.max())), None
    if fit_line is not None:
        refit_line = None if full_range else partial(refit, by=fit_line)
        span, line = _range_of_slices(point, features, values, refit, refit_line)
    gain = GainSpread()
    if recordings is not None:
        gains = _gains_of_recordings(features, values, recordings, refit)
        gain = _spread_of_gain(values, recordings, rows, reported, gains, fingertips)
    return IntervalRegressor(point, intervals, span, centre, deviation, misses_loads, widening, gain, line)


def _inflation(point: Regressor, rows: IntArray, left_out: LeftOut) -> float:
    """Return the factor by which residuals of the left-out rows are widened."""
    if left_out:
        return student_inflation(len(np.unique(rows)))
    if isinstance(point, CurveMean):
        return 1.0
    return _INFLATION


def _inflation_of_twists(values: FloatArray, twists: LeftOut) -> float:
    """Return Student's factor for as many errors as parts of the (n,) values have a load."""
    loads = np.concatenate(find_twists(values))
    return student_inflation(sum(bool(np.isin(part, loads).any()) for _, part in twists))


def _gains_of_recordings(features: FloatArray, values: FloatArray, recordings: IntArray, refit: Refit) -> list[float]:
    """Return the logarithm of the gain of each recording that the others can predict."""
    gains: list[float] = []
    least = LOADED_SHARE * float(np.abs(values).max())
    for kept, out in left_out_groups(recordings):
        if len(kept) and np.ptp(values[kept]) > 0 and np.abs(values[out]).max() > least:
            part = refit(kept)
            gain = loaded_log_gain(reported_values(part, part.predict(features[out])), values[out])
            if gain is not None:
                gains.append(gain)
    return gains


def _spread_of_gain(
    values: FloatArray,
    recordings: IntArray,
    rows: IntArray,
    predicted: FloatArray,
    gains: Sequence[float],
    fingertips: int,
) -> GainSpread:
    """Return the spread of the gain from the predictions of left-out rows, and the gains of left-out recordings."""
    order = np.argsort(rows, kind="stable")
    rows, predicted = rows[order], predicted[order]
    is_first = first_twists(values, recordings)
    return GainSpread.fit(predicted, values[rows], recordings[rows], is_first[rows], gains, fingertips)


def _range_of_slices(
    point: Regressor, features: FloatArray, values: FloatArray, refit: Refit, refit_line: Refit | None
) -> tuple[ValueRange, Regressor | None]:
    """Return the range of slices and the line that reads values beyond it, if any can occur.

    Peaks of twists one way are of one sign, and no load is always possible.
    """
    low, high, beyond = float(values.min()), float(values.max()), _UNSEEN * float(np.ptp(values))
    span = ValueRange(low, high, 0.0 if low >= 0 else low - beyond, 0.0 if high <= 0 else high + beyond)
    if refit_line is None:
        return span, None
    low_end, high_end = (_range_end(point, features, values, refit, refit_line, sign) for sign in (1, -1))
    if low_end > high_end:
        # Every prediction may hide a value beyond either end.
        low_end, high_end = math.inf, -math.inf
    return replace(span, low_end=low_end, high_end=high_end), refit_line(np.arange(len(values)))


def _range_end(
    point: Regressor, features: FloatArray, values: FloatArray, refit: Refit, refit_line: Refit, sign: int
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

    def median(by: Regressor, rows: IntArray) -> float:
        return float(np.median(sign * reported_values(by, by.predict(features[rows]))))

    end, outermost = float(outward.min()), median(point, order[: max(n_out // 2, 1)])
    if len(kept) < _LEAST_FRAMES or np.ptp(values[kept]) == 0:
        # Untestable: no prediction as far out as the outermost ones now is known to be right.
        return sign * max(end, outermost)
    inside, true = float(outward[kept].min()), float(np.median(outward[out]))
    if not median(refit_line(kept), out) - true > _LARGEST_SHORTFALL * (inside - true) > 0:
        return -sign * math.inf
    span = float(np.ptp(values))
    shortfall = (median(refit(kept), out) - inside) / max(inside - true, _LEAST_DISTANCE * span)
    return sign * max(end, end + shortfall * _LIKELY_UNSEEN * span, outermost)


def _misses_loads(truth: FloatArray, inside: BoolArray) -> bool:
    """Return whether too many loads lie outside their intervals.

    Most frames of a stream are free of load. Their small residuals say nothing of a load that an estimator misses, so
    loads are a stratum of their own, by their truth (label-conditional, Vovk 2012).
    """
    loaded = np.abs(truth) > LOADED_SHARE * float(np.abs(truth).max())
    return bool(loaded.any() and not loaded.all() and inside[loaded].mean() < _LEAST_COVERED)


def best_strength(
    features: FloatArray,
    values: FloatArray,
    fit: RegressorFit,
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

    errors = {one: float(np.mean([squared_error(one, *split) for split in splits])) for one in strengths}
    best = max(strength for strength, error in errors.items() if error <= min(errors.values()) * 1.001)
    return best, errors[best]


def is_one_sided(torque_nm: FloatArray) -> bool:
    """Return whether a load cell was pushed from one side only, and was free of load for much of the time."""
    largest = float(torque_nm[np.argmax(np.abs(torque_nm))])
    along = torque_nm * np.sign(largest)
    return bool(along.min() > -0.05 * abs(largest) and (along < 0.02 * abs(largest)).mean() > 0.2)
