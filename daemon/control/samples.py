"""What the control loop takes: torque samples, the states of arm and gripper with times, and the latest of each."""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS

# Torques between two ticks; more come only while the loop stands still.
MOST_UNJUDGED = 256


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
            object.__setattr__(self, "reason", f"it measured {self.torque_nm}, which is no number")
            object.__setattr__(self, "torque_nm", None)


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
    # Nothing but the start of an experiment is missing: it enables the arm.
    enabled_by_start: bool = False


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


@dataclass(frozen=True, slots=True, kw_only=True)
class TorqueSource:
    """A source of torques: its period and the averaging window of one torque.

    `has_friction_band`: friction hides the torque within a band; the wrist turns through it without a change.
    `from_robot`: the torque comes with the robot's state, so its age is checked there. `measures_torque` is False for a
    fingertip without a calibration; a silent one is a fault all the same. `warm_up_s`: the longest time from a grip to
    the first torque; 0 for a source that measures without a grip. `has_gain`: an `adapt` step can correct its gain.
    """

    name: str
    period_s: float
    window_s: float = 0.0
    has_friction_band: bool = False
    from_robot: bool = False
    measures_torque: bool = True
    warm_up_s: float = 0.0
    has_gain: bool = False

    def fresh_s(self, config: LoopConfig) -> float:
        """Return how long after its arrival a torque is fresh."""
        return max(STALE_AFTER_PERIODS * self.period_s, config.stale_after_s)


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
    unjudged: deque[TorqueSample] = field(default_factory=lambda: deque(maxlen=MOST_UNJUDGED))
    arm: ArmStatus | None = None
    gripper: GripperStatus | None = None
    lost: dict[str, str] = field(default_factory=dict)
    recording_error: str = ""
    # How late the loop is, and the error of each dead task.
    late_s: float = 0.0
    died: Mapping[str, str] = field(default_factory=dict)

    def add_torque(self, torque: TorqueSample) -> None:
        """Store a torque, unless it is older than the latest one of its source."""
        known = self.torques.get(torque.source)
        if known is not None and torque.t_mid_ns <= known.t_mid_ns:
            return
        self.torques[torque.source] = torque
        if torque.torque_nm is None:
            return
        self.unjudged.append(torque)
        times_ns, torques_nm = self.history.setdefault(torque.source, ([], []))
        times_ns.append(torque.t_mid_ns)
        torques_nm.append(torque.torque_nm)
        kept_ns = round(self.kept_s * 1e9)
        # Trimmed rarely, because it moves the whole lists.
        if times_ns[0] < torque.t_mid_ns - 2 * kept_ns:
            old = bisect_left(times_ns, torque.t_mid_ns - kept_ns)
            del times_ns[:old], torques_nm[:old]
