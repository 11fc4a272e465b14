"""The safety table: the response to each fault, and the sentence for the operator.

The response is at least the strongest one of all rows that apply. A fault without a row stops the robot too: it ends
its task, and `TASK_DIED` is a row.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum


class Response(IntEnum):
    """Responses, from the mildest to the strongest; the strongest of all active rows applies."""

    NOTE = 0  # reported and counted, nothing else
    REFUSE_START = 1  # a running experiment continues, a new one does not start
    HOLD = 2  # wrist and experiment clock stand still until the cause has gone
    STOP_AND_KEEP_GRIP = 3  # the wrist is stopped, the experiment ends, the tool stays gripped
    STOP_AND_RELEASE = 4  # the wrist is stopped, the experiment ends, the gripper opens


@dataclass(frozen=True, slots=True)
class Rule:
    """One row: the response, the operator's sentence with its cure, and how long a hold may last before it stops.

    A fault that `is_past` is detected after it is over, such as a pause of the loop. A fault that `explains` is
    reported first, and faults that only hold the wrist count as its consequences: queued data is old, and boards
    seem lost. Faults with one `timer` are one hold: a board that is silent is lost soon after. One that `stops_at_rest`
    is a stop even if nothing moved, because a person was near the arm, or touched it.
    """

    response: Response
    sentence: str
    cure: str
    hold_at_most_s: float | None = None
    is_past: bool = False
    explains: bool = False
    stops_at_rest: bool = False
    timer: str = ""

    @property
    def kind(self) -> str:
        """What every fault of this row has in common: the sentence without its detail."""
        return self.sentence.split("{detail}")[0].rstrip(": ")


# A hold's timer runs down at this rate while its fault is absent: a fault that is present for more than a third of the
# time becomes a stop.
DECAY = 0.5

_KEEP, _RELEASE, _HOLD = Response.STOP_AND_KEEP_GRIP, Response.STOP_AND_RELEASE, Response.HOLD


class FaultCode(Enum):
    """The safety table: kinds of faults with their rules."""

    ESTIMATE_STALE = Rule(
        _HOLD,
        "no new torque has arrived: {detail}.",
        "Check the sensor's cable and its task in `shearloop listen health`. If the wrist stopped, send "
        "`shearloop command unlock`.",
        hold_at_most_s=5.0,
        timer="torque source",
    )
    SENSOR_LOST = Rule(
        _HOLD,
        "a torque sensor is not connected: {detail}.",
        "Connect it again; the daemon finds it by itself. If the wrist stopped, send `shearloop command unlock`.",
        hold_at_most_s=5.0,
        timer="torque source",
    )
    ESTIMATE_INVALID = Rule(
        _HOLD,
        "the torque estimate is not valid: {detail}.",
        "It resumes with the next valid torque; if it stopped, clear the cause, then send `shearloop command unlock`.",
        hold_at_most_s=5.0,
    )
    ESTIMATE_JUMPED = Rule(
        _HOLD,
        "the torque jumped without a motion of the wrist: {detail}.",
        "Check whether the tool slipped or the screw broke loose. If the wrist stopped, send "
        "`shearloop command unlock`.",
        hold_at_most_s=5.0,
    )
    NOT_FOLLOWING = Rule(
        _HOLD,
        "the torque no longer follows the wrist: {detail}.",
        "The grip slips, or the screw broke loose or stripped: look at the tool, then send `shearloop command unlock`. "
        "`loop.max_offset_drift_nm` is the limit.",
        hold_at_most_s=5.0,
    )
    TORQUE_LIMIT = Rule(
        _RELEASE,
        "the torque is beyond its limit: {detail}.",
        "Find the obstacle at the tool, then send `shearloop command unlock`. `shearloop command release --yes` opens "
        "a gripper that still holds the tool; a clamped tool is turned back at the pendant. Raise `limits.torque_nm` "
        "only if tool and gel bear it.",
    )
    ANGLE_LIMIT = Rule(
        _KEEP,
        "the wrist has reached its angle limit: {detail}.",
        "If the tool slips, grip it again, else widen `limits.angle_rad`; then send `shearloop command unlock`.",
    )
    TORQUES_DISAGREE = Rule(
        _HOLD,
        "two torque measurements disagree: {detail}.",
        "Tare both with nothing gripped; if they still disagree, calibrate again. If the wrist stopped, send "
        "`shearloop command unlock`.",
        hold_at_most_s=3.0,
    )
    PROTECTIVE_STOP = Rule(
        _KEEP,
        "the robot is in a protective stop: {detail}.",
        "Clear the obstacle that the robot touched, then send `shearloop command unlock`.",
        stops_at_rest=True,
    )
    EMERGENCY_STOP = Rule(
        _KEEP,
        "the robot's emergency stop is pressed: {detail}.",
        "Release the button, power the arm on at the pendant, then send `shearloop command unlock`.",
        stops_at_rest=True,
    )
    GRIPPER_FAULT = Rule(
        _KEEP,
        "the gripper reports a fault: {detail}.",
        "Clear the fault. `shearloop command unlock` then activates the gripper again, which opens its fingers. If "
        "they may hold a tool, it asks first.",
    )
    GRIPPER_COMMANDED = Rule(
        _KEEP,
        "another program, or the pendant, commands the gripper: {detail}.",
        "Let no other program command it, look at the tool, then send `shearloop command unlock`.",
    )
    GRIP_LOST = Rule(
        _KEEP,
        "the gripper no longer holds an object: {detail}.",
        "Put the tool back if it is not between the fingers, then send `shearloop command unlock`.",
    )
    NOT_RELEASED = Rule(
        _KEEP,
        "the gripper did not open, the tool is still gripped: {detail}.",
        "Open it by hand and clear the fault, then send `shearloop command unlock`.",
    )
    STATE_STALE = Rule(
        _HOLD,
        "a device's state is out of date: {detail}.",
        "It resumes with the next state; check the cable, and whether this computer is overloaded. If the wrist "
        "stopped, send `shearloop command unlock`.",
        hold_at_most_s=2.0,
    )
    DEVICE_AWAITED = Rule(
        _KEEP,
        "a device that the experiment needs is not connected yet: {detail}.",
        "Switch it on and connect it; the daemon finds it by itself. `shearloop doctor CONFIG` examines it.",
    )
    ROBOT_STARTING = Rule(_KEEP, "the robot is not ready yet: {detail}.", "The experiment can begin in a few seconds.")
    DEVICE_LOST = Rule(
        _KEEP,
        "a device that the experiment needs is gone: {detail}.",
        "Connect it again; the daemon finds it by itself. Then send `shearloop command unlock`, and the experiment can "
        "begin.",
    )
    ROBOT_LOST = Rule(
        _KEEP,
        "the robot, or the daemon's process that drives it, is gone: {detail}.",
        "It reconnects automatically; then send `shearloop command unlock`, and the experiment can begin.",
    )
    ROBOT_BLOCKED = Rule(
        _KEEP,
        "the robot does not move: {detail}.",
        "Clear the cause and send `shearloop command unlock`. Then the experiment can begin.",
    )
    ROBOT_UNCONTROLLED = Rule(
        _KEEP,
        "the daemon has lost control of the robot: {detail}.",
        "If no person stopped it at the pendant, check its cable, and whether this computer is overloaded; then send "
        "`shearloop command unlock`, and the experiment can begin.",
    )
    TASK_DIED = Rule(
        _KEEP,
        "a task of the daemon crashed and restarts: {detail}.",
        "Read the log above this line, then send `shearloop command unlock`. Report the crash if it recurs.",
    )
    DAEMON_PAUSED = Rule(
        _KEEP,
        "the daemon itself was not running: {detail}.",
        "Do not pause it (SIGSTOP, Ctrl-Z), nor suspend or overload the computer, while an experiment runs; then send "
        "`shearloop command unlock`.",
        is_past=True,
        explains=True,
    )
    LOOP_LATE = Rule(
        _HOLD,
        "the daemon is too slow for its devices: {detail}.",
        "End other programs on this computer, or see the service's real-time options. If the wrist stopped, send "
        "`shearloop command unlock`.",
        hold_at_most_s=5.0,
        is_past=True,
        explains=True,
    )
    HELD_TOO_LONG = Rule(
        _KEEP,
        "the wrist was held for too long by several faults: {detail}.",
        "Clear the longest one first, then send `shearloop command unlock`.",
    )
    RECORDING_FAILED = Rule(
        Response.REFUSE_START,
        "the recording cannot be written: {detail}.",
        "Make room on the disk, or make the folder again; a running experiment continues unrecorded.",
    )
    COMMAND_REFUSED = Rule(
        Response.NOTE,
        "a command was refused: {detail}.",
        "A running experiment continues when commands are accepted again. If this recurs, end other programs.",
    )
    COMMAND_UNANSWERED = Rule(
        Response.NOTE,
        "the robot's worker ended before it answered a command: {detail}.",
        "It restarts automatically. When the robot is connected again, send `shearloop command unlock`.",
    )
    STEP_OVERDUE = Rule(
        _KEEP,
        "a step took longer than it may: {detail}.",
        "Find the cause of the delay, or lengthen the step's `timeout_s`; then send `shearloop command unlock`.",
    )
    STEP_FAILED = Rule(
        _KEEP, "the experiment cannot continue: {detail}.", "Clear the cause, then send `shearloop command unlock`."
    )
    OPERATOR_STOP = Rule(
        _KEEP, "the operator stopped it: {detail}.", "Send `shearloop command unlock` before the next start."
    )
    TOOL_GRIPPED = Rule(
        Response.NOTE,
        "a tool is still gripped, or may be: {detail}.",
        "Secure it. Then `shearloop command release --yes` opens the gripper, and the object drops.",
    )
    GRIP_UNKNOWN = Rule(
        Response.NOTE,
        "the gripper holds something in a grip that is not known: {detail}.",
        "Angle, force and zeros of an earlier grip are not used. Check what it holds; "
        "`shearloop command release --yes` opens the gripper, and the object drops.",
    )
    DAEMON_ENDED = Rule(_KEEP, "the daemon ended: {detail}.", "Look at the rig, then send `shearloop command unlock`.")

    @property
    def text(self) -> str:
        """The name in words: the code in messages."""
        return self.name.lower().replace("_", " ")

    @property
    def timer(self) -> str:
        """The name of its hold timer."""
        return self.value.timer or self.name

    @classmethod
    def of_text(cls, text: str) -> "FaultCode":
        """Return the fault of a message's code; raises KeyError for an unknown one."""
        return cls[text.upper().replace(" ", "_")]


