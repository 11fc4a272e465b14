"""The safety table: what happens when something is not as it should be, and what the operator is told.

Every event has one row. A response is never weaker than the strongest row that applies; whatever is not a row ends
with the robot still as well, because the task that meets it dies, and `TASK_DIED` is a row.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum, IntEnum


class Response(IntEnum):
    """What is done, from the mildest to the strongest; the strongest of all active rows is carried out."""

    NOTE = 0  # told and counted, nothing else
    REFUSE_START = 1  # a running experiment goes on, a new one is not begun
    HOLD = 2  # the wrist stands still until the cause has gone; the experiment's clock stands too
    STOP_AND_KEEP_GRIP = 3  # the wrist is stopped, the experiment ends, the tool stays gripped
    STOP_AND_RELEASE = 4  # the wrist is stopped, the experiment ends, the gripper opens


class FaultCode(Enum):
    """What can be wrong."""

    ESTIMATE_STALE = "estimate stale"
    ESTIMATE_INVALID = "estimate invalid"
    ESTIMATE_JUMPED = "estimate jumped"
    TORQUE_LIMIT = "torque limit"
    ANGLE_LIMIT = "angle limit"
    TORQUES_DISAGREE = "torques disagree"
    PROTECTIVE_STOP = "protective stop"
    EMERGENCY_STOP = "emergency stop"
    GRIPPER_FAULT = "gripper fault"
    GRIP_LOST = "grip lost"
    NOT_RELEASED = "not released"
    STATE_STALE = "state stale"
    DEVICE_AWAITED = "device awaited"
    DEVICE_LOST = "device lost"
    ROBOT_LOST = "robot lost"
    ROBOT_BLOCKED = "robot blocked"
    TASK_DIED = "task died"
    DAEMON_PAUSED = "daemon paused"
    LOOP_LATE = "loop late"
    HELD_TOO_LONG = "held too long"
    RECORDING_FAILED = "recording failed"
    COMMAND_REFUSED = "command refused"
    COMMAND_UNANSWERED = "command unanswered"
    STEP_OVERDUE = "step overdue"


@dataclass(frozen=True, slots=True)
class Rule:
    """One row: the response, what the operator reads, and how long a hold may last before it becomes a stop.

    A hold that comes back counts on: see `FORGETS`. What is `told_afterwards` has been so since the judgement before,
    and is over when it is told, as that the loop was away. What `explains` is told first of all that is wrong from then
    on until nothing is, for that may follow from it.
    """

    response: Response
    sentence: str
    cure: str
    hold_at_most_s: float | None = None
    told_afterwards: bool = False
    explains: bool = False


# Of how long an event has held, so much is forgotten for each second in which it does not: what is wrong for more than
# a third of the time becomes a stop, as what is wrong all the time does.
FORGETS = 0.5

_KEEP, _RELEASE, _HOLD = Response.STOP_AND_KEEP_GRIP, Response.STOP_AND_RELEASE, Response.HOLD

TABLE: Mapping[FaultCode, Rule] = {
    FaultCode.ESTIMATE_STALE: Rule(
        _HOLD,
        "no new torque has come: {detail}.",
        "Look at the sensor's cable and at its task in `shearloop listen health`.",
        hold_at_most_s=5.0,
    ),
    FaultCode.ESTIMATE_INVALID: Rule(
        _HOLD,
        "the torque estimate is not valid: {detail}.",
        "Wait for the next valid estimate, or tare with nothing gripped and start again.",
        hold_at_most_s=5.0,
    ),
    FaultCode.ESTIMATE_JUMPED: Rule(
        _HOLD,
        "the torque jumped by more than the wrist can have caused: {detail}.",
        "Look whether the tool slipped or the screw broke loose.",
        hold_at_most_s=5.0,
    ),
    FaultCode.TORQUE_LIMIT: Rule(
        _RELEASE,
        "the torque is beyond its limit: {detail}.",
        "Check what blocks the tool; raise `limits.torque_nm` only when tool and gel bear it.",
    ),
    FaultCode.ANGLE_LIMIT: Rule(
        _KEEP,
        "the wrist has reached its angle limit: {detail}.",
        "The tool may be slipping; regrip it, or widen `limits.angle_rad`.",
    ),
    FaultCode.TORQUES_DISAGREE: Rule(
        _HOLD,
        "two torque measurements disagree: {detail}.",
        "Tare both with nothing gripped; when they still disagree, calibrate again.",
        hold_at_most_s=3.0,
    ),
    FaultCode.PROTECTIVE_STOP: Rule(
        _KEEP,
        "the robot is in a protective stop: {detail}.",
        "Look what the robot touched, clear it, then `shearloop command unlock`.",
    ),
    FaultCode.EMERGENCY_STOP: Rule(
        _KEEP,
        "the robot's emergency stop is pressed: {detail}.",
        "Release the button, power the arm on the pendant, then `shearloop command unlock`.",
    ),
    FaultCode.GRIPPER_FAULT: Rule(
        _KEEP,
        "the gripper reports a fault: {detail}.",
        "Clear what it names, then `shearloop command unlock` activates the gripper anew.",
    ),
    FaultCode.GRIP_LOST: Rule(
        _KEEP,
        "the gripper no longer holds an object: {detail}.",
        "Put the tool back and start the experiment again.",
    ),
    FaultCode.NOT_RELEASED: Rule(
        _KEEP,
        "the gripper was told to open and did not, the tool is still gripped: {detail}.",
        "Open it by hand and clear what it names, then `shearloop command unlock`.",
    ),
    FaultCode.STATE_STALE: Rule(
        _HOLD,
        "a device's state is out of date: {detail}.",
        "It goes on by itself when the state comes again; look at its cable, and whether this computer is overloaded.",
        hold_at_most_s=2.0,
    ),
    FaultCode.DEVICE_AWAITED: Rule(
        _KEEP,
        "what an experiment needs has not been there yet: {detail}.",
        "Switch it on and connect it; it is found by itself. `shearloop doctor CONFIG` examines it.",
    ),
    FaultCode.DEVICE_LOST: Rule(
        _KEEP,
        "a device that the experiment needs is gone: {detail}.",
        "Plug it in again; it is found by itself, then start the experiment again.",
    ),
    FaultCode.ROBOT_LOST: Rule(
        _KEEP,
        "the robot, or the daemon's process that drives it, is gone: {detail}.",
        "It is connected again by itself; then `shearloop command unlock`, and start the experiment again.",
    ),
    FaultCode.ROBOT_BLOCKED: Rule(
        _KEEP,
        "the robot does not move: {detail}.",
        "Clear what it names and `shearloop command unlock`, then start the experiment again.",
    ),
    FaultCode.TASK_DIED: Rule(
        _KEEP,
        "a task of the daemon died and is being started again: {detail}.",
        "Read the log above this line; report it when it comes back.",
    ),
    FaultCode.DAEMON_PAUSED: Rule(
        _HOLD,
        "the daemon itself was not running: {detail}.",
        "Let nothing pause it (SIGSTOP, Ctrl-Z), nor suspend or overload the computer, while an experiment runs.",
        hold_at_most_s=5.0,
        told_afterwards=True,
        explains=True,
    ),
    FaultCode.LOOP_LATE: Rule(
        _HOLD,
        "the daemon is too slow for its devices: {detail}.",
        "End other programs on this computer, or see the service's real-time options.",
        hold_at_most_s=5.0,
        told_afterwards=True,
    ),
    FaultCode.HELD_TOO_LONG: Rule(
        _KEEP,
        "the wrist was held for too long, now for one reason and now for another: {detail}.",
        "Clear what held it longest first, then start the experiment again.",
    ),
    FaultCode.RECORDING_FAILED: Rule(
        Response.REFUSE_START,
        "the recording cannot be written: {detail}.",
        "Make room on the disk or name another folder; what runs goes on unrecorded.",
    ),
    FaultCode.COMMAND_REFUSED: Rule(
        Response.NOTE,
        "a command was refused: {detail}.",
        "Nothing was done; mend the command and send it again.",
    ),
    FaultCode.COMMAND_UNANSWERED: Rule(
        Response.NOTE,
        "the robot's process was gone when the loop commanded it: {detail}.",
        "It is started anew by itself; once the robot is connected again, `shearloop command unlock`.",
    ),
    FaultCode.STEP_OVERDUE: Rule(
        _KEEP,
        "a step took longer than it may: {detail}.",
        "Look what kept it waiting; lengthen `timeout_s` of the step when it was too short.",
    ),
}


# So long after what explains, all that only holds the wrist follows from it: then what waited has been read, and boards
# that were thought to be gone have sent again, each half second.
SETTLES_S = 2.0
# Several causes that take turns hold the wrist no longer than one alone may.
HELD_AT_MOST_S = max(rule.hold_at_most_s for rule in TABLE.values() if rule.hold_at_most_s is not None)


@dataclass(frozen=True, slots=True)
class Fault:
    """One event with what is particular to this occurrence.

    Where it `follows` from what is told first, it goes without saying.
    """

    event: FaultCode
    detail: str
    follows: bool = False

    @property
    def rule(self) -> Rule:
        """The table's row."""
        return TABLE[self.event]

    @property
    def sentence(self) -> str:
        """What the operator reads: what happened, and what to do."""
        # A detail may be a sentence of a driver's; ours has a full stop of its own.
        return f"{self.rule.sentence.format(detail=self.detail.removesuffix('.'))} {self.rule.cure}"


