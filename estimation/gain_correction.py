"""Correction of a torque's gain by twists of known torque.

It is a regression with the prior of `GainSpread` (empirical Bayes): one twist moves the gain only as far as twists of
one recording agree.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.gain import GainSpread
from shearloop.estimation.interval_regressor import IntervalRegressor, Intervals
from shearloop.estimation.ridge import CensoredRidge
from shearloop.estimation.twists import LOADED_FRACTION, find_twists, log_gain

# The gain drifts while the gel settles, so successive twists deviate alike from the later ones, by this fraction of the
# variance; more twists do not average it away.
_ALIKE = 0.8
# Twists change the gain if the square of their deviation, in standard errors, exceeds this. One more unknown improves a
# fit by so much by chance (Akaike 1974).
_BY_CHANCE = 2.0
_MIN_ZERO, _MIN_CHANGE = 1e-6, 1e-3
# A correction that leaves more than this fraction of the spread carries no information.
_MAX_LEFT = 0.95
# The known torques are the corrected ones within this factor: a fingertip whose gain drifts left 5, a wrong unit 30.
_MOST_LEFT = 10.0
# Damping of the first step, the maximum of steps, and the square of a step, in standard errors, that changes nothing.
_FIRST_DAMPING, _MAX_STEPS, _SETTLED = 1e-3, 200, 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class GainCorrection:
    """Factors (m,) on the torques of m fingertips with their standard errors, and the offset of their sum.

    `spread` is the remaining spread of the gain, `twists` the number of twists. If an estimator combines its fingertips
    in another way, m is 1.
    """

    factors: FloatArray
    errors: FloatArray
    offset_nm: float
    spread: GainSpread
    twists: int

    @property
    def is_unchanged(self) -> bool:
        """Whether the factors stay at 1, because the twists' deviation may be chance."""
        return bool(np.abs(np.log(self.factors)).max() < _MIN_CHANGE)


def adapt_regressor(
    regressor: IntervalRegressor,
    features: FloatArray,
    torque_nm: FloatArray,
    sides: IntArray,
    first: BoolArray | None = None,
) -> tuple[IntervalRegressor, GainCorrection]:
    """Return a torque's regressor with each side's gain corrected by (n, d) features of known torques (n,).

    `sides` (d,) is the side of each feature, `first` (n,) marks frames of the first twist after a grip. Raises
    CalibrationError without a load that is large enough to show the gain, and for torques far from the corrected ones.
    """
    point = regressor.point
    least_nm = LOADED_FRACTION * max(abs(regressor.range.low), abs(regressor.range.high))
    twists = [twist for twist in find_twists(torque_nm) if np.abs(torque_nm[twist]).max() >= least_nm]
    if not twists:
        raise CalibrationError(
            f"no twist reaches {least_nm:.3g} N·m while an estimate is possible; twist further, some seconds "
            "after the grip"
        )
    sign = point.sign if isinstance(point, CensoredRidge) else 1.0
    m, weighted = int(sides.max()) + 1, features * point.weights
    constant = point.offset - float(point.mean @ point.weights)
    parts = np.array([weighted[:, sides == side].sum(axis=1) + constant / m for side in range(m)]).T
    correction = correct_gain(
        regressor.gain, parts, sign * torque_nm, twists, first=first, bounded=isinstance(point, CensoredRidge)
    )
    factors, loaded = correction.factors, np.concatenate(twists)
    known_nm, corrected_nm = sign * torque_nm[loaded], parts[loaded] @ factors + correction.offset_nm
    if isinstance(point, CensoredRidge):
        corrected_nm = np.maximum(corrected_nm, 0.0)
    left = float(np.abs(known_nm).sum() / max(float((corrected_nm * np.sign(known_nm)).sum()), _MIN_ZERO))
    if not 1.0 / _MOST_LEFT <= left <= _MOST_LEFT:
        raise CalibrationError(
            f"the known torques are {left:.2g} times the corrected estimates, and no grip changes the gain as much: "
            "look at the unit and the lever of the load cell, and whether this is the calibration's tool"
        )
    # Torques of both directions would cancel in a sum.
    before = parts[loaded].sum(axis=1)
    total = float(parts[loaded] @ factors @ before / (before @ before))
    weights, larger = point.weights * factors[sides], max(total, 1.0)
    offset = constant * float(factors.mean()) + float(point.mean @ weights) + correction.offset_nm
    adapted = replace(
        regressor,
        point=replace(point, weights=weights, offset=offset),
        intervals=Intervals(regressor.intervals.edges * total, regressor.intervals.half_widths * larger),
        range=regressor.range.scaled(larger),
        gain=correction.spread,
    )
    return adapted, correction


