"""Gain of a torque: how much it changes between recordings, and its correction by twists of known torque.

The same twist moves the gel differently in another grip, so the estimates of a recording have an error in common that
grows with the torque. Its size is a random effect. Several recordings estimate it, and a prior counts as some more
recordings. A correction is a regression with that prior (empirical Bayes): one twist moves the
gain only as far as twists of one recording agree.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.confidence import TWO_SIDED_95
from shearloop.estimation.twists import find_twists, log_gain

# Standard deviation of the logarithm of the gain between recordings, for one fingertip and for two, and the recordings
# that it counts as. Cylinders and days recorded twice differ by factors of 0.44 to 1.4 for one fingertip, of 0.86 and
# 1.2 for two (docs/decisions/0046).
PRIOR_SPREADS, _PRIOR_RECORDINGS = {1: 0.28, 2: 0.16}, 3
# The same for a calibration on fewer twists, which do not show that the torque repeats. The gains of two recordings
# with one twist each differ by factors of 3.0 (right), 2.2 (left) and 1.1 (both).
_REPEATING_TWISTS, _UNREPEATED_SPREADS = 3, {1: 0.9, 2: 0.24}
# The same for the first twist after a grip against the later ones, and the number of grips that its mean of 0 counts
# as.
FIRST_SPREAD, _PRIOR_GRIPS = 0.2, 1
# The same for a tool that was not calibrated, against the law over the diameter: a factor of 4 either way.
TOOL_SPREAD = 0.7
# The minimum spread of a recording's twists: a few equal ones are chance.
_MIN_WITHIN = 0.05
_MIN_NOISE, _MIN_ZERO, _MIN_CHANGE = 1e-3, 1e-6, 1e-3
# The gain drifts while the gel settles, so successive twists deviate alike from the later ones, by this fraction of the
# variance; more twists do not average it away.
_ALIKE = 0.8
# Twists change the gain if the square of their deviation, in standard errors, exceeds this. One more unknown improves a
# fit by so much by chance (Akaike 1974).
_BY_CHANCE = 2.0
# Furthest diameter beyond the calibrated ones, as a ratio.
_REACH = 1.5
# A correction that leaves more than this fraction of the spread carries no information.
_MAX_LEFT = 0.95
# Damping of the first step, the maximum of steps, and the square of a step, in standard errors, that changes nothing.
_FIRST_DAMPING, _MAX_STEPS, _SETTLED = 1e-3, 200, 1e-12


@dataclass(frozen=True, slots=True)
class GainSpread:
    """Standard deviations of the gain's logarithm, and of the rest of a loaded frame's error in N·m.

    `between` is of one grip to the next, and as certain as from this number of `recordings`; `within` is of twists
    of one grip. The first twist after a grip differs from the later ones by `first`, with the deviation `first_spread`.
    `drift` is by how much more one half of a grip's twists deviates from the other than grips from each other.
    `zero` is of the torque without motion, as a fraction of the load: 0 for the calibration's tool.
    """

    between: float = 0.0
    within: float = _MIN_WITHIN
    noise_nm: float = 0.0
    recordings: int = _PRIOR_RECORDINGS
    zero: float = 0.0
    first: float = 0.0
    first_spread: float = FIRST_SPREAD
    drift: float = 0.0

    @classmethod
    def fit(
        cls,
        predicted: FloatArray,
        truth: FloatArray,
        grips: IntArray,
        is_first: BoolArray,
        left_out: Sequence[float],
        halves: Sequence[float],
        fingertips: int,
    ) -> Self:
        """Return the spread from (n,) predictions of left-out frames and their truth, in the order of time.

        `grips` are the number of each frame's grip, `is_first` whether the frame belongs to the grip's first twist.
        `left_out` are logarithms of the gains of grips that were left out of the fit, `halves` of the gains of the
        halves of a grip's twists. The fingertips have one prior.
        """
        rows_of_grips = [np.flatnonzero(grips == grip) for grip in np.unique(grips)]
        found = [_GripGains.of(predicted[rows], truth[rows], is_first[rows]) for rows in rows_of_grips]
        errors_nm = [error_nm for grip in found for error_nm in grip.errors_nm]
        noise_nm = float(np.sqrt(np.mean(np.concatenate(errors_nm) ** 2))) if errors_nm else 0.0
        least_noise_nm = _MIN_NOISE * float(np.abs(truth).max(initial=0.0))
        # A tool's own gain is not a difference between twists, so each grip counts from its own mean.
        compared = [grip for grip in found if grip.later]
        freedom = sum(len(grip.later) - 1 for grip in compared)
        squares = sum(sum((gain - grip.mean) ** 2 for gain in grip.later) for grip in compared)
        within = math.sqrt(squares / freedom) if freedom else 0.0
        firsts = [gain - grip.mean for grip in compared for gain in grip.first]
        first = sum(firsts) / (_PRIOR_GRIPS + len(firsts))
        first_prior = FIRST_SPREAD / math.sqrt(fingertips)
        n_twists = sum(len(grip.errors_nm) for grip in found)
        spreads = _UNREPEATED_SPREADS if 0 < n_twists < _REPEATING_TWISTS else PRIOR_SPREADS
        prior = cls(
            spreads[fingertips],
            max(within, _MIN_WITHIN),
            max(noise_nm, least_noise_nm),
            first=first,
            first_spread=_pooled(first_prior, _PRIOR_RECORDINGS, [(deviation - first) ** 2 for deviation in firsts]),
        )
        spread = prior._with_recordings([logarithm**2 for logarithm in left_out])
        between_halves = float(np.mean(np.square(halves))) if len(halves) else 0.0
        return replace(spread, drift=math.sqrt(max(between_halves - spread.between**2, 0.0)))

    @property
    def is_of_another_tool(self) -> bool:
        """Whether the torque is of a tool that was not calibrated, so that nothing is known of its own gain."""
        return self.zero > 0.0

    def _with_recordings(self, squares: Sequence[float]) -> Self:
        """Return the spread after recordings with these squares of the gain's logarithm."""
        between = _pooled(self.between, self.recordings, squares)
        return replace(self, between=between, recordings=self.recordings + len(squares))

    def reach(self, value: float) -> tuple[float, float]:
        """Return how far the truth may lie below and above a value, at 95 %, because of the gain."""
        factor = math.exp(TWO_SIDED_95 * self.between)
        inward, outward = abs(value) * (1.0 - 1.0 / factor), abs(value) * (factor - 1.0)
        return (inward, outward) if value > 0 else (outward, inward)

    def correct(
        self,
        parts: FloatArray,
        truth: FloatArray,
        twists: Sequence[IntArray],
        *,
        first: BoolArray | None = None,
        bounded: bool,
    ) -> "GainCorrection":
        """Return the factors on the parts (n, m) of predictions that m fingertips add, and the offset.

        The logarithms of the factors and the offset have normal priors, and each twist is one equation, along its
        torque: errors of its shape come from delays, not from the gain. Frames of a twist share its gain, so a long
        twist determines the gain no better than twists agree. A deviation that may be chance leaves the factors at 1:
        on a grip with the calibration's gain, following it would only add an error. `first` (n,) marks frames of the
        first twist after a grip. With `bounded` a frame without load counts only while it is predicted above zero.
        Raises CalibrationError where the twists do not follow the torque, or leave the gain as uncertain as before.
        """
        loaded = np.concatenate(twists)
        is_first = np.array([first is not None and bool(first[rows].any()) for rows in twists])
        # Variances of the logarithm: the part common to successive twists, and each twist's part.
        alike = _ALIKE * self.within**2
        own = self.within**2 - alike + np.where(is_first, self.first_spread**2, 0.0)
        # The spread of first twists holds how far a single one deviates.
        only_first = bool(is_first.all())
        common = alike if only_first else alike + self.drift**2
        whole = parts.sum(axis=1)
        of_each = float(own.mean()) / len(twists)
        equations = partial(self._equations, parts, truth, twists, is_first, own, bounded=bounded)
        # A gain that drifts is no reason to refuse: such twists are followed less.
        steady = self._with_this(whole[loaded], truth[loaded], alike + of_each)
        equations(alike, steady.between).check_informative(parts[loaded])
        spread = self._with_this(whole[loaded], truth[loaded], common + of_each)
        known = partial(equations, common)
        with_prior = known(spread.between)
        shown = with_prior.solve()
        covariance = with_prior.covariance(shown)
        of_twists = _relative_error(covariance, parts[loaded], shown)
        followed, left = shown, of_twists
        # On another tool nothing says that the gain is the calibration's.
        if not self.is_of_another_tool:
            seen = self._deviation(whole, truth, twists, is_first, common, own)
            followed = _beyond_chance(known, with_prior, shown, min(spread.between, seen.beyond_chance))
            not_followed = _log_total(parts[loaded], shown) - _log_total(parts[loaded], followed)
            left = seen.spread_left(math.hypot(of_twists, not_followed), spread.between, only_first=only_first)
        m = parts.shape[1]
        factors = np.exp(followed[:m])
        return GainCorrection(
            factors,
            factors * np.sqrt(np.diag(covariance))[:m],
            float(followed[m]),
            replace(spread, between=min(left, spread.between)),
            len(twists),
        )

    def _deviation(
        self,
        whole: FloatArray,
        truth: FloatArray,
        twists: Sequence[IntArray],
        is_first: BoolArray,
        common: float,
        own: FloatArray,
    ) -> "_Deviation":
        """Return the twists' deviation from the calibration's gain, of the sums `whole` (n,) of the parts.

        Other parameters are as in `_equations`.
        """
        gains: list[float] = []
        variances: list[float] = []
        for rows, first, variance in zip(twists, is_first, own.tolist(), strict=True):
            gain = log_gain(whole[rows], truth[rows])
            if gain is not None:
                gains.append(gain - (self.first if first else 0.0))
                power = max(float(whole[rows] @ whole[rows]), self.noise_nm**2)
                variances.append(variance + self.noise_nm**2 / power)
        weights = np.linalg.solve(np.diag(variances) + common, np.ones(len(gains)))
        variance = 1.0 / float(weights.sum())
        return _Deviation(variance * float(weights @ np.array(gains)), variance)

    def _equations(
        self,
        parts: FloatArray,
        truth: FloatArray,
        twists: Sequence[IntArray],
        is_first: BoolArray,
        own: FloatArray,
        common: float,
        between: float,
        *,
        bounded: bool,
    ) -> "_Equations":
        """Return what twists (k) say of the factors on parts (n, m), in standard errors.

        `is_first` (k,) marks the first twists after a grip. The logarithm's variances are `common` to the twists, and
        each one's `own` (k,); `between` is its standard deviation from grip to grip.
        """
        # Along its torque, a twist's noise grows with the power of the torque, an error of the gain with its square.
        along = [truth[rows] for rows in twists]
        power = np.array([float(torque @ torque) for torque in along])
        errors = np.diag(power * (self.noise_nm**2 + own * power)) + common * np.outer(power, power)
        whiten = np.linalg.inv(np.linalg.cholesky(errors))
        of_parts = np.array([torque @ parts[rows] for torque, rows in zip(along, twists, strict=True)])
        # The first twist reads the gain times its own deviation from the later ones.
        deviation = np.exp(np.where(is_first, self.first, 0.0))[:, None]
        loaded = np.concatenate(twists)
        unloaded = np.setdiff1d(np.arange(len(truth)), loaded)
        # The unloaded frames before a twist have one error in common.
        weight = math.sqrt(len(twists) / max(len(unloaded), 1)) / self.noise_nm
        m = parts.shape[1]
        load_nm = float(np.sqrt((truth[loaded] ** 2).mean()))
        of_offset_nm = max(self.zero, _MIN_ZERO) * load_nm
        return _Equations(
            of_parts=whiten @ (deviation * of_parts),
            of_offset=whiten @ np.array([torque.sum() for torque in along]),
            known=whiten @ power,
            parts=parts[unloaded],
            weight=weight,
            prior=np.append(np.full(m, math.sqrt(m) * between), of_offset_nm),
            bounded=bounded,
        )

    def _with_this(self, predicted: FloatArray, truth: FloatArray, explained: float) -> Self:
        """Return the spread with the gain of loaded frames (n,), less the variance that twists and noise explain.

        Raises CalibrationError where they have no gain.
        """
        gain = log_gain(predicted, truth)
        if gain is None:
            raise CalibrationError(
                "the estimates do not follow the known torque; check that the load cell and the calibration have the "
                "same direction, and twist again"
            )
        explained += self.noise_nm**2 / max(float(predicted @ predicted), self.noise_nm**2)
        return self._with_recordings([max(gain**2 - explained, 0.0)])


