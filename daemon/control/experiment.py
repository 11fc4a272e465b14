"""Runs an experiment step by step: its commands, its steps as generators, its phases. No I/O; time is an argument.

Each step is a generator that receives a `StepContext`, yields a `StepCommand`, and returns at its end. The experiment's
clock stands while it is paused, or while the control loop says so, as during a hold.
"""

import math
from collections.abc import Generator
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

from shearloop.daemon.control import experiment_schema as steps
from shearloop.daemon.control.experiment_schema import ExperimentFile, Step
from shearloop.daemon.control.known_tool import AT_REST, TORQUE_TOLERANCE, KnownTool
from shearloop.daemon.control.step_demands import demands
from shearloop.daemon.control.step_motions import AS_ASKED, Speeds
from shearloop.daemon.torques import SIGNS
from shearloop.words import beyond

# An angle counts as reached within this; the wrist's resolution is ten times finer.
ANGLE_TOLERANCE_RAD = 0.002
# A ramp this close to its set point has ended: the difference comes from rounding.
RAMPED_NM = 1e-9


@dataclass(frozen=True, slots=True)
class Hold:
    """The wrist stands still."""


@dataclass(frozen=True, slots=True)
class MoveToAngle:
    """The wrist joint turns to an angle, at most at this speed."""

    angle_rad: float
    speed_rad_per_s: float


@dataclass(frozen=True, slots=True)
class ConstantVelocity:
    """The wrist turns at a constant speed, counterclockwise positive."""

    speed_rad_per_s: float


@dataclass(frozen=True, slots=True)
class TrackTorque:
    """The wrist follows a torque set point in closed loop."""

    torque_nm: float
    ramp_nm_per_s: float


WristSetPoint: TypeAlias = Hold | MoveToAngle | ConstantVelocity | TrackTorque


# An action of the devices or of the identification; a retreat is an approach, and a release a grip as well.
Action: TypeAlias = steps.ApproachStep | steps.GripStep | steps.TareStep | steps.IdentifyStep | steps.AdaptStep


@dataclass(frozen=True, slots=True)
class StepContext:
    """Input of a step: the wrist joint's angle now and at the grip, the driving torque, and the present ramp.

    `torque_nm` is None without a fresh valid estimate, `ramp_nm` without a closed loop. `elapsed_s` is the experiment's
    time.
    """

    wrist_rad: float
    torque_nm: float | None
    ramp_nm: float | None
    gripped_at_rad: float
    elapsed_s: float


@dataclass(frozen=True, slots=True)
class StepCommand:
    """Output of a step.

    An action starts with the first command that has it, and ends the step. `hold_number` counts the angles or
    torques at which a step waits, from 1; 0 while it waits at none.
    """

    wrist: WristSetPoint = Hold()
    action: Action | None = None
    activity: str = ""
    hold_number: int = 0

    @property
    def turns(self) -> bool:
        """Whether it turns the wrist."""
        return not isinstance(self.wrist, Hold) or isinstance(self.action, steps.IdentifyStep)


class ExperimentPhase(Enum):
    """Phase of an experiment."""

    RUNNING = "running"
    PAUSED = "paused"  # by the operator
    DONE = "done"
    STOPPED = "stopped"  # before its end: by the operator, by safety, or by a step that failed


StepProgram: TypeAlias = Generator[StepCommand, StepContext, None]


