"""Checks of an experiment: the steps that limits, devices or the steps before do not allow. No I/O."""

import math
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from itertools import repeat

from shearloop.bank.errors import CalibrationError
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.decimal_commas import DECIMAL_POINT, may_be_decimals
from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ApproachStep,
    ExperimentFile,
    GripperStep,
    GripStep,
    HoldTorqueStep,
    IdentifyStep,
    Mistake,
    ReleaseStep,
    Step,
    TareStep,
    TightenStep,
    TurnToStep,
    TwistingStep,
    TwistStep,
    is_whole,
    outline,
)
from shearloop.daemon.control.known_tool import NOTHING_KNOWN, known_after
from shearloop.daemon.control.step_demands import demand
from shearloop.daemon.control.step_motions import needs_torque
from shearloop.daemon.control.turns import Turn, turns
from shearloop.daemon.motion_cap import Commissioning, MotionCap, knows_tool
from shearloop.daemon.torques import LOAD_CELL, WRENCH, Direction, TorqueSource, direction_of
from shearloop.drivers.robotiq.models import GripperModel
from shearloop.drivers.ur.settings import UrLimits
from shearloop.estimation import Measured

# Numbers of a file may differ from a cap by rounding.
_ROUNDING = 1e-9


def not_measured(file: ExperimentFile, driving: TorqueSource) -> Iterator[tuple[int, str]]:
    """Yield the number, from 0, of each step that twists a held tool the way that the driving source reads as 0."""
    other = direction_of(-driving.only_sign)
    why = "its calibration has the other one alone; calibrate on twists both ways"
    if driving.name == LOAD_CELL:
        why = "its lever presses the other way alone, by `load_cell.direction`; turn that way"
    for number, (step, turn) in enumerate(_with_turns(file)):
        if turn is not None and other in turn.asks_for:
            yield (
                number,
                f"{step.do} turns {other}, and {driving.name} measures no torque of this direction: {why}, or let "
                "another source drive",
            )


def _with_turns(file: ExperimentFile) -> Iterator[tuple[Step, Turn | None]]:
    """Yield each step and what it turns; None for each where a step lacks a key, for which the file is refused.

    Nothing is known of the start: a tool may be held then, turned and loaded.
    """
    known = turns(file, NOTHING_KNOWN) if is_whole(file) else repeat(None)
    return zip(file.steps, known, strict=False)


def _capped_nm(file: ExperimentFile, turn: Turn, cap: MotionCap) -> float:
    """Return the largest torque limit of a step."""
    return cap.torque_nm_of(file.torque_source, turn.may_load)


def check_steps(file: ExperimentFile, cap: MotionCap | None = None) -> list[Mistake]:
    """Return each step that exceeds its limits or its timeout, and each step that the steps before it make wrong.

    These are limits of a step above the experiment's, the first `hold_torque` on an unidentified tool, a `tare` of a
    gripped one, a torque that undoes a `tighten`, a `grip` wider than the one before it, and limits that the tool is
    beyond as the step begins. No limit above the `cap` is of use.
    """
    found: list[Mistake] = [*_undoing(file), *_opening(file), *_begun_beyond_limits(file)]
    identified = gripped = False
    for number, (step, turn) in enumerate(_with_turns(file)):
        found += _looser_limits(file, number, step)
        found += [(("steps", number), sentence) for sentence in _beyond_own_limits(file, step, turn, cap)]
        if isinstance(step, GripperStep):
            gripped = isinstance(step, GripStep) and step.expect_object
        if gripped and isinstance(step, TareStep):
            cure = "put it before the `grip`, or a `release` before it"
            found.append((("steps", number), f"tare would make the gripped tool's torque the zero; {cure}"))
        match step:
            case IdentifyStep():
                identified = True
            case _ if _forgets_tool(step, file.torque_source):
                identified = False
            case HoldTorqueStep() if not identified:
                cure = "put an `identify` step before it, after the last `tare`, `grip`, `release` or `adapt`"
                found.append((("steps", number), f"hold_torque needs an identified tool; {cure}"))
                # One sentence is enough.
                identified = True
    return found


