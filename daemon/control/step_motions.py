"""What moves in an experiment, in words, and what moves first."""

import math
from typing import Final, NamedTuple

from shearloop.daemon.control.experiment_schema import (
    ApproachStep,
    ExperimentFile,
    GripperStep,
    GripStep,
    HoldTorqueStep,
    IdentifyStep,
    ReleaseStep,
    Step,
    TareStep,
    TightenStep,
    TurnToStep,
    TwistingStep,
    TwistStep,
)
from shearloop.drivers.robotiq.models import LARGEST_STROKE_MM, GripperModel


class Speeds(NamedTuple):
    """The largest speeds that a rig allows; a step that asks for more moves with these."""

    wrist_rad_per_s: float = math.inf
    linear_m_per_s: float = math.inf

    def turning(self, asked_rad_per_s: float) -> str:
        """Return in words how fast a step turns the wrist."""
        return f"at {min(asked_rad_per_s, self.wrist_rad_per_s):g} rad/s"

    def moving(self, asked_m_per_s: float) -> str:
        """Return in words how fast a step moves the tool centre."""
        return f"at {min(asked_m_per_s, self.linear_m_per_s):g} m/s"


AS_ASKED: Final = Speeds()


def first_motion_before_grip(file: ExperimentFile) -> int | None:
    """Return the number, from 1, of the first step that moves the arm before any grip or release, or None."""
    for number, step in enumerate(file.steps, 1):
        if isinstance(step, GripperStep):
            return None
        if isinstance(step, TwistingStep | TurnToStep | ApproachStep):
            return number
    return None


def first_turn_before_tare(file: ExperimentFile, *, holds: bool = False) -> int | None:
    """Return the number, from 1, of the first step that turns a tool before any tare, or None.

    `holds`: whether the gripper may hold one as the experiment begins.
    """
    for number, step in enumerate(file.steps, 1):
        if isinstance(step, TareStep):
            return None
        if isinstance(step, GripperStep):
            holds = not isinstance(step, ReleaseStep)
        if isinstance(step, TwistingStep) or (holds and isinstance(step, TurnToStep)):
            return number
    return None


def first_gripper_step(file: ExperimentFile) -> tuple[int, GripperStep] | None:
    """Return the first step that moves the fingers, with its number from 1, or None."""
    return next(((n, step) for n, step in enumerate(file.steps, 1) if isinstance(step, GripperStep)), None)


def first_grip(file: ExperimentFile) -> tuple[int, GripStep] | None:
    """Return the first step that moves the fingers, with its number from 1, if it is a `grip`; else None."""
    match first_gripper_step(file):
        case (number, GripStep() as step):
            return number, step
    return None


def opens_to(step: ReleaseStep, gripper: GripperModel | None) -> str:
    """Return how far a step opens the fingers of a gripper, in words; as it is written where none is known.

    A width that would not let a held tool go opens them fully.
    """
    stroke_mm = LARGEST_STROKE_MM if gripper is None else gripper.stroke_mm
    if step.width_mm >= stroke_mm:
        return f"to {stroke_mm:g} mm"
    return f"to {step.width_mm:g} mm, or fully where they hold something about as wide or wider"


def first_motion(file: ExperimentFile, gripper: GripperModel | None = None, speeds: Speeds = AS_ASKED) -> str:
    """Return the first motion of an experiment as a sentence, for the operator who starts it."""
    for number, step in enumerate(file.steps, 1):
        if (motion := motion_of(step, gripper, speeds)) is not None:
            return f"the first motion is step {number} of {len(file.steps)} ({step.do}): {motion}"
    return "no step moves anything"


def motion_of(step: Step, gripper: GripperModel | None, speeds: Speeds) -> str | None:
    """Return what moves in a step, as a sentence, or None."""
    match step:
        case ApproachStep(along_tool_m=float(distance_m)):
            return (
                f"the arm moves {1e3 * distance_m:+.0f} mm along the tool's axis, {speeds.moving(step.speed_m_per_s)}"
            )
        case ApproachStep(pose_m_rad=tuple(pose)):
            x, y, z = (f"{1e3 * value:.0f}" for value in pose[:3])
            return f"the arm moves to x {x}, y {y}, z {z} mm, {speeds.moving(step.speed_m_per_s)}"
        case GripStep():
            return f"the fingers close to {step.width_mm:g} mm, or onto a tool with at most {step.force_n:g} N"
        case ReleaseStep():
            return f"the fingers open {opens_to(step, gripper)}, and a tool in them drops"
        case TurnToStep():
            return f"the wrist turns to {step.angle_rad:g} rad, {speeds.turning(step.speed_rad_per_s)}"
        case TwistStep():
            return f"the wrist twists to {step.angles_rad[0]:g} rad, {speeds.turning(step.speed_rad_per_s)}"
        case IdentifyStep():
            return f"the wrist turns to and fro, by at most {step.amplitude_rad:g} rad"
        case HoldTorqueStep():
            return f"the wrist turns until the torque is {step.signed_torque_nm:+g} N·m"
        case TightenStep():
            return f"the wrist turns {step.direction}, {speeds.turning(step.speed_rad_per_s)}"
        case _:
            return None
