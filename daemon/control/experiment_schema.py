"""The experiment file: its limits and its steps, as pydantic models with bounds that the rig can keep."""

from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from shearloop.daemon.config_file import ConfigModel, either

MOST_ANGLES = 1000


def _angles(given: object) -> object:
    """Return `START:STOP:STEPS` as evenly spaced angles, ends included; lists and numbers unchanged."""
    if isinstance(given, int | float):
        return (given,)
    if not isinstance(given, str):
        return given
    parts = given.split(":")
    try:
        start, stop, steps = float(parts[0]), float(parts[1]), int(parts[2])
    except (ValueError, IndexError):
        raise ValueError(f"{given!r} is not START:STOP:STEPS, for example 1.45:1.65:10") from None
    if len(parts) != 3 or not 2 <= steps <= MOST_ANGLES:
        raise ValueError(f"{given!r} must have three parts, the last a number of steps from 2 to {MOST_ANGLES}")
    return tuple(np.linspace(start, stop, steps).tolist())


Angles = Annotated[tuple[float, ...], BeforeValidator(_angles), Field(min_length=1)]
Seconds = Annotated[float, Field(ge=0, le=24 * 3600)]
TorqueNm = Annotated[float, Field(ge=-5, le=5)]
PositiveTorqueNm = Annotated[float, Field(gt=0, le=5)]
WristSpeed = Annotated[float, Field(gt=0, le=3.14, description="rad/s")]
Pose = Annotated[tuple[float, float, float, float, float, float], Field(description="x, y, z in m; rotation vector")]


class ExperimentLimits(ConfigModel):
    """Limits of all steps; a step's limits can only be tighter."""

    torque_nm: PositiveTorqueNm = 0.5
    angle_rad: Annotated[float, Field(gt=0, le=6.28, description="from the angle at which the tool was gripped")] = 3.2


class _Step(ConfigModel):
    timeout_s: Annotated[float, Field(gt=0, le=24 * 3600)] | None = None
    limits: ExperimentLimits | None = None


class ApproachStep(_Step):
    """Move the tool centre in a straight line, to a pose or by a distance along the tool's axis."""

    do: Literal["approach"]
    pose_m_rad: Pose | None = None
    along_tool_m: Annotated[float, Field(ge=-0.5, le=0.5)] | None = None
    speed_m_per_s: Annotated[float, Field(gt=0, le=0.5)] = 0.1

    _one_end = either("pose_m_rad", "along_tool_m")


class RetreatStep(ApproachStep):
    """Move away in a straight line."""

    do: Literal["retreat"]  # type: ignore[assignment]  # the same move under another name


class GripStep(_Step):
    """Close to a width, or onto an object in between."""

    do: Literal["grip"]
    width_mm: Annotated[float, Field(ge=0, le=140)] = 0.0
    speed_mm_per_s: Annotated[float, Field(ge=30, le=250)] = 60.0
    force_n: Annotated[float, Field(ge=10, le=125)] = 20.0
    expect_object: bool = True


class TareStep(_Step):
    """Take new homogeneous frames and a new zero of the load cell, with the wrist standing still."""

    do: Literal["tare"]


class IdentifyStep(_Step):
    """Measure stiffness, delay and noise of the gripped tool, with small twists."""

    do: Literal["identify"]
    amplitude_rad: Annotated[float, Field(gt=0, le=0.6)] = 0.2


class TwistStep(_Step):
    """Twist to angles, hold at each, and return."""

    do: Literal["twist"]
    angles_rad: Angles
    absolute: bool = Field(False, description="angles of the wrist joint, not from the angle at the grip")
    speed_rad_per_s: WristSpeed = 0.2
    hold_s: Seconds = 2.0
    return_to_start: bool = True
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1


class TurnToStep(_Step):
    """Turn the wrist joint to an angle, before a tool is gripped."""

    do: Literal["turn_to"]
    angle_rad: Annotated[float, Field(ge=-6.28, le=6.28)]
    speed_rad_per_s: WristSpeed = 0.4


