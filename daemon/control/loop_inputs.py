"""The latest of everything that the loop goes by, with the times that say how old it is. Values only."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class TorqueSample:
    """One torque of one source: None where it is not valid; when it was measured and when it became known.

    Where friction hides the torque within a band, `low_nm` and `high_nm` are its ends: anything between is as likely.
    """

    source: str
    torque_nm: float | None
    why: str
    t_mid_ns: int
    t_ns: int
    low_nm: float | None = None
    high_nm: float | None = None

    def __post_init__(self) -> None:
        """Take what is not a number for no torque at all."""
        if self.torque_nm is not None and not math.isfinite(self.torque_nm):
            object.__setattr__(self, "torque_nm", None)

    def nearest_to(self, expected_nm: float | None) -> float | None:
        """Return the torque within the band that is nearest to the expected one; what is inside contradicts nothing."""
        if self.torque_nm is None or self.low_nm is None or self.high_nm is None or expected_nm is None:
            return self.torque_nm
        return min(max(expected_nm, self.low_nm), self.high_nm)


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """What the loop needs of the robot's state."""

    wrist_rad: float
    t_ns: int
    protective_stop: bool = False
    emergency_stop: bool = False
    blocked: str = ""


@dataclass(frozen=True, slots=True)
class GripperStatus:
    """What the loop needs of the gripper's state.

    `unsure` where the gripper does not say whether it holds anything, though it may: it was not sent where its fingers
    stand, as after a halt or without power, or it is not active.
    """

    t_ns: int
    width_mm: float
    holding: bool
    moving: bool
    fault: str = ""
    unsure: bool = False

    @property
    def stands(self) -> str:
        """How fingers stand that do not say whether they hold anything."""
        return "are moving" if self.moving else "stand where a stop, an activation or a lack of power has left them"


@dataclass(frozen=True, slots=True, kw_only=True)
class TorqueSource:
    """A torque that can drive or supervise: how often it comes, and over what time it averages.

    `sticks` where friction hides it within a band: then it says nothing while the wrist turns through the band.
    `of_the_arm` where it comes with the arm's state, whose age is watched already. `measures_torque` is false where
    nothing makes a torque of what it measures, as of a fingertip without a calibration: that it is silent is told all
    the same.
    """

    name: str
    period_s: float
    window_s: float = 0.0
    sticks: bool = False
    of_the_arm: bool = False
    measures_torque: bool = True


@dataclass(slots=True)
class _Recent:
    """The valid torques of one source, in order of the time that they belong to."""

    t_mid_ns: list[int] = field(default_factory=list)
    torque_nm: list[float] = field(default_factory=list)

    def add(self, t_mid_ns: int, torque_nm: float, kept_ns: int) -> None:
        """Append one; those before `kept_ns` are forgotten when they are as many as the others, which is cheap."""
        self.t_mid_ns.append(t_mid_ns)
        self.torque_nm.append(torque_nm)
        if self.t_mid_ns[0] < t_mid_ns - 2 * kept_ns:
            old = bisect_left(self.t_mid_ns, t_mid_ns - kept_ns)
            del self.t_mid_ns[:old], self.torque_nm[:old]

    def mean(self, from_ns: int, to_ns: int) -> float | None:
        """Return the mean of those between two times, ends included; None where there is none."""
        first, end = bisect_left(self.t_mid_ns, from_ns), bisect_right(self.t_mid_ns, to_ns)
        return sum(self.torque_nm[first:end]) / (end - first) if end > first else None


@dataclass(slots=True)
class LoopInputs:
    """The latest values. `lost` and `died` map a device or task to a sentence while it is gone.

    Valid torques are kept for `kept_s`, to compare two sources at the same time, whatever their rates.
    """

    kept_s: float = 10.0
    torques: dict[str, TorqueSample] = field(default_factory=dict)
    recent: dict[str, _Recent] = field(default_factory=dict)
    arm: ArmStatus | None = None
    hand: GripperStatus | None = None
    lost: dict[str, str] = field(default_factory=dict)
    died: Mapping[str, str] = field(default_factory=dict)
    recording_failed: str = ""
    late_s: float = 0.0

    def hear(self, torque: TorqueSample) -> None:
        """Take in a torque; what is older than what is known already is left out."""
        known = self.torques.get(torque.source)
        if known is not None and torque.t_mid_ns <= known.t_mid_ns:
            return
        self.torques[torque.source] = torque
        if torque.torque_nm is not None:
            recent = self.recent.setdefault(torque.source, _Recent())
            recent.add(torque.t_mid_ns, torque.torque_nm, round(self.kept_s * 1e9))

    def mean_torque_nm(self, source: str, from_ns: int, to_ns: int) -> float | None:
        """Return the mean of a source's valid torques that belong to a time, or None where there is none."""
        known = self.recent.get(source)
        return None if known is None else known.mean(from_ns, to_ns)