def _looser_limits(file: ExperimentFile, number: int, step: Step) -> Iterator[Mistake]:
    """Yield each limit of a step that is above the experiment's, which holds all the same."""
    if step.limits is None:
        return
    for key, unit in (("torque_nm", "N·m"), ("angle_rad", "rad")):
        own, whole = getattr(step.limits, key), getattr(file.limits, key)
        if key in step.limits.model_fields_set and own > whole + _ROUNDING:
            yield (
                ("steps", number, "limits", key),
                f"the limit of {step.do} is {own:g} {unit}, and the experiment's is {whole:g} {unit}: a step's limits "
                f"can only be tighter; raise the experiment's limits.{key}, or write {whole:g} or less",
            )


def _beyond_own_limits(file: ExperimentFile, step: Step, turn: Turn | None, cap: MotionCap | None) -> Iterator[str]:
    """Yield what a step asks for beyond its limits and its timeout, each with a cure."""
    limits, needs = file.limits_of(step), demand(step)
    if needs.torque_nm >= limits.torque_nm:
        cure = "raise limits.torque_nm, or ask for less"
        if cap is not None and turn is not None and limits.torque_nm + _ROUNDING >= _capped_nm(file, turn, cap):
            # A larger limit is refused too.
            cure = f"ask for less, because {cap.sentence}"
        yield f"{step.do} asks for {needs.torque_nm:g} N·m, and its limit is {limits.torque_nm:g} N·m; {cure}"
    if needs.angle_rad >= limits.angle_rad:
        asks = f"{step.do} asks for {needs.angle_rad:g} rad, and its limit is {limits.angle_rad:g} rad"
        if isinstance(step, TwistStep) and may_be_decimals(step.angles_rad):
            yield f"{asks}; {DECIMAL_POINT}; or raise limits.angle_rad"
        else:
            yield f"{asks}; raise limits.angle_rad, or ask for less"
    if step.timeout_s is not None and needs.stands_s >= step.timeout_s:
        asks = f"{step.do} stands still for {needs.stands_s:g} s in all, and its timeout is {step.timeout_s:g} s"
        yield f"{asks}; raise timeout_s"


def _begun_beyond_limits(file: ExperimentFile) -> Iterator[Mistake]:
    """Yield each step that may be stopped as it begins, because the tool is beyond its limits."""
    if not is_whole(file):
        return
    known = NOTHING_KNOWN
    for number, step in enumerate(file.steps):
        held_nm, limit_nm = known.torque_nm.exact, file.limits_of(step).torque_nm
        if held_nm is not None and abs(held_nm) >= limit_nm and not isinstance(step, ReleaseStep):
            yield (
                ("steps", number),
                f"the steps before it leave {abs(held_nm):g} N·m on the tool, and its limit is {limit_nm:g} N·m: it "
                "may be stopped as it begins, and the gripper opened; raise limits.torque_nm, or hold less before it",
            )
        turned_rad, limit_rad = known.angle_rad.exact, file.limits_of(step).angle_rad
        if turned_rad is not None and abs(turned_rad) >= limit_rad and not isinstance(step, GripperStep):
            yield (
                ("steps", number),
                f"the steps before it leave the tool turned by {abs(turned_rad):g} rad, and its limit is {limit_rad:g} "
                "rad: it may be stopped as it begins; raise limits.angle_rad, or turn back before it",
            )
        known = known_after(step, known)


def _forgets_tool(step: Step, torque_source: str) -> bool:
    """Return whether an identification is invalid afterwards: a new grip, zero, or gain of the driving torque."""
    match step:
        case AdaptStep(fingertip=fingertip):
            return fingertip == torque_source
    return isinstance(step, TareStep | GripperStep)


