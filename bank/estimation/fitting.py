"""Fitting an estimator to recordings: one function for all estimators, on raw frames or on slices.

Every choice is made on data later than the data fitted to. Nothing looks at the recordings that the calibration will
be evaluated on.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.bank_match import BankMatcher
from shearloop.bank.estimation.calibration import Calibration
from shearloop.bank.estimation.estimator import (
    LEAST_DIAMETERS,
    Bounds,
    CalibrationRow,
    Material,
    OutputModel,
    Physics,
    Reading,
)
from shearloop.bank.estimation.fingertip_validator import FingertipValidator
from shearloop.bank.estimation.fitting_slices import fit_slices
from shearloop.bank.estimation.grip_segmentation import segment_grip
from shearloop.bank.estimation.load_delay import LoadTiming, measure_timing, torque_bounds
from shearloop.bank.estimation.session_state import SessionState
from shearloop.bank.estimation.values import FrameSeries, Measured, TactileFrame, check_finite, distinct
from shearloop.bank.estimators import EstimatorName, estimator_class

# With more variance left on a tool of another diameter, the tools have no torque in common.
_TOOLS_MAY_LEAVE = 0.75


def fit(
    name: EstimatorName,
    recordings: Sequence[FrameSeries],
    source: str,
    physics: Physics | None = None,
    *,
    timing: LoadTiming | None = None,
    full_range: bool = False,
) -> Calibration:
    """Calibrate an estimator on recordings of one kind, in time order; `source` describes them in words.

    Slices with torque give a torque, those with diameters a diameter. `timing` is measured on the recordings where it
    is not given. With `full_range` the user guarantees that no torque exceeds the slices: intervals do not extend
    further. Raises CalibrationError for recordings that do not determine the calibration, and for missing physics.
    """
    physics, kind = physics or Physics(), estimator_class(name)
    sides = _check_recordings(recordings)
    if kind.needs and getattr(physics, kind.needs) is None:
        raise CalibrationError(f"the estimator {name} needs a {kind.needs}; name it with --{kind.needs}")
    chosen = [one.select_sides(sides) for one in recordings]
    is_raw = recordings[0].kind == "raw"
    if is_raw:
        timing = timing or measure_timing(recordings)
    material = _material(chosen, physics) if is_raw else Material(np.ones((len(sides), N_CHANNELS)), physics)
    tools = _tools_of(recordings)
    blank = Calibration(
        estimator=kind.prepare(material),
        kind=recordings[0].kind,
        sides=sides,
        source=source,
        bank_identity=physics.bank.identity if physics.bank is not None and kind.needs == "bank" else "",
        tool_mm=tools[0].value if len(tools) == 1 else np.nan,
        validators=material.validators,
    )
    if timing is None or not is_raw:
        return fit_slices(blank, chosen, physics, full_range=full_range)
    fitted = _fit_raw(blank, chosen, physics, timing.uncertainty_s)
    return fitted if timing.references else replace(fitted, assumptions=("load timing",))


def _check_recordings(recordings: Sequence[FrameSeries]) -> tuple[str, ...]:
    """Return the sides that all recordings have; raises CalibrationError for recordings that do not belong together."""
    if not recordings:
        raise CalibrationError("there is no recording to calibrate on")
    check_finite(recordings)
    if len({one.kind for one in recordings}) > 1:
        raise CalibrationError("raw frames and slices of differences do not fit into one calibration; make two")
    sides = tuple(side for side in recordings[0].sides if all(side in one.sides for one in recordings))
    if not sides:
        raise CalibrationError("the recordings have no side in common; name the side of each when importing")
    return sides


def _tools_of(recordings: Sequence[FrameSeries]) -> list[Measured]:
    """Return the known diameters in mm of raw recordings' different tools."""
    return distinct([tool for one in recordings if (tool := one.tool_mm) is not None])


