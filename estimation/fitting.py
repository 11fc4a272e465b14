"""Fitting an estimator to recordings: one function for all estimators.

Every choice is made on data left out of the fit: later data, blocks of time or recordings (docs/calibrations.md).
Nothing looks at the recordings that the calibration will be evaluated on.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.channels import ChannelTable
from shearloop.bank.errors import CalibrationError
from shearloop.estimation.bank_match import BankMatcher
from shearloop.estimation.calibration import Calibration, check_bank_table
from shearloop.estimation.channel_imputer import ChannelImputer
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.estimator import (
    MIN_DIAMETERS,
    Bounds,
    CalibrationRows,
    Estimator,
    Material,
    OutputModel,
    Physics,
    Reading,
)
from shearloop.estimation.estimator_names import EstimatorName, estimator_class
from shearloop.estimation.fingertip_validator import LARGEST_DEVIATION, compare_frames
from shearloop.estimation.gain import ToolLaw
from shearloop.estimation.gain_correction import GainCorrection
from shearloop.estimation.gain_fit import fit_tool_law
from shearloop.estimation.grips import Grip, find_grips
from shearloop.estimation.interval_regressor import IntervalRegressor
from shearloop.estimation.learned_frames import LearnedFrames
from shearloop.estimation.load_delay import LoadTiming, measure_timing, torque_bounds
from shearloop.estimation.ridge import CensoredRidge, sign_of_loads
from shearloop.estimation.series import FrameSeries, check_finite, distinct
from shearloop.estimation.session import AMBIGUOUS, Session
from shearloop.estimation.torque_profile import TorqueProfile
from shearloop.estimation.twists import LOADED_FRACTION, first_twists, loaded_log_gain
from shearloop.estimation.validator_fit import MIN_IDLE, GripParts, fit_validator, too_few_frames
from shearloop.estimation.values import GripState, Measured
from shearloop.words import CountedReasons, counted

# Why a frame that is gripped and undisturbed is not fitted.
_NO_ONE_POSITION = f"{AMBIGUOUS[0]}: build a bank with a grid of k and sigma for this fingertip"
_NO_TRUE_TORQUE = "no torque was measured at the time of a frame"
# With more variance left on a tool of another diameter, the tools have no torque in common.
_TOOLS_MAY_LEAVE = 0.75
# Fraction of a recording's frames below its released torque, and the penalty while tools are compared.
_RELEASED, _TOOLS_STRENGTH = 0.05, 1e-5
# Tools have a torque in common where their gains differ by less than this factor.
_TOOLS_DIFFER = 2.0


def fit(
    name: EstimatorName,
    recordings: FrameSeries | Sequence[FrameSeries],
    source: str,
    physics: Physics | None = None,
    *,
    timing: LoadTiming | None = None,
    nested: bool = False,
) -> Calibration:
    """Calibrate an estimator on a recording or several, in time order; `source` describes them in words.

    `timing` is measured on the recordings where it is not given. With `nested` a fit of motion chooses its settings
    too, instead of the usual ones. Raises CalibrationError for recordings that do not determine the calibration, and
    for missing physics.
    """
    physics, kind = physics or Physics(), estimator_class(name)
    recordings = [recordings] if isinstance(recordings, FrameSeries) else list(recordings)
    sides = _check_recordings(recordings)
    check_physics(kind, physics, recordings[0].table)
    chosen = [recording.select_sides(sides) for recording in recordings]
    timing = timing or measure_timing(recordings)
    material = replace(_material(chosen, physics), nested=nested)
    tools = _tools_of(recordings)
    blank = Calibration(
        estimator=kind.prepare(material),
        sides=sides,
        source=source,
        bank_identity=physics.bank.identity if physics.bank is not None and kind.needs == "bank" else "",
        tool_mm=tools[0].value if len(tools) == 1 else np.nan,
        validators=material.validators,
        profile=TorqueProfile.fit(chosen),
        learned=LearnedFrames.of(recording.channels for recording in chosen),
        emulated=any(recording.emulated for recording in recordings),
    )
    fitted = _fit_outputs(blank, chosen, physics, timing.uncertainty_s)
    return fitted if timing.references else replace(fitted, assumptions=("load timing",))


def check_physics(kind: type[Estimator], physics: Physics, table: ChannelTable) -> None:
    """Raise CalibrationError for an estimator without its bank or mesh, or with one of another kind of fingertip."""
    if kind.needs and getattr(physics, kind.needs) is None:
        raise CalibrationError(f"the estimator {kind.name} needs a {kind.needs}: --{kind.needs}, in Python `Physics`")
    if kind.needs == "bank" and physics.bank is not None:
        check_bank_table(physics.bank, table, "the recordings have")
    if kind.needs == "mesh" and physics.mesh is not None and physics.mesh.n_electrodes != table.n_electrodes:
        raise CalibrationError(
            f"the mesh is of another kind of fingertip: it has {physics.mesh.n_electrodes} electrodes, and the "
            f"recordings have {table.description}; give the mesh of this fingertip"
        )


def _check_recordings(recordings: Sequence[FrameSeries]) -> tuple[str, ...]:
    """Return the sides that all recordings have; raises CalibrationError for recordings that do not belong together."""
    if not recordings:
        raise CalibrationError("there is no recording to calibrate on")
    if strangers := [one for one in recordings if not isinstance(one, FrameSeries)]:
        raise CalibrationError(f"{strangers[0]!r} is no series of frames; `read_series` reads one from a recording")
    check_finite(recordings)
    if len({recording.table for recording in recordings}) > 1:
        raise CalibrationError("the recordings are of different kinds of fingertips; make a calibration of each")
    sides = tuple(side for side in recordings[0].sides if all(side in recording.sides for recording in recordings))
    if not sides:
        raise CalibrationError("the recordings have no side in common; name the side of each when importing")
    return sides


def _tools_of(recordings: Sequence[FrameSeries]) -> list[Measured]:
    """Return the known diameters in mm of the recordings' different tools."""
    return distinct([tool for recording in recordings if (tool := recording.tool_mm) is not None])


