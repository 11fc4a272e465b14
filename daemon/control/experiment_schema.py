"""The experiment file: its limits and its steps, as pydantic models with bounds that the rig can keep."""

import math
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, get_args

import numpy as np
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError, WithJsonSchema, model_validator

from shearloop.daemon.config_file import NAMED_FILES, ConfigModel, FileKind, either, not_of_kind
from shearloop.daemon.motion_cap import CAPPED_M_PER_S, CAPPED_NM, CAPPED_RAD_PER_S
from shearloop.daemon.torques import SIGNS, Direction
from shearloop.drivers import ranges
from shearloop.drivers.ranges import LARGEST_ANGLE_RAD
from shearloop.drivers.robotiq.models import FORCES_N, LARGEST_STROKE_MM, SPEEDS_MM_PER_S
from shearloop.words import shown

MAX_ANGLES = 1000
# Bounds on what an experiment costs: its plan is made in the loop that moves the robot.
MAX_STEPS, MAX_ANGLES_IN_ALL = 500, 4000
# Larger numbers have no differences.
_LARGEST_WRITTEN = 1e9


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
        raise ValueError(f"{shown(given)} is not START:STOP:STEPS, for example 1.45:1.65:10") from None
    if not abs(start) + abs(stop) < _LARGEST_WRITTEN:
        raise ValueError(f"{shown(given)} must start and stop at an angle in rad")
    if len(parts) != 3 or not 2 <= steps <= MAX_ANGLES:
        raise ValueError(f"{shown(given)} must have three parts, the last a number of steps from 2 to {MAX_ANGLES}")
    return tuple(np.linspace(start, stop, steps).tolist())


_ANGLE = {"type": "number", "minimum": -LARGEST_ANGLE_RAD, "maximum": LARGEST_ANGLE_RAD, "unit": "rad"}
Angles = Annotated[
    tuple[ranges.Angle, ...],
    Field(min_length=1),
    BeforeValidator(_angles),
    WithJsonSchema(
        {
            "description": "one angle, a list, or START:STOP:STEPS",
            "anyOf": [
                _ANGLE,
                {"type": "array", "items": _ANGLE, "minItems": 1},
                {"type": "string", "pattern": "^[^:]+:[^:]+:[^:]+$"},
            ],
        }
    ),
]


# What some gripper has; the configured model's own ranges are checked with its configuration.
FingerWidth = Annotated[float, Field(ge=0, le=LARGEST_STROKE_MM)]
FingerSpeed = Annotated[float, Field(ge=SPEEDS_MM_PER_S.low, le=SPEEDS_MM_PER_S.high)]
FingerForce = Annotated[float, Field(ge=FORCES_N.low, le=FORCES_N.high)]


class ExperimentLimits(ConfigModel):
    """Limits of all steps; a step's limits can only be tighter."""

    torque_nm: ranges.TorqueLimit = Field(
        default=CAPPED_NM, description="a larger torque stops the experiment, and the gripper opens"
    )
    angle_rad: ranges.Turn = Field(
        default=3.2, description="largest angle, from the angle at the grip or at the first start with a clamped tool"
    )


class _Step(ConfigModel):
    timeout_s: ranges.Duration | None = Field(None, description="a longer step stops the experiment")
    limits: ExperimentLimits | None = Field(None, description="tighter limits for this step")


class ApproachStep(_Step):
    """Move the tool centre in a straight line, to a pose or by a distance along the tool's axis."""

    do: Literal["approach"]
    pose_m_rad: ranges.Pose | None = Field(None, description="pose: x, y, z and rotation vector; else `along_tool_m`")
    along_tool_m: float | None = Field(
        None, ge=-0.5, le=0.5, description="distance along the tool's axis; else `pose_m_rad`"
    )
    speed_m_per_s: float = Field(CAPPED_M_PER_S, gt=0, le=0.5, description="speed of the tool centre")

    _one_end = either("pose_m_rad", "along_tool_m")


class RetreatStep(ApproachStep):
    """Move away in a straight line."""

    do: Literal["retreat"]  # type: ignore[assignment]  # the same move under another name


class GripStep(_Step):
    """Close to a width, or onto an object in between."""

    do: Literal["grip"]
    width_mm: FingerWidth = Field(0.0, description="width to close to")
    speed_mm_per_s: FingerSpeed = Field(60.0, description="speed of the fingers")
    force_n: FingerForce = Field(20.0, description="largest force of the fingers")
    expect_object: bool = Field(True, description="whether it is an error to close on nothing")