def _undoing(file: ExperimentFile) -> Iterator[Mistake]:
    """Yield each torque against the last `tighten` of its grip, where only its sign says so."""
    tightened: tuple[int, Direction] | None = None
    for number, step in enumerate(file.steps, 1):
        match step:
            case ReleaseStep():
                tightened = None
            case TightenStep(direction=direction):
                tightened = number, direction
            case HoldTorqueStep(direction=None, torque_nm=torque_nm) if tightened is not None:
                before, direction, back = *tightened, direction_of(torque_nm)
                if back not in (None, direction):
                    yield (
                        ("steps", number - 1),
                        f"hold_torque turns {back} by the sign of its torque_nm, and undoes step {before}, "
                        f"tighten {direction}; write `direction: {direction}`, or `direction: {back}` if it is meant",
                    )


def _opening(file: ExperimentFile) -> Iterator[Mistake]:
    """Yield each `grip` that is wider than one before it: it would open the fingers, which only a `release` does."""
    closed: tuple[int, float] | None = None
    for number, step in enumerate(file.steps, 1):
        if isinstance(step, ReleaseStep):
            closed = None
        elif isinstance(step, GripStep) and closed is not None and step.width_mm > closed[1]:
            before, width_mm = closed
            yield (
                ("steps", number - 1),
                f"grip to {step.width_mm:g} mm would open the fingers, which step {before} closes to {width_mm:g} mm; "
                "put a `release` before it, or correct `width_mm`",
            )
        elif isinstance(step, GripStep):
            closed = number, step.width_mm


def check_devices(
    file: ExperimentFile, robot: UrLimits | None, gripper: GripperModel | None, cap: MotionCap | None = None
) -> Iterator[Mistake]:
    """Yield each step with a pose, angle, torque or grip that the configured devices do not allow.

    Nothing of these is clipped, because another pose than the written one may be anywhere. `cap` is of the robot's
    commissioning: a step that asks for more than it is refused too.
    """
    for number, (step, turn) in enumerate(_with_turns(file)):
        beyond = (_outside_robot(step, robot), _outside_gripper(step, gripper), _beyond_cap(file, step, turn, cap))
        for outside in beyond:
            if outside:
                yield (("steps", number), f"{step.do} {outside}")


def _beyond_cap(file: ExperimentFile, step: Step, turn: Turn | None, cap: MotionCap | None) -> str:
    """Return which speed or torque of a step the robot's commissioning does not allow, or an empty string."""
    if cap is None:
        return ""
    # By the names of the keys: a kind of step that is added later is checked too.
    speeds = (
        ("speed_m_per_s", cap.linear_speed_m_per_s, "m/s"),
        ("speed_rad_per_s", cap.wrist_speed_rad_per_s, "rad/s"),
    )
    for key, most, unit in speeds:
        if hasattr(step, key) and _is_beyond(getattr(step, key), most):
            return f"has {key} {getattr(step, key):g} {unit}: write {most:g} or less, because {cap.sentence}"
    if turn is not None and (turn.turns_tool or turn.may_load):
        limit_nm, most_nm = file.limits_of(step).torque_nm, _capped_nm(file, turn, cap)
        if _is_beyond(limit_nm, most_nm):
            cure = f"write {most_nm:g} or less, and ask for less than {most_nm:g} N·m"
            has = f"has limits.torque_nm {limit_nm:g} N·m{_loads_beyond(file, turn, cap)}"
            return f"{has}: {cure}, because {cap.sentence}"
    return ""


def _loads_beyond(file: ExperimentFile, turn: Turn, cap: MotionCap) -> str:
    """Return the direction of a step in which a report does not raise the torque, in words; empty without one."""
    beyond = turn.may_load - cap.torque_directions
    if file.torque_source not in cap.torque_sources or not beyond:
        return ""
    return f", and may load the tool {' or '.join(sorted(beyond))}"


def _is_beyond(value: float, most: float) -> bool:
    """Return whether a value of a file is above a cap; an infinite one stands for one that could not be read."""
    return most + _ROUNDING < value < math.inf


