"""Fitting an estimator to raw frames: recordings of grips, each of one tool, with the load cell's torque beside."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.alignment import torque_within
from shearloop.bank.estimation.bank_match import BankMatcher, register, settle_half_turn
from shearloop.bank.estimation.calibrated import NEEDS_BANK, Calibration, OutputModel, columns_for, features_of
from shearloop.bank.estimation.cylinders import LEAST_LEFT, Gripped, fit_cylinders
from shearloop.bank.estimation.fingertip_validator import FingertipValidator
from shearloop.bank.estimation.fitting_choices import Physics, ks_of, locator_of, ridge_for, strengths_for
from shearloop.bank.estimation.fitting_regressor import error_on_later, fit_reader, one_sided
from shearloop.bank.estimation.grip_segmentation import gripped_part
from shearloop.bank.estimation.imputation import ChannelImputer
from shearloop.bank.estimation.interval_regressor import IntervalRegressor
from shearloop.bank.estimation.regressors import Ridge, TobitRidge, later_origins
from shearloop.bank.estimation.session_state import SessionState
from shearloop.bank.estimation.temporal_features import TemporalFeatures
from shearloop.bank.estimation.values import FrameSeries, Measured, TactileFrame, distinct

# Directions of motion per fingertip, and frames back: 13 frames are 7 s, about twice the gel's creep.
_N_DIRECTIONS, _N_LAGS = 4, 12
# A hundred features of a few directions need little holding back.
_MOTION_STRENGTHS = (1e-6, 1e-5, 1e-4)
# A full heatmap over all lags takes a good part of a second: more frames than this are thinned out to calibrate on.
_LARGEST_MATCHED = 120
# A place drifts from recording to recording as motion does not: motion alone is preferred unless it leaves more than
# this share of the torque's variance unexplained on later frames, and the place takes this share off the error.
_MOTION_MAY_LEAVE, _PLACE_MUST_GAIN = 0.5, 0.5
# Where more than this is left on a tool of another diameter, none of the torque is common to the tools.
_TOOLS_MAY_LEAVE = 0.75
# A diameter stays the same within a recording: more frames than this tell no more, and take long.
_MOST_FOR_DIAMETER = 240
# Fewer different diameters than this do not determine a line and whether it is one.
_LEAST_DIAMETERS = 3


def fit_raw(blank: Calibration, recordings: list[FrameSeries], physics: Physics, times_unsure_s: float) -> Calibration:
    """Return a blank calibration with what raw frames tell, whose torques may be stamped off by times_unsure_s.

    Raises CalibrationError for recordings that do not determine it.
    """
    parts = [gripped_part(one) for one in recordings]
    guards = tuple(
        FingertipValidator.fit(
            side, *(_frames_of(one, part, layer) for one, part in zip(recordings, parts, strict=True))
        )
        for layer, side in enumerate(blank.sides)
    )
    calibration = replace(blank, guards=guards, scale=np.array([guard.noise for guard in guards]))
    if blank.estimator == "fused":
        gripped = [one.channels[part[1]] for one, part in zip(recordings, parts, strict=True)]
        motion = replace(TemporalFeatures.fit(gripped, guards, _N_DIRECTIONS, _N_LAGS), placed=True)
        calibration = replace(calibration, motion=motion)
    if physics.bank is not None:
        # Whatever reads the torque, the place in the bank is shown beside it.
        found = register(guards[0].idle, physics.bank.homogeneous)
        touch = guards[0].gripped - guards[0].idle
        calibration = replace(calibration, registration=settle_half_turn(found, touch, physics.bank))
    locator = locator_of(calibration, physics)
    every = _thinning(calibration, recordings)
    rows = [row for i, one in enumerate(recordings) for row in _replayed(calibration, locator, i, one, every)]
    if not rows:
        raise CalibrationError("no frame of the recordings is gripped and undisturbed for long enough to calibrate on")
    if calibration.motion is None:
        places = np.array([row.place for row in rows])
        calibration = replace(calibration, filling=ChannelImputer.fit(places, guards))
    features = np.array([row.features for row in rows])
    torque_nm = np.array([row.torque_nm for row in rows])
    calibration, reader, unexplained = _torque_reader(
        calibration, features, torque_nm, _within(recordings, rows, times_unsure_s)
    )
    torque, diameter = (
        OutputModel(reader, None, ks_of(calibration.estimator, features)),
        _diameter_task(calibration, rows),
    )
    if _undetermined(recordings, unexplained):
        if diameter is None:
            tools = " and ".join(f"{one.value:.3g}" for one in tools_of(recordings))
            raise CalibrationError(
                f"the tools of {tools} mm turn so differently that no torque is common to them; calibrate on each alone"
            )
        return replace(calibration, diameter=diameter)
    return replace(calibration, torque=torque, diameter=diameter)


def _frames_of(
    series: FrameSeries, part: tuple[slice, slice, slice], layer: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return one side's frames before the grip, in it, and after it."""
    before, during, after = (series.channels[one, layer] for one in part)
    return before, during, after


