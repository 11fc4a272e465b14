"""Fitting an estimator to raw frames: recordings of grips, each of one tool, with the load cell's torque."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import N_CHANNELS, smoothed_along_channels
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.bank_match import BankMatcher, find_numbering, resolve_half_turn
from shearloop.bank.estimation.calibration import NEEDS_BANK, Calibration, Name, OutputModel
from shearloop.bank.estimation.fingertip_validator import FingertipValidator
from shearloop.bank.estimation.grip_segmentation import segment_grip
from shearloop.bank.estimation.interval_regressor import (
    LEAST_HALF_WIDTH,
    STRENGTHS,
    IntervalRegressor,
    Intervals,
    best_strength,
    fit_interval_regressor,
    is_one_sided,
)
from shearloop.bank.estimation.load_delay import torque_bounds
from shearloop.bank.estimation.novelty import reciprocal_means
from shearloop.bank.estimation.regressors import ChannelImputer, Regressor, Ridge, TobitRidge, later_origins
from shearloop.bank.estimation.session_state import BASELINE_FRAMES, SessionState, TemporalFeatures
from shearloop.bank.estimation.values import FrameSeries, Measured, TactileFrame, distinct
from shearloop.bank.polynomial import TWO_SIDED_95

if TYPE_CHECKING:
    from shearloop.bank.eit.mesh import Mesh

# Directions of motion per fingertip, and frames back: 13 frames are 7 s, about twice the gel's creep.
_N_DIRECTIONS, _N_LAGS = 4, 12
# A hundred features of a few directions need little penalty.
_MOTION_STRENGTHS = (1e-6, 1e-5, 1e-4)
# A heatmap over all lags takes most of a second, so longer recordings are thinned out.
_LARGEST_MATCHED = 120
# Positions drift between recordings, motion does not. So motion alone is preferred unless it leaves more than the first
# share of the torque's variance unexplained on later frames and the position lowers the error by the second.
_MOTION_MAY_LEAVE, _POSITION_MUST_GAIN = 0.5, 0.5
# With more variance left on a tool of another diameter, the tools have no torque in common.
_TOOLS_MAY_LEAVE = 0.75
# A diameter is constant within a recording: more frames add nothing and take long.
_MOST_FOR_DIAMETER = 240
# Fewer diameters do not determine a line and its error.
_LEAST_DIAMETERS, _LEAST_LEFT = 3, 2
# Directions of motion within recordings that the diameter's line shrinks, and the most frames that they are fitted to.
_N_NUISANCE, _MOST_FRAMES = 16, 500
# The tools differ along a direction where the positions vary by this factor more than their noise. At least this share
# of the variation along the clearest direction counts as the tools', at any noise.
_CLEAR, _LEAST_SHARE = 2.0, 0.2
# Centred positions have one direction less than their number; the last one is rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Physics:
    """Knowledge before calibration: the bank, and the mesh of the reconstruction."""

    bank: Bank | None = None
    mesh: "Mesh | None" = None


def k_range(name: Name, features: FloatArray) -> FloatArray:
    """Return the least and the largest k of (n, d) features, empty for an estimator without a bank."""
    return np.array([features[:, 0].min(), features[:, 0].max()]) if name in NEEDS_BANK else np.zeros(0)


def ridge_fit(name: Name) -> Callable[[FloatArray, FloatArray, float], Regressor]:
    """Return the fit of a ridge; the features of a bank match have different units and are scaled."""
    return Ridge.fit_scaled if name in NEEDS_BANK else Ridge.fit


def strengths_for(name: Name) -> tuple[float, ...]:
    """Return the penalties to choose from: a single one for the paper's polynomials and for curves."""
    return {"paper": (1e-9,), "motion_regression": (0.0,)}.get(name, STRENGTHS)


def tools_of(recordings: Sequence[FrameSeries]) -> list[Measured]:
    """Return the known diameters in mm of raw recordings' different tools."""
    return distinct([tool for one in recordings if (tool := one.tool_mm) is not None])


