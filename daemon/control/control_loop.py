"""Decides, at every tick, what robot and gripper are told: experiment, controller and safety table in one place.

A plain object without I/O or clock. Senses go in, `ControlOutput` come out; what the orders led to is told back.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from shearloop.daemon.control.controller import TwistController
from shearloop.daemon.control.creep import Creep
from shearloop.daemon.control.experiment_schema import ExperimentFile, ExperimentLimits, turns_before_a_grip
from shearloop.daemon.control.fault_detection import MonitorInputs, MonitorSettings, compared_for_s, troubles
from shearloop.daemon.control.identify import ToolModel
from shearloop.daemon.control.loop_inputs import GripperStatus, LoopInputs, TorqueSample, TorqueSource
from shearloop.daemon.control.safety import Fault, FaultCode, Response, SafetyDecision, SafetyMonitor
from shearloop.daemon.control.step_commands import (
    Action,
    ActionState,
    GripTo,
    Hold,
    IdentifyStiffness,
    StepCommand,
    StepContext,
    Tare,
    TrackTorque,
)
from shearloop.daemon.control.step_runner import Experiment, ExperimentPhase
from shearloop.daemon.control.wrist_controller import WristController, WristVelocity

# Of no experiment; made once, for it is asked for at every tick.
NO_LIMITS = ExperimentLimits()


@dataclass(frozen=True, slots=True)
class ControlOutput:
    """What is to be told to the devices now; `begin` and `release` are for this tick alone.

    `hold` is not the end as `stop` is: whatever moves the arm brakes, and goes on afterwards.
    """

    wrist_rad_per_s: float = 0.0
    stop: bool = False
    hold: bool = False
    begin: Action | None = None
    release: bool = False


@dataclass(frozen=True, slots=True)
class LoopStatus:
    """Where the loop stands, for `loop.state`."""

    phase: str
    doing: str
    turn: WristVelocity
    verdict: SafetyDecision


class ControlLoop:
    """One closed loop: one arm, one hand, torques of which one drives."""

    def __init__(
        self,
        wrists: dict[str, WristController],
        watch: MonitorSettings,
        supervisors: dict[str, TorqueSource],
        required: tuple[str, ...],
        creep: Mapping[str, Creep] = MappingProxyType({}),
    ) -> None:
        """Take a wrist for each source that may drive, all sources by name, and the devices that must be there.

        `creep` tells of the sources that see a gel's shear and not its torque.
        """
        self.senses = LoopInputs(kept_s=compared_for_s(supervisors.values(), watch))
        self.gate = SafetyMonitor()
        self.experiment: Experiment | None = None
        self.standing = LoopStatus("idle", "", WristVelocity(), SafetyDecision(Response.NOTE))
        self._wrists = wrists
        self._watch = watch
        self._sources = supervisors
        # Of each that may drive, the others, which supervise it.
        self._others = {
            drive: tuple(source for name, source in supervisors.items() if name != drive) for drive in supervisors
        }
        self._required = required
        self._creep = creep
        self._wish = StepCommand()
        self._begun = -1
        self._action = ActionState.IDLE
        self._failure = ""
        self._origin_rad: float | None = None
        # Whether a tool is meant to be between the fingers.
        self._grips = False
        self._released = False
        # Why the gripper did not open when a stop asked for it, until the operator has seen to it.
        self._unreleased = ""
        self._notes: list[Fault] = []

    def hear(self, torque: TorqueSample) -> None:
        """Take in a torque of any source."""
        creep = self._creep.get(torque.source)
        if creep is not None and torque.torque_nm is not None:
            torque = replace(torque, torque_nm=creep.torque_nm(torque.torque_nm, torque.t_mid_ns))
        self.senses.hear(torque)
        for wrist in self._wrists.values():
            wrist.hear(torque)

    def start(self, file: ExperimentFile, t_ns: int) -> str | None:
        """Begin an experiment, or return why it cannot be begun."""
        if self.experiment is not None and self.experiment.running:
            return f"the experiment {self.experiment.file.name!r} is still running; stop it first"
        if file.drive not in self._wrists:
            return f"`drive: {file.drive}` is none of the torques that are measured: {', '.join(self._wrists)}"
        if self.gate.stopped:
            return f"a stop has not been acknowledged: {' '.join(self.standing.verdict.reasons)}"
        against = [
            trouble.sentence
            for trouble in self._troubles(file.limits, file.drive, t_ns)
            if trouble.rule.response >= Response.REFUSE_START
        ]
        if against:
            return " ".join(against)
        if why := self._may_hold_unknown(file):
            return why
        self.experiment = Experiment(file, t_ns)
        self._begun, self._action, self._released = -1, ActionState.IDLE, False
        # Without a gripper of ours, somebody else holds the tool; with one, it may hold it already.
        hand = self.senses.hand
        self._grips = "gripper" not in self._required or (hand is not None and hand.holding)
        self._origin_rad = None
        self._wish = StepCommand()
        return None

    def _may_hold_unknown(self, file: ExperimentFile) -> str:
        """Return why an experiment may turn a tool that nobody knows of and nothing would watch, or an empty text."""
        number, hand = turns_before_a_grip(file), self._unknown_hand()
        if number is None or hand is None:
            return ""
        return (
            f"the gripper does not say whether it holds a tool: its fingers, {hand.width_mm:.1f} mm apart, "
            f"{hand.stands}; put a `grip` or a `release` before step {number} ({file.steps[number - 1].do}), which "
            "turns the wrist"
        )

    def _unknown_hand(self) -> GripperStatus | None:
        """Return the hand where it does not say whether it holds a tool, else None."""
        hand = self.senses.hand
        return hand if "gripper" in self._required and hand is not None and (hand.unsure or hand.moving) else None

    def pause(self) -> str | None:
        """Stand still until `resume`, or return why not."""
        if self.experiment is not None and self.experiment.phase is ExperimentPhase.PAUSED:
            return "the experiment is paused already; `resume` goes on with it"
        if self.experiment is None or self.experiment.phase is not ExperimentPhase.RUNNING:
            return "no experiment is running"
        self.experiment.pause()
        return None

    def resume(self) -> str | None:
        """Go on after `pause`, or return why not."""
        if self.experiment is None or self.experiment.phase is not ExperimentPhase.PAUSED:
            return "no experiment is paused"
        self.experiment.resume()
        return None

    def stop(self, why: str) -> None:
        """End the experiment and stand still."""
        if self.experiment is not None:
            self.experiment.stop(why)

    def acknowledge(self) -> None:
        """Let a stop go, on the operator's word."""
        self._unreleased = ""
        self.gate.acknowledge()

    def note_refusal(self, sentence: str) -> None:
        """Tell of a command that a device refused."""
        self._notes.append(Fault(FaultCode.COMMAND_REFUSED, sentence))

    def note_unanswered(self, sentence: str) -> None:
        """Tell of a command of the loop's own that the robot's process, which has ended, did not answer."""
        self._notes.append(Fault(FaultCode.COMMAND_UNANSWERED, sentence))

    def action_ended(self, failure: str = "") -> None:
        """Tell that the action that was begun has ended, well or with a reason."""
        self._action = ActionState.FAILED if failure else ActionState.DONE
        self._failure = failure
        match self._wish.action:
            case Tare() if not failure:
                # Whatever was learnt of the tool was learnt from another zero.
                self._driving_wrist.forget()
                self._rest_gels()
            case GripTo() as grip if not failure:
                self._gripped(grip)
            case _:
                pass

    def release_ended(self, failure: str = "") -> None:
        """Tell that the gripper has opened after a stop, or why it has not."""
        self._unreleased = failure

    def sent(self, wrist_rad_per_s: float) -> None:
        """Tell what wrist speed was really sent, after all clipping."""
        if self.experiment is not None:
            self._driving_wrist.sent(wrist_rad_per_s)

    def tick(self, t_ns: int) -> ControlOutput:
        """Return what is to be done now."""
        experiment, arm = self.experiment, self.senses.arm
        limits = experiment.limits if experiment is not None else NO_LIMITS
        drive = experiment.file.drive if experiment is not None else next(iter(self._wrists))
        found = [*self._troubles(limits, drive, t_ns), *self._notes]
        self._notes.clear()
        if self._unreleased:
            found.append(Fault(FaultCode.NOT_RELEASED, self._unreleased))
        if experiment is None or not experiment.running:
            # Nothing moves: what is wrong is told, and only what stopped an experiment waits for the operator.
            return self._ended(self.gate.look(found))
        verdict = self.gate.judge(found, t_ns)
        if verdict.response >= Response.STOP_AND_KEEP_GRIP:
            experiment.stop(" ".join(verdict.reasons))
            return self._ended(verdict)
        if arm is None:
            return self._ended(verdict)
        return self._carry_on(experiment, verdict, arm.wrist_rad, t_ns)

    @property
    def controller(self) -> TwistController | None:
        """Return the controller while a loop is closed."""
        return self._driving_wrist.controller

    @property
    def identified(self) -> ToolModel | None:
        """Return what is known of the tool in the grip."""
        return self._driving_wrist.identified

    @property
    def _driving_wrist(self) -> WristController:
        if self.experiment is None:
            return next(iter(self._wrists.values()))
        return self._wrists[self.experiment.file.drive]

    def _carry_on(self, experiment: Experiment, verdict: SafetyDecision, wrist_rad: float, t_ns: int) -> ControlOutput:
        held = verdict.response is Response.HOLD
        if self._origin_rad is None:
            self._origin_rad = wrist_rad
        latest = self.senses.torques.get(experiment.file.drive)
        view = StepContext(
            wrist_rad - self._origin_rad,
            latest.torque_nm if latest is not None and not held else None,
            gripped_at_rad=self._origin_rad,
            action=self._action,
            failure=self._failure,
        )
        experiment.update(view, t_ns, held=held)
        # What is held back is still what the torque is needed for.
        self._wish = experiment.wish
        if not experiment.running:
            return self._ended(verdict)
        still = held or experiment.phase is ExperimentPhase.PAUSED
        turns = not isinstance(self._wish.wrist, Hold) or isinstance(self._wish.action, IdentifyStiffness)
        # What is held is watched for being lost; of a stop that came just before, the gripper may tell only now.
        if turns and not self._grips and (hand := self._unknown_hand()) is not None:
            experiment.stop(
                f"step {experiment.number} ({experiment.step.do}) cannot be done: the gripper does not say whether it "
                f"holds a tool: its fingers, {hand.width_mm:.1f} mm apart, {hand.stands}; put a `grip` or a `release` "
                "before it"
            )
            return self._ended(verdict)
        begin = None if still else self._begin(experiment, t_ns, wrist_rad)
        if not experiment.running:
            return self._ended(verdict)
        turn = self._turn(t_ns, wrist_rad, still=still)
        phase = "held" if held else experiment.phase.value
        self.standing = LoopStatus(phase, experiment.doing, turn, verdict)
        return ControlOutput(turn.speed_rad_per_s, hold=still, begin=begin)

    def _begin(self, experiment: Experiment, t_ns: int, wrist_rad: float) -> Action | None:
        """Begin what the wish asks for the first time: an action of the devices, an identification, a closed loop."""
        wish, wrist = self._wish, self._driving_wrist
        match wish.wrist:
            case TrackTorque() as track if wrist.tracks != track:
                why = wrist.refuses(track, experiment.limits.torque_nm)
                if why:
                    experiment.stop(f"step {wish.number + 1} ({experiment.step.do}) cannot be done: {why}")
                    return None
                wrist.begin_tracking(track, t_ns, wrist_rad, experiment.limits.torque_nm)
            case _:
                pass
        if wish.action is None:
            self._action = ActionState.IDLE
            return None
        if wish.number == self._begun:
            return None
        self._begun, self._action, self._failure = wish.number, ActionState.RUNNING, ""
        if isinstance(wish.action, IdentifyStiffness):
            wrist.begin_measuring(wish.action, experiment.limits.torque_nm)
            return None
        return wish.action

    def _turn(self, t_ns: int, wrist_rad: float, *, still: bool) -> WristVelocity:
        wrist, origin_rad = self._driving_wrist, self._origin_rad
        if still or origin_rad is None:
            return wrist.hold()
        if isinstance(self._wish.action, IdentifyStiffness) and self._action is ActionState.RUNNING:
            turn, ended = wrist.measure(t_ns, wrist_rad)
            if ended is not None:
                self.action_ended(ended)
            return turn
        return wrist.turn(self._wish.wrist, t_ns, wrist_rad, origin_rad)

    def _gripped(self, grip: GripTo) -> None:
        arm, hand = self.senses.arm, self.senses.hand
        self._origin_rad = arm.wrist_rad if arm is not None else None
        # What was met though nobody had expected it is watched as well.
        self._grips = grip.expect_object or (hand is not None and hand.holding)
        self._driving_wrist.forget()
        self._rest_gels()

    def _rest_gels(self) -> None:
        for creep in self._creep.values():
            creep.forget()

    def _ended(self, verdict: SafetyDecision) -> ControlOutput:
        experiment = self.experiment
        phase = experiment.phase.value if experiment is not None else "idle"
        self.standing = LoopStatus(phase, experiment.why if experiment is not None else "", WristVelocity(), verdict)
        self._wish = StepCommand()
        release = verdict.response is Response.STOP_AND_RELEASE and not self._released
        self._released |= release
        return ControlOutput(stop=True, release=release)

    def _troubles(self, limits: ExperimentLimits, drive: str, t_ns: int) -> list[Fault]:
        experiment, arm = self.experiment, self.senses.arm
        running = experiment is not None and experiment.running
        paused = experiment is not None and experiment.phase is ExperimentPhase.PAUSED
        twisted_rad = 0.0
        if arm is not None and self._origin_rad is not None:
            twisted_rad = arm.wrist_rad - self._origin_rad
        wish = self._wish
        moves = not isinstance(wish.wrist, Hold) or isinstance(wish.action, IdentifyStiffness)
        gripped = running and self._grips and not isinstance(wish.action, GripTo)
        watched = MonitorInputs(
            driving=self._sources[drive],
            supervising=self._others[drive],
            limits=limits,
            torque_needed=gripped and moves and not paused,
            gripped=gripped,
            twisted_rad=twisted_rad,
            expected_nm=self._driving_wrist.expected_nm if running else None,
            overdue=experiment.overdue if running and experiment is not None else "",
            required=self._required,
        )
        return list(troubles(self.senses, watched, self._watch, t_ns))
