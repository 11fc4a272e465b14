"""Each step of an experiment as a small program: it sees a `StepContext`, yields a `StepCommand`, and ends when it
is done.

Generators read like the procedure that a person would follow at the bench; none of them knows the time of day, a
device or the event loop. Elapsed time is the experiment's own, which stands while it is paused or held.
"""

from collections.abc import Callable, Generator
from typing import TypeAlias

from shearloop.daemon.control import experiment_schema as steps
from shearloop.daemon.control.step_commands import (
    Action,
    ActionState,
    ConstantVelocity,
    GripTo,
    Hold,
    IdentifyStiffness,
    MoveTo,
    MoveToAngle,
    StepCommand,
    StepContext,
    Tare,
    TrackTorque,
    WristSetpoint,
)

# An angle counts as reached within this; the wrist's own resolution is ten times finer.
ANGLE_TOLERANCE_RAD = 0.002
# How near the set point counts as there, as a share of it: the closed loop's own accuracy.
TORQUE_TOLERANCE = 0.10

Elapsed: TypeAlias = Callable[[], float]
Programme: TypeAlias = Generator[StepCommand, StepContext, None]


class StepFailedError(Exception):
    """A step cannot go on; the message says why."""


def programme_of(step: "steps.Step", elapsed_s: Elapsed) -> Programme:
    """Return the program of one step; `elapsed_s()` is the experiment's own time in seconds."""
    match step:
        case steps.ApproachStep() | steps.RetreatStep():
            return _act(
                MoveTo(step.pose_m_rad, step.speed_m_per_s, step.along_tool_m or 0.0), "moving in a straight line"
            )
        case steps.GripStep():
            grip = GripTo(step.width_mm, step.speed_mm_per_s, step.force_n, step.expect_object)
            return _act(grip, "closing the gripper")
        case steps.ReleaseStep():
            return _act(GripTo(step.width_mm, 60.0, 10.0, expect_object=False), "opening the gripper")
        case steps.TareStep():
            return _act(Tare(), "taking the zero of every torque sensor")
        case steps.IdentifyStep():
            return _act(IdentifyStiffness(step.amplitude_rad), "measuring the tool's stiffness, delay and noise")
        case steps.TurnToStep():
            return _turn_to(step)
        case steps.TwistStep():
            return _twist(step, elapsed_s)
        case steps.HoldTorqueStep():
            return _hold_torque(step, elapsed_s)
        case steps.TightenStep():
            return _tighten(step)
        case steps.WaitStep():
            return _wait(Hold(), step.wait_s, elapsed_s, "waiting")


def _act(action: Action, doing: str) -> Programme:
    while True:
        view = yield StepCommand(Hold(), action, doing)
        if view.action is ActionState.FAILED:
            raise StepFailedError(view.failure)
        if view.action is ActionState.DONE:
            return


def _wait(wrist: WristSetpoint, wait_s: float, elapsed_s: Elapsed, doing: str, hold: int = 0) -> Programme:
    end_s = elapsed_s() + wait_s
    while (left_s := end_s - elapsed_s()) > 0:
        yield StepCommand(wrist, doing=f"{doing}, {left_s:.1f} s left", hold=hold)


def _go_to(angle_rad: float, speed_rad_per_s: float, doing: str) -> Programme:
    while True:
        view = yield StepCommand(MoveToAngle(angle_rad, speed_rad_per_s), doing=doing)
        if abs(view.wrist_rad - angle_rad) <= ANGLE_TOLERANCE_RAD:
            return


def _turn_to(step: steps.TurnToStep) -> Programme:
    view = yield StepCommand(doing="reading the wrist's angle")
    doing = f"turning the wrist to {step.angle_rad:.3f} rad"
    yield from _go_to(step.angle_rad - view.gripped_at_rad, step.speed_rad_per_s, doing)


def _twist(step: steps.TwistStep, elapsed_s: Elapsed) -> Programme:
    view = yield StepCommand(doing="reading the wrist's angle")
    start_rad = view.wrist_rad
    origin_rad = view.gripped_at_rad if step.absolute else 0.0
    angles_rad = [angle_rad - origin_rad for angle_rad in step.angles_rad]
    for repeat in range(1, step.repeats + 1):
        for number, angle_rad in enumerate(angles_rad, start=1):
            where = f"angle {number} of {len(angles_rad)}, repeat {repeat} of {step.repeats}"
            yield from _go_to(angle_rad, step.speed_rad_per_s, f"twisting to {angle_rad:.3f} rad: {where}")
            hold = MoveToAngle(angle_rad, step.speed_rad_per_s)
            held = (repeat - 1) * len(angles_rad) + number
            yield from _wait(hold, step.hold_s, elapsed_s, f"holding {angle_rad:.3f} rad: {where}", held)
            if step.return_to_start:
                yield from _go_to(start_rad, step.speed_rad_per_s, f"returning: {where}")


def _hold_torque(step: steps.HoldTorqueStep, elapsed_s: Elapsed) -> Programme:
    track = TrackTorque(step.torque_nm, step.ramp_nm_per_s)
    near_nm = max(TORQUE_TOLERANCE * abs(step.torque_nm), 1e-3)
    while True:
        view = yield StepCommand(track, doing=f"bringing the torque to {step.torque_nm:+.3f} N·m")
        if view.torque_nm is not None and abs(view.torque_nm - step.torque_nm) <= near_nm:
            break
    yield from _wait(track, step.hold_s, elapsed_s, f"holding {step.torque_nm:+.3f} N·m", 1)


def _tighten(step: steps.TightenStep) -> Programme:
    sign = -1.0 if step.direction == "clockwise" else 1.0
    start_rad = (yield StepCommand(doing="reading the wrist's angle")).wrist_rad
    while True:
        doing = f"turning {step.direction} until {step.until_torque_nm:.3f} N·m or {step.until_angle_rad:.2f} rad"
        view = yield StepCommand(ConstantVelocity(sign * step.speed_rad_per_s), doing=doing)
        if view.torque_nm is not None and abs(view.torque_nm) >= step.until_torque_nm:
            return
        if abs(view.wrist_rad - start_rad) >= step.until_angle_rad:
            return


def expected_s(step: "steps.Step") -> float:
    """Return about how long a step takes, for the remaining time that an operator is shown."""
    match step:
        case steps.TwistStep():
            reach = [abs(angle) for angle in step.angles_rad] if not step.absolute else [0.2] * len(step.angles_rad)
            ways = (2.0 if step.return_to_start else 1.0) * sum(reach) / step.speed_rad_per_s
            return step.repeats * (ways + len(reach) * step.hold_s)
        case steps.HoldTorqueStep():
            return abs(step.torque_nm) / step.ramp_nm_per_s + step.hold_s
        case steps.TightenStep():
            return step.until_angle_rad / step.speed_rad_per_s
        case steps.WaitStep():
            return step.wait_s
        case steps.IdentifyStep():
            return 20.0
        case steps.TareStep():
            return 6.0
        case _:
            return 3.0