def fit_raw(
    blank: Calibration, recordings: list[FrameSeries], physics: Physics, timing_uncertainty_s: float
) -> Calibration:
    """Return a blank calibration fitted to raw frames; their torques may be off by the uncertainty in time.

    Raises CalibrationError for recordings that do not determine it.
    """
    parts = [segment_grip(one) for one in recordings]
    validators = tuple(
        FingertipValidator.fit(
            side,
            *(
                (one.channels[before, layer], one.channels[during, layer], one.channels[after, layer])
                for one, (before, during, after) in zip(recordings, parts, strict=True)
            ),
        )
        for layer, side in enumerate(blank.sides)
    )
    calibration = replace(blank, validators=validators, scale=np.array([one.noise for one in validators]))
    if blank.estimator == "motion_regression":
        gripped = [one.channels[part[1]] for one, part in zip(recordings, parts, strict=True)]
        temporal = TemporalFeatures.fit(gripped, validators, _N_DIRECTIONS, _N_LAGS)
        calibration = replace(calibration, temporal=replace(temporal, uses_position=True))
    if physics.bank is not None:
        # Every estimator shows the bank match with its torque.
        found = find_numbering(validators[0].idle, physics.bank.homogeneous)
        touch = validators[0].gripped - validators[0].idle
        calibration = replace(calibration, numbering=resolve_half_turn(found, touch, physics.bank))
    matcher = calibration.matcher(physics.bank)
    every = 1
    if calibration.estimator == "paper":
        every = max(1, sum(len(one.t_s) for one in recordings) // _LARGEST_MATCHED)
    rows = [row for i, one in enumerate(recordings) for row in _replay(calibration, matcher, i, one, every)]
    if not rows:
        raise CalibrationError("no frame of the recordings is gripped and undisturbed for long enough to calibrate on")
    if calibration.temporal is None:
        imputer = ChannelImputer.fit(np.array([row.position for row in rows]), validators)
        calibration = replace(calibration, imputer=imputer)
    features = np.array([row.features for row in rows])
    torque_nm = np.array([row.torque_nm for row in rows])
    bounds = _row_bounds(recordings, rows, timing_uncertainty_s) if timing_uncertainty_s else None
    calibration, regressor, unexplained = _fit_torque(calibration, features, torque_nm, bounds)
    diameter = _fit_diameter(calibration, rows)
    if len(tools_of(recordings)) > 1 and unexplained > _TOOLS_MAY_LEAVE:
        if diameter is None:
            tools = " and ".join(f"{one.value:.3g}" for one in tools_of(recordings))
            raise CalibrationError(
                f"the tools of {tools} mm turn so differently that they have no torque in common; calibrate on each "
                "alone"
            )
        return replace(calibration, diameter=diameter)
    torque = OutputModel(regressor, None, k_range(calibration.estimator, features))
    return replace(calibration, torque=torque, diameter=diameter)


def _fit_torque(
    calibration: Calibration, features: FloatArray, torque: FloatArray, bounds: tuple[FloatArray, FloatArray] | None
) -> tuple[Calibration, IntervalRegressor, float]:
    """Return the torque's regressor, and the calibration with the features that do better on later frames.

    The third value is the share of the torque's variance that motion leaves unexplained there, 0 without motion.
    """
    temporal, name = calibration.temporal, calibration.estimator
    if temporal is None:
        # Bank positions lie within its grid; other features follow drift anywhere and need a limit. Without memory the
        # gel's drift enters the torque, so validation uses later frames only.
        regressor = fit_interval_regressor(
            calibration.columns("torque", features),
            torque,
            ridge_fit(name),
            strengths=strengths_for(name),
            limit_features=name not in NEEDS_BANK,
            left_out=later_origins(len(torque)),
            bounds=bounds,
        )
        return calibration, regressor, 0.0
    fit = TobitRidge.fit if is_one_sided(torque) else Ridge.fit_scaled
    # The recordings decide whether the gel's position adds to its motion.
    n_motion = temporal.n_lags * temporal.directions.shape[0] * temporal.directions.shape[1]
    choices = {False: features[:, :n_motion], True: features}
    errors = {used: best_strength(one, torque, fit, _MOTION_STRENGTHS)[1] for used, one in choices.items()}
    unexplained = errors[False] / float(torque.var())
    used = unexplained > _MOTION_MAY_LEAVE and errors[True] < _POSITION_MUST_GAIN * errors[False]
    regressor = fit_interval_regressor(
        choices[used], torque, fit, strengths=_MOTION_STRENGTHS, limit_features=True, bounds=bounds
    )
    calibration = replace(calibration, temporal=replace(temporal, uses_position=used))
    return calibration, regressor, errors[used] / float(torque.var())


def _row_bounds(
    recordings: list[FrameSeries], rows: list["_Row"], uncertainty_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return the least and the largest torque that each row may have."""
    found = [torque_bounds(one, uncertainty_s) for one in recordings]
    least_nm, largest_nm = (np.array([found[row.recording][end][row.frame] for row in rows]) for end in (0, 1))
    return least_nm, largest_nm


def _fit_diameter(calibration: Calibration, rows: list["_Row"]) -> OutputModel | None:
    """Return the diameter's model, None where the recordings do not have enough different ones."""
    # By age within the recordings, so that every part has all tools.
    known = sorted((row for row in rows if np.isfinite(row.diameter_mm)), key=lambda row: row.age_s)
    if len({row.diameter_mm for row in known}) < _LEAST_DIAMETERS:
        return None
    if calibration.temporal is not None:
        return OutputModel(fit_cylinders(_cylinder_grips(known)), None, np.zeros(0))
    known = known[:: 1 + len(known) // _MOST_FOR_DIAMETER]
    diameters = np.array([row.diameter_mm for row in known])
    features = np.array([calibration.columns("diameter", row.features) for row in known])
    # A new grip is another recording, not a later part of this one.
    number = np.array([row.recording for row in known])
    each = [(np.flatnonzero(number != one), np.flatnonzero(number == one)) for one in np.unique(number)]
    left_out = [pair for pair in each if len(np.unique(diameters[pair[0]])) >= _LEAST_LEFT]
    name = calibration.estimator
    regressor = fit_interval_regressor(
        features, diameters, ridge_fit(name), strengths=strengths_for(name), left_out=left_out
    )
    return OutputModel(regressor, None, k_range(name, np.array([row.features for row in known])))


@dataclass(frozen=True, slots=True, eq=False)
class CylinderGrip:
    """A recording of one tool: its diameter, (n, d) differences to the idle frame, and (n, d) means over the grip.

    In units of noise; d runs over the channels of one side, then of the next.
    """

    diameter_mm: float
    frames: FloatArray
    means: FloatArray


def fit_cylinders(grips: Sequence[CylinderGrip]) -> IntervalRegressor:
    """Return the diameter's regressor on the mean of a grip, from grips of three diameters or more.

    Its interval is the error on cylinders left out.
    """
    diameters = np.array([one.diameter_mm for one in grips])
    line = fit_line(grips)
    squares = []
    for one in grips:
        # Leave out all grips of this cylinder: another one would only confirm this diameter.
        rest = [other for other in grips if other.diameter_mm != one.diameter_mm]
        if len({other.diameter_mm for other in rest}) >= _LEAST_LEFT:
            squares.append(float(((fit_line(rest).predict(one.means) - one.diameter_mm) ** 2).mean()))
    # Each recording counts once, which is too few for a quantile.
    half_width = max(TWO_SIDED_95 * math.sqrt(np.mean(squares)), LEAST_HALF_WIDTH * float(np.ptp(diameters)))
    low, high = float(diameters.min()), float(diameters.max())
    half_span = 0.5 * (high - low)
    return IntervalRegressor(
        line, Intervals(np.zeros(0), np.array([half_width])), low, high, -np.inf, np.inf, misses_loads=False,
        mean_feature=line.mean, largest_deviation=np.zeros(0), contamination_below=0.0, contamination_above=0.0,
        timing_widening=1.0, lowest=low - half_span, highest=high + half_span,
    )  # fmt: skip


def fit_line(grips: Sequence[CylinderGrip]) -> Ridge:
    """Return the line from a position to a diameter through grips of two diameters or more.

    The noise of the idle frame is constant within a recording, like the diameter, so a regression on single frames
    confuses the two. Here a recording counts as one position of known noise. Motion within recordings is shrunk, and
    the line uses only directions where positions differ by more than their noise, by the amount that they would
    differ without it (errors in variables, Fuller 1987). Averaging reciprocal channels and smoothing along neighbours,
    as the paper did with its cylinders, lowers the noise.
    """
    diameters = np.array([one.diameter_mm for one in grips])
    reduction = _noise_reduction(grips[0].frames.shape[1] // N_CHANNELS)
    frames = [one.frames @ reduction for one in grips]
    positions = np.array([one.mean(axis=0) for one in frames])
    moved = np.concatenate([one - position for one, position in zip(frames, positions, strict=True)])
    moved = moved[:: 1 + len(moved) // _MOST_FRAMES]
    _, sizes, directions = np.linalg.svd(moved, full_matrices=False)
    n = max(min(_N_NUISANCE, int(np.count_nonzero(sizes)) - 1), 0)
    shrink = 1.0 - sizes[n] / sizes[:n]

    def whitened(rows: FloatArray) -> FloatArray:
        return np.asarray(rows - (rows @ directions[:n].T * shrink) @ directions[:n])

    frame_noise = float((whitened(moved) ** 2).sum()) / max(len(moved) - len(grips), 1)
    noise = frame_noise * (1.0 / BASELINE_FRAMES + float(np.mean([1.0 / len(one) for one in frames])))
    centred = whitened(positions - positions.mean(axis=0))
    squares, modes = np.linalg.eigh(centred @ centred.T)
    clear: BoolArray = squares > max(_CLEAR * noise, _ROUNDING * float(squares[-1]))
    clear[-1] = True
    squares, modes = squares[clear], modes[:, clear]
    # One recording under several diameters would give an infinitely steep line.
    least = _ROUNDING * noise + math.sqrt(np.finfo(np.float64).tiny)
    true = np.maximum(squares - noise, _LEAST_SHARE * squares) + least
    along = centred.T @ (modes @ (modes.T @ (diameters - diameters.mean()) / true))
    mean = np.mean([one.frames.mean(axis=0) for one in grips], axis=0)
    return Ridge(mean, reduction @ whitened(along), float(diameters.mean()), 0.0)


def _noise_reduction(n_sides: int) -> FloatArray:
    """Return the (m·896, m·448) matrix that smooths m sides' channels and averages reciprocal ones."""
    return np.asarray(np.kron(np.eye(n_sides), reciprocal_means(smoothed_along_channels(np.eye(N_CHANNELS)))))


def _cylinder_grips(rows: list["_Row"]) -> list[CylinderGrip]:
    """Return each recording's grip of its tool."""
    grips = []
    for number in sorted({row.recording for row in rows}):
        own = [row for row in rows if row.recording == number]
        frames, means = (np.array([getattr(row, name) for row in own]) for name in ("position", "mean_position"))
        grips.append(CylinderGrip(own[0].diameter_mm, frames, means))
    return grips


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """One calibration frame: its recording, number and age there, its features and the truth.

    position and mean_position (d,) are the difference to the idle frame and its mean over the grip, in units of noise.
    """

    recording: int
    frame: int
    age_s: float
    features: FloatArray
    position: FloatArray
    mean_position: FloatArray
    torque_nm: float
    diameter_mm: float


def _replay(
    calibration: Calibration, matcher: BankMatcher | None, recording: int, series: FrameSeries, every: int
) -> list[_Row]:
    """Return the frames that an estimate would be made of, processed as in a session."""
    state = SessionState(calibration.validators, calibration.temporal)
    rows = []
    for i, (t_s, channels, torque, diameter) in enumerate(
        zip(series.t_s, series.channels, series.torque_at_frames(), series.diameter_mm, strict=True)
    ):
        processed = state.process(TactileFrame.of(float(t_s), channels))
        if not processed.reasons and np.isfinite(torque) and i % every == 0:
            features, _ = calibration.features(matcher, processed.difference, state.temporal_features, float(t_s))
            age_s = float(t_s - series.t_s[0])
            position, mean_position = (
                (one / calibration.scale).ravel() for one in (processed.difference, state.mean_difference)
            )
            rows.append(_Row(recording, i, age_s, features, position, mean_position, float(torque), float(diameter)))
    return rows