def _material(recordings: Sequence[FrameSeries], physics: Physics) -> Material:
    """Return what an estimator is prepared from."""
    grips = [
        (number, recording.channels, grip)
        for number, recording in enumerate(recordings, 1)
        for grip in _clear_grips(recording, number, len(recordings))
    ]
    validators = []
    for layer, side in enumerate(recordings[0].sides):
        parts = [
            GripParts(frames[grip.idle, layer], frames[grip.gripped, layer], frames[grip.released, layer])
            for _, frames, grip in grips
        ]
        _check_one_fingertip(side, [(number, part) for (number, *_), part in zip(grips, parts, strict=True)])
        validators.append(fit_validator(side, *parts))
    gripped = [frames[grip.gripped] for _, frames, grip in grips]
    return Material(
        np.array([validator.noise for validator in validators]),
        physics,
        recordings[0].table,
        tuple(validators),
        gripped,
    )


def _check_one_fingertip(side: str, parts: Sequence[tuple[int, GripParts]]) -> None:
    """Raise CalibrationError where idle frames of a side deviate from the others as another fingertip's do.

    `parts` have the numbers of their recordings. All are compared with the one that is nearest to the others.
    """
    numbers = [number for number, _ in parts]
    idle = np.array([np.median(part.idle, axis=0) for _, part in parts])
    # By the frame that is compared, and the one that it is compared with.
    deviations = np.array([compare_frames(frame, idle)[2] for frame in idle])
    # Frames without channels to compare are refused for that.
    deviations[~np.isfinite(deviations)] = 0.0
    usual = int(np.median(deviations, axis=0).argmin())
    odd = int(deviations[:, usual].argmax())
    deviation = float(deviations[odd, usual])
    if deviation <= LARGEST_DEVIATION:
        return
    differ = f"its idle voltages deviate by {100 * deviation:.0f} %, more than {100 * LARGEST_DEVIATION:.0f} %"
    if numbers[odd] == numbers[usual]:
        raise CalibrationError(
            f"recording {numbers[odd]} is not of one {side} fingertip: between its grips {differ}. Use a part of it"
        )
    raise CalibrationError(
        f"recording {numbers[odd]} is of another {side} fingertip or gel than recording {numbers[usual]}: {differ}. "
        "Leave one of them out, or import one again if its sides are exchanged"
    )


