"""Which of the gel's motion a torque is fitted to: directions, memory and penalty, by twists left out.

Few directions and a long memory in growing steps generalise to other twists, grips and days; how few depends on the
fingertips. So every combination is fitted with each twist left out, and judged on the loaded frames of that twist:
the many frames without a load would decide otherwise. The fits that are nearly as good as the best are averaged, which
is again one linear map. A penalty shrinks the estimates; the left-out twists show by how much, and the map is divided
by it.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.estimation.estimator import Bounds
from shearloop.estimation.fingertip_validator import FingertipValidator
from shearloop.estimation.interval_fit import Validation, fit_interval_regressor
from shearloop.estimation.interval_regressor import IntervalRegressor, reported_values
from shearloop.estimation.left_out import LeftOut, left_out_blocks, left_out_groups
from shearloop.estimation.motion_features import TemporalFeatures
from shearloop.estimation.ridge import CensoredRidge, Ridge, is_one_sided
from shearloop.estimation.twists import LOADED_FRACTION, find_twists

# Ends of the steps of the memory in frames back: 18 frames are 10 s, and the gel creeps for some seconds.
MEMORY_EDGES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 13, 16, 19)
# Directions per fingertip, steps of the memory (12 and 18 frames), and penalties to choose from.
MAX_DIRECTIONS = 3
_DIRECTIONS, _STEPS, _PENALTIES = (1, 2, 3), (10, 12), (1e-5, 1e-4)
# Where the gel holds its position, that position shows a long twist, and the shortest memory serves.
_STEPS_WITH_POSITION = (8,)
# Minimum number of twists that are left out one by one, and maximum number of parts; more twists are grouped.
_MIN_TWISTS, _MAX_PARTS = 3, 10
# Below this fraction of loaded frames, the frames left out hold few twists.
_RARE_LOAD, _FRAMES_OF_FEW_TWISTS = 0.5, 2
# The directions of the motion over this many frames, 4 s. Over 6 frames the first twists after a grip err
# more, over 12 frames later twists do (docs/decisions/0044). A nested choice tries all three.
_DIRECTION_FRAMES, _NESTED_DIRECTION_FRAMES = (8,), (8, 6, 12)
# Positions drift between recordings, motion does not. So the position must lower motion's squared error on frames left
# out to the second fraction where motion leaves more than the first of the torque's variance, else to the third. On
# recorded fingertips, which were twisted one way, the fraction is 0.54 to 18, on emulated ones 0.01 to 0.4.
_MOTION_MAY_LEAVE, _POSITION_GAINS, _POSITION_GAINS_MUCH = 0.5, 0.5, 0.3
# Of twists both ways, motion may learn the order, which is another one next time, and twists left out do not show it.
# There the position also serves where it leaves this fraction of the torque's variance at most.
_POSITION_MAY_LEAVE = 0.1
# Fits (n, d) features to (n,) values with a penalty.
LinearFit: TypeAlias = Callable[[FloatArray, FloatArray, float], Ridge]


def fit_directions(
    parts: Sequence[FloatArray], validators: tuple[FingertipValidator, ...], *, nested: bool = False
) -> TemporalFeatures:
    """Fit the main directions of motion to each recording's (n, m, c) gripped frames.

    With `nested` they are of the motion over several times, for the fit to choose.
    """
    windows = _NESTED_DIRECTION_FRAMES if nested else _DIRECTION_FRAMES
    directions = []
    for layer, validator in enumerate(validators):
        of_side = [part[:, layer] for part in parts]
        directions.append(np.vstack([main_directions(of_side, validator.noise, frames) for frames in windows]))
    return TemporalFeatures(np.array(directions), np.array(MEMORY_EDGES), uses_position=True)


def fit_motion(
    temporal: TemporalFeatures, features: FloatArray, torque_nm: FloatArray, bounds: Bounds | None, grips: IntArray
) -> tuple[TemporalFeatures, IntervalRegressor, float]:
    """Return the features that a torque is fitted to, their regressor, and the unexplained fraction of its variance.

    The torques (n,) belong to all (n, d) `features`. The fraction is on frames left out.
    """
    m, p, _ = temporal.directions.shape
    layout = Layout(len(temporal.edges) - 1, m, p)
    fit_one: LinearFit = CensoredRidge.fit if is_one_sided(torque_nm) else Ridge.fit_scaled
    twists, variance = twists_left_out(torque_nm), float(torque_nm.var())
    left_out = twists or left_out_blocks(len(torque_nm))
    alone, with_position = (
        choose_motion(features, torque_nm, layout, fit_one, left_out, position=used) for used in (False, True)
    )
    chosen = with_position if _reads_position(alone, with_position, torque_nm) else alone
    regressor = fit_interval_regressor(
        features[:, chosen.columns],
        torque_nm,
        chosen.fit_used,
        strengths=(0.0,),
        limit_features=True,
        validation=Validation.by_twists(twists, torque_nm),
        bounds=bounds,
        grips=grips,
        fingertips=len(temporal.directions),
    )
    return _reduced(temporal, chosen), regressor, chosen.squared_error / variance


def _reads_position(alone: "MotionFit", with_position: "MotionFit", torque_nm: FloatArray) -> bool:
    """Return whether torques (n,) are fitted to the gel's position too, by both fits' errors on frames left out."""
    variance = float(torque_nm.var())
    leaves_much = alone.squared_error > _MOTION_MAY_LEAVE * variance
    share = _POSITION_GAINS if leaves_much else _POSITION_GAINS_MUCH
    if with_position.squared_error < share * alone.squared_error:
        return True
    loaded_nm = LOADED_FRACTION * float(np.abs(torque_nm).max())
    both_ways = bool(torque_nm.min() < -loaded_nm and torque_nm.max() > loaded_nm)
    return both_ways and with_position.squared_error < _POSITION_MAY_LEAVE * variance


def _reduced(temporal: TemporalFeatures, to: "MotionFit") -> TemporalFeatures:
    """Return the features that a fit uses."""
    first = to.first_direction
    directions = temporal.directions[:, first : first + to.n_directions].copy()
    return replace(temporal, directions=directions, edges=temporal.edges[: to.n_steps + 1], uses_position=to.position)


@dataclass(frozen=True, slots=True)
class Settings:
    """How fits are chosen and averaged. `window` is the number of the window that directions come from.

    Fits with a left-out error within the factor `nearly_as_good` of the minimum are averaged. The slope is divided out
    if left-out loads err by less than the fraction `sure_slope`, because a poor estimate has no sure slope. On the
    recorded stream both fingertips have 0.08, right 0.11, left 0.25.
    """

    window: int = 0
    nearly_as_good: float = 1.25
    sure_slope: float = 0.15


# Settings that a nested choice tries in each of the windows.
_NEARLY_AS_GOOD, _SURE_SLOPES = (1.0, 1.25, 1.5), (0.0, 0.15, math.inf)


@dataclass(frozen=True, slots=True)
class Layout:
    """What the columns of the features of motion are: steps of the memory × sides × directions, then positions.

    The directions are MAX_DIRECTIONS of each window, one window after the other.
    """

    n_steps: int
    n_sides: int
    n_directions: int

    @property
    def n_windows(self) -> int:
        """The number of windows that directions come from."""
        return max(self.n_directions // MAX_DIRECTIONS, 1)

    def columns(self, n_steps: int, n_directions: int, window: int = 0, *, position: bool) -> BoolArray:
        """Return which columns (d,) belong to the nearest steps and a window's first directions.

        With `position` the positions along these directions belong to them too.
        """
        first = window * MAX_DIRECTIONS
        number = np.arange(self.n_directions)
        used = (number >= first) & (number < first + n_directions)
        moved = np.broadcast_to(used, (self.n_steps, self.n_sides, self.n_directions)).copy()
        moved[n_steps:] = False
        return np.concatenate([moved.ravel(), np.tile(used & position, self.n_sides)])


@dataclass(frozen=True, slots=True)
class Candidate:
    """One choice of directions per fingertip, steps of the memory, penalty, and the directions' window."""

    n_directions: int
    n_steps: int
    penalty: float
    window: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class MotionFit:
    """The chosen candidates; the slope of their mean, the fit, on frames left out; and its mean squared error there.

    The candidates have one window.
    """

    layout: Layout
    fit_one: LinearFit
    position: bool
    candidates: tuple[Candidate, ...]
    slope: float = 1.0
    squared_error: float = field(default=np.inf)

    @property
    def n_directions(self) -> int:
        """The maximum number of directions of a candidate."""
        return max(candidate.n_directions for candidate in self.candidates)

    @property
    def n_steps(self) -> int:
        """The maximum number of steps of a candidate."""
        return max(candidate.n_steps for candidate in self.candidates)

    @property
    def first_direction(self) -> int:
        """The number of the first direction of the candidates' window."""
        return self.candidates[0].window * MAX_DIRECTIONS

    @property
    def columns(self) -> BoolArray:
        """Which columns (d,) of the features are used."""
        window = self.candidates[0].window
        return self.layout.columns(self.n_steps, self.n_directions, window, position=self.position)

    def fit(self, features: FloatArray, values: FloatArray, _strength: float = 0.0) -> Ridge:
        """Return the mean of the candidates' fits to (n, d) features and (n,) values, divided by the slope."""
        members = [self._fit_candidate(candidate, features, values) for candidate in self.candidates]
        return mean_ridge(members).scaled(1.0 / self.slope)

    def fit_used(self, features: FloatArray, values: FloatArray, strength: float = 0.0) -> Ridge:
        """Return `fit` for features (n, d) that are reduced to the used `columns`."""
        whole = np.zeros((len(features), len(self.columns)))
        whole[:, self.columns] = features
        found = self.fit(whole, values, strength)
        return replace(found, mean=found.mean[self.columns], weights=found.weights[self.columns])

    def _fit_candidate(self, one: Candidate, features: FloatArray, values: FloatArray) -> Ridge:
        columns = self.layout.columns(one.n_steps, one.n_directions, one.window, position=self.position)
        found = self.fit_one(features[:, columns], values, one.penalty)
        mean, weights = np.zeros((2, features.shape[1]))
        mean[columns], weights[columns] = found.mean, found.weights
        return replace(found, mean=mean, weights=weights)