TABLE: Mapping[FaultCode, Rule] = {code: code.value for code in FaultCode}
# The longest hold by several alternating faults.
LONGEST_HOLD_S = max(rule.hold_at_most_s for rule in TABLE.values() if rule.hold_at_most_s is not None)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault with its details; a consequence of another fault is not reported to the operator."""

    code: FaultCode
    detail: str
    is_consequence: bool = False
    # When its cause was measured (CLOCK_MONOTONIC), if a measurement shows it.
    t_ns: int | None = field(default=None, compare=False)

    @property
    def rule(self) -> Rule:
        """The table's row."""
        return TABLE[self.code]

    @property
    def cause(self) -> str:
        """The sentence without its full stop, and without the cure."""
        # A driver's detail may end with a full stop; the sentence has its own.
        return self.rule.sentence.format(detail=self.detail.removesuffix(".")).removesuffix(".")

    @property
    def sentence(self) -> str:
        """The operator's sentence, with the cure."""
        return f"{self.cause}. {self.rule.cure}"


@dataclass(frozen=True, slots=True)
class SafetyDecision:
    """The response to all present faults, and the faults."""

    response: Response
    faults: tuple[Fault, ...] = ()

    @property
    def reported(self) -> tuple[Fault, ...]:
        """The faults without consequences, the cause first."""
        return tuple(fault for fault in self.faults if not fault.is_consequence)

    @property
    def codes(self) -> str:
        """The codes of the reported faults, separated by commas, as messages have them."""
        return ", ".join(fault.code.text for fault in self.reported)

    @property
    def reasons(self) -> tuple[str, ...]:
        """One sentence per fault, without consequences."""
        return tuple(fault.sentence for fault in self.reported)


