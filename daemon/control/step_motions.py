"""The first step of each kind that an experiment has, and the largest speeds."""

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ApproachStep,
    ExperimentFile,
    GripperStep,
    GripStep,
    ReleaseStep,
    Step,
    TareStep,
    TurnToStep,
    TwistingStep,
)


class Speeds(NamedTuple):
    """The largest speeds that a rig allows; a step that asks for more moves with these."""

    wrist_rad_per_s: float = math.inf
    linear_m_per_s: float = math.inf


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
    """Return the number, from 1, of the first step that turns a tool before any tare, or None; `holds` as below."""
    number = first_measured(file, holds=holds)
    return None if number is None or isinstance(file.steps[number - 1], TareStep) else number


def first_measured(file: ExperimentFile, *, holds: bool) -> int | None:
    """Return the number, from 1, of the first step that needs the sensors, or None: it turns a tool, tares or adapts.

    `holds`: whether the gripper may hold a tool as the experiment begins.
    """
    for number, step, held in _with_held(file, holds=holds):
        if isinstance(step, AdaptStep | TareStep | TwistingStep) or (held and isinstance(step, TurnToStep)):
            return number
    return None


def needs_torque(file: ExperimentFile, *, has_gripper: bool) -> bool:
    """Return whether a step needs a torque that can drive, whatever the gripper holds as the experiment begins.

    A straight move with a tool needs one for its limit. No start allows one before the first grip if the gripper may
    hold a tool; without a gripper, a tool may be clamped.
    """
    carries = any(held and isinstance(step, ApproachStep) for _, step, held in _with_held(file, holds=not has_gripper))
    return carries or first_measured(file, holds=True) is not None


def _with_held(file: ExperimentFile, *, holds: bool) -> Iterator[tuple[int, Step, bool]]:
    """Yield each step with its number, from 1, and whether a tool may be held in it; `holds` as above."""
    for number, step in enumerate(file.steps, 1):
        if isinstance(step, GripperStep):
            holds = not isinstance(step, ReleaseStep)
        yield number, step, holds


def first_gripper_step(file: ExperimentFile) -> tuple[int, GripperStep] | None:
    """Return the first step that moves the fingers, with its number from 1, or None."""
    return next(((n, step) for n, step in enumerate(file.steps, 1) if isinstance(step, GripperStep)), None)


def first_grip(file: ExperimentFile) -> tuple[int, GripStep] | None:
    """Return the first step that moves the fingers, with its number from 1, if it is a `grip`; else None."""
    match first_gripper_step(file):
        case (number, GripStep() as step):
            return number, step
    return None


def first_release(file: ExperimentFile) -> int | None:
    """Return the number, from 1, of the first `release`, or None.

    Only a `release` lets a tool drop. The gripper's task refuses a `grip` that would open the fingers on a tool, or
    activate the gripper.
    """
    return next((number for number, step in enumerate(file.steps, 1) if isinstance(step, ReleaseStep)), None)