class HoldTorqueStep(_Step):
    """Ramp the torque to a set point, and hold it in closed loop."""

    do: Literal["hold_torque"]
    torque_nm: TorqueNm
    ramp_nm_per_s: Annotated[float, Field(gt=0, le=1)] = 0.05
    hold_s: Seconds = 10.0


class TightenStep(_Step):
    """Turn until a torque or an angle is reached."""

    do: Literal["tighten"]
    until_torque_nm: PositiveTorqueNm
    until_angle_rad: Annotated[float, Field(gt=0, le=6.28)]
    speed_rad_per_s: WristSpeed = 0.05
    direction: Literal["clockwise", "counterclockwise"] = "clockwise"


class ReleaseStep(_Step):
    """Open the gripper."""

    do: Literal["release"]
    width_mm: Annotated[float, Field(ge=0, le=140)] = 140.0


class WaitStep(_Step):
    """Stand still for a time."""

    do: Literal["wait"]
    wait_s: Seconds


Step = Annotated[
    ApproachStep
    | RetreatStep
    | GripStep
    | TareStep
    | IdentifyStep
    | TurnToStep
    | TwistStep
    | HoldTorqueStep
    | TightenStep
    | ReleaseStep
    | WaitStep,
    Field(discriminator="do"),
]


class ExperimentFile(ConfigModel):
    """One experiment: its torque source, its limits and its steps in order."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    torque_source: Annotated[str, Field(min_length=1)] = Field(
        "right", description="torque that drives the loop: a fingertip's name, `skin`, `load_cell` or `wrench`"
    )
    limits: ExperimentLimits = ExperimentLimits()
    tool_mm: Annotated[float, Field(gt=0, lt=140)] | None = Field(
        None, description="diameter of the tool; recordings store it, and calibrations use it"
    )
    slices: Literal["torque", "diameter"] | None = Field(
        None,
        description="kind of samples that `shearloop run --slices DIR` stores for each held angle; none by default",
    )
    steps: Annotated[tuple[Step, ...], Field(min_length=1)]

    def limits_of(self, step: Step) -> ExperimentLimits:
        """Return the tighter of the experiment's limits and the step's."""
        own = step.limits or self.limits
        torque_nm, angle_rad = min(own.torque_nm, self.limits.torque_nm), min(own.angle_rad, self.limits.angle_rad)
        return ExperimentLimits(torque_nm=torque_nm, angle_rad=angle_rad)


def first_turn_before_grip(file: ExperimentFile) -> int | None:
    """Return the number, from 1, of the first step that turns the wrist before any grip or release, or None."""
    for number, step in enumerate(file.steps, 1):
        match step:
            case GripStep() | ReleaseStep():
                return None
            case IdentifyStep() | TurnToStep() | TwistStep() | HoldTorqueStep() | TightenStep():
                return number
    return None


def check_limits(file: ExperimentFile) -> str:
    """Return a sentence on the first step that exceeds its limits, or an empty string."""
    for number, step in enumerate(file.steps):
        limits, (torque_nm, angle_rad) = file.limits_of(step), _reach(step)
        torque = torque_nm, limits.torque_nm, "N·m", "torque_nm"
        for value, limit, unit, key in (torque, (angle_rad, limits.angle_rad, "rad", "angle_rad")):
            if value >= limit:
                return (
                    f"`steps[{number}]` ({step.do}) asks for {value:g} {unit}, and its limit is {limit:g} {unit}; "
                    f"raise `limits.{key}`, or ask for less"
                )
    return ""


def _reach(step: Step) -> tuple[float, float]:
    """Return the largest torque (N·m) and angle from the grip (rad) of a step; 0 if unknown."""
    match step:
        case HoldTorqueStep():
            return abs(step.torque_nm), 0.0
        case TightenStep():
            return step.until_torque_nm, step.until_angle_rad
        case IdentifyStep():
            return 0.0, step.amplitude_rad
        case TwistStep(absolute=False):
            return 0.0, max(map(abs, step.angles_rad))
        case _:
            return 0.0, 0.0
