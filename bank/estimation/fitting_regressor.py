"""Fitting a reader: a head to the features, and intervals to what went wrong on what was left out."""

from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.contamination import Passing
from shearloop.bank.estimation.interval_regressor import LEAST_HALF_WIDTH, Head, IntervalRegressor, shown
from shearloop.bank.estimation.intervals import LEVEL, Intervals, for_few
from shearloop.bank.estimation.regressors import (
    InverseCalibration,
    TobitRidge,
    best_strength,
    later_splits,
    left_out_blocks,
)

HeadOf: TypeAlias = Callable[[FloatArray, FloatArray, float], Head]
# From (earlier, later) rows to how much harder each of the later ones is to read than is typical of the earlier ones.
Difficulty: TypeAlias = Callable[[IntArray, IntArray], FloatArray]
# From the same to the later ones mixed with what is foreign to them, as far as that passes.
Mixed: TypeAlias = Callable[[IntArray, IntArray], Passing]

# Penalties to choose from, in units of the features' sum of squares.
STRENGTHS = tuple(10.0**power for power in range(-6, 1))
# Future data lies further from the past than one part of a recording from the next, unless what was left out was the
# future itself.
_INFLATION = 1.05
_LEAST_FRAMES = 8
# Values left out at either end of the range, to see whether what lies beyond it is read as beyond it, or at its end:
# if more than half of the way beyond is missing.
_AT_END, _MAY_BE_MISSING = 0.2, 0.5
# What is left out is taken for no less far beyond the rest than so many spans of the range: where torques that are
# nearly equal are parted, their noise would be read as a way.
_LEAST_TRIED = 0.05
# As far beyond the range, in spans of it, as frames still pass for familiar ones. Slices of 0.14 N·m do where those
# below 0.06 were calibrated on, 1.6 spans beyond, and no slice lies further (`extrapolation-torque-slices` of
# docs/charts.md).
_UNSEEN = 2.0
# What is read inside the range is taken for so far beyond it, when it is asked from where on readings may be of that:
# with more of it the end lies further inside, and more of what was read well is doubted.
_LIKELY_UNSEEN = 0.5
# Loads above this share of the largest count as loads, and this share of them must lie within their intervals.
_LOADED_SHARE, _LEAST_COVERED = 0.1, 0.75