def mean_ridge(members: Sequence[Ridge]) -> Ridge:
    """Return the linear map that predicts the mean of the members' predictions."""
    centre = np.mean([member.mean for member in members], axis=0)
    weights = np.mean([member.weights for member in members], axis=0)
    offset = float(np.mean([member.offset + (centre - member.mean) @ member.weights for member in members]))
    first = members[0]
    if isinstance(first, CensoredRidge):
        squares = [member.sigma**2 for member in members if isinstance(member, CensoredRidge)]
        first = replace(first, sigma=float(np.sqrt(np.mean(squares))))
    strength = float(np.mean([member.strength for member in members]))
    return replace(first, mean=centre, weights=weights, offset=offset, strength=strength)


def twists_left_out(torque_nm: FloatArray) -> LeftOut:
    """Return (rest, part) of (n,) torques in time order, where a part is a twist or some, with frames on both sides.

    Of fewer than three twists among many frames without a load, a part is two frames: a whole twist left out would
    leave nothing to learn from. The list is empty for a load that hardly ever ends.
    """
    n, twists = len(torque_nm), find_twists(torque_nm)
    if len(twists) >= _MIN_TWISTS:
        ends = [(before[-1] + after[0] + 1) // 2 for before, after in itertools.pairwise(twists)]
        number = np.searchsorted(ends, np.arange(n), side="right")
        return left_out_groups(number * min(len(twists), _MAX_PARTS) // len(twists))
    if sum(map(len, twists)) > _RARE_LOAD * n:
        return []
    return left_out_groups(np.arange(n) // _FRAMES_OF_FEW_TWISTS)


def choose_motion(
    features: FloatArray,
    torque_nm: FloatArray,
    layout: Layout,
    fit_one: LinearFit,
    left_out: LeftOut,
    *,
    position: bool,
) -> MotionFit:
    """Return the fit of (n, d) features, with all of the layout's columns, to (n,) torques.

    With directions of several windows, window and settings are chosen too.
    """
    twists = find_twists(torque_nm)
    loaded = np.concatenate(twists)
    # A single twist does not show which fit another one needs: one direction is the safest.
    can_choose = len(twists) >= _MIN_TWISTS or len(loaded) > _RARE_LOAD * len(torque_nm)
    directions = _DIRECTIONS if can_choose else (1,)
    steps = _STEPS_WITH_POSITION if position else _STEPS
    windows = range(layout.n_windows if can_choose else 1)
    combinations = itertools.product(directions, steps, _PENALTIES, windows)
    candidates = tuple(itertools.starmap(Candidate, combinations))
    fits = [MotionFit(layout, fit_one, position, (candidate,)) for candidate in candidates]
    predicted = np.array([_predict_left_out(fit, features, torque_nm, left_out) for fit in fits])
    judged = _LeftOutFits(
        predicted,
        np.array([candidate.window for candidate in candidates]),
        torque_nm,
        partial(reported_values, fits[0].fit(features, torque_nm)),
    )
    good, slope = np.ones(len(fits), dtype=np.bool_), 1.0
    if can_choose:
        settings = Settings() if len(windows) == 1 else judged.best_settings(loaded, left_out)
        good, slope = judged.choose(settings, loaded)
    left_out_nm = judged.mean(good, np.arange(len(torque_nm)))
    error = float(((left_out_nm - torque_nm) ** 2).mean())
    return MotionFit(layout, fit_one, position, tuple(itertools.compress(candidates, good)), slope, error)


@dataclass(frozen=True, slots=True, eq=False)
class _LeftOutFits:
    """Raw predictions (k, n) of k fits on frames left out, each one's window (k,), and the (n,) torques.

    `reported` turns raw predictions into the torques that they mean.
    """

    predicted: FloatArray
    windows: IntArray
    torque_nm: FloatArray
    reported: Callable[[FloatArray], FloatArray]

    def mean(self, good: BoolArray, rows: IntArray) -> FloatArray:
        """Return the torques of rows by the mean of the good fits (k,)."""
        return self.reported(self.predicted[good][:, rows].mean(axis=0))

    def choose(self, settings: Settings, rows: IntArray) -> tuple[BoolArray, float]:
        """Return which fits (k,) are averaged, and the slope of their mean, as these loaded rows show it."""
        truth = self.torque_nm[rows]
        squares = ((self.reported(self.predicted[:, rows]) - truth) ** 2).mean(axis=1)
        squares[self.windows != settings.window] = np.inf
        good = squares <= settings.nearly_as_good**2 * squares.min()
        return good, _shrinkage(self.mean(good, rows), truth, settings.sure_slope)

    def best_settings(self, loaded: IntArray, left_out: LeftOut) -> Settings:
        """Return the settings with the minimum error on each part's loaded rows, where the other parts choose."""
        parts = [np.intersect1d(part, loaded) for _, part in left_out]
        numbers = np.unique(self.windows).tolist()
        choices = itertools.starmap(Settings, itertools.product(numbers, _NEARLY_AS_GOOD, _SURE_SLOPES))

        def squared_error(settings: Settings) -> float:
            errors: list[FloatArray] = []
            for part in parts:
                good, slope = self.choose(settings, np.setdiff1d(loaded, part))
                errors.append(self.mean(good, part) / slope - self.torque_nm[part])
            return float((np.concatenate(errors) ** 2).sum())

        return min(choices, key=squared_error)


def _predict_left_out(one: MotionFit, features: FloatArray, values: FloatArray, left_out: LeftOut) -> FloatArray:
    """Return the (n,) predictions by fits that have not seen them."""
    predicted = np.zeros(len(values))
    for rest, part in left_out:
        predicted[part] = one.fit(features[rest], values[rest]).predict(features[part])
    return predicted


def _shrinkage(predicted: FloatArray, truth: FloatArray, sure: float) -> float:
    """Return the slope of (n,) predictions over the truth of loaded frames.

    It is 1 where they err by more than the fraction `sure` of the truth, both as root mean squares.
    """
    power = float(truth @ truth)
    along = float(predicted @ truth)
    if along <= 0 or float(((predicted - truth) ** 2).sum()) > sure**2 * power:
        return 1.0
    return along / power


def main_directions(parts: Sequence[FloatArray], noise: FloatArray, frames: int) -> FloatArray:
    """Return the main directions (p, c), in units of noise (c,), of the motion over `frames` in each part (n, c)."""
    moved = np.vstack([(part[frames:] - part[:-frames]) / noise for part in parts])
    rows = np.linalg.svd(moved, full_matrices=False)[2][:MAX_DIRECTIONS] / noise
    return np.asarray(rows * np.sign(rows.sum(axis=1, keepdims=True)))
