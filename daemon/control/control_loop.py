"""The control loop: decides at every tick on robot and gripper, from experiment, controllers and safety table.

A plain object without I/O or clock: inputs come in, `ControlOutput` go out, and events report their results.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from shearloop.daemon.control.controller import TwistController, WristCommand
from shearloop.daemon.control.creep import Creep
from shearloop.daemon.control.experiment_schema import (
    ExperimentFile,
    ExperimentLimits,
    IdentifyStep,
    TareStep,
    first_turn_before_grip,
)
from shearloop.daemon.control.fault_detection import LoopInputs, MonitorInputs, compared_for_s, detect_faults
from shearloop.daemon.control.identification import ToolModel
from shearloop.daemon.control.loop_inputs import GripperStatus, LoopConfig, TorqueSample, TorqueSource
from shearloop.daemon.control.safety import Fault, FaultCode, Response, SafetyDecision, SafetyMonitor
from shearloop.daemon.control.step_runner import (
    Action,
    ActionState,
    Experiment,
    ExperimentPhase,
    GripTo,
    Hold,
    StepCommand,
    StepContext,
    TrackTorque,
)
from shearloop.daemon.control.wrist_controller import WristController


@dataclass(frozen=True, slots=True)
class ControlOutput:
    """Commands to the devices; `action` and `release` are set for one tick.

    `hold` interrupts a motion, which continues afterwards; `stop` ends it.
    """

    wrist_rad_per_s: float = 0.0
    stop: bool = False
    hold: bool = False
    action: Action | None = None
    release: bool = False


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
    ) -> None:
        """Take all torque sources by name, the required devices, and the creep of sources that measure shear.

        Each source that measures torque may drive.
        """
        self.inputs = LoopInputs(kept_s=compared_for_s(sources.values(), config))
        self.safety = SafetyMonitor()
        self.experiment: Experiment | None = None
        self.status = LoopStatus("idle", "", WristCommand(), SafetyDecision(Response.NOTE))
        self._wrists = {
            name: WristController(source, config) for name, source in sources.items() if source.measures_torque
        }
        self._config = config
        self._sources = sources
        self._required = required
        self._creep = creep
        self._command = StepCommand()
        # The step whose action has begun.
        self._begun = -1
        self._action_state = ActionState.IDLE
        self._action_error = ""
        # The wrist's angle at the grip.
        self._origin_rad: float | None = None
        # Whether a tool should be between the fingers.
        self._grips = False
        self._released = False
        # Why the gripper did not open after a stop, until the operator acknowledges it.
        self._release_error = ""
        self._refusals: list[Fault] = []

    def on_torque(self, torque: TorqueSample) -> None:
        """Take a torque of any source."""
        creep = self._creep.get(torque.source)
        if creep is not None and torque.torque_nm is not None:
            torque = replace(torque, torque_nm=creep.torque_nm(torque.torque_nm, torque.t_mid_ns))
        self.inputs.add_torque(torque)
        for wrist in self._wrists.values():
            wrist.on_torque(torque)

    def on_gripper(self, gripper: GripperStatus) -> None:
        """Take a state of the gripper, unless it is older than the latest one."""
        known = self.inputs.gripper
        if known is None or gripper.t_ns >= known.t_ns:
            self.inputs.gripper = gripper

    def on_link(self, device: str, sentence: str, *, up: bool) -> None:
        """Take the return or the loss of a device, with a sentence."""
        if up:
            self.inputs.lost.pop(device, None)
        else:
            self.inputs.lost[device] = sentence

    def on_recording_error(self, error: str) -> None:
        """Take the present error of the recording; an empty string ends it."""
        self.inputs.recording_error = error

    def start(self, file: ExperimentFile, t_ns: int) -> str | None:
        """Begin an experiment; return None, or why it cannot begin."""
        if self.experiment is not None and self.experiment.running:
            return f"the experiment {self.experiment.file.name!r} is still running; stop it first"
        if file.torque_source not in self._wrists:
            known = ", ".join(self._wrists)
            return f"`torque_source: {file.torque_source}` is not a measured torque; choose one of {known}"
        if self.safety.stopped:
            return f"a stop has not been acknowledged: {' '.join(self.status.decision.reasons)}"
        refusals = [
            fault.sentence
            for fault in self._faults(file.limits, file.torque_source, t_ns)
            if fault.rule.response >= Response.REFUSE_START
        ]
        if refusals:
            return " ".join(refusals)
        number, hand = first_turn_before_grip(file), self._uncertain_gripper()
        if number is not None and hand is not None:
            turning = f"step {number} ({file.steps[number - 1].do}), which turns the wrist"
            return f"{_uncertain(hand)}; put a `grip` or a `release` before {turning}"
        self.experiment = Experiment(file, t_ns)
        self._begun, self._action_state, self._released = -1, ActionState.IDLE, False
        # Without a gripper of ours the tool is held by other means; with one, it may hold a tool already.
        gripper = self.inputs.gripper
        self._grips = "gripper" not in self._required or (gripper is not None and gripper.holding)
        self._origin_rad = None
        self._command = StepCommand()
        return None

    def pause(self) -> str | None:
        """Stand still until `resume`; return None, or why not."""
        if self.experiment is not None and self.experiment.phase is ExperimentPhase.PAUSED:
            return "the experiment is paused already; `resume` continues it"
        if self.experiment is None or self.experiment.phase is not ExperimentPhase.RUNNING:
            return "no experiment is running"
        self.experiment.pause()
        return None

    def resume(self) -> str | None:
        """Continue after `pause`; return None, or why not."""
        if self.experiment is None or self.experiment.phase is not ExperimentPhase.PAUSED:
            return "no experiment is paused"
        self.experiment.resume()
        return None

    def stop(self, reason: str) -> None:
        """End the experiment and stand still."""
        if self.experiment is not None:
            self.experiment.stop(reason)

    def acknowledge(self) -> None:
        """Clear a stop on the operator's command."""
        self._release_error = ""
        self.safety.acknowledge()

    def on_command_refused(self, sentence: str) -> None:
        """Note a command that a device refused."""
        self._refusals.append(Fault(FaultCode.COMMAND_REFUSED, sentence))

    def on_command_unanswered(self, sentence: str) -> None:
        """Note a command that the robot's process did not answer before its end."""
        self._refusals.append(Fault(FaultCode.COMMAND_UNANSWERED, sentence))

    def on_action_ended(self, error: str = "") -> None:
        """Take the end of the present action, with its error if it failed."""
        self._action_state = ActionState.FAILED if error else ActionState.DONE
        self._action_error = error
        match self._command.action:
            case TareStep() if not error:
                # The tool was identified with another zero.
                self._forget_tool()
            case GripTo() as grip if not error:
                self._on_gripped(grip)
            case _:
                pass

    def on_release_ended(self, error: str = "") -> None:
        """Take the end of the release after a stop, with its error if the gripper did not open."""
        self._release_error = error

    def on_speed_sent(self, wrist_rad_per_s: float) -> None:
        """Take the wrist speed that was sent, after all clipping."""
        if self.experiment is not None:
            self._driving_wrist.on_speed_sent(wrist_rad_per_s)

    def tick(self, t_ns: int) -> ControlOutput:
        """Return the commands for now."""
        experiment, arm = self.experiment, self.inputs.arm
        limits = experiment.limits if experiment is not None else ExperimentLimits()
        drive = experiment.file.torque_source if experiment is not None else next(iter(self._wrists))
        found = [*self._faults(limits, drive, t_ns), *self._refusals]
        self._refusals.clear()
        if self._release_error:
            found.append(Fault(FaultCode.NOT_RELEASED, self._release_error))
        if experiment is None or not experiment.running:
            # Nothing moves: faults are reported, and only a stop of an experiment waits for the operator.
            return self._ended(self.safety.report(found))
        decision = self.safety.judge(found, t_ns)
        if decision.response >= Response.STOP_AND_KEEP_GRIP:
            experiment.stop(" ".join(decision.reasons))
            return self._ended(decision)
        if arm is None:
            return self._ended(decision)
        return self._run_step(experiment, decision, arm.wrist_rad, t_ns)

    @property
    def controller(self) -> TwistController | None:
        """The torque controller while the loop is closed."""
        return self._driving_wrist.controller

    @property
    def tool(self) -> ToolModel | None:
        """The identified tool."""
        return self._driving_wrist.tool

    @property
    def _driving_wrist(self) -> WristController:
        if self.experiment is None:
            return next(iter(self._wrists.values()))
        return self._wrists[self.experiment.file.torque_source]

    def _uncertain_gripper(self) -> GripperStatus | None:
        """Return the gripper's state if it cannot say whether it holds a tool, else None."""
        hand = self.inputs.gripper
        uncertain = "gripper" in self._required and hand is not None and (hand.uncertain or hand.moving)
        return hand if uncertain else None

    def _run_step(self, experiment: Experiment, decision: SafetyDecision, wrist_rad: float, t_ns: int) -> ControlOutput:
        held = decision.response is Response.HOLD
        if self._origin_rad is None:
            self._origin_rad = wrist_rad
        latest = self.inputs.torques.get(experiment.file.torque_source)
        context = StepContext(
            wrist_rad - self._origin_rad,
            latest.torque_nm if latest is not None and not held else None,
            gripped_at_rad=self._origin_rad,
            action=self._action_state,
            action_error=self._action_error,
        )
        experiment.update(context, t_ns, held=held)
        # While the wrist is held, faults still depend on the step's own command.
        self._command = experiment.command
        if not experiment.running:
            return self._ended(decision)
        still = held or experiment.phase is ExperimentPhase.PAUSED
        # A tool that the gripper holds is watched. After a stop, the gripper's doubt may arrive only now.
        if self._turns and not self._grips and (hand := self._uncertain_gripper()) is not None:
            step = f"step {experiment.step_number} ({experiment.step.do}) cannot be done"
            experiment.stop(f"{step}: {_uncertain(hand)}; put a `grip` or a `release` before it")
            return self._ended(decision)
        action = None if still else self._begin(experiment, t_ns, wrist_rad)
        if not experiment.running:
            return self._ended(decision)
        velocity = self._velocity(t_ns, wrist_rad, self._origin_rad, still=still)
        phase = "held" if held else experiment.phase.value
        self.status = LoopStatus(phase, experiment.activity, velocity, decision)
        return ControlOutput(velocity.speed_rad_per_s, hold=still, action=action)

    @property
    def _turns(self) -> bool:
        return not isinstance(self._command.wrist, Hold) or isinstance(self._command.action, IdentifyStep)

    def _begin(self, experiment: Experiment, t_ns: int, wrist_rad: float) -> Action | None:
        """Close the loop or start the identification of a new command; return its action for the devices."""
        command, wrist = self._command, self._driving_wrist
        match command.wrist:
            case TrackTorque() as track if wrist.tracked != track:
                if reason := wrist.close_loop(track, t_ns, wrist_rad, experiment.limits.torque_nm):
                    experiment.stop(f"step {command.step_index + 1} ({experiment.step.do}) cannot be done: {reason}")
                    return None
            case _:
                pass
        if command.action is None:
            self._action_state = ActionState.IDLE
            return None
        if command.step_index == self._begun:
            return None
        self._begun, self._action_state, self._action_error = command.step_index, ActionState.RUNNING, ""
        if isinstance(command.action, IdentifyStep):
            wrist.begin_identification(command.action, experiment.limits.torque_nm)
            return None
        return command.action

    def _velocity(self, t_ns: int, wrist_rad: float, origin_rad: float, *, still: bool) -> WristCommand:
        wrist = self._driving_wrist
        if still:
            return wrist.hold()
        if isinstance(self._command.action, IdentifyStep) and self._action_state is ActionState.RUNNING:
            velocity, ended = wrist.identify(t_ns, wrist_rad)
            if ended is not None:
                self.on_action_ended(ended)
            return velocity
        return wrist.turn(self._command.wrist, t_ns, wrist_rad, origin_rad)

    def _on_gripped(self, grip: GripTo) -> None:
        arm, gripper = self.inputs.arm, self.inputs.gripper
        self._origin_rad = arm.wrist_rad if arm is not None else None
        # An unexpected object is watched as well.
        self._grips = grip.expect_object or (gripper is not None and gripper.holding)
        self._forget_tool()

    def _forget_tool(self) -> None:
        self._driving_wrist.reset()
        for creep in self._creep.values():
            creep.reset()

    def _ended(self, decision: SafetyDecision) -> ControlOutput:
        experiment = self.experiment
        phase = experiment.phase.value if experiment is not None else "idle"
        reason = experiment.stop_reason if experiment is not None else ""
        self.status = LoopStatus(phase, reason, WristCommand(), decision)
        self._command = StepCommand()
        release = decision.response is Response.STOP_AND_RELEASE and not self._released
        self._released |= release
        return ControlOutput(stop=True, release=release)

    def _faults(self, limits: ExperimentLimits, drive: str, t_ns: int) -> list[Fault]:
        experiment, arm = self.experiment, self.inputs.arm
        running = experiment is not None and experiment.running
        paused = experiment is not None and experiment.phase is ExperimentPhase.PAUSED
        twisted_rad = 0.0
        if arm is not None and self._origin_rad is not None:
            twisted_rad = arm.wrist_rad - self._origin_rad
        gripped = running and self._grips and not isinstance(self._command.action, GripTo)
        controller = self.controller
        watched = MonitorInputs(
            driving=self._sources[drive],
            supervising=tuple(source for name, source in self._sources.items() if name != drive),
            limits=limits,
            torque_needed=gripped and self._turns and not paused,
            gripped=gripped,
            twisted_rad=twisted_rad,
            expected_nm=controller.torque_nm if running and controller is not None else None,
            overdue=experiment.overdue if running and experiment is not None else "",
            required=self._required,
        )
        return detect_faults(self.inputs, watched, self._config, t_ns)


def _uncertain(gripper: GripperStatus) -> str:
    return (
        "the gripper does not say whether it holds a tool: its fingers, "
        f"{gripper.width_mm:.1f} mm apart, {gripper.uncertainty}"
    )
