"""Decides, at every tick, what robot and gripper are told: experiment, controller and safety table in one place.

A plain object without I/O or clock. Senses go in, `Orders` come out; what the orders led to is told back.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from daemon.control.controller import TwistController
from daemon.control.creep import Creep
from daemon.control.identify import Identified
from daemon.experiment.machine import Experiment, Phase
from daemon.experiment.steps import ExperimentFile, Limits, turns_before_a_grip
from daemon.experiment.wishes import (
    Action,
    ActionState,
    GripTo,
    MeasureTool,
    Still,
    TakeZero,
    Track,
    View,
    Wish,
)
from daemon.loop.senses import Hand, Senses, Source, Torque
from daemon.loop.watch import Watched, WatchSettings, compared_for_s, troubles
from daemon.loop.wrist import Wrist, WristTurn
from daemon.safety import Event, Response, SafetyGate, Trouble, Verdict
from drivers.values import value

# Of no experiment; made once, for it is asked for at every tick.
NO_LIMITS = Limits()


@value(frozen=True, slots=True)
class Orders:
    """What is to be told to the devices now; `begin` and `release` are for this tick alone.

    `hold` is not the end as `stop` is: whatever moves the arm brakes, and goes on afterwards.
    """

    wrist_rad_per_s: float = 0.0
    stop: bool = False
    hold: bool = False
    begin: Action | None = None
    release: bool = False


@value(frozen=True, slots=True)
class Standing:
    """Where the loop stands, for `loop.state`."""

    phase: str
    doing: str
    turn: WristTurn
    verdict: Verdict


class Brain:
    """One closed loop: one arm, one hand, torques of which one drives."""

    def __init__(
        self,
        wrists: dict[str, Wrist],
        watch: WatchSettings,
        supervisors: dict[str, Source],
        required: tuple[str, ...],
        creep: Mapping[str, Creep] = MappingProxyType({}),
    ) -> None:
        """Take a wrist for each source that may drive, all sources by name, and the devices that must be there.

        `creep` tells of the sources that see a gel's shear and not its torque.
        """
        self.senses = Senses(kept_s=compared_for_s(supervisors.values(), watch))
        self.gate = SafetyGate()
        self.experiment: Experiment | None = None
        self.standing = Standing("idle", "", WristTurn(), Verdict(Response.NOTE))
        self._wrists = wrists
        self._watch = watch
        self._sources = supervisors
        # Of each that may drive, the others, which supervise it.
        self._others = {
            drive: tuple(source for name, source in supervisors.items() if name != drive) for drive in supervisors
        }
        self._required = required
        self._creep = creep
        self._wish = Wish()
        self._begun = -1
        self._action = ActionState.IDLE
        self._failure = ""
        self._origin_rad: float | None = None
        # Whether a tool is meant to be between the fingers.
        self._grips = False
        self._released = False
        # Why the gripper did not open when a stop asked for it, until the operator has seen to it.
        self._unreleased = ""
        self._notes: list[Trouble] = []

    def hear(self, torque: Torque) -> None:
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
        self._wish = Wish()
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

    def _unknown_hand(self) -> Hand | None:
        """Return the hand where it does not say whether it holds a tool, else None."""
        hand = self.senses.hand
        return hand if "gripper" in self._required and hand is not None and (hand.unsure or hand.moving) else None

    def pause(self) -> str | None:
        """Stand still until `resume`, or return why not."""
        if self.experiment is not None and self.experiment.phase is Phase.PAUSED:
            return "the experiment is paused already; `resume` goes on with it"
        if self.experiment is None or self.experiment.phase is not Phase.RUNNING:
            return "no experiment is running"
        self.experiment.pause()
        return None

    def resume(self) -> str | None:
        """Go on after `pause`, or return why not."""
        if self.experiment is None or self.experiment.phase is not Phase.PAUSED:
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
        self._notes.append(Trouble(Event.COMMAND_REFUSED, sentence))

    def note_unanswered(self, sentence: str) -> None:
        """Tell of a command of the loop's own that the robot's process, which has ended, did not answer."""
        self._notes.append(Trouble(Event.COMMAND_UNANSWERED, sentence))

    def action_ended(self, failure: str = "") -> None:
        """Tell that the action that was begun has ended, well or with a reason."""
        self._action = ActionState.FAILED if failure else ActionState.DONE
        self._failure = failure
        match self._wish.action:
            case TakeZero() if not failure:
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

    def tick(self, t_ns: int) -> Orders:
        """Return what is to be done now."""
        experiment, arm = self.experiment, self.senses.arm
        limits = experiment.limits if experiment is not None else NO_LIMITS
        drive = experiment.file.drive if experiment is not None else next(iter(self._wrists))
        found = [*self._troubles(limits, drive, t_ns), *self._notes]
        self._notes.clear()
        if self._unreleased:
            found.append(Trouble(Event.NOT_RELEASED, self._unreleased))
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
    def identified(self) -> Identified | None:
        """Return what is known of the tool in the grip."""
        return self._driving_wrist.identified

    @property
    def _driving_wrist(self) -> Wrist:
        if self.experiment is None:
            return next(iter(self._wrists.values()))
        return self._wrists[self.experiment.file.drive]

    def _carry_on(self, experiment: Experiment, verdict: Verdict, wrist_rad: float, t_ns: int) -> Orders:
        held = verdict.response is Response.HOLD
        if self._origin_rad is None:
            self._origin_rad = wrist_rad
        latest = self.senses.torques.get(experiment.file.drive)
        view = View(
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
        still = held or experiment.phase is Phase.PAUSED
        turns = not isinstance(self._wish.wrist, Still) or isinstance(self._wish.action, MeasureTool)
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
        self.standing = Standing(phase, experiment.doing, turn, verdict)
        return Orders(turn.speed_rad_per_s, hold=still, begin=begin)

    def _begin(self, experiment: Experiment, t_ns: int, wrist_rad: float) -> Action | None:
        """Begin what the wish asks for the first time: an action of the devices, an identification, a closed loop."""
        wish, wrist = self._wish, self._driving_wrist
        match wish.wrist:
            case Track() as track if wrist.tracks != track:
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
        if isinstance(wish.action, MeasureTool):
            wrist.begin_measuring(wish.action, experiment.limits.torque_nm)
            return None
        return wish.action

    def _turn(self, t_ns: int, wrist_rad: float, *, still: bool) -> WristTurn:
        wrist, origin_rad = self._driving_wrist, self._origin_rad
        if still or origin_rad is None:
            return wrist.hold()
        if isinstance(self._wish.action, MeasureTool) and self._action is ActionState.RUNNING:
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

    def _ended(self, verdict: Verdict) -> Orders:
        experiment = self.experiment
        phase = experiment.phase.value if experiment is not None else "idle"
        self.standing = Standing(phase, experiment.why if experiment is not None else "", WristTurn(), verdict)
        self._wish = Wish()
        release = verdict.response is Response.STOP_AND_RELEASE and not self._released
        self._released |= release
        return Orders(stop=True, release=release)

    def _troubles(self, limits: Limits, drive: str, t_ns: int) -> list[Trouble]:
        experiment, arm = self.experiment, self.senses.arm
        running = experiment is not None and experiment.running
        paused = experiment is not None and experiment.phase is Phase.PAUSED
        twisted_rad = 0.0
        if arm is not None and self._origin_rad is not None:
            twisted_rad = arm.wrist_rad - self._origin_rad
        wish = self._wish
        moves = not isinstance(wish.wrist, Still) or isinstance(wish.action, MeasureTool)
        gripped = running and self._grips and not isinstance(wish.action, GripTo)
        watched = Watched(
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
