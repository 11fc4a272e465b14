"""What an experiment may ask for, as it is written in YAML. Every bound is one that the rig can keep."""

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

MOST_ANGLES = 1000


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


def _angles(given: object) -> object:
    """Read `start:stop:steps` as evenly spaced angles, ends included; lists and numbers pass as they are."""
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


def _finite(angles: tuple[float, ...]) -> tuple[float, ...]:
    if not np.isfinite(angles).all():
        raise ValueError("angles must be finite numbers")
    return angles


Angles = Annotated[tuple[float, ...], BeforeValidator(_angles), AfterValidator(_finite), Field(min_length=1)]
Seconds = Annotated[float, Field(ge=0, le=24 * 3600)]
TorqueNm = Annotated[float, Field(ge=-5, le=5)]
PositiveTorqueNm = Annotated[float, Field(gt=0, le=5)]
WristSpeed = Annotated[float, Field(gt=0, le=3.14, description="rad/s")]
Pose = Annotated[tuple[float, float, float, float, float, float], Field(description="x, y, z in m; rotation vector")]


class ExperimentLimits(_Section):
    """What no step may exceed; a step's own limits can only be tighter."""

    torque_nm: PositiveTorqueNm = 0.5
    angle_rad: Annotated[float, Field(gt=0, le=6.28, description="from the angle at which the tool was gripped")] = 3.2


class _Step(_Section):
    timeout_s: Annotated[float, Field(gt=0, le=24 * 3600)] | None = None
    limits: ExperimentLimits | None = None


class ApproachStep(_Step):
    """Move the tool centre in a straight line to where it can grip: to a pose, or so far along the tool's axis."""

    do: Literal["approach"]
    pose_m_rad: Pose | None = None
    along_tool_m: Annotated[float, Field(ge=-0.5, le=0.5)] | None = None
    speed_m_per_s: Annotated[float, Field(gt=0, le=0.5)] = 0.1

    @model_validator(mode="after")
    def _one_end(self) -> "ApproachStep":
        if (self.pose_m_rad is None) == (self.along_tool_m is None):
            raise ValueError("give either pose_m_rad or along_tool_m, and not both")
        return self


class RetreatStep(ApproachStep):
    """Move away in a straight line."""

    do: Literal["retreat"]  # type: ignore[assignment]  # the same move under the name that the reader expects


class GripStep(_Step):
    """Close to a width or onto the object that is met before it."""

    do: Literal["grip"]
    width_mm: Annotated[float, Field(ge=0, le=140)] = 0.0
    speed_mm_per_s: Annotated[float, Field(ge=30, le=250)] = 60.0
    force_n: Annotated[float, Field(ge=10, le=125)] = 20.0
    expect_object: bool = True


class TareStep(_Step):
    """Take the homogeneous frames and the load cell's zero anew; the wrist stands still meanwhile."""

    do: Literal["tare"]


class IdentifyStep(_Step):
    """Measure stiffness, delay and noise on the tool in hand, with small twists."""

    do: Literal["identify"]
    amplitude_rad: Annotated[float, Field(gt=0, le=0.6)] = 0.2


class TwistStep(_Step):
    """Twist to angles, hold at each, and return."""

    do: Literal["twist"]
    angles_rad: Angles
    absolute: bool = Field(False, description="whether angles are the wrist's own, or from where the tool was gripped")
    speed_rad_per_s: WristSpeed = 0.2
    hold_s: Seconds = 2.0
    return_to_start: bool = True
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1


class TurnToStep(_Step):
    """Turn the wrist to an angle of its own, before a tool is gripped."""

    do: Literal["turn_to"]
    angle_rad: Annotated[float, Field(ge=-6.28, le=6.28)]
    speed_rad_per_s: WristSpeed = 0.4


class HoldTorqueStep(_Step):
    """Bring the torque to a set point along a ramp, and hold it there in closed loop."""

    do: Literal["hold_torque"]
    torque_nm: TorqueNm
    ramp_nm_per_s: Annotated[float, Field(gt=0, le=1)] = 0.05
    hold_s: Seconds = 10.0


class TightenStep(_Step):
    """Turn until a torque or an angle is reached, whichever comes first."""

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
    """Stand still for a while."""

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


class ExperimentFile(_Section):
    """One experiment: what drives it, what bounds it, and its steps in order."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    drive: Annotated[str, Field(min_length=1)] = Field(
        "right", description="the torque that drives the loop: a fingertip's name, `skin`, `load_cell` or `wrench`"
    )
    limits: ExperimentLimits = ExperimentLimits()
    tool_mm: Annotated[float, Field(gt=0, lt=140)] | None = Field(
        None, description="diameter of the tool that it is done with; recordings name it, and calibrations go by it"
    )
    slices: Literal["torque", "diameter"] | None = Field(
        None, description="what `shearloop run --slices DIR` keeps of each held angle; nothing by default"
    )
    steps: Annotated[tuple[Step, ...], Field(min_length=1)]


def turns_before_a_grip(file: ExperimentFile) -> int | None:
    """Return the number, from 1, of the step that turns the wrist before any has gripped or released; None of none."""
    for number, step in enumerate(file.steps, 1):
        match step:
            case GripStep() | ReleaseStep():
                return None
            case IdentifyStep() | TurnToStep() | TwistStep() | HoldTorqueStep() | TightenStep():
                return number
    return None


def beyond_limits(file: ExperimentFile) -> str:
    """Return which step asks for what its limits forbid, or an empty text."""
    for number, step in enumerate(file.steps):
        own = step.limits or file.limits
        allowed = min(own.torque_nm, file.limits.torque_nm), min(own.angle_rad, file.limits.angle_rad)
        for wants, limit, unit, key in zip(
            _reach(step), allowed, ("N·m", "rad"), ("torque_nm", "angle_rad"), strict=True
        ):
            if wants >= limit:
                return (
                    f"`steps[{number}]` ({step.do}) asks for {wants:g} {unit}, and its limit is {limit:g} {unit}; "
                    f"raise `limits.{key}`, or ask for less"
                )
    return ""


def _reach(step: Step) -> tuple[float, float]:
    """Return the torque (N·m) and the angle from the grip (rad) that a step asks for; 0 where that is not known."""
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