class Opening(GripStep):
    """A motion of the fingers that may only open them."""


def opening(width_mm: float, speed_mm_per_s: float) -> Opening:
    """Return the step that opens the gripper, with its least force."""
    least_n = FORCES_N.low
    content = {"width_mm": width_mm, "speed_mm_per_s": speed_mm_per_s, "force_n": least_n, "expect_object": False}
    return Opening.model_validate({"do": "grip", **content})


class TareStep(_Step):
    """Take the zero of every torque sensor, and the idle frame of fingertips, while the wrist stands still."""

    do: Literal["tare"]


class IdentifyStep(_Step):
    """Measure stiffness, delay and noise of the gripped tool, with small twists."""

    do: Literal["identify"]
    amplitude_rad: float = Field(0.2, gt=0, le=0.6, description="largest angle of the twists")
    # Four frames of the EIT-kit and a half.
    hold_s: float = Field(2.5, ge=0.1, le=60, description="time at each angle; 0.8 is enough for a load cell")


class AdaptStep(_Step):
    """Correct a fingertip's gain by a torque measured since the grip, until the next grip or tare."""

    do: Literal["adapt"]
    fingertip: str = Field(min_length=1, description="a fingertip's name or `combined`, calibrated on recordings")
    reference: Literal["load_cell", "wrench"] = Field("load_cell", description="source of the known torque")


class TwistStep(_Step):
    """Twist to angles, hold at each, and return."""

    do: Literal["twist"]
    angles_rad: Angles
    absolute: bool = Field(False, description="true: angles of the wrist joint; false: from the angle at the grip")
    speed_rad_per_s: ranges.WristSpeed = Field(CAPPED_RAD_PER_S, description="speed of the wrist")
    hold_s: ranges.Seconds = Field(2.0, description="time at each angle")
    return_to_start: bool = Field(True, description="turn back after each angle")
    repeats: int = Field(1, ge=1, le=1000, description="rounds over all angles")


class TurnToStep(_Step):
    """Turn the wrist joint to an angle, before a tool is gripped."""

    do: Literal["turn_to"]
    angle_rad: ranges.Angle = Field(description="angle of the wrist joint")
    speed_rad_per_s: ranges.WristSpeed = Field(CAPPED_RAD_PER_S, description="speed of the wrist")


class HoldTorqueStep(_Step):
    """Ramp the torque to a set point, and hold it in closed loop."""

    do: Literal["hold_torque"]
    torque_nm: ranges.TorqueSetPoint = Field(description="the set point; counterclockwise is positive")
    direction: Direction | None = Field(None, description="direction of the torque, which then has no sign")
    ramp_nm_per_s: float = Field(0.05, gt=0, le=1, description="rise of the set point")
    hold_s: ranges.Seconds = Field(10.0, description="time at the set point")

    @model_validator(mode="after")
    def _one_sign(self) -> "HoldTorqueStep":
        if self.direction is not None and self.torque_nm < 0:
            raise ValueError(f"with `direction`, torque_nm has no sign: write {-self.torque_nm:g}")
        return self

    @property
    def signed_torque_nm(self) -> float:
        """The set point; counterclockwise is positive."""
        return self.torque_nm if self.direction is None else SIGNS[self.direction] * self.torque_nm


class TightenStep(_Step):
    """Turn until a torque or an angle is reached."""

    do: Literal["tighten"]
    until_torque_nm: ranges.TorqueLimit = Field(description="the turn ends at this torque")
    until_angle_rad: ranges.Turn = Field(description="the turn ends at this angle")
    speed_rad_per_s: ranges.WristSpeed = Field(0.05, description="speed of the wrist")
    direction: Direction = Field(
        description="direction of the turn, as the thread's, seen from in front of the gripper"
    )


class ReleaseStep(_Step):
    """Open the gripper."""

    do: Literal["release"]
    width_mm: FingerWidth = Field(
        LARGEST_STROKE_MM, description="minimum width to open to; a smaller gripper opens fully"
    )


class WaitStep(_Step):
    """Stand still for a time."""

    do: Literal["wait"]
    wait_s: ranges.Seconds = Field(description="time to stand still")


# Every step is in one of three groups: it may twist a gripped tool, it may grip another one, or neither.
TwistingStep: TypeAlias = IdentifyStep | TwistStep | HoldTorqueStep | TightenStep
GripperStep: TypeAlias = GripStep | ReleaseStep
OtherStep: TypeAlias = ApproachStep | RetreatStep | TareStep | AdaptStep | TurnToStep | WaitStep
Step = Annotated[OtherStep | GripperStep | TwistingStep, Field(discriminator="do")]