class Experiment:
    """One run of an experiment file."""

    def __init__(self, file: ExperimentFile, t_ns: int, speeds: Speeds = AS_ASKED, start: KnownTool = AT_REST) -> None:
        """Begin at t_ns; `speeds` are the largest that the rig allows, `start` is the known state of the tool."""
        self.file = file
        # The approximate duration of each step, for the remaining time shown to the operator.
        self._expected_s = [one.takes_s for one in demands(file, speeds, start)]
        self.phase = ExperimentPhase.RUNNING
        self.stop_reason = ""
        # The step's command, also while the wrist stands still.
        self.command = StepCommand()
        # The tighter of the experiment's limits and the step's.
        self.limits = file.limits
        # The number of the present step, or of the last one, from 1.
        self.step_number = 0
        # A sentence when the step has exceeded its timeout.
        self.overdue: str | None = None
        self._t_ns = t_ns
        self._elapsed_s = self._step_began_s = 0.0
        self._program: StepProgram
        self._acting = False
        self._begin_next()

    @property
    def running(self) -> bool:
        """Whether it may still move something."""
        return self.phase in (ExperimentPhase.RUNNING, ExperimentPhase.PAUSED)

    @property
    def step(self) -> Step:
        """The present step, or the last one."""
        return self.file.steps[self.step_number - 1]

    @property
    def remaining_s(self) -> float:
        """The approximate remaining time."""
        return self._left_s if self.running else 0.0

    @property
    def _left_s(self) -> float:
        """The approximate time of what has not been done."""
        here_s = max(0.0, self._expected_s[self.step_number - 1] - self._elapsed_s + self._step_began_s)
        return here_s + sum(self._expected_s[self.step_number :])

    @property
    def progress(self) -> float:
        """The completed fraction, 0 to 1; a stopped experiment keeps the fraction at its stop."""
        if self.phase is ExperimentPhase.DONE:
            return 1.0
        return max(0.0, 1.0 - self._left_s / max(sum(self._expected_s), 1e-9))

    def update(
        self,
        t_ns: int,
        wrist_rad: float,
        torque_nm: float | None,
        *,
        ramp_nm: float | None = None,
        gripped_at_rad: float = 0.0,
        clock_stands: bool = False,
    ) -> None:
        """Choose the command for now, unless the experiment is paused or its clock has to stand.

        The angles are the wrist joint's: now, and at the grip. `ramp_nm` is the torque that the closed loop asks for.
        """
        passed_s = max(0, t_ns - self._t_ns) / 1e9
        self._t_ns = max(t_ns, self._t_ns)
        if clock_stands or self.phase is not ExperimentPhase.RUNNING:
            return
        self._elapsed_s += passed_s
        context = StepContext(wrist_rad, torque_nm, ramp_nm, gripped_at_rad, self._elapsed_s)
        try:
            self.command = self._program.send(context)
        except StopIteration:
            self._begin_next()
        longest_s, spent_s = self.step.timeout_s, self._elapsed_s - self._step_began_s
        if longest_s is not None and spent_s > longest_s:
            step = f"step {self.step_number} ({self.step.do})"
            self.overdue = f"{step} has taken {beyond(spent_s, longest_s, 1)} s of at most {longest_s:g} s"

    def begin_action(self) -> bool:
        """Return whether the command's action has to begin now; it counts as begun."""
        begins, self._acting = not self._acting, True
        return begins

    def end_action(self, error: str | None = None) -> bool:
        """End the step with its action, or the experiment with an error; return whether an action was under way."""
        ends, self._acting = self._acting, False
        if ends and error is not None:
            self.stop(f"step {self.step_number} ({self.step.do}) failed: {error}")
        elif ends:
            self._begin_next()
        return ends

    def pause(self) -> str | None:
        """Stand still until `resume`; return None, or why not."""
        if self.phase is ExperimentPhase.PAUSED:
            return "the experiment is paused already; `resume` continues it"
        if self.phase is not ExperimentPhase.RUNNING:
            return "no experiment is running"
        self.phase = ExperimentPhase.PAUSED
        return None

    def resume(self) -> str | None:
        """Continue after `pause`; return None, or why not."""
        if self.phase is not ExperimentPhase.PAUSED:
            return "no experiment is paused"
        self.phase = ExperimentPhase.RUNNING
        return None

    def stop(self, reason: str) -> None:
        """End for good; a stopped experiment cannot be resumed."""
        if self.running:
            self.phase, self.stop_reason, self.command = ExperimentPhase.STOPPED, reason, StepCommand()

    def fail(self, reason: str) -> None:
        """End because the step cannot be done."""
        self.stop(f"step {self.step_number} ({self.step.do}) cannot be done: {reason}")

    def _begin_next(self) -> None:
        self.overdue, self._acting = None, False
        while self.step_number < len(self.file.steps):
            self.step_number += 1
            self._step_began_s = self._elapsed_s
            self.limits = self.file.limits_of(self.step)
            self._program = _program(self.step, self._elapsed_s)
            try:
                self.command = next(self._program)
            except StopIteration:  # nothing to do, such as a wait of 0 s
                continue
            return
        self.phase, self.command = ExperimentPhase.DONE, StepCommand()