@dataclass(frozen=True, slots=True)
class SafetyDecision:
    """The response to all that is wrong now, and every reason for it."""

    response: Response
    troubles: tuple[Fault, ...] = ()

    @property
    def reasons(self) -> tuple[str, ...]:
        """One sentence a trouble, but for what follows from another one."""
        return tuple(trouble.sentence for trouble in self.troubles if not trouble.follows)


class SafetyMonitor:
    """Judges what is wrong, lets holds go when their cause has gone, and keeps a stop until it is acknowledged."""

    def __init__(self) -> None:
        # For how long each event has held, and any of them the wrist, less what is forgotten; and which of them did at
        # the last judgement, if there was one.
        self._held_ns: dict[FaultCode, int] = {}
        self._wrist_ns = 0
        # What each has contributed to the wrist's, to be told.
        self._of_each_ns: dict[FaultCode, int] = {}
        self._holding: frozenset[FaultCode] = frozenset()
        self._judged_ns: int | None = None
        # What explained all that is wrong, and when.
        self._cause: tuple[Fault, int] | None = None
        self._stopped: SafetyDecision | None = None

    def judge(self, troubles: Iterable[Fault], t_ns: int) -> SafetyDecision:
        """Return the response to the troubles of this moment (t_ns on the monotonic clock)."""
        active = tuple(troubles)
        # Up to 125 times a second, and nearly always there is nothing to count.
        if active or self._wrist_ns or self._holding:
            self._count(active, t_ns)
        self._judged_ns = t_ns
        response = max(map(self._response, active), default=Response.NOTE)
        if response is Response.HOLD and self._wrist_ns > HELD_AT_MOST_S * 1e9:
            active = (*active, Fault(FaultCode.HELD_TOO_LONG, self._told_of_holds()))
            response = TABLE[FaultCode.HELD_TOO_LONG].response
        if active:
            active = self._explained(active, t_ns, held=response >= Response.HOLD)
        else:
            self._cause = None
        verdict = SafetyDecision(response, active)
        if response >= Response.STOP_AND_KEEP_GRIP and (self._stopped is None or response > self._stopped.response):
            self._stopped = verdict
        if self._stopped is None:
            return verdict
        return self._with_the_stop(self._stopped, active)

    def look(self, troubles: Iterable[Fault]) -> SafetyDecision:
        """Return what is wrong while nothing moves: a stop that waits is kept, but none is begun."""
        active = tuple(troubles)
        self._forget()
        if self._stopped is None:
            return SafetyDecision(Response.NOTE, active)
        return self._with_the_stop(self._stopped, active)

    def acknowledge(self) -> None:
        """Let a stop go, on the operator's word; what is still wrong stops again at the next judgement."""
        self._stopped = None
        self._forget()

    @property
    def stopped(self) -> bool:
        """Whether a stop waits for the operator."""
        return self._stopped is not None

    def _explained(self, active: tuple[Fault, ...], t_ns: int, *, held: bool) -> tuple[Fault, ...]:
        """Return the troubles of t_ns, first what they may follow from; what stops is told in any case."""
        own = next((trouble for trouble in active if trouble.rule.explains), None)
        if own is not None:
            self._cause = own, t_ns
        if self._cause is None:
            return active
        cause, since_ns = self._cause
        settled = t_ns - since_ns > SETTLES_S * 1e9
        if settled and not held:
            # A full disk may stay so for hours, and what stops an experiment then does not come of the pause.
            self._cause = None
            return active
        others = (trouble for trouble in active if trouble is not own)
        return cause, *(replace(one, follows=True) if not settled and self._may_follow(one) else one for one in others)

    def _may_follow(self, trouble: Fault) -> bool:
        """Return whether a trouble may be no more than what comes of a pause: a full disk and a refusal are not."""
        return trouble.event is FaultCode.COMMAND_UNANSWERED or self._response(trouble) is Response.HOLD

    @staticmethod
    def _with_the_stop(stop: SafetyDecision, active: tuple[Fault, ...]) -> SafetyDecision:
        """Return what is wrong: a stop outlives its cause, and what has come since is told beside it."""
        events = {trouble.event for trouble in active}
        first = (trouble for trouble in stop.troubles if trouble.event not in events)
        return SafetyDecision(stop.response, (*first, *active))

    def _count(self, active: tuple[Fault, ...], t_ns: int) -> None:
        """Take in what there is at t_ns: what held until now has held for longer, the rest is forgotten."""
        passed_ns = 0 if self._judged_ns is None else t_ns - self._judged_ns
        holding = frozenset(trouble.event for trouble in active if trouble.rule.hold_at_most_s is not None)
        held = self._holding.union(event for event in holding if TABLE[event].told_afterwards)
        counted = {
            event: _counted(self._held_ns.get(event, 0), passed_ns, held=event in held)
            for event in (*self._held_ns, *holding)
        }
        self._held_ns = {event: held_ns for event, held_ns in counted.items() if held_ns or event in holding}
        self._wrist_ns = _counted(self._wrist_ns, passed_ns, held=bool(held))
        if not self._wrist_ns:
            self._of_each_ns.clear()
        for event in held:
            self._of_each_ns[event] = self._of_each_ns.get(event, 0) + passed_ns
        self._holding = holding

    def _forget(self) -> None:
        self._held_ns.clear()
        self._of_each_ns.clear()
        self._wrist_ns, self._holding, self._judged_ns, self._cause = 0, frozenset(), None, None

    def _response(self, trouble: Fault) -> Response:
        rule = trouble.rule
        longest_s = rule.hold_at_most_s
        if longest_s is not None and self._held_ns[trouble.event] > longest_s * 1e9:
            return Response.STOP_AND_KEEP_GRIP
        return rule.response

    def _told_of_holds(self) -> str:
        """Return for how long each event has held, the longest first."""
        longest_first = sorted(self._of_each_ns.items(), key=lambda held: -held[1])
        return ", ".join(f"{event.value} for {held_ns / 1e9:.1f} s" for event, held_ns in longest_first)


def _counted(held_ns: int, passed_ns: int, *, held: bool) -> int:
    """Return for how long something has held, after so much more time in which it did or did not."""
    return held_ns + passed_ns if held else max(0, held_ns - round(FORGETS * passed_ns))
