"""The faults: the safety table with the response to each, and the sentence for the operator.

The response is at least the strongest one of all rows that apply. A fault without a row stops the robot too: it ends
its task, and `TASK_DIED` is a row.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
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
    """One row: the response, the operator's sentence with its cure, and what else is special about the fault."""

    response: Response
    sentence: str
    cure: str
    # A hold that lasts longer becomes a stop. Faults with one `timer` are one hold: a board that is silent is lost soon
    # after.
    hold_at_most_s: float | None = None
    timer: str = ""
    # It is detected after it is over, such as a pause of the loop.
    is_past: bool = False
    # It is reported first, and others count as its consequences: queued data is old, and boards seem lost.
    explains: bool = False
    # It can be such a consequence, as each fault can that only holds the wrist.
    follows: bool = False
    # It is a stop even if nothing moved, because a person was near the arm, or touched it.
    stops_at_rest: bool = False
    # A run that it stops has ended as a person asked: the summary calls it no error.
    asked_for: bool = False
    # Emulated devices have it on command, or because the computer is too busy: the summary of an emulated run says so.
    # A fault with other causes, such as a step's time limit or a blocked robot, is none of these.
    by_busy_computer: bool = False

    @property
    def may_be_consequence(self) -> bool:
        """Whether a fault of this row may be a consequence of one that explains."""
        return self.follows or self.response is Response.HOLD

    @property
    def kind(self) -> str:
        """What every fault of this row has in common: the sentence without its detail."""
        return self.sentence.split("{detail}")[0].rstrip(": ")


_KEEP, _RELEASE, _HOLD = Response.STOP_AND_KEEP_GRIP, Response.STOP_AND_RELEASE, Response.HOLD