def _clear_grips(recording: FrameSeries, number: int, of: int) -> list[Grip]:
    """Return the grips with enough frames; raises CalibrationError with the recording's name if it has none."""
    grips = find_grips(recording)
    few = [too_few_frames(grip.idle.stop - grip.idle.start, grip.gripped.stop - grip.gripped.start) for grip in grips]
    if all(few):
        raise CalibrationError(f"recording {number} of {of}: {_loaded_at_first(recording) or few[0]}")
    return [grip for grip, why in zip(grips, few, strict=True) if not why]


def _loaded_at_first(recording: FrameSeries) -> str:
    """Return why no frame is idle where the load cell shows a torque from the first frame on, else nothing."""
    torque = recording.torque_at_frames()
    first = torque[np.isfinite(torque)][:MIN_IDLE]
    if not len(first) or np.abs(first).min() <= max(LOADED_FRACTION * np.nanmax(np.abs(torque)), LOADED_NM):
        return ""
    return (
        f"the load cell shows {np.median(first):+.3f} N·m from the first frame on, so that none is idle: take its zero "
        "before the grip (`shearloop command tare`), begin some seconds before gripping, and record again"
    )


def _fit_outputs(
    calibration: Calibration, recordings: list[FrameSeries], physics: Physics, timing_uncertainty_s: float
) -> Calibration:
    """Return the calibration with its outputs; the torques may be off by the uncertainty in time."""
    matcher = calibration.matcher(physics.bank)
    rows, refused = _replay(calibration, matcher, recordings)
    if rows is None:
        raise CalibrationError(f"no frame of the recordings can be calibrated on: {_most_frequent(refused)}")
    for number in range(len(recordings)):
        if number not in rows.recording:
            why = _most_frequent([one for one in refused if one.recording == number])
            raise CalibrationError(
                f"no frame of recording {number + 1} of {len(recordings)} can be calibrated on: {why}"
            )
    estimator = calibration.estimator
    if not estimator.imputes_by_motion:
        estimator = replace(estimator, imputer=ChannelImputer.fit(rows.position, calibration.validators))
    prepared = estimator
    bounds = _torque_bounds(rows, recordings, timing_uncertainty_s)
    estimator, regressor, unexplained = prepared.fit_torque(rows.features, rows.torque_nm, bounds, rows.grip)
    # By age within the recordings, so that every part has all tools.
    order = np.argsort(rows.age_s, kind="stable")
    known = rows.where(order[np.isfinite(rows.diameter_mm[order])])
    has_diameter = len(np.unique(known.diameter_mm)) >= MIN_DIAMETERS
    diameter = estimator.fit_diameter(known) if has_diameter else None
    law = None
    if len(tools := _tools_of(recordings)) > 1:
        fitted = _fit_tools(prepared, rows, recordings) if has_diameter else None
        if fitted is not None:
            estimator, regressor, law = fitted
        elif unexplained > _TOOLS_MAY_LEAVE:
            raise _tools_differ(tools, has_diameter=has_diameter)
    torque = OutputModel(regressor, estimator.k_range(rows.features))
    return replace(calibration, estimator=estimator, torque=torque, diameter=diameter, tools=law)


def _torque_bounds(rows: CalibrationRows, recordings: list[FrameSeries], uncertainty_s: float) -> Bounds | None:
    """Return the least and the largest torque of each row where its time is uncertain; None without uncertainty."""
    if not uncertainty_s:
        return None
    each = [torque_bounds(recording, uncertainty_s) for recording in recordings]
    places = zip(rows.recording.tolist(), rows.frame.tolist(), strict=True)
    least_nm, largest_nm = np.array([[end[frame] for end in each[recording]] for recording, frame in places]).T
    return least_nm, largest_nm