def _outside_robot(step: Step, limits: UrLimits | None) -> str:
    if limits is None:
        return ""
    joints = limits.joints
    low_rad, high_rad = joints.lower_rad[-1] + joints.margin_rad, joints.upper_rad[-1] - joints.margin_rad
    angles_rad: tuple[float, ...] = ()
    match step:
        case ApproachStep(pose_m_rad=pose) if pose is not None:
            outside = limits.box.why_outside(pose[:3])
            return f"ends at {outside}" if outside else ""
        case TurnToStep(angle_rad=angle_rad):
            angles_rad = (angle_rad,)
        case TwistStep(absolute=True, angles_rad=given):
            angles_rad = given
        case HoldTorqueStep() | TightenStep() if (torque_nm := demand(step).torque_nm) >= limits.torque_nm.inner:
            return (
                f"asks for {torque_nm:g} N·m, and the robot's torque_nm allows less than {limits.torque_nm.inner:g} N·m"
            )
    for angle_rad in angles_rad:
        if not low_rad <= angle_rad <= high_rad:
            ends = f"{low_rad:g} to {high_rad:g} rad"
            return f"turns to {angle_rad:g} rad, and the robot's wrist has {ends} with its margin"
    return ""


def _outside_gripper(step: Step, model: GripperModel | None) -> str:
    match step:
        case GripStep() if model is not None:
            beyond = model.why_beyond(step.width_mm, step.speed_mm_per_s, step.force_n)
            return f"asks for {beyond}" if beyond else ""
        case ReleaseStep() if model is not None and "width_mm" in step.model_fields_set:
            beyond = model.why_beyond(step.width_mm, model.speed_mm_per_s.low, model.force_n.low)
            return f"asks for {beyond}" if beyond else ""
    return ""


def experiment_mistakes(
    content: object, config: DaemonConfig, sources: Mapping[str, TorqueSource], robot: Commissioning | None = None
) -> list[Mistake]:
    """Return each step and key of an experiment's content that its own limits or the devices do not allow."""
    file = outline(content)
    needs = needs_torque(file, has_gripper=config.gripper is not None)
    limits, cap = (robot.settings.limits, robot.cap) if robot is not None else (None, None)
    mistakes = check_steps(file, cap)
    mistakes += check_devices(file, limits, config.gripper_model, cap)
    named = isinstance(content, dict) and "torque_source" in content
    of_rig = {*config.fingertips, *sources, WRENCH} | ({"skin"} if config.skin is not None else set())
    # The default may be no source of this rig. A written name that is none is misspelt.
    if file.torque_source and (needs or (named and file.torque_source not in of_rig)):
        mistakes += _undriven(file, sources, config, robot, named=named)
    if file.torque_source in sources:
        mistakes += [(("steps", number), why) for number, why in not_measured(file, sources[file.torque_source])]
    if config.gripper is None:
        cure = "add a `gripper` section to the configuration, or take the step out"
        mistakes += [
            (("steps", number), f"{step.do} needs a gripper, and none is configured; {cure}")
            for number, step in enumerate(file.steps)
            if isinstance(step, GripperStep)
        ]
    # Only an experiment that is read needs it.
    from shearloop.daemon.control.sensor_reach import beyond_reach

    mistakes += [(("steps", number), why) for number, why in beyond_reach(file, sources)]
    wrong = _wrong_tools(file, sources, known=knows_tool(file.tool_mm, config, robot)) if needs else ()
    place = "torque_source" if file.tool_mm is None else "tool_mm"
    mistakes += [((place,), why) for why in wrong]
    return mistakes + _unadaptable(file, sources)