def _program(step: Step, now_s: float) -> StepProgram:
    """Return the generator of one step that begins at the experiment's time `now_s`."""
    match step:
        case steps.ApproachStep():
            return _act(step, "moving in a straight line")
        case steps.GripStep():
            return _act(step, "closing the gripper")
        case steps.ReleaseStep():
            return _act(steps.opening(step.width_mm, 60.0), "opening the gripper")
        case steps.TareStep():
            return _act(step, "taking the zero of every torque sensor")
        case steps.IdentifyStep():
            return _act(step, "measuring the tool's stiffness, delay and noise")
        case steps.AdaptStep():
            return _act(step, f"correcting the gain of {step.fingertip} by the {step.reference.replace('_', ' ')}")
        case steps.TurnToStep():
            return _turn_to(step)
        case steps.TwistStep():
            return _twist(step)
        case steps.HoldTorqueStep():
            return _hold_torque(step)
        case steps.TightenStep():
            return _tighten(step)
        case steps.WaitStep():
            return _wait(Hold(), step.wait_s, now_s, "waiting")


def _act(action: Action, activity: str) -> StepProgram:
    while True:
        yield StepCommand(Hold(), action, activity)


def _wait(wrist: WristSetPoint, wait_s: float, now_s: float, activity: str, hold_number: int = 0) -> StepProgram:
    end_s = now_s + wait_s
    while (left_s := end_s - now_s) > 0:
        context = yield StepCommand(wrist, activity=f"{activity}, {left_s:.1f} s left", hold_number=hold_number)
        now_s = context.elapsed_s


def _go_to(angle_rad: float, speed_rad_per_s: float, activity: str) -> Generator[StepCommand, StepContext, StepContext]:
    """Turn to an angle; return the context at the arrival."""
    while True:
        context = yield StepCommand(MoveToAngle(angle_rad, speed_rad_per_s), activity=activity)
        if abs(context.wrist_rad - angle_rad) <= ANGLE_TOLERANCE_RAD:
            return context


def _turn_to(step: steps.TurnToStep) -> StepProgram:
    activity = f"turning the wrist to {step.angle_rad:.3f} rad"
    yield from _go_to(step.angle_rad, step.speed_rad_per_s, activity)


def _twist(step: steps.TwistStep) -> StepProgram:
    context = yield StepCommand(activity="reading the wrist's angle")
    start_rad, speed_rad_per_s = context.wrist_rad, step.speed_rad_per_s
    origin_rad = 0.0 if step.absolute else context.gripped_at_rad
    for repeat in range(1, step.repeats + 1):
        for number, angle_rad in enumerate(step.angles_rad, start=1):
            where = f"angle {number} of {len(step.angles_rad)}, repeat {repeat} of {step.repeats}"
            goal_rad = origin_rad + angle_rad
            context = yield from _go_to(goal_rad, speed_rad_per_s, f"twisting to {angle_rad:.3f} rad: {where}")
            hold, hold_number = MoveToAngle(goal_rad, speed_rad_per_s), (repeat - 1) * len(step.angles_rad) + number
            yield from _wait(hold, step.hold_s, context.elapsed_s, f"holding {angle_rad:.3f} rad: {where}", hold_number)
            if step.return_to_start:
                yield from _go_to(start_rad, speed_rad_per_s, f"returning: {where}")


def _hold_torque(step: steps.HoldTorqueStep) -> StepProgram:
    torque_nm = step.signed_torque_nm
    track = TrackTorque(torque_nm, step.ramp_nm_per_s)
    tolerance_nm = max(TORQUE_TOLERANCE * abs(torque_nm), 1e-3)
    while True:
        context = yield StepCommand(track, activity=f"bringing the torque to {torque_nm:+.3f} N·m")
        if context.torque_nm is None or context.ramp_nm is None:
            continue
        # The hold counts from the end of the ramp. The torque comes within the tolerance before.
        ramped = math.isclose(context.ramp_nm, torque_nm, abs_tol=RAMPED_NM)
        if ramped and abs(context.torque_nm - torque_nm) <= tolerance_nm:
            break
    yield from _wait(track, step.hold_s, context.elapsed_s, f"holding {torque_nm:+.3f} N·m", 1)


def _tighten(step: steps.TightenStep) -> StepProgram:
    start_rad = (yield StepCommand(activity="reading the wrist's angle")).wrist_rad
    sign = SIGNS[step.direction]
    velocity = ConstantVelocity(sign * step.speed_rad_per_s)
    while True:
        activity = f"turning {step.direction} until {step.until_torque_nm:.3f} N·m or {step.until_angle_rad:.2f} rad"
        context = yield StepCommand(velocity, activity=activity)
        # A torque the other way is what the steps before have left.
        if context.torque_nm is not None and sign * context.torque_nm >= step.until_torque_nm:
            return
        if abs(context.wrist_rad - start_rad) >= step.until_angle_rad:
            return