def _material(recordings: Sequence[FrameSeries], physics: Physics) -> Material:
    """Return what an estimator of raw frames is prepared from."""
    parts = [segment_grip(one) for one in recordings]
    validators = tuple(
        FingertipValidator.fit(
            side,
            *(
                (one.channels[before, layer], one.channels[during, layer], one.channels[after, layer])
                for one, (before, during, after) in zip(recordings, parts, strict=True)
            ),
        )
        for layer, side in enumerate(recordings[0].sides)
    )
    grips = [one.channels[during] for one, (_, during, _) in zip(recordings, parts, strict=True)]
    return Material(np.array([one.noise for one in validators]), physics, validators, grips)


def _fit_raw(
    calibration: Calibration, recordings: list[FrameSeries], physics: Physics, timing_uncertainty_s: float
) -> Calibration:
    """Return the calibration with its outputs; the torques may be off by the uncertainty in time."""
    matcher, n_frames = calibration.matcher(physics.bank), sum(len(one.t_s) for one in recordings)
    every = max(1, int(n_frames // calibration.estimator.most_frames))
    rows = [row for i, one in enumerate(recordings) for row in _replay(calibration, matcher, i, one, every)]
    if not rows:
        raise CalibrationError("no frame of the recordings is gripped and undisturbed for long enough to calibrate on")
    bounds = _row_bounds(recordings, rows, timing_uncertainty_s) if timing_uncertainty_s else None
    estimator = calibration.estimator.with_imputer(np.array([row.position for row in rows]), calibration.validators)
    features, torque_nm = np.array([row.features for row in rows]), np.array([row.torque_nm for row in rows])
    estimator, regressor, unexplained = estimator.fit_torque(features, torque_nm, bounds)
    # By age within the recordings, so that every part has all tools.
    known = sorted((row for row in rows if np.isfinite(row.diameter_mm)), key=lambda row: row.age_s)
    enough = len({row.diameter_mm for row in known}) >= LEAST_DIAMETERS
    diameter = estimator.fit_diameter(known) if enough else None
    torque: OutputModel | None = OutputModel(regressor, None, estimator.k_range(features))
    if len(tools := _tools_of(recordings)) > 1 and unexplained > _TOOLS_MAY_LEAVE:
        if diameter is None:
            raise CalibrationError(
                f"the tools of {' and '.join(f'{one.value:.3g}' for one in tools)} mm turn so differently that they "
                "have no torque in common; calibrate on each alone"
            )
        torque = None
    return replace(calibration, estimator=estimator, torque=torque, diameter=diameter)


def _row_bounds(recordings: list[FrameSeries], rows: list[CalibrationRow], uncertainty_s: float) -> Bounds:
    """Return the least and the largest torque that each row may have."""
    found = [torque_bounds(one, uncertainty_s) for one in recordings]
    least_nm, largest_nm = (np.array([found[row.recording][end][row.frame] for row in rows]) for end in (0, 1))
    return least_nm, largest_nm


def _replay(
    calibration: Calibration, matcher: BankMatcher | None, recording: int, series: FrameSeries, every: int
) -> list[CalibrationRow]:
    """Return the frames that an estimate would be made of, processed as in a session."""
    estimator, rows = calibration.estimator, []
    state = SessionState(calibration.validators, estimator.motion)
    for i, (t_s, channels, torque, diameter) in enumerate(
        zip(series.t_s.tolist(), series.channels, series.torque_at_frames(), series.diameter_mm, strict=True)
    ):
        processed = state.process(TactileFrame.of(t_s, channels))
        if processed.reasons or not np.isfinite(torque) or i % every:
            continue
        reading = Reading(processed.difference, t_s, state.mean_difference, state.motion, matcher)
        position, mean_position = (
            (one / estimator.scale).ravel() for one in (reading.difference, reading.mean_difference)
        )
        rows.append(
            CalibrationRow(
                recording, i, t_s - float(series.t_s[0]), estimator.features(reading)[0], position, mean_position,
                float(torque), float(diameter),
            )
        )  # fmt: skip
    return rows