def _wrong_tools(file: ExperimentFile, sources: Mapping[str, TorqueSource], *, known: bool) -> Iterator[str]:
    """Yield why the calibration of a source has no torque on the experiment's tool; `known`: its diameter will be.

    One that only supervises holds the wrist as well, as soon as it turns.
    """
    turns = any(isinstance(step, TwistingStep | TurnToStep) for step in file.steps)
    tool = None if file.tool_mm is None else Measured(file.tool_mm, 0.0)
    for name, source in sources.items():
        if source.calibration is None or not source.measures_torque or (tool is None and known):
            continue
        try:
            source.calibration.for_tool(tool)
        except CalibrationError as error:
            if name == file.torque_source:
                yield f"{name} has no torque on this tool: {error}, or correct `tool_mm`"
            elif turns:
                yield (
                    f"{name}, which supervises, has no torque on this tool: {error}, or leave out its `calibration`; "
                    "its frames are recorded without one too"
                )


def _undriven(
    file: ExperimentFile,
    sources: Mapping[str, TorqueSource],
    config: DaemonConfig,
    robot: Commissioning | None,
    *,
    named: bool,
) -> list[Mistake]:
    """Return the mistake of a `torque_source` that cannot drive, if it is one; `named`: the file has this key."""
    drive, driving = file.torque_source, [name for name, source in sources.items() if source.measures_torque]
    noise_nm, limit_nm = robot.settings.facts.mean_noise_nm if robot is not None else 0.0, file.tightest_nm
    noisy = f"is known to {noise_nm:g} N·m only, and the smallest limit is {limit_nm:g} N·m"
    if noise_nm < limit_nm:
        driving.append(WRENCH)
    if drive in driving:
        return []
    cause, cure = _why_not_driving(drive, config)
    if drive == WRENCH:
        cause, cure = f"{noisy}, which its noise alone may pass", "calibrate a fingertip, or add a load cell"
    if driving:
        there = f"there are {', '.join(driving)}" if driving[1:] else f"there is only {driving[0]}"
        near = "".join(f"; did you mean {name}?" for name in get_close_matches(drive, driving, 1))
        cure = f"choose another, or {cure}; {there}{near}"
    elif drive != WRENCH:
        cure += f"; no other can drive, because the wrench {noisy}"
    default = "" if named else f"; the file names no `torque_source`, and {drive} is the default"
    return [(("torque_source",), f"`{drive}` {cause}: {cure}{default}")]


def _unadaptable(file: ExperimentFile, sources: Mapping[str, TorqueSource]) -> list[Mistake]:
    """Return each `adapt` step without a known torque, a gain to correct, or a twist before it."""
    found: list[Mistake] = []
    twisted = False
    for number, step in enumerate(file.steps):
        if isinstance(step, TareStep | GripperStep):
            twisted = False
        twisted = twisted or isinstance(step, TwistingStep)
        if not isinstance(step, AdaptStep) or "fingertip" not in step.model_fields_set:
            continue
        named = [name for name, source in sources.items() if source.has_gain]
        if step.fingertip not in named:
            known = f"choose one of {', '.join(named)}" if named else "calibrate one with `shearloop calibrate`"
            why = f"adapt corrects `{step.fingertip}`, which has no calibration on recordings; {known}"
            found.append((("steps", number), why))
        if step.reference not in (*sources, WRENCH):
            cure = "add a `load_cell` section to the configuration, or write `reference: wrench`"
            found.append((("steps", number), f"adapt needs a load cell, and none is configured; {cure}"))
        if not twisted:
            cure = "put an `identify` or a `twist` before it, after the last `tare`, `grip` or `release`"
            found.append((("steps", number), f"adapt needs a twisted tool; {cure}"))
    return found


def _why_not_driving(drive: str, config: DaemonConfig) -> tuple[str, str]:
    """Return why a source does not measure torques, and the cure."""
    if drive in config.fingertips:
        return "is a fingertip without a calibration, which has no torque", "add `calibration`"
    if drive == "skin" and config.skin is not None:
        return "has no torque without a radius", "add `skin.tool_radius_mm`"
    return "is not a measured torque", "configure its device"