def _tools_differ(tools: list[Measured], *, has_diameter: bool) -> CalibrationError:
    """Return the refusal of tools that have no torque in common."""
    cure = "with twists of every tool in one direction" if has_diameter else "on three diameters"
    return CalibrationError(
        f"the tools of {' and '.join(f'{tool.value:.3g}' for tool in tools)} mm turn so differently that they "
        f"have no torque in common; calibrate on each alone, or {cure}"
    )


def _fit_tools(
    estimator: Estimator, rows: CalibrationRows, recordings: Sequence[FrameSeries]
) -> tuple[Estimator, IntervalRegressor, ToolLaw] | None:
    """Return the regressor of torques in units of each recording's gain, and the law of these gains over the tools.

    A recording's gain is the root mean square of its torque: twists of all tools move the gel alike. None where the
    tools have the torque in common, or were twisted both ways. Motion shows how torque changes after the grip, so a
    recording counts from its least torque on.
    """
    diameters_mm = np.array(
        [np.nan if recording.tool_mm is None else recording.tool_mm.value for recording in recordings]
    )
    rows = rows.where(np.isfinite(diameters_mm)[rows.recording])
    # The sign of a torque only says how the load cell is mounted: from here on the loads are positive.
    sign = sign_of_loads(rows.torque_nm)
    features, torque_nm = rows.features, sign * rows.torque_nm
    tools, recording = np.unique(rows.recording, return_inverse=True)
    diameters_mm = diameters_mm[tools]
    for of_recording in (recording == number for number in range(len(tools))):
        if torque_nm[of_recording].min() < -LOADED_FRACTION * torque_nm[of_recording].max():
            return None
        torque_nm[of_recording] -= np.quantile(torque_nm[of_recording], _RELEASED)

    each = [np.flatnonzero(recording == number) for number in range(len(tools))]
    if _have_torque_in_common(features, torque_nm, each):
        return None
    gains = np.array([np.sqrt((torque_nm[rows] ** 2).mean()) for rows in each])
    estimator, regressor, _ = estimator.fit_torque(features, sign * torque_nm / gains[recording], None, rows.grip)
    return estimator, regressor, fit_tool_law(diameters_mm, gains)


def _have_torque_in_common(features: FloatArray, torque_nm: FloatArray, each: Sequence[IntArray]) -> bool:
    """Return whether the torques of each recording's rows follow from the others' with nearly the same gain.

    The loads are positive.
    """
    found: list[float] = []
    for out in each:
        kept = np.setdiff1d(np.arange(len(torque_nm)), out)
        line = CensoredRidge.fit(features[kept], torque_nm[kept], _TOOLS_STRENGTH)
        gain = loaded_log_gain(np.maximum(line.predict(features[out]), 0.0), torque_nm[out])
        if gain is None:
            return False
        found.append(gain)
    return max(found) - min(found) < math.log(_TOOLS_DIFFER)


def adapt(
    calibration: Calibration,
    recordings: Sequence[FrameSeries],
    source: str,
    physics: Physics | None = None,
    *,
    first_frames: Sequence[int] = (),
    names: Sequence[str] = (),
) -> tuple[Calibration, GainCorrection]:
    """Return a calibration with the gain of each fingertip corrected by recordings of known torque, and the correction.

    There is at least one recording. `source` describes them in words, `names` each of them. Twists count from each
    recording's frame of `first_frames` on. The correction is shrunk by their uncertainty. Raises CalibrationError for
    recordings without a torque estimate under load, for frames that the calibration has learned from, and for a
    calibration without such a gain.
    """
    if len(tools := _tools_of(recordings)) > 1:
        raise CalibrationError("the recordings are of several tools; adapt to one at a time")
    calibration = calibration.for_tool(tools[0] if tools else None)
    calibration.gain_regressor()
    matcher = calibration.matcher((physics or Physics()).bank)
    check_finite(recordings)
    recordings = [recording.select_sides(calibration.sides) for recording in recordings]
    first_frames = first_frames or [0] * len(recordings)
    if all(first >= len(recording.t_s) for recording, first in zip(recordings, first_frames, strict=True)):
        raise CalibrationError("the recordings have no frame of the part to adapt on; use an earlier or a longer part")
    rows, refused = _replay(calibration, matcher, recordings)
    if rows is not None:
        is_first = first_twists(rows.torque_nm, rows.grip)
        count = rows.frame >= np.array(first_frames)[rows.recording]
        rows, is_first = rows.where(count), is_first[count]
    if rows is None or not len(rows.frame):
        of_part = [one for one in refused if one.frame >= first_frames[one.recording]]
        raise CalibrationError(
            f"no frame can be adapted on: {_most_frequent(of_part)}; `shearloop evaluate` lists the reasons; twist the "
            "gripped tool again"
        )
    for number, recording in enumerate(recordings):
        name = names[number] if names else f"recording {number + 1} of {len(recordings)}"
        _check_new(calibration.learned, recording, rows.frame[rows.recording == number], name)
    features = rows.features[:, calibration.estimator.columns["torque"]]
    adapted, correction = calibration.correct_gain(features, rows.torque_nm, is_first)
    used = [recording.channels[first:] for recording, first in zip(recordings, first_frames, strict=True)]
    learned = calibration.learned.with_frames(used)
    return replace(adapted, source=f"{calibration.source}, adapted on {source}", learned=learned), correction