@dataclass(frozen=True, slots=True)
class Stop:
    """A stop, from its first cause until the operator acknowledges it."""

    response: Response
    faults: tuple[Fault, ...]
    # Grows with each cause that begins a stop or joins one.
    number: int
    # The reason of a stop on request, as the status shows it; empty for a stop by a fault.
    reason: str = ""
    # Whether it has opened the gripper.
    released: bool = False

    @property
    def causes(self) -> str:
        """The causes, without their cures."""
        return "; ".join(fault.cause for fault in self.faults)


class SafetyMonitor:
    """Judges faults: a hold ends with its cause, a stop stays until the operator acknowledges it."""

    def __init__(self, patience: float = 1.0) -> None:
        """`patience` is the factor on the longest holds; above 1 on an emulated rig alone."""
        self._patience = patience
        # The stop that waits for the operator, and the one that was acknowledged last.
        self.waiting: Stop | None = None
        self.acknowledged: Stop | None = None
        self.acknowledgements = 0
        # How many causes have begun a stop, or joined one that waits for the operator.
        self._causes = 0
        # Hold timers of faults and of the wrist, and the faults of the last judgement that hold.
        self._hold_ns: dict[str, int] = {}
        self._wrist_ns = 0
        self._holding: frozenset[FaultCode] = frozenset()
        # Each fault's contribution to the wrist's timer, for the report.
        self._share_ns: dict[FaultCode, int] = {}
        self._judged_ns: int | None = None

    def judge(self, faults: Iterable[Fault], t_ns: int) -> SafetyDecision:
        """Return the response to the faults at t_ns (monotonic clock) while an experiment runs."""
        active = tuple(faults)
        if active or self._wrist_ns or self._holding:
            self._count(active, t_ns)
        self._judged_ns = t_ns
        response = max(map(self._response, active), default=Response.NOTE)
        if response is Response.HOLD and self._wrist_ns > self._patience * LONGEST_HOLD_S * 1e9:
            active = (*active, Fault(FaultCode.HELD_TOO_LONG, self._hold_report()))
            response = TABLE[FaultCode.HELD_TOO_LONG].response
        # Faults that stop come before faults that hold: the message begins with the cause of the stop.
        active = tuple(sorted(active, key=self._response, reverse=True))
        decision = SafetyDecision(response, self._explained(active, _explaining(active)))
        if response >= Response.STOP_AND_KEEP_GRIP and (self.waiting is None or response > self.waiting.response):
            self._causes += 1
            self.waiting = Stop(response, decision.faults, self._causes)
        return decision if self.waiting is None else self._with_stop(self.waiting, active)

    def report(self, faults: Iterable[Fault]) -> SafetyDecision:
        """Return the faults while nothing moves: a pending stop is kept, and only the robot's own stops begin one."""
        active = tuple(faults)
        self._reset_timers()
        for fault in active:
            if fault.rule.stops_at_rest:
                # One that lasts is one cause.
                known = self.waiting.faults if self.waiting is not None else ()
                self._causes += fault.code not in {one.code for one in known}
                self._join(fault)
        return SafetyDecision(Response.NOTE, active) if self.waiting is None else self._with_stop(self.waiting, active)

    def stop(self, fault: Fault, reason: str = "") -> None:
        """Begin a stop that no input shows, such as an operator's; it keeps the grip, and a stronger one stays.

        `reason` is as in `Stop`.
        """
        self._causes += 1
        self._join(fault, reason)

    def _join(self, fault: Fault, reason: str = "") -> None:
        """Let a fault join the stop that waits, or begin one."""
        stop = self.waiting or Stop(Response.STOP_AND_KEEP_GRIP, (), self._causes)
        others = (one for one in stop.faults if one.code is not fault.code)
        self.waiting = replace(stop, faults=(*others, fault), number=self._causes, reason=reason or stop.reason)

    def release_once(self) -> bool:
        """Return whether the stop that waits has to open the gripper now; it counts as done."""
        stop = self.waiting
        if stop is None or stop.released or stop.response is not Response.STOP_AND_RELEASE:
            return False
        self.waiting = replace(stop, released=True)
        return True

    def acknowledge(self) -> None:
        """Clear a stop on the operator's command; a fault that persists stops again at the next judgement."""
        if self.waiting is not None:
            self.acknowledged, self.waiting = self.waiting, None
            self.acknowledgements += 1
        self._reset_timers()

    @property
    def stop_number(self) -> int:
        """The number of the stop that waits for the operator; 0 without one."""
        return self.waiting.number if self.waiting is not None else 0

    @classmethod
    def _explained(cls, active: tuple[Fault, ...], cause: Fault | None) -> tuple[Fault, ...]:
        """Return the faults with their cause first and its consequences marked; without a cause, as they are."""
        if cause is None:
            return active
        others = (fault for fault in active if fault.code is not cause.code)
        return (cause, *(replace(one, is_consequence=True) if _may_follow(one) else one for one in others))

    @classmethod
    def _with_stop(cls, stop: Stop, active: tuple[Fault, ...]) -> SafetyDecision:
        """Return the stop's faults, updated with the present ones."""
        codes = {fault.code for fault in active}
        # In the order of the stop, so that its cause stays first.
        known = {fault.code for fault in stop.faults}
        kept = [fault for fault in stop.faults if fault.code not in codes]
        kept += [fault for fault in active if fault.code in known]
        order = list(dict.fromkeys(fault.code for fault in stop.faults))
        kept.sort(key=lambda fault: order.index(fault.code))
        new = (fault for fault in active if fault.code not in known)
        return SafetyDecision(stop.response, cls._explained((*kept, *new), _explaining(stop.faults)))

    def _count(self, active: tuple[Fault, ...], t_ns: int) -> None:
        """Advance the hold timers to t_ns: up for faults that lasted until now, down for the others."""
        passed_ns = 0 if self._judged_ns is None else t_ns - self._judged_ns
        holding = frozenset(fault.code for fault in active if fault.rule.hold_at_most_s is not None)
        lasted = self._holding.union(code for code in holding if TABLE[code].is_past)
        lasted_timers = {code.timer for code in lasted}
        holding_timers = {code.timer for code in holding}
        counted = {
            timer: _counted(self._hold_ns.get(timer, 0), passed_ns, up=timer in lasted_timers)
            for timer in (*self._hold_ns, *holding_timers)
        }
        self._hold_ns = {timer: hold_ns for timer, hold_ns in counted.items() if hold_ns or timer in holding_timers}
        self._wrist_ns = _counted(self._wrist_ns, passed_ns, up=bool(lasted))
        if not self._wrist_ns:
            self._share_ns.clear()
        for code in lasted:
            self._share_ns[code] = self._share_ns.get(code, 0) + passed_ns
        self._holding = holding

    def _reset_timers(self) -> None:
        self._hold_ns.clear()
        self._share_ns.clear()
        self._wrist_ns, self._holding, self._judged_ns = 0, frozenset(), None

    def _response(self, fault: Fault) -> Response:
        rule = fault.rule
        longest_s = rule.hold_at_most_s
        if longest_s is not None and self._hold_ns[fault.code.timer] > self._patience * longest_s * 1e9:
            return Response.STOP_AND_KEEP_GRIP
        return rule.response

    def _hold_report(self) -> str:
        """Return the hold time of each fault, the longest first."""
        longest_first = sorted(self._share_ns.items(), key=lambda entry: -entry[1])
        return ", ".join(f"{code.text} for {hold_ns / 1e9:.1f} s" for code, hold_ns in longest_first)


def _explaining(faults: tuple[Fault, ...]) -> Fault | None:
    return next((fault for fault in faults if fault.rule.explains), None)


def _may_follow(fault: Fault) -> bool:
    """Whether a fault may be a consequence of a pause."""
    return fault.code is FaultCode.COMMAND_UNANSWERED or fault.rule.response is Response.HOLD


def _counted(hold_ns: int, passed_ns: int, *, up: bool) -> int:
    """Return a hold timer after `passed_ns`, which it counts up or down."""
    return hold_ns + passed_ns if up else max(0, hold_ns - round(DECAY * passed_ns))
