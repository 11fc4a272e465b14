"""The control loop: decides at every tick on robot and gripper, from experiment, controllers and safety table.

A plain object without I/O or clock: it takes inputs and events, and returns a `ControlOutput` at each tick.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeAlias

from shearloop.daemon.control.creep import Creep
from shearloop.daemon.control.experiment import Action, Experiment, ExperimentPhase, StepCommand, TrackTorque
from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ExperimentFile,
    ExperimentLimits,
    GripStep,
    IdentifyStep,
    TareStep,
    TurnToStep,
)
from shearloop.daemon.control.fault_detection import (
    LONGEST_HANG_S,
    Grasp,
    RunningStep,
    Watched,
    compared_for_s,
    detect_faults,
)
from shearloop.daemon.control.faults import Fault, FaultCode, Response
from shearloop.daemon.control.held_tool import HeldTool
from shearloop.daemon.control.inputs import ArmStatus, GripperStatus, LatestInputs
from shearloop.daemon.control.operator_view import OperatorView
from shearloop.daemon.control.safety import SafetyDecision, SafetyMonitor
from shearloop.daemon.control.step_motions import Speeds, first_gripper_step, needs_torque
from shearloop.daemon.control.torque_controller import WristCommand
from shearloop.daemon.control.wrist_controller import Compute, WristController, at_once
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import TorqueSample, TorqueSource, beyond_noise

# An `adapt` step compares the fingertip with the torques of this time.
ADAPTED_OVER_S = 600.0
NO_ANGLE = "the controller reports no angle of the wrist"
# Torques are reported as beyond these before the first experiment.
DEFAULT_LIMITS = ExperimentLimits()


@dataclass(frozen=True, slots=True)
class Drive:
    """The wrist turns at a speed, and a straight move continues; `action` begins in this tick."""

    rad_per_s: float
    action: Action | None = None


@dataclass(frozen=True, slots=True)
class StandStill:
    """The wrist stands, and a straight move is interrupted until the next `Drive`."""


@dataclass(frozen=True, slots=True)
class End:
    """Motion and action end; `release`: then the gripper opens, which one tick of a stop asks for."""

    release: bool = False


# What the control loop decides in a tick: to drive, to stand still, or to end all motion.
ControlOutput: TypeAlias = Drive | StandStill | End


@dataclass(frozen=True, slots=True)
class _Tick:
    """The facts of one tick while an experiment may move something."""

    t_ns: int
    wrist_rad: float
    # The torques that a turn of the tool waits for, in words; empty for none.
    awaited: str
    # Whether a fault holds the wrist and the experiment's clock.
    on_hold: bool


@dataclass(frozen=True, slots=True)
class LoopStatus:
    """State of the loop, for `loop.state`."""

    phase: str
    activity: str
    velocity: WristCommand
    decision: SafetyDecision


class ControlLoop:
    """One closed loop: one arm, one gripper, and one of several torques that drives."""

    def __init__(
        self,
        config: LoopConfig,
        sources: Mapping[str, TorqueSource],
        required: tuple[str, ...],
        creep: Mapping[str, Creep] = MappingProxyType({}),
        dead_tasks: Mapping[str, str] = MappingProxyType({}),
        patience: float = 1.0,
        compute: Compute = at_once,
    ) -> None:
        """Take all torque sources by name, the required devices, and the creep of sources that measure shear.

        Each source that measures torque may drive. `dead_tasks` has the error of each task that is dead at present.
        `patience` is the factor on the deadlines, above 1 on an emulated rig alone. `compute` begins a computation that
        would make the loop late.
        """
        sources = {name: replace(source, min_fresh_s=config.stale_after_s) for name, source in sources.items()}
        kept_s = max(ADAPTED_OVER_S, compared_for_s(sources.values()))
        self.inputs = LatestInputs(kept_s=kept_s, died=dead_tasks)
        self.safety = SafetyMonitor(patience)
        self.experiment: Experiment | None = None
        # The diameter that the latest experiment states, while it runs and as long as the gripper may hold its tool. It
        # is kept across a restart.
        self.stated_tool_mm: float | None = None
        # How many experiments have begun.
        self.runs = 0
        self.status = LoopStatus("idle", "", WristCommand(), SafetyDecision(Response.NOTE))
        self.config = config
        self.sources = sources
        self._creep = creep
        self._wrists = {
            name: WristController(source, config, compute) for name, source in sources.items() if source.measures_torque
        }
        # The wrist's controller for the driving torque, and what is watched with it.
        self.wrist = next(iter(self._wrists.values()))
        self._watched = Watched(
            driving=self.wrist.source,
            supervising=self._others(self.wrist.source),
            config=config,
            required=required,
            patience=patience,
        )
        self.tool = HeldTool(self.inputs, has_gripper="gripper" in required)
        # When the latest grip, release or tare ended, until each torque has been measured since, or should have been.
        self._unmeasured_since_ns: int | None = None
        # By source: whether its zero is known, which was taken since this process began or is kept from an earlier one.
        # It is not known once it was lost, or asked for and not taken; a source without an entry had neither.
        self._zero_known: dict[str, bool] = {}
        # Faults that were reported since the latest tick.
        self._reported: list[Fault] = []
        self.operator = OperatorView(
            self.inputs,
            self.tool,
            self.safety,
            sources,
            self._zero_known,
            running_experiment=lambda: self.running_experiment,
        )

    @property
    def warm_up_s(self) -> float:
        """The longest time from a grip to the first torque of a source."""
        return max((one.warm_up_s for one in self.sources.values() if one.measures_torque), default=0.0)

    @property
    def running_experiment(self) -> Experiment | None:
        """The experiment while it may still move something."""
        return self.experiment if self.experiment is not None and self.experiment.running else None

    @property
    def stated_tool_note(self) -> str:
        """How the widths by the maker's figures differ from the stated diameter; empty where they do not."""
        running = self.running_experiment
        first = first_gripper_step(running.file) if running is not None else None
        if running is not None and first is not None and running.step_number <= first[0]:
            # The fingers may still hold the tool of before.
            return ""
        return self.tool.why_not_stated(self.stated_tool_mm)

    def on_torque(self, torque: TorqueSample) -> None:
        """Accept a torque sample from any source."""
        creep = self._creep.get(torque.source)
        if creep is not None and torque.torque_nm is not None:
            torque = replace(torque, torque_nm=creep.torque_nm(torque.torque_nm, torque.t_mid_ns))
        self.inputs.add_torque(torque)
        if (wrist := self._wrists.get(torque.source)) is not None:
            wrist.on_torque(torque)

    def on_zero(self, source: str, *, known: bool = True) -> None:
        """Take that a source's zero is known from now on, or is not."""
        self._zero_known[source] = known

    def on_restored_zero(self, source: str) -> None:
        """Take that an earlier process's zero is of the present grip, unless it was lost since then."""
        self._zero_known.setdefault(source, True)

    def torques_of(self, source: str) -> tuple[Sequence[int], Sequence[float]]:
        """Return the valid torques of a source that are kept: times of measurement in ns, ascending, and N·m.

        Torques within the source's noise are as in `beyond_noise`.
        """
        times_ns, torques_nm = self.inputs.history.get(source, ([], []))
        noise_nm = self.sources[source].noise_nm if source in self.sources else 0.0
        return times_ns, beyond_noise(times_ns, torques_nm, noise_nm)

    def on_arm(self, arm: ArmStatus) -> None:
        """Take a state of the robot; one without an angle stops the arm, and the last angle stays."""
        if not math.isfinite(arm.wrist_rad):
            known = self.inputs.arm or arm
            arm = replace(arm, wrist_rad=known.wrist_rad, blocked=arm.blocked or NO_ANGLE)
        self.inputs.arm = arm

    def on_gripper(self, gripper: GripperStatus) -> None:
        """Take a state of the gripper, unless it is older than the latest one."""
        known = self.inputs.gripper
        if known is None or gripper.t_ns >= known.t_ns:
            self.inputs.gripper, before = gripper, self.tool.another
            self.tool.on_gripper(gripper, judges=self.running_experiment is None)
            if self.tool.another not in ("", before):
                self.stated_tool_mm = None

    def on_link(self, device: str, sentence: str, *, up: bool) -> None:
        """Take the return or the loss of a device, with a sentence."""
        if up:
            self.inputs.lost.pop(device, None)
        else:
            self.inputs.lost[device] = sentence
            # A device that was unplugged or switched off may return with another zero.
            for name, source in self.sources.items():
                if name == device or (source.from_robot and device == "robot"):
                    self.on_zero(name, known=False)

    def on_recording_error(self, error: str) -> None:
        """Take the present error of the recording; an empty string ends it."""
        self.inputs.recording_error = error

    def on_fault(self, code: FaultCode, detail: str) -> None:
        """Take a fault that no input shows, for the next tick."""
        self._reported.append(Fault(code, detail))

    def on_action_ended(self, error: str | None = None) -> None:
        """Take the end of the present action, and why it failed, if it did."""
        experiment, arm = self.experiment, self.inputs.arm
        action = experiment.command.action if experiment is not None else None
        if experiment is None or not experiment.end_action(error):
            return
        if error:
            self.safety.stop(Fault(FaultCode.STEP_FAILED, experiment.stop_reason))
            return
        if isinstance(action, AdaptStep) and action.fingertip == self.wrist.source.name:
            # The stiffness was identified with another gain.
            self.wrist.reset()
        if not isinstance(action, TareStep | GripStep):
            return
        if isinstance(action, TareStep):
            for name, source in self.sources.items():
                if source.from_robot:
                    self.on_zero(name)
        # The tool was identified with another zero, or in another grip.
        self._forget_tool()
        self._unmeasured_since_ns = arm.t_ns if arm is not None else None
        if isinstance(action, GripStep):
            self.tool.on_grip_ended(action)

    def has_zero(self, source: str) -> bool:
        """Return whether a source's zero was taken since this process began, or is kept from the one before."""
        return self._zero_known.get(source, False)

    def start_refusal(self) -> str | None:
        """Return why no experiment at all can begin, by the latest tick, or None.

        Whether a torque is too large depends on the experiment.
        """
        if (reason := self.operator.start_refusal()) is not None:
            return reason
        found = detect_faults(self.inputs, self._watched, DEFAULT_LIMITS, None, self.inputs.ticked_ns)
        of_any = [fault for fault in self._lasting(found) if fault.code is not FaultCode.TORQUE_LIMIT]
        return self._refusal_by(of_any, self.inputs.ticked_ns) or self._awaited_judgement()

    def refusal_of(
        self, file: ExperimentFile, t_ns: int, *, confirmed: bool = False, is_enabled: bool = True
    ) -> str | None:
        """Return why an experiment cannot begin, or None; `confirmed`: a held tool may drop.

        `is_enabled`: the arm has been enabled for the experiment. Else it will be, and what that ends refuses nothing.
        """
        if (reason := self.operator.start_refusal()) is not None:
            return reason
        found = detect_faults(self.inputs, self._watched, file.limits, None, t_ns)
        faults = found if is_enabled else self._lasting(found)
        reason = self._refusal_by(faults, t_ns) or self.operator.why_not_begun(file)
        if reason := reason or self._awaited_judgement():
            return reason
        if not confirmed and (drops := self.operator.drop_sentence(file)):
            return f"{drops}; secure it, then send the same command with `--yes`"
        return None

    def start(self, file: ExperimentFile, t_ns: int, *, confirmed: bool = False) -> str | None:
        """Begin an experiment; return None, or why it cannot begin; `confirmed` is as in `refusal_of`."""
        if self.running_experiment is None and self.inputs.gripper is not None:
            # Requests of other programs before the start are no fault of this experiment.
            self.tool.judge(self.inputs.gripper)
        if (reason := self.refusal_of(file, t_ns, confirmed=confirmed)) is not None:
            return reason
        self.wrist = self._wrist_of(file)
        driving, speeds = self.wrist.source, Speeds(wrist_rad_per_s=self.config.wrist_speed_rad_per_s)
        self.experiment = Experiment(file, t_ns, speeds, self.operator.known_tool())
        self._watched = replace(self._watched, driving=driving, supervising=self._others(driving))
        self.stated_tool_mm = file.tool_mm
        # What the last experiment knew of the tool may be wrong by now.
        self.wrist.reset()
        self.tool.begin_experiment()
        self._unmeasured_since_ns = t_ns
        self.safety.begin_experiment()
        self.runs += 1
        # Until the first tick, the status must not show the end of the previous run.
        phase, activity = self.experiment.phase.value, self.experiment.command.activity
        self.status = LoopStatus(phase, activity, WristCommand(), SafetyDecision(Response.NOTE))
        return None

    def _wrist_of(self, file: ExperimentFile) -> WristController:
        """Return the wrist's controller; an experiment that needs no torque may name a source without one."""
        name = file.torque_source
        if name not in self._wrists and not needs_torque(file, has_gripper=self.tool.has_gripper):
            name = next(iter(self._wrists))
        return self._wrists[name]

    def pause(self) -> str | None:
        """Stand still until `resume`; return None, or why not."""
        return self.experiment.pause() if self.experiment is not None else "no experiment is running"

    @property
    def longest_hang_s(self) -> float:
        """For how long the loop may decide nothing without a stop that waits for an acknowledgement."""
        return self._watched.patience * LONGEST_HANG_S

    def resume(self) -> str | None:
        """Continue after `pause`; return None, or why not."""
        return self.experiment.resume() if self.experiment is not None else "no experiment is paused"

    def stop(self, fault: Fault) -> None:
        """End the experiment, if one runs, and stand still until the operator acknowledges the stop."""
        self.safety.stop(fault)
        if self.running_experiment is not None:
            self.running_experiment.stop(fault.cause)

    def acknowledge(self) -> None:
        """Clear a stop on the operator's command."""
        self.tool.release_error = None
        self.safety.acknowledge()

    def tick(self, t_ns: int, late_s: float = 0.0, sent_rad_per_s: float | None = None) -> ControlOutput:
        """Return the commands for now; the loop is `late_s` late.

        `sent_rad_per_s` is the wrist speed that the worker accepted last, None while it has not answered.
        """
        if sent_rad_per_s is not None:
            self.wrist.sent(sent_rad_per_s)
        running, arm = self.running_experiment, self.inputs.arm
        self.inputs.begin_tick(t_ns, late_s)
        limits = self.experiment.limits if self.experiment is not None else DEFAULT_LIMITS
        awaited = self._awaited_torques(t_ns)
        step = self._running_step(running, awaited) if running is not None else None
        found = [*detect_faults(self.inputs, self._watched, limits, step, t_ns), *self._reported]
        self._reported.clear()
        self.inputs.unjudged.clear()
        if self.tool.release_error is not None:
            found.append(Fault(FaultCode.NOT_RELEASED, self.tool.release_error))
        if running is None:
            if not self.tool.may_hold():
                self.stated_tool_mm = None
            # Nothing moves: faults are reported, and only a stop of an experiment waits for the operator.
            return self._ended(self.safety.report(self._at_rest(found)))
        decision = self.safety.judge(found, t_ns)
        if decision.response >= Response.STOP_AND_KEEP_GRIP:
            running.stop(" ".join(decision.reasons))
        if arm is None or decision.response >= Response.STOP_AND_KEEP_GRIP:
            return self._ended(decision)
        tick = _Tick(t_ns, arm.wrist_rad, awaited, on_hold=decision.response is Response.HOLD)
        return self._run_step(running, decision, tick)

    def _running_step(self, running: Experiment, awaited: str) -> RunningStep:
        """Return what the experiment needs and expects; `awaited` are the torques that a turn waits for."""
        command, controller = running.command, self.wrist.controller
        grasp = self._grasp(command)
        needed = grasp.may_hold and command.turns and not awaited
        runs = running.phase is ExperimentPhase.RUNNING
        return RunningStep(
            torque_needed=needed and runs,
            lacks_zero=self._lacks_zero(running),
            grasp=grasp,
            twisted_rad=self.tool.twisted_rad,
            expected_nm=controller.torque_nm if controller is not None else None,
            not_following=controller.filter.not_following if controller is not None and runs else "",
            overdue=running.overdue,
            others_requests=self.tool.others_requests,
        )

    def _lacks_zero(self, running: Experiment) -> bool:
        """Return whether the present step needs a zero of the driving torque, and it is not known.

        As at the start, a `turn_to` of a clamped tool needs none: it is the way to turn the tool back.
        """
        driving = self.wrist.source
        turns_back = isinstance(running.step, TurnToStep) and not self.tool.has_gripper
        return driving.needs_zero and not turns_back and not self.has_zero(driving.name)

    def _grasp(self, command: StepCommand) -> Grasp:
        if isinstance(command.action, GripStep):
            return Grasp.CHANGING
        if self.tool.expected:
            return Grasp.HELD
        return Grasp.POSSIBLE if self.tool.may_turn else Grasp.NONE

    def _at_rest(self, found: Sequence[Fault]) -> list[Fault]:
        """Return the faults while no experiment runs, with what the operator should know of a held tool."""
        faults = list(found)
        if self.safety.waiting is not None and (held := self.tool.gripped_tool) is not None:
            is_held = self.tool.held is not None
            faults.append(Fault(FaultCode.TOOL_GRIPPED if is_held else FaultCode.TOOL_MAY_BE_GRIPPED, held))
        if unknown := self.tool.unknown_grip:
            faults.append(Fault(FaultCode.GRIP_UNKNOWN, unknown))
        return self._unless_enabled_by_start(faults)

    def _unless_enabled_by_start(self, faults: Sequence[Fault]) -> list[Fault]:
        """Return the faults without the block of an arm that the start of an experiment enables."""
        arm = self.inputs.arm
        enabled = arm is not None and arm.enabled_by_start
        return [fault for fault in faults if not (enabled and fault.code is FaultCode.ROBOT_BLOCKED)]

    def _lasting(self, faults: Sequence[Fault]) -> list[Fault]:
        """Return the faults that remain once the arm is enabled: a pause of the loop is over by then."""
        return [fault for fault in self._unless_enabled_by_start(faults) if not fault.rule.is_past]

    def _awaited_judgement(self) -> str | None:
        """Return why the gripper cannot yet say whether it has an earlier daemon's grip, or None."""
        if self.tool.awaits_judgement:
            return "the fingers move, and an earlier daemon had gripped a tool: wait until they stand still"
        return None

    def _others(self, driving: TorqueSource) -> tuple[TorqueSource, ...]:
        return tuple(source for source in self.sources.values() if source is not driving)

    def _run_step(self, experiment: Experiment, decision: SafetyDecision, tick: _Tick) -> ControlOutput:
        """Let the experiment choose its command, and the wrist's controller a speed."""
        self._choose_command(experiment, tick)
        turns = experiment.command.turns
        waits = turns and bool(tick.awaited)
        if turns and not waits and self.tool.may_turn:
            # From the first turn on, a torque that does not come is a fault.
            self._unmeasured_since_ns = None
        action, velocity = None, WristCommand()
        stands = tick.on_hold or waits or experiment.phase is ExperimentPhase.PAUSED
        if stands:
            self.wrist.stand_still()
        else:
            action = self._begin_command(experiment, tick)
            if experiment.running:
                velocity = self._wrist_command(experiment, tick)
        if not experiment.running:
            return self._ended(self.safety.report(decision.faults))
        phase = "held" if tick.on_hold else experiment.phase.value
        activity = tick.awaited if waits else experiment.command.activity
        self.status = LoopStatus(phase, activity, velocity, decision)
        return StandStill() if stands else Drive(velocity.speed_rad_per_s, action)

    def _choose_command(self, experiment: Experiment, tick: _Tick) -> None:
        """Let the experiment choose its command; it ends if it would turn a tool that may be in the gripper."""
        latest = self.inputs.torques.get(self.wrist.source.name)
        torque_nm = latest.torque_nm if latest is not None and not tick.on_hold else None
        gripped_at_rad = self.tool.count_angle(tick.wrist_rad)
        clock_stands = tick.on_hold or (experiment.command.turns and bool(tick.awaited))
        experiment.update(
            tick.t_ns,
            tick.wrist_rad,
            torque_nm,
            ramp_nm=self.wrist.ramp_nm,
            gripped_at_rad=gripped_at_rad,
            clock_stands=clock_stands,
        )
        # After a stop, the gripper's doubt may arrive only now. A `grip` that may meet nothing allows turns, although a
        # tool as wide as its target is not felt: it is watched like a held one.
        gripper = self.inputs.gripper
        unfelt = gripper is not None and gripper.unfelt
        if experiment.command.turns and not (self.tool.expected or unfelt) and (uncertain := self.tool.uncertain):
            self._fail(experiment, f"{uncertain}; put a `grip` or a `release` before it")

    def _begin_command(self, experiment: Experiment, tick: _Tick) -> Action | None:
        """Begin what the command asks for, and return the action of the devices that begins now, or None.

        A command that cannot be done ends the experiment.
        """
        command = experiment.command
        if isinstance(command.wrist, TrackTorque):
            reason = self.wrist.close_loop(command.wrist, tick.t_ns, tick.wrist_rad)
            if reason is not None:
                self._fail(experiment, reason)
        if not experiment.running or command.action is None or not experiment.begin_action():
            return None
        match command.action:
            case TareStep() if (reason := self.operator.why_no_tare_step()) is not None:
                self._fail(experiment, reason)
                return None
            case IdentifyStep() if self.tool.is_empty:
                self._fail(experiment, "the gripper holds nothing to identify; put a `grip` before it")
                return None
            case GripStep() as grip:
                self.tool.begin_grip(grip)
            case IdentifyStep() as identify:
                self.wrist.begin_identification(identify, experiment.limits.torque_nm)
                return None
        return command.action

    def _wrist_command(self, experiment: Experiment, tick: _Tick) -> WristCommand:
        """Return how the wrist turns for the command; the end of an identification begins the next step."""
        command = experiment.command
        if isinstance(command.action, IdentifyStep) and (excitation := self.wrist.excitation) is not None:
            velocity = self.wrist.identify(excitation, tick.t_ns, tick.wrist_rad)
            if excitation.done:
                self.on_action_ended(excitation.failure)
            return velocity
        return self.wrist.turn(command.wrist, tick.t_ns, tick.wrist_rad)

    def _awaited_torques(self, t_ns: int) -> str:
        """Return in words which torques the next turn of the tool waits for after a grip or a tare; empty for none.

        An estimator needs some frames of the new grip; a source without a torque after its `warm_up_s` is a fault.
        """
        since_ns = self._unmeasured_since_ns
        if since_ns is None or not self.tool.may_turn:
            return ""
        awaited, reason = [], ""
        for name, source in self.sources.items():
            latest = self.inputs.torques.get(name)
            measured = latest is not None and latest.torque_nm is not None and latest.t_mid_ns >= since_ns
            due = t_ns - since_ns < source.warm_up_s * 1e9 and name not in self.inputs.lost
            if due and source.measures_torque and not measured:
                awaited.append(name)
                reason = latest.reason if latest is not None else ""
        if not awaited:
            return ""
        return f"waiting for the first torque of {', '.join(awaited)}{f': {reason}' if reason else ''}"

    def _fail(self, experiment: Experiment, reason: str) -> None:
        """End an experiment with a step that cannot be done; the stop waits for the operator, as each stop does."""
        experiment.fail(reason)
        self.safety.stop(Fault(FaultCode.STEP_FAILED, experiment.stop_reason))

    def _forget_tool(self) -> None:
        self.wrist.reset()
        for creep in self._creep.values():
            creep.reset()

    def _ended(self, decision: SafetyDecision) -> End:
        phase = self.experiment.phase.value if self.experiment is not None else "idle"
        self.status = LoopStatus(phase, self._why_ended(), WristCommand(), decision)
        return End(self.safety.release_once())

    def _why_ended(self) -> str:
        """Return why nothing moves, for the status; empty if nothing was stopped."""
        experiment, stop = self.experiment, self.safety.waiting
        if stop is not None and stop.asked_for:
            return stop.asked_for
        if experiment is None:
            return ""
        acknowledged = self.safety.acknowledged
        if experiment.phase is ExperimentPhase.STOPPED and stop is None and acknowledged is not None:
            return f"the stop is acknowledged; its cause was: {acknowledged.causes}"
        return experiment.stop_reason

    def _refusal_by(self, faults: Sequence[Fault], t_ns: int) -> str | None:
        """Return the sentences of the faults in whose presence no experiment starts, or None."""
        refusing = [fault for fault in faults if fault.rule.response >= Response.REFUSE_START]
        return self.inputs.why_refused(refusing, t_ns)
