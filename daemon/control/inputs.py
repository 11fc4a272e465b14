"""The inputs of the control loop: states of arm and gripper with their times, and the latest of each input."""

from bisect import bisect_left
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from shearloop.daemon.control.faults import Fault
from shearloop.daemon.messaging.deadlines import stood_still
from shearloop.daemon.messaging.messages import stale_after_s
from shearloop.daemon.torques import TorqueSample
from shearloop.estimation import Measured

# The loop decides at least this often; a longer time is a standstill of the daemon.
LONGEST_REST_S = stale_after_s("robot.state")
# After a standstill, what the devices sent meanwhile has been read by then, and a fingertip has sent another frame.
READ_WITHIN_S = 1.0
# Torques between two ticks; more come only while the loop stands still.
MAX_UNJUDGED = 256


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """State of the robot, as far as the loop needs it."""

    wrist_rad: float
    t_ns: int
    protective_stop: bool = False
    emergency_stop: bool = False
    blocked: str = ""
    # The robot is being unlocked, powered or started.
    starting: bool = False
    # Messages that came late can be why it is blocked.
    late: bool = False
    # Nothing but the start of an experiment is missing: it enables the arm.
    enabled_by_start: bool = False
    # Why no torque of the wrench comes with it; empty where one does.
    no_torque: str = ""
    slowed_by: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class GripperStatus:
    """State of the gripper, as far as the loop needs it.

    `uncertain`: the gripper cannot say whether it holds an object, because it is inactive, lost its power, or was
    stopped on its way. `unfelt`: the fingers stand at a target that they did not open to, where an object as wide would
    not be felt. `requested_counts`: the position of the last request of any program. `others_requests`: the number of
    requests of other programs. `inactive`: it activates before its next motion, which opens and closes the fingers
    once. `too_hot`: it refuses a grip, and activates before it opens. `unmeasured_mm`: the width of a held object, with
    its largest error, by the maker's figures; None for a gripper that measures diameters.
    """

    t_ns: int
    width_mm: float
    holding: bool
    moving: bool
    fault: str = ""
    uncertain: bool = False
    unfelt: bool = False
    requested_counts: int | None = None
    others_requests: int = 0
    inactive: bool = False
    too_hot: bool = False
    unmeasured_mm: Measured | None = None

    @property
    def may_hold(self) -> bool:
        """Whether the fingers hold an object, or may."""
        return self.holding or self.moving or self.uncertain or self.unfelt

    @property
    def fingers(self) -> str:
        """A sentence on the motion and the width of its fingers."""
        width = f"{self.width_mm:.1f} mm"
        if self.holding:
            return f"its fingers hold something {width} wide"
        if self.moving:
            return f"its fingers move, {width} apart"
        if self.uncertain:
            return f"its fingers stand {width} apart, and it cannot say whether they hold something"
        nothing = "nothing wider between them" if self.unfelt else "nothing between them"
        return f"its fingers are {width} apart with {nothing}"


@dataclass(slots=True)
class LatestInputs:
    """The latest inputs; `lost` maps missing devices to a sentence.

    Valid torques are kept for `kept_s`, to compare sources at the same time: the times of measurement of each
    source, ascending, and the torques.
    """

    kept_s: float
    torques: dict[str, TorqueSample] = field(default_factory=dict)
    history: dict[str, tuple[list[int], list[float]]] = field(default_factory=dict)
    # Valid torques since the latest tick, which may be several of one source.
    unjudged: deque[TorqueSample] = field(default_factory=lambda: deque(maxlen=MAX_UNJUDGED))
    arm: ArmStatus | None = None
    gripper: GripperStatus | None = None
    lost: dict[str, str] = field(default_factory=dict)
    recording_error: str = ""
    # When the loop decided last, how late it was, and the error of each dead task.
    ticked_ns: int = 0
    late_s: float = 0.0
    died: Mapping[str, str] = field(default_factory=dict)
    # How long the latest standstill of the daemon was.
    _stood_s: float = 0.0
    # Until when what came meanwhile may be unread.
    _unread_until_ns: int = 0

    def begin_tick(self, t_ns: int, late_s: float) -> None:
        """Note a decision, and the standstill before it."""
        gap_s = (t_ns - self.ticked_ns) / 1e9
        if self.ticked_ns and gap_s > LONGEST_REST_S:
            self._stood_s, self._unread_until_ns = gap_s, t_ns + round(READ_WITHIN_S * 1e9)
        self.ticked_ns, self.late_s = t_ns, late_s

    def stood_s(self, t_ns: int) -> float:
        """Return how long the daemon stood still, while that is why states are old, and replies late; else 0."""
        gap_s = (t_ns - self.ticked_ns) / 1e9
        if self.ticked_ns and gap_s > LONGEST_REST_S:
            return gap_s
        return self._stood_s if t_ns < self._unread_until_ns else 0.0

    def why_refused(self, faults: Sequence[Fault], t_ns: int) -> str | None:
        """Return the sentences of faults that refuse a start, or the standstill that explains all of them, or None."""
        stood_s = self.stood_s(t_ns)
        if faults and stood_s and all(fault.is_old for fault in faults):
            return stood_still(stood_s)
        return " ".join(fault.sentence for fault in faults) or None

    def add_torque(self, torque: TorqueSample) -> None:
        """Store a torque as the latest one of its source, and in the history unless a later measurement is there.

        A mean over several frames lies before a single frame that came before it.
        """
        self.torques[torque.source] = torque
        if torque.torque_nm is None:
            return
        self.unjudged.append(torque)
        times_ns, torques_nm = self.history.setdefault(torque.source, ([], []))
        if times_ns and torque.t_mid_ns <= times_ns[-1]:
            return
        times_ns.append(torque.t_mid_ns)
        torques_nm.append(torque.torque_nm)
        kept_ns = round(self.kept_s * 1e9)
        # Trimmed rarely, because it moves the whole lists.
        if times_ns[0] < torque.t_mid_ns - 2 * kept_ns:
            old = bisect_left(times_ns, torque.t_mid_ns - kept_ns)
            del times_ns[:old], torques_nm[:old]