def correct_gain(
    before: GainSpread,
    parts: FloatArray,
    truth: FloatArray,
    twists: Sequence[IntArray],
    *,
    first: BoolArray | None = None,
    bounded: bool,
) -> GainCorrection:
    """Return the factors on the parts (n, m) of predictions that m fingertips add, and the offset.

    The logarithms of the factors and the offset have normal priors, and each twist is one equation, along its
    torque: errors of its shape come from delays, not from the gain. Frames of a twist share its gain, so a long
    twist determines the gain no better than twists agree. A deviation that may be chance leaves the factors at 1:
    on a grip with the calibration's gain, following it would only add an error. `first` (n,) marks frames of the
    first twist after a grip. With `bounded` a frame without load counts only while it is predicted above zero.
    Raises CalibrationError where the twists do not follow the torque, or leave the gain as uncertain as before.
    """
    is_first = np.array([first is not None and bool(first[rows].any()) for rows in twists])
    known = _Twists(before, parts, truth, twists, is_first, bounded)
    known.refuse_uninformative()
    spread = known.spread_with_these(known.common)
    equations = known.equations(known.common, spread.between)
    shown = equations.solve()
    covariance = equations.covariance(shown)
    followed, left = shown, _relative_error(covariance, known.loaded, shown)
    # On another tool nothing says that the gain is the calibration's.
    if not before.is_of_another_tool:
        deviation = known.deviation()
        followed = known.without_chance(equations, shown, min(spread.between, deviation.beyond_chance))
        not_followed = _log_total(known.loaded, shown) - _log_total(known.loaded, followed)
        left = deviation.spread_left(math.hypot(left, not_followed), spread.between, only_first=known.only_first)
    m = parts.shape[1]
    factors = np.exp(followed[:m])
    return GainCorrection(
        factors,
        factors * np.sqrt(np.diag(covariance))[:m],
        float(followed[m]),
        replace(spread, between=min(left, spread.between)),
        len(twists),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Twists:
    """Twists of known torque: the parts (n, m) of predictions that m fingertips add, and the truth (n,).

    rows are of each of the k twists, is_first (k,) marks the first after a grip. `before` is the spread of the gain
    that is known without them. Variances are of the gain's logarithm: `own` (k,) of each twist, `alike` common to
    successive twists.
    """

    before: GainSpread
    parts: FloatArray
    truth: FloatArray
    rows: Sequence[IntArray]
    is_first: BoolArray
    bounded: bool

    @property
    def loaded(self) -> FloatArray:
        """The parts of the loaded frames."""
        return self.parts[np.concatenate(self.rows)]

    @property
    def only_first(self) -> bool:
        """Whether there is no twist but the first one after a grip."""
        return bool(self.is_first.all())

    @property
    def alike(self) -> float:
        """The variance common to successive twists."""
        return _ALIKE * self.before.within**2

    @property
    def own(self) -> FloatArray:
        """The variance (k,) of each twist."""
        before = self.before
        return before.within**2 - self.alike + np.where(self.is_first, before.first_spread**2, 0.0)

    @property
    def common(self) -> float:
        """The variance common to these twists, with the gain's drift."""
        # The spread of first twists holds how far a single one deviates.
        return self.alike if self.only_first else self.alike + self.before.drift**2

    def refuse_uninformative(self) -> None:
        """Raise CalibrationError where the twists have no gain, or leave it as uncertain as before."""
        # A gain that drifts is no reason to refuse: such twists are followed less.
        steady = self.spread_with_these(self.alike)
        self.equations(self.alike, steady.between).check_informative(self.loaded)

    def spread_with_these(self, common: float) -> GainSpread:
        """Return the spread with the twists' gain, less the variance that chance and noise explain.

        `common` is the twists' common variance. Raises CalibrationError where they have no gain.
        """
        rows = np.concatenate(self.rows)
        predicted, noise_nm = self.parts.sum(axis=1)[rows], self.before.noise_nm
        gain = log_gain(predicted, self.truth[rows])
        if gain is None:
            raise CalibrationError(
                "the estimates do not follow the known torque; check that the load cell's zero and direction "
                "are right, and twist again"
            )
        of_each = float(self.own.mean()) / len(self.rows)
        explained = common + of_each + noise_nm**2 / max(float(predicted @ predicted), noise_nm**2)
        return self.before.with_recordings([max(gain**2 - explained, 0.0)])

    def without_chance(self, equations: "_Equations", shown: FloatArray, beyond_chance: float) -> FloatArray:
        """Return the part of the unknowns (m + 1,) that the twists have `shown` which chance does not explain.

        `beyond_chance` is the spread of the gain from grip to grip that the sum of the fingertips shows.
        """
        shrunk = self.equations(self.common, beyond_chance).solve()
        m = len(shown) - 1
        if m > 1 and equations.misfit(shrunk) - equations.misfit(shown) > _BY_CHANCE * m:
            # The fingertips' gains have changed against each other, which their sum does not show.
            return shown
        return shrunk

    def deviation(self) -> "_Deviation":
        """Return the twists' deviation from the calibration's gain, of the sums of the parts."""
        whole, noise_nm = self.parts.sum(axis=1), self.before.noise_nm
        gains: list[float] = []
        variances: list[float] = []
        for rows, first, variance in zip(self.rows, self.is_first, self.own.tolist(), strict=True):
            gain = log_gain(whole[rows], self.truth[rows])
            if gain is not None:
                gains.append(gain - (self.before.first if first else 0.0))
                power = max(float(whole[rows] @ whole[rows]), noise_nm**2)
                variances.append(variance + noise_nm**2 / power)
        weights = np.linalg.solve(np.diag(variances) + self.common, np.ones(len(gains)))
        variance = 1.0 / float(weights.sum())
        return _Deviation(variance * float(weights @ np.array(gains)), variance)

    def equations(self, common: float, between: float) -> "_Equations":
        """Return what the twists say of the factors on the parts, in standard errors.

        `common` is the twists' common variance, `between` the standard deviation from grip to grip.
        """
        # Along its torque, a twist's noise grows with the power of the torque, an error of the gain with its square.
        parts, truth, noise_nm = self.parts, self.truth, self.before.noise_nm
        along = [truth[rows] for rows in self.rows]
        power = np.array([float(torque @ torque) for torque in along])
        errors = np.diag(power * (noise_nm**2 + self.own * power)) + common * np.outer(power, power)
        whiten = np.linalg.inv(np.linalg.cholesky(errors))
        of_parts = np.array([torque @ parts[rows] for torque, rows in zip(along, self.rows, strict=True)])
        # The first twist reads the gain times its own deviation from the later ones.
        deviation = np.exp(np.where(self.is_first, self.before.first, 0.0))[:, None]
        loaded = np.concatenate(self.rows)
        unloaded = np.setdiff1d(np.arange(len(truth)), loaded)
        # The unloaded frames before a twist have one error in common.
        weight = math.sqrt(len(self.rows) / max(len(unloaded), 1)) / noise_nm
        m = parts.shape[1]
        load_nm = float(np.sqrt((truth[loaded] ** 2).mean()))
        of_offset_nm = max(self.before.zero, _MIN_ZERO) * load_nm
        return _Equations(
            of_parts=whiten @ (deviation * of_parts),
            of_offset=whiten @ np.array([torque.sum() for torque in along]),
            known=whiten @ power,
            parts=parts[unloaded],
            weight=weight,
            prior=np.append(np.full(m, math.sqrt(m) * between), of_offset_nm),
            bounded=self.bounded,
        )


@dataclass(frozen=True, slots=True)
class _Deviation:
    """The logarithm of the gain of some twists against the calibration's, and its variance."""

    log_gain: float
    variance: float

    @property
    def beyond_chance(self) -> float:
        """The standard deviation of the gain from grip to grip that these twists show beyond chance."""
        return max(math.sqrt(max(self.log_gain**2 - _BY_CHANCE * self.variance, 0.0)), _MIN_CHANGE)

    @property
    def unchanged(self) -> float:
        """How likely an unchanged gain is against a changed one, 1 within chance (Akaike's relative likelihood)."""
        return min(1.0, math.exp((_BY_CHANCE - self.log_gain**2 / self.variance) / 2.0))

    def spread_left(self, of_twists: float, before: float, *, only_first: bool) -> float:
        """Return the gain's spread after these twists, which leave `of_twists`, from the one before.

        How far first twists deviate is known from few grips: one that may be chance narrows nothing.
        """
        if not only_first:
            return of_twists
        return math.sqrt((1.0 - self.unchanged) * of_twists**2 + self.unchanged * before**2)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """What twists say of the unknowns x: the logarithms of m factors, and the offset. In standard errors.

    A twist says of_parts (k, m) · factors + of_offset (k,) · offset = known (k,), a frame without load parts (n, m) ·
    factors + offset = 0 with this weight, or at most 0 where it is `bounded`, and the prior (m + 1,) deviations x = 0.
    """

    of_parts: FloatArray
    of_offset: FloatArray
    known: FloatArray
    parts: FloatArray
    weight: float
    prior: FloatArray
    bounded: bool

    def solve(self) -> FloatArray:
        """Return the unknowns (m + 1,); raises CalibrationError where they do not settle."""
        x = _least_squares(self.residuals, self.slopes, np.zeros(len(self.prior)))
        if x is None:
            raise CalibrationError("the gain of these twists does not settle; twist further, and several times")
        return x

    def covariance(self, x: FloatArray) -> FloatArray:
        """Return the covariance of the unknowns (m + 1, m + 1) at x."""
        slopes = self.slopes(x)
        return np.asarray(np.linalg.inv(slopes.T @ slopes))

    def check_informative(self, loaded: FloatArray) -> None:
        """Raise CalibrationError where twists leave the sum of the loaded parts (n, m) as uncertain as the prior."""
        x = self.solve()
        before = _relative_error(np.diag(self.prior**2), loaded, x)
        if _relative_error(self.covariance(x), loaded, x) > _MAX_LEFT * before:
            raise CalibrationError(
                "these twists leave the gain as uncertain as it was: twists of the calibration differ too much, or "
                "these are too small; twist further, and several times"
            )

    def misfit(self, x: FloatArray) -> float:
        """Return the sum of the squared residuals without the residuals of the prior."""
        known = self.residuals(x)[: -len(self.prior)]
        return float(known @ known)

    def residuals(self, x: FloatArray) -> FloatArray:
        """Return the (k + n + m + 1,) residuals."""
        factors, offset = np.exp(x[:-1]), x[-1]
        free = self.parts @ factors + offset
        of_twists = self.of_parts @ factors + self.of_offset * offset - self.known
        return np.concatenate(
            [of_twists, self.weight * (np.maximum(free, 0.0) if self.bounded else free), x / self.prior]
        )

    def slopes(self, x: FloatArray) -> FloatArray:
        """Return their derivatives (k + n + m + 1, m + 1); bounds that do not bind carry no information."""
        factors, offset = np.exp(x[:-1]), x[-1]
        counts = (self.parts @ factors + offset > 0) | (not self.bounded)
        free = np.column_stack([self.parts * factors, np.ones(len(self.parts))]) * counts[:, None]
        of_twists = np.column_stack([self.of_parts * factors, self.of_offset])
        return np.concatenate([of_twists, self.weight * free, np.diag(1.0 / self.prior)])


def _least_squares(
    residuals: Callable[[FloatArray], FloatArray], slopes: Callable[[FloatArray], FloatArray], start: FloatArray
) -> FloatArray | None:
    """Return the (d,) unknowns that minimize the squared residuals, by Levenberg's and Marquardt's steps.

    None where they do not settle. SciPy's would take the daemon a tenth of a second to import.
    """
    x, damping = start, _FIRST_DAMPING
    left = residuals(x)
    for _ in range(_MAX_STEPS):
        slope = slopes(x)
        information, gradient = slope.T @ slope, slope.T @ left
        step = -np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
        if float(step @ information @ step) < _SETTLED:
            return x
        trial = residuals(x + step)
        if float(trial @ trial) < float(left @ left):
            x, left, damping = x + step, trial, damping / 10.0
        else:
            damping *= 10.0
    return None


def _relative_error(covariance: FloatArray, parts: FloatArray, x: FloatArray) -> float:
    """Return the standard error of (n, m) corrected parts as a ratio of their sum, both as root mean squares.

    `covariance` (m + 1, m + 1) is the covariance of the unknowns x: the factors' logarithms, and the offset.
    """
    factors, offset_nm = np.exp(x[:-1]), float(x[-1])
    slopes = np.column_stack([parts * factors, np.ones(len(parts))])
    corrected = parts @ factors + offset_nm
    variances = np.einsum("ni,ij,nj->n", slopes, covariance, slopes)
    return float(np.sqrt(variances.mean() / (corrected**2).mean()))


def _log_total(parts: FloatArray, x: FloatArray) -> float:
    """Return the logarithm of the size of (n, m) parts that are corrected by the unknowns x."""
    corrected = parts @ np.exp(x[:-1]) + x[-1]
    return 0.5 * math.log(float(corrected @ corrected))