def _torque_reader(
    calibration: Calibration, features: FloatArray, torque: FloatArray, within: tuple[FloatArray, FloatArray] | None
) -> tuple[Calibration, IntervalRegressor, float]:
    """Return the torque's reader, and the calibration with the features that do better on later frames.

    Third comes the share of the torque's variance that motion leaves unexplained there, 0 where none is read.
    """
    motion = calibration.motion
    if motion is None:
        columns, head = columns_for(calibration.estimator, "torque", features), ridge_for(calibration.estimator)
        strengths = strengths_for(calibration.estimator)
        # Places in the bank are within its grid; all else would follow a drift to wherever it leads. Without memory
        # the gel's drift goes into the torque: what is left out must come later, as the future will.
        limit_reach = calibration.estimator not in NEEDS_BANK
        later = later_origins(len(torque))
        reader = fit_reader(
            columns, torque, head, strengths=strengths, limit_reach=limit_reach, left_out=later, within=within
        )
        return calibration, reader, 0.0
    head = TobitRidge.fit if one_sided(torque) else Ridge.fit_scaled
    # Whether the gel's place tells more than its motion is for the recordings to say.
    n_motion = motion.n_lags * motion.directions.shape[0] * motion.directions.shape[1]
    choices = {False: features[:, :n_motion], True: features}
    errors = {placed: error_on_later(one, torque, head, _MOTION_STRENGTHS) for placed, one in choices.items()}
    unexplained = errors[False] / float(torque.var())
    placed = unexplained > _MOTION_MAY_LEAVE and errors[True] < _PLACE_MUST_GAIN * errors[False]
    reader = fit_reader(choices[placed], torque, head, strengths=_MOTION_STRENGTHS, limit_reach=True, within=within)
    calibration = replace(calibration, motion=replace(motion, placed=placed))
    return calibration, reader, errors[placed] / float(torque.var())


def _within(recordings: list[FrameSeries], rows: list["_Row"], unsure_s: float) -> tuple[FloatArray, FloatArray] | None:
    """Return the least and the largest torque that each row may be of, None where times are known."""
    if unsure_s == 0:
        return None
    found = [torque_within(one, unsure_s) for one in recordings]
    least_nm, largest_nm = (np.array([found[row.recording][end][row.frame] for row in rows]) for end in (0, 1))
    return least_nm, largest_nm


def _diameter_task(calibration: Calibration, rows: list["_Row"]) -> OutputModel | None:
    """Return how diameters are read, None where the recordings do not know of different ones."""
    # Each recording has one tool: in the order of time within them, every part has all.
    known = sorted((row for row in rows if np.isfinite(row.diameter_mm)), key=lambda row: row.since_s)
    if len({row.diameter_mm for row in known}) < _LEAST_DIAMETERS:
        return None
    if calibration.motion is not None:
        return OutputModel(fit_cylinders(_grips(known)), None, np.zeros(0))
    known = known[:: 1 + len(known) // _MOST_FOR_DIAMETER]
    diameters = np.array([row.diameter_mm for row in known])
    features = np.array([columns_for(calibration.estimator, "diameter", row.features) for row in known])
    # Whoever grips a tool again sees another recording, not a later part of this one.
    number = np.array([row.recording for row in known])
    each = [(np.flatnonzero(number != one), np.flatnonzero(number == one)) for one in np.unique(number)]
    left_out = [pair for pair in each if len(np.unique(diameters[pair[0]])) >= LEAST_LEFT]
    head, strengths = ridge_for(calibration.estimator), strengths_for(calibration.estimator)
    reader = fit_reader(features, diameters, head, strengths=strengths, left_out=left_out)
    return OutputModel(reader, None, ks_of(calibration.estimator, np.array([row.features for row in known])))


def _grips(rows: list["_Row"]) -> list[Gripped]:
    """Return what each recording's frames say of its tool."""
    grips = []
    for number in sorted({row.recording for row in rows}):
        own = [row for row in rows if row.recording == number]
        frames, held = (np.array([getattr(row, name) for row in own]) for name in ("place", "held"))
        grips.append(Gripped(own[0].diameter_mm, frames, held))
    return grips


def _undetermined(recordings: list[FrameSeries], unexplained: float) -> bool:
    """Return whether tools of different diameters turn so differently that no torque is common to them."""
    return len(tools_of(recordings)) > 1 and unexplained > _TOOLS_MAY_LEAVE


def tools_of(recordings: Sequence[FrameSeries]) -> list[Measured]:
    """Return the diameters of raw recordings' different tools in mm, as far as they are known."""
    return distinct([tool for one in recordings if (tool := one.tool_mm) is not None])


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """One frame that is calibrated on: of which recording, its number and age there, what is seen and what is true.

    place and held (d,) are the difference to the idle frame and its mean over the grip, in units of noise.
    """

    recording: int
    frame: int
    since_s: float
    features: FloatArray
    place: FloatArray
    held: FloatArray
    torque_nm: float
    diameter_mm: float


def _replayed(
    calibration: Calibration, locator: BankMatcher | None, recording: int, series: FrameSeries, every: int
) -> list[_Row]:
    """Return the frames that an estimate would be made of, by the way that makes it."""
    memory = SessionState(calibration.guards, calibration.motion)
    rows = []
    for i, (t_s, channels, torque, diameter) in enumerate(
        zip(series.t_s, series.channels, series.torque_at_frames(), series.diameter_mm, strict=True)
    ):
        moment = memory.see(TactileFrame.of(float(t_s), channels))
        if not moment.why and np.isfinite(torque) and i % every == 0:
            features = features_of(calibration, locator, moment.difference, memory.moved, float(t_s)).features
            since_s = float(t_s - series.t_s[0])
            place, held = ((one / calibration.scale).ravel() for one in (moment.difference, memory.held))
            rows.append(_Row(recording, i, since_s, features, place, held, float(torque), float(diameter)))
    return rows


def _thinning(calibration: Calibration, recordings: list[FrameSeries]) -> int:
    if calibration.estimator != "paper":
        return 1
    return max(1, sum(len(one.t_s) for one in recordings) // _LARGEST_MATCHED)