def fit_reader(
    features: FloatArray,
    values: FloatArray,
    head_of: HeadOf,
    *,
    strengths: tuple[float, ...] = STRENGTHS,
    limit_reach: bool = False,
    left_out: Sequence[tuple[IntArray, IntArray]] = (),
    difficulty: Difficulty | None = None,
    mixed: Mixed | None = None,
    within: tuple[FloatArray, FloatArray] | None = None,
    all_values: bool = False,
) -> IntervalRegressor:
    """Fit a head to (n, d) features and (n,) values in time order, and intervals to the residuals of what was left out.

    `left_out` are pairs of rows fitted to and rows that stand for what is to come; by default blocks of time in turn.
    With `difficulty` residuals are taken in units of it, and whoever reads widens by it (normalised conformal
    prediction, Papadopoulos et al. 2002); then it is also looked at whether values beyond the range would be read as
    such, unless these are `all_values` that will ever come. With `mixed` intervals reach as far as what passes with
    something foreign in it goes astray. Where a value may be any from the first to the second (n,) of `within`,
    intervals reach as far as the further one.
    Raises CalibrationError where the data does not determine them.
    """
    if len(values) < _LEAST_FRAMES or np.ptp(values) == 0:
        raise CalibrationError(
            f"{len(values)} frames with values between {np.min(values, initial=np.inf):.3g} and "
            f"{np.max(values, initial=-np.inf):.3g} determine no calibration; record more, at different loads"
        )

    def judged(strength: float, past: IntArray, future: IntArray) -> tuple[FloatArray, FloatArray]:
        return _judged(features, values, head_of, strength, past, future)

    # Of the candidates the one that does best on what comes later …
    strength = strengths[0]
    if len(strengths) > 1:
        strength = _best(features, values, head_of, strengths)
    # … and how far it goes astray on what was left out.
    blocks = list(left_out or left_out_blocks(len(values)))
    found = [judged(strength, past, future) for past, future in blocks]
    predicted, residuals = (np.concatenate([pair[i] for pair in found]) for i in (0, 1))
    truth = np.concatenate([values[future] for _, future in blocks])
    hardness = np.ones_like(truth)
    if difficulty is not None:
        hardness = np.concatenate([difficulty(past, future) for past, future in blocks])
    head = head_of(features, values, strength)
    edges = (-head.sigma, 0.0, 0.4 * float(np.abs(values).max())) if isinstance(head, TobitRidge) else ()
    rows = np.concatenate([future for _, future in blocks])
    inflation = 1.0 if isinstance(head, InverseCalibration) else _INFLATION
    if left_out:
        inflation = for_few(len(np.unique(rows)))
    centre = features.mean(axis=0)
    reach = np.abs(features - centre).max(axis=0) if limit_reach else np.zeros(0)
    least = LEAST_HALF_WIDTH * float(np.ptp(values))
    intervals, widened = Intervals.fit(predicted, residuals / hardness, edges, inflation, least), 1.0
    # Before they are widened for times that are not known: a load that is not seen is none at any time.
    half = np.array([intervals.half_width(one) for one in predicted])
    misses_loads = difficulty is None and _misses_loads(truth, np.abs(residuals) <= half)
    if within is not None:
        if not left_out:
            # Times that could not be checked are those of few loads, in a block or two each.
            inflation = for_few(len(blocks))
        astray = np.max([np.abs(truth + residuals - end[rows]) for end in within], axis=0)
        known_nm = intervals.half_widths[-1]
        intervals = Intervals.fit(predicted, astray / hardness, edges, inflation, least)
        widened = float(intervals.half_widths[-1] / known_nm)
    low_end, high_end = -np.inf, np.inf
    if difficulty is not None and not all_values:
        low_end, high_end = (
            _end(head, features, values, lambda rows: head_of(features[rows], values[rows], strength), sign)
            for sign in (1, -1)
        )
    hidden = (0.0, 0.0)
    if mixed is not None:
        heads = ((head_of(features[past], values[past], strength), mixed(past, future)) for past, future in blocks)
        hidden = _hidden(features, values, heads, inflation)
    low, high, beyond = float(values.min()), float(values.max()), _UNSEEN * float(np.ptp(values))
    return IntervalRegressor(
        head, intervals, low, high, low_end, high_end, misses_loads, centre, reach, *hidden, widened,
        # However far from the range it is, a load may always be none.
        min(low - beyond, 0.0), max(high + beyond, 0.0),
    )  # fmt: skip


def _hidden(
    features: FloatArray, values: FloatArray, seen: Iterable[tuple[Head, Passing]], inflation: float
) -> tuple[float, float]:
    """Return how far below and above what heads read of mixtures the truth lies, but for one in twenty on each side.

    In units of the nearness: so measured, mixtures that hold a seventh or more of something foreign go astray alike.
    """
    astray = [np.zeros(0)]
    for head, passing in seen:
        if not len(passing.rows):
            continue
        own, which = np.unique(passing.rows, return_inverse=True)
        pure, mixed = (
            np.array([shown(head, one) for one in head.predict(rows)]) for rows in (features[own], passing.features)
        )
        pure = pure[which]
        # More slices mend the error of the slices, and not what is mixed in.
        astray.append((inflation * (pure - values[passing.rows]) + mixed - pure) / passing.nearness)
    found = np.concatenate(astray)
    if not len(found):
        return 0.0, 0.0
    return max(float(np.quantile(found, LEVEL)), 0.0), max(float(-np.quantile(found, 1 - LEVEL)), 0.0)