class FaultCode(Enum):
    """The safety table: kinds of faults with their rules."""

    ESTIMATE_STALE = Rule(
        _HOLD,
        "a sensor has sent nothing new: {detail}.",
        "Check the sensor's cable and its task in `shearloop listen health`. If the wrist stopped, send "
        "`shearloop command unlock`.",
        hold_at_most_s=5.0,
        timer="torque source",
        by_busy_computer=True,
    )
    SENSOR_LOST = Rule(
        _HOLD,
        "a sensor is not connected: {detail}.",
        "Connect it again; the daemon finds it by itself. If the wrist stopped, send `shearloop command unlock`.",
        hold_at_most_s=5.0,
        timer="torque source",
    )
    ZERO_LOST = Rule(
        _KEEP,
        "the torque that drives the wrist counts from no known zero: {detail}.",
        "Take a gripped tool out with `shearloop command release --yes`, then send `shearloop command unlock`. Turn a "
        "clamped tool back with a step `turn_to`. Then take the zero with nothing loaded: `shearloop command tare`, or "
        "a step `tare`.",
    )
    ESTIMATE_INVALID = Rule(
        _HOLD,
        "the torque estimate is not valid: {detail}.",
        "It resumes with the next valid torque; if it stopped, clear the cause, then send `shearloop command unlock`.",
        hold_at_most_s=5.0,
    )
    ESTIMATE_LATE = Rule(
        _HOLD,
        "the computer or its matching is too slow: {detail}.",
        "`latency_s` of `shearloop listen eit.estimate` is the time that a fingertip's matching takes, with its wait. "
        "End other programs on the daemon's computer, or build a bank with fewer cells. If the wrist stopped, send "
        "`shearloop command unlock`.",
        hold_at_most_s=5.0,
        timer="torque source",
        by_busy_computer=True,
    )
    WRENCH_UNKNOWN = Rule(
        _HOLD,
        "the robot's states come too rarely for a torque of its wrench: {detail}.",
        "End other programs on the daemon's computer, look at the network, or lower `rate_hz` of the robot's settings. "
        "If the wrist stopped, send `shearloop command unlock`.",
        hold_at_most_s=5.0,
        timer="torque source",
        by_busy_computer=True,
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
        "Tare both with nothing gripped; if they still disagree, calibrate again with the held tool. If the wrist "
        "stopped, send `shearloop command unlock`.",
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
        "Make the cell safe and release the button, then send `shearloop command unlock`, which powers the arm and "
        "releases its brakes.",
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
        "It resumes with the next state; check the cable, and whether the daemon's computer is overloaded. If the "
        "wrist stopped, send `shearloop command unlock`.",
        hold_at_most_s=2.0,
        by_busy_computer=True,
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
        by_busy_computer=True,
    )
    ROBOT_LOST = Rule(
        _KEEP,
        "the robot, or the daemon's process that drives it, is gone: {detail}.",
        "It reconnects automatically; then send `shearloop command unlock`, and the experiment can begin.",
        by_busy_computer=True,
    )
    ROBOT_BLOCKED = Rule(
        _KEEP,
        "the robot does not move: {detail}.",
        "Clear the cause and send `shearloop command unlock`. Then the experiment can begin.",
    )
    ROBOT_UNCONTROLLED = Rule(
        _KEEP,
        "the daemon has lost control of the robot: {detail}.",
        "If no person stopped it at the pendant, check its cable, and whether the daemon's computer is overloaded; "
        "then send `shearloop command unlock`, and the experiment can begin.",
        by_busy_computer=True,
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
        by_busy_computer=True,
    )
    LOOP_LATE = Rule(
        _HOLD,
        "the daemon is too slow for its devices: {detail}.",
        "End other programs on the daemon's computer, or see the service's real-time options. If the wrist stopped, "
        "send `shearloop command unlock`.",
        hold_at_most_s=5.0,
        is_past=True,
        explains=True,
        by_busy_computer=True,
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
        follows=True,
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
        _KEEP,
        "the operator stopped it: {detail}.",
        "Send `shearloop command unlock` before the next start.",
        asked_for=True,
    )
    TOOL_GRIPPED = Rule(
        Response.NOTE,
        "a tool is still gripped: {detail}.",
        "Secure it. Then `shearloop command release --yes` opens the gripper, and the object drops.",
    )
    TOOL_MAY_BE_GRIPPED = Rule(
        Response.NOTE,
        "a tool may still be gripped: {detail}.",
        "Look, and secure a tool that is there. `shearloop command release --yes` opens the gripper, and it drops.",
    )
    GRIP_UNKNOWN = Rule(
        Response.NOTE,
        "the gripper holds something in a grip that is not known: {detail}.",
        "Angle, force and zeros of an earlier grip are not used. Check what it holds; "
        "`shearloop command release --yes` opens the gripper, and the object drops.",
    )
    DAEMON_ENDED = Rule(
        _KEEP, "the daemon ended: {detail}.", "Look at the rig, then send `shearloop command unlock`.", asked_for=True
    )

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
_CURE_OF_THE_PAST = "Look at the rig, then send `shearloop command unlock`."
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
    # When it stopped the rig of an earlier process, in words; empty for a fault of this process.
    when: str = field(default="", compare=False)
    # Whether it is known to be over, though its stop still waits for the operator.
    is_over: bool = field(default=False, compare=False)

    @property
    def rule(self) -> Rule:
        """The table's row."""
        return TABLE[self.code]

    @property
    def is_old(self) -> bool:
        """Whether only the age of the last message shows it."""
        return self.code in (FaultCode.STATE_STALE, FaultCode.ESTIMATE_STALE) and self.t_ns is not None

    @property
    def cause(self) -> str:
        """The sentence without its full stop and without the cure; a fault of the past begins with its time."""
        when = ", ".join(filter(None, (self.when, "over by now" if self.is_over else "")))
        # A driver's detail may end with a full stop; the sentence has its own.
        sentence = self.rule.sentence.format(detail=self.detail.removesuffix(".")).removesuffix(".")
        return f"{when}: {sentence}" if when else sentence

    @property
    def sentence(self) -> str:
        """The operator's sentence, with the cure."""
        return f"{self.cause}. {_CURE_OF_THE_PAST if self.is_over else self.rule.cure}"