@dataclass(frozen=True, slots=True)
class _GripGains:
    """The logarithms of the gains of a grip's twists, the first after the grip apart from the later ones.

    `errors_nm` has one row for each twist: the errors that its gain does not explain.
    """

    first: Sequence[float]
    later: Sequence[float]
    errors_nm: Sequence[FloatArray]

    @classmethod
    def of(cls, predicted: FloatArray, truth: FloatArray, is_first: BoolArray) -> Self:
        """Return the gains of (n,) predictions of one grip; a twist that they do not follow has none."""
        first: list[float] = []
        later: list[float] = []
        errors_nm: list[FloatArray] = []
        for rows in find_twists(truth):
            gain = log_gain(predicted[rows], truth[rows])
            if gain is None:
                errors_nm.append(truth[rows])
                continue
            errors_nm.append(truth[rows] - math.exp(gain) * predicted[rows])
            (first if is_first[rows[0]] else later).append(gain)
        return cls(first, later, errors_nm)

    @property
    def mean(self) -> float:
        """The mean of the later twists."""
        return float(np.mean(self.later))


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


@dataclass(frozen=True, slots=True)
class ToolLaw:
    """Gain over the tool's diameter: ln gain = intercept + slope · ln diameter, and the spread of a tool left out.

    The diameters in mm reach from low_mm to high_mm.
    """

    intercept: float
    slope: float
    spread: float
    low_mm: float
    high_mm: float

    @classmethod
    def fit(cls, diameters_mm: FloatArray, gains: FloatArray) -> Self:
        """Fit to (n,) gains of tools of three diameters or more."""
        x, y = np.log(diameters_mm), np.log(gains)
        slope, intercept = np.polyfit(x, y, 1)
        tools = np.unique(x).tolist()
        squares = [
            float(np.mean((y[x == tool] - np.polyval(np.polyfit(x[x != tool], y[x != tool], 1), tool)) ** 2))
            for tool in tools
        ]
        # A line through two points says little of how far a third one lies, so the prior stays.
        spread = max(_pooled(TOOL_SPREAD, _PRIOR_RECORDINGS, squares), TOOL_SPREAD)
        return cls(float(intercept), float(slope), spread, float(diameters_mm.min()), float(diameters_mm.max()))

    @property
    def factor(self) -> float:
        """How far a torque may be off either way before a twist of known torque, at 95 %."""
        return math.exp(TWO_SIDED_95 * self.spread)

    def gain(self, diameter_mm: float) -> float | None:
        """Return the gain on a tool, None too far from the calibrated ones."""
        if not self.low_mm / _REACH <= diameter_mm <= self.high_mm * _REACH:
            return None
        return math.exp(self.intercept + self.slope * math.log(diameter_mm))


def _beyond_chance(
    known: "Callable[[float], _Equations]", equations: "_Equations", shown: FloatArray, beyond_chance: float
) -> FloatArray:
    """Return the part of the unknowns that twists have `shown` which chance does not explain.

    `known` returns the equations for a spread of the gain from grip to grip, `beyond_chance` is the one that the sum of
    the fingertips shows.
    """
    shrunk = known(beyond_chance).solve()
    m = len(shown) - 1
    if m > 1 and equations.misfit(shrunk) - equations.misfit(shown) > _BY_CHANCE * m:
        # The fingertips' gains have changed against each other, which their sum does not show.
        return shown
    return shrunk


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


def _pooled(prior: float, counts_as: int, squares: Sequence[float]) -> float:
    """Return the root mean square of deviations, with a prior that counts as some."""
    return math.sqrt((counts_as * prior**2 + sum(squares)) / (counts_as + len(squares)))