def _end(head: Head, features: FloatArray, values: FloatArray, refit: Callable[[IntArray], Head], sign: int) -> float:
    """Return the value at or below which (for the sign −1: above which) a reading may be of anything further out.

    The outermost values are left out and read by what is left. If they are read at its end instead of beyond it, or
    even within it, then so will be what lies beyond the whole range, and the more, the further it lies: asked here is
    what lies `_LIKELY_UNSEEN` beyond. Otherwise it is the end of the range itself.
    """
    outward = sign * values
    order = np.argsort(outward, kind="stable")
    # Equal ones stay together: if some of them were fitted to, they would tell where the others are.
    n_out = int((outward <= outward[order[round(_AT_END * len(values)) - 1]]).sum())
    out, kept = order[:n_out], np.sort(order[n_out:])

    def read(by: Head, rows: IntArray) -> float:
        return float(np.median([sign * shown(by, one) for one in by.predict(features[rows])]))

    found, read_now = float(outward.min()), read(head, order[: max(n_out // 2, 1)])
    if len(kept) < _LEAST_FRAMES or np.ptp(values[kept]) == 0:
        # Nobody can tell: of what is read as the outermost are now, none is known to be one of them.
        return sign * max(found, read_now)
    inside = float(outward[kept].min())
    seen, true = read(refit(kept), out), float(np.median(outward[out]))
    if seen - true > _MAY_BE_MISSING * (inside - true) > 0:
        span = float(np.ptp(values))
        # By what lies hardly beyond the rest nothing tells how it goes on.
        short = (seen - inside) / max(inside - true, _LEAST_TRIED * span)
        # At least as far inside as the outermost are read now.
        found = max(found, found + short * _LIKELY_UNSEEN * span, read_now)
    return sign * found


def _misses_loads(truth: FloatArray, inside: BoolArray) -> bool:
    """Return whether too many loads lie outside of their intervals.

    Most frames of a stream are free of load and read as such: their small residuals say nothing of a load that an
    estimator does not see. Loads are a stratum of their own, by their truth (label-conditional, Vovk 2012).
    """
    loaded = np.abs(truth) > _LOADED_SHARE * float(np.abs(truth).max())
    return bool(loaded.any() and not loaded.all() and inside[loaded].mean() < _LEAST_COVERED)


def error_on_later(features: FloatArray, values: FloatArray, head_of: HeadOf, strengths: tuple[float, ...]) -> float:
    """Return the mean squared error on parts later than those fitted to, with the strength that makes it least."""
    strength = _best(features, values, head_of, strengths)
    found = [
        float((_judged(features, values, head_of, strength, past, future)[1] ** 2).mean())
        for past, future in _splits(values)
    ]
    return float(np.mean(found))


def _splits(values: FloatArray) -> list[tuple[IntArray, IntArray]]:
    return [(past, future) for past, future in later_splits(len(values)) if np.ptp(values[past]) > 0]


def _best(features: FloatArray, values: FloatArray, head_of: HeadOf, strengths: tuple[float, ...]) -> float:
    def error(strength: float, past: IntArray, future: IntArray) -> float:
        return float((_judged(features, values, head_of, strength, past, future)[1] ** 2).mean())

    return best_strength(strengths, error, _splits(values))


def _judged(
    features: FloatArray, values: FloatArray, head_of: HeadOf, strength: float, past: IntArray, future: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return what a head fitted to the past says of the future, and how far that is from the truth."""
    head = head_of(features[past], values[past], strength)
    raw = head.predict(features[future])
    return raw, np.array([shown(head, one) for one in raw]) - values[future]


def one_sided(torque_nm: FloatArray) -> bool:
    """Return whether a load cell was pushed from one side only, and free of load for a good part of the time."""
    largest = float(torque_nm[np.argmax(np.abs(torque_nm))])
    along = torque_nm * np.sign(largest)
    return bool(along.min() > -0.05 * abs(largest) and (along < 0.02 * abs(largest)).mean() > 0.2)