class ExperimentFile(ConfigModel):
    """One experiment: its torque source, its limits and its steps in order."""

    what: ClassVar[str] = "experiment"

    _kind = not_of_kind(
        FileKind(
            "a configuration",
            "start it with `shearloop run FILE`, and name an experiment in it as `experiment`",
            ("fingertips", "skin"),
        ),
        *NAMED_FILES,
    )

    name: str = Field(min_length=1, max_length=80, description="name in messages and recordings")
    torque_source: Annotated[str, Field(min_length=1)] = Field(
        "right",
        description="torque that drives the loop: a fingertip's name, `combined`, `skin`, `load_cell` or `wrench`",
    )
    limits: ExperimentLimits = Field(ExperimentLimits(), description="limits of all steps")
    tool_mm: float | None = Field(
        None, gt=0, lt=LARGEST_STROKE_MM, description="the tool's diameter: see calibrations.md"
    )
    slices: Literal["torque", "diameter"] | None = Field(
        None,
        description="kind of slice that `recording export --format slices` makes of each held angle; none by default",
    )
    steps: tuple[Step, ...] = Field(min_length=1, description="the steps in order")

    @model_validator(mode="after")
    def _bounded(self) -> "ExperimentFile":
        if len(self.steps) > MAX_STEPS:
            raise ValueError(
                f"it has {len(self.steps)} steps, and an experiment has at most {MAX_STEPS}: make two of it"
            )
        angles = sum(len(step.angles_rad) for step in self.steps if isinstance(step, TwistStep))
        if angles > MAX_ANGLES_IN_ALL:
            raise ValueError(
                f"its `twist` steps have {angles} angles in all, and an experiment has at most {MAX_ANGLES_IN_ALL}: "
                "repeat fewer of them with `repeats`, or make two of it"
            )
        return self

    @property
    def tightest_nm(self) -> float:
        """The smallest torque limit of a step."""
        return min(self.limits_of(step).torque_nm for step in self.steps)

    def limits_of(self, step: Step) -> ExperimentLimits:
        """Return the tighter of the experiment's limits and the step's."""
        own = {} if step.limits is None else step.limits.model_dump(exclude_unset=True)
        whole = self.limits
        torque_nm = min(own.get("torque_nm", whole.torque_nm), whole.torque_nm)
        angle_rad = min(own.get("angle_rad", whole.angle_rad), whole.angle_rad)
        # The limits of an outline may be infinite.
        return ExperimentLimits.model_construct(torque_nm=torque_nm, angle_rad=angle_rad)


# A location in an experiment's file, and the mistake there.
Mistake = tuple[tuple[int | str, ...], str]
_STEP: TypeAdapter[Step] = TypeAdapter(Step)
STEP_KINDS: dict[str, Any] = {
    name: kind for kind in get_args(get_args(Step)[0]) for name in get_args(kind.model_fields["do"].annotation)
}


def outline(content: object) -> ExperimentFile:
    """Return the content of a file as far as it can be read; a source of torque that is no name is empty.

    A step with mistakes has only its kind and the names in it.
    """
    given = content if isinstance(content, dict) else {}
    steps = given.get("steps")
    try:
        limits = ExperimentLimits.model_validate(given.get("limits", {}))
    except ValidationError:
        limits = ExperimentLimits.model_construct(torque_nm=math.inf, angle_rad=math.inf)
    tool_mm = given.get("tool_mm")
    source = given.get("torque_source", ExperimentFile.model_fields["torque_source"].default)
    return ExperimentFile.model_construct(
        torque_source=source if isinstance(source, str) else "",
        limits=limits,
        tool_mm=tool_mm if isinstance(tool_mm, int | float) and 0 < tool_mm < LARGEST_STROKE_MM else None,
        steps=tuple(map(_outlined, steps)) if isinstance(steps, list) else (),
    )


def _outlined(content: object) -> Step:
    try:
        return _STEP.validate_python(content)
    except ValidationError:
        given = content if isinstance(content, dict) else {}
        names = {key: given[key] for key in ("do", "fingertip", "reference") if isinstance(given.get(key), str)}
        step: Step = STEP_KINDS.get(names.get("do", ""), WaitStep).model_construct(**names)
        return step


def is_whole(file: ExperimentFile) -> bool:
    """Return whether each step of an outline has the keys that it needs."""
    for step in file.steps:
        needed = {name for name, field in type(step).model_fields.items() if field.is_required()}
        if not needed <= step.model_fields_set:
            return False
    return True