def _check_new(learned: LearnedFrames, recording: FrameSeries, frames: IntArray, name: str) -> None:
    """Raise CalibrationError where some of these frames (n,) of a recording are among those learned from."""
    known = frames[learned.include(recording.channels[frames])] + recording.first_frame
    if len(known):
        raise CalibrationError(
            f"the calibration has used {len(known)} of {counted(len(frames), 'gripped frame')} of {name} already "
            f"(frames {known[0]} to {known[-1]}), and they would count twice; adapt on other twists, or adapt a "
            "calibration that has not used these"
        )


class _Refused(NamedTuple):
    """A frame that gives no estimate: the number of its recording, its own number there, and why."""

    recording: int
    frame: int
    why: str


def _replay(
    calibration: Calibration, matcher: BankMatcher | None, recordings: Sequence[FrameSeries]
) -> tuple[CalibrationRows | None, list[_Refused]]:
    """Return the frames that give an estimate, processed as in a session, and why the others give none.

    The frames are None if no frame gives one.
    """
    estimator, rows, refused, grip = calibration.estimator, [], list[_Refused](), 0
    for recording, series in enumerate(recordings):
        session = Session(calibration, matcher=matcher, period_s=series.period_s)
        grip, before = grip + 1, GripState.NONE
        truths = zip(series.torque_at_frames(), series.diameter_mm, strict=True)
        for i, (frame, truth) in enumerate(zip(series.frames(), truths, strict=True)):
            processed, t_s = session.process(frame), frame.t_s
            if processed.grip is GripState.NONE and before is not GripState.NONE:
                grip += 1
            before = processed.grip
            if processed.reasons or not np.isfinite(truth[0]):
                why = processed.reasons[0] if processed.reasons else _NO_TRUE_TORQUE
                refused.append(_Refused(recording, i, why))
                continue
            reading = Reading.of(processed, t_s, matcher)
            if reading.is_ambiguous:
                refused.append(_Refused(recording, i, _NO_ONE_POSITION))
                continue
            # Before the gel was seen idle, its position means nothing, and so the frame shows no diameter.
            torque_nm, diameter_mm = truth if processed.has_baseline else (truth[0], np.nan)
            features = estimator.features(reading)
            places = (
                (difference / estimator.scale).ravel()
                for difference in (processed.difference, processed.mean_difference)
            )
            rows.append((recording, i, t_s - float(series.t_s[0]), features, *places, torque_nm, diameter_mm, grip))
    return CalibrationRows(*map(np.array, zip(*rows, strict=True))) if rows else None, refused


def _most_frequent(refused: Sequence[_Refused]) -> str:
    """Return what refuses most frames that are gripped, with their number; else what refuses most of all."""
    against = CountedReasons()
    for one in refused:
        against.add(one.why)
    counts = against.most_frequent_first
    gripped = [(count, why) for count, why in counts if why in (_NO_ONE_POSITION, _NO_TRUE_TORQUE)]
    count, why = (gripped or counts)[0]
    return f"{why} ({count} of {counted(against.total, 'frame')})"
