"""Inputs of the control loop: the latest torques and device states, with their times. Values only."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class TorqueSample:
    """One torque of one source, with the time of its measurement (`t_mid_ns`) and of its arrival (`t_ns`).

    `torque_nm` is None if it is not valid, for `reason`. `low_nm` and `high_nm` bound the friction band that
    hides the torque.
    """

    source: str
    torque_nm: float | None
    reason: str
    t_mid_ns: int
    t_ns: int
    low_nm: float | None = None
    high_nm: float | None = None

    def __post_init__(self) -> None:
        """Treat NaN and infinity as no torque."""
        if self.torque_nm is not None and not math.isfinite(self.torque_nm):
            object.__setattr__(self, "torque_nm", None)

    def nearest_to(self, expected_nm: float | None) -> float | None:
        """Return the torque of the friction band that is nearest to the expected one."""
        if self.torque_nm is None or self.low_nm is None or self.high_nm is None or expected_nm is None:
            return self.torque_nm
        return min(max(expected_nm, self.low_nm), self.high_nm)


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """State of the robot, as far as the loop needs it."""

    wrist_rad: float
    t_ns: int
    protective_stop: bool = False
    emergency_stop: bool = False
    blocked: str = ""


@dataclass(frozen=True, slots=True)
class GripperStatus:
    """State of the gripper, as far as the loop needs it.

    `uncertain`: the gripper cannot say whether it holds an object, because it is inactive, lost its power, or was
    stopped on its way.
    """

    t_ns: int
    width_mm: float
    holding: bool
    moving: bool
    fault: str = ""
    uncertain: bool = False

    @property
    def uncertainty(self) -> str:
        """Why the gripper does not know whether it holds an object; completes "its fingers …"."""
        return "are moving" if self.moving else "stand where a stop, an activation or a lack of power has left them"


@dataclass(frozen=True, slots=True, kw_only=True)
class TorqueSource:
    """A source of torques: its period and the averaging window of one torque.

    `has_friction_band`: friction hides the torque within a band; the wrist turns through it without a change.
    `from_robot`: the torque comes with the robot's state, so its age is checked there. `measures_torque` is False for a
    fingertip without a calibration; a silent one is a fault all the same.
    """

    name: str
    period_s: float
    window_s: float = 0.0
    has_friction_band: bool = False
    from_robot: bool = False
    measures_torque: bool = True


@dataclass(slots=True)
class _History:
    """Valid torques of one source, ordered by the time of measurement."""

    t_mid_ns: list[int] = field(default_factory=list)
    torque_nm: list[float] = field(default_factory=list)

    def add(self, t_mid_ns: int, torque_nm: float, kept_ns: int) -> None:
        """Append a torque, and trim once the list spans twice `kept_ns`."""
        self.t_mid_ns.append(t_mid_ns)
        self.torque_nm.append(torque_nm)
        if self.t_mid_ns[0] < t_mid_ns - 2 * kept_ns:
            old = bisect_left(self.t_mid_ns, t_mid_ns - kept_ns)
            del self.t_mid_ns[:old], self.torque_nm[:old]

    def mean(self, from_ns: int, to_ns: int) -> float | None:
        """Return the mean torque between two times, ends included; None without any."""
        first, end = bisect_left(self.t_mid_ns, from_ns), bisect_right(self.t_mid_ns, to_ns)
        return sum(self.torque_nm[first:end]) / (end - first) if end > first else None


@dataclass(slots=True)
class LoopInputs:
    """The latest inputs. `lost` and `died` map missing devices and dead tasks to a sentence.

    Valid torques are kept for `kept_s`, to compare two sources at the same time.
    """

    kept_s: float = 10.0
    torques: dict[str, TorqueSample] = field(default_factory=dict)
    history: dict[str, _History] = field(default_factory=dict)
    arm: ArmStatus | None = None
    gripper: GripperStatus | None = None
    lost: dict[str, str] = field(default_factory=dict)
    died: Mapping[str, str] = field(default_factory=dict)
    recording_error: str = ""
    late_s: float = 0.0

    def add_torque(self, torque: TorqueSample) -> None:
        """Store a torque, unless it is older than the latest one of its source."""
        known = self.torques.get(torque.source)
        if known is not None and torque.t_mid_ns <= known.t_mid_ns:
            return
        self.torques[torque.source] = torque
        if torque.torque_nm is not None:
            history = self.history.setdefault(torque.source, _History())
            history.add(torque.t_mid_ns, torque.torque_nm, round(self.kept_s * 1e9))

    def mean_torque_nm(self, source: str, from_ns: int, to_ns: int) -> float | None:
        """Return the mean of a source's valid torques between two times, or None without any."""
        known = self.history.get(source)
        return None if known is None else known.mean(from_ns, to_ns)
