"""Fault detection: from the loop's inputs to the faults of the safety table, with their present numbers."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from shearloop.daemon.control.experiment_schema import ExperimentLimits
from shearloop.daemon.control.loop_inputs import ArmStatus, GripperStatus, LoopConfig, TorqueSample, TorqueSource
from shearloop.daemon.control.safety import Fault, FaultCode
from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS, stale_after_s

# 2.5 periods of their topics.
ARM_STALE_S = stale_after_s("robot.state")
HAND_STALE_S = stale_after_s("gripper.state")
# The loop decides on each of the robot's states; a longer interval is late.
LONGEST_TICK_S = 0.02
# A loop later than this turned the wrist on a stale state.
LATEST_LOOP_S = ARM_STALE_S - LONGEST_TICK_S
# A longer absence is a paused process rather than a slow loop. CLOCK_MONOTONIC stands while the computer is suspended;
# the devices that were lost report that case.
AWAY_S = 1.0


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


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorInputs:
    """The sources, the limits and the experiment's present needs."""

    driving: TorqueSource
    supervising: tuple[TorqueSource, ...]
    limits: ExperimentLimits
    # The wrist is driven by the torque, or twists under its limit.
    torque_needed: bool
    gripped: bool
    twisted_rad: float
    expected_nm: float | None = None
    overdue: str = ""
    required: tuple[str, ...] = ()


def detect_faults(inputs: LoopInputs, watched: MonitorInputs, config: LoopConfig, t_ns: int) -> list[Fault]:
    """Return every fault at t_ns, in the order of the safety table."""
    found: list[Fault] = []
    if watched.torque_needed:
        found += _torque_faults(inputs, watched, config, t_ns)
    found += _limit_faults(inputs, watched, config, t_ns)
    found += _device_faults(inputs, watched, t_ns)
    for name, reason in inputs.lost.items():
        if name in watched.required and name not in _awaited(inputs, watched):
            lost = (FaultCode.ROBOT_LOST, reason) if name == "robot" else (FaultCode.DEVICE_LOST, f"{name}: {reason}")
            found.append(Fault(*lost))
    for name, reason in inputs.died.items():
        found.append(Fault(FaultCode.TASK_DIED, f"{name}: {reason}"))
    if inputs.late_s > AWAY_S:
        found.append(Fault(FaultCode.DAEMON_PAUSED, f"it stood still for {inputs.late_s:.1f} s"))
    elif inputs.late_s > LATEST_LOOP_S:
        found.append(Fault(FaultCode.LOOP_LATE, f"the loop ran {inputs.late_s * 1e3:.0f} ms late"))
    if inputs.recording_error:
        found.append(Fault(FaultCode.RECORDING_FAILED, inputs.recording_error))
    if watched.overdue:
        found.append(Fault(FaultCode.STEP_OVERDUE, watched.overdue))
    return found


def compared_for_s(sources: Iterable[TorqueSource], config: LoopConfig) -> float:
    """Return the history that comparing two sources takes: the oldest fresh torque with its acquisition."""
    return max(_fresh_for_s(one, config) + 2.0 * max(one.window_s, one.period_s) for one in sources)


def _torque_faults(inputs: LoopInputs, watched: MonitorInputs, config: LoopConfig, t_ns: int) -> list[Fault]:
    source = watched.driving
    found: list[Fault] = []
    for other in watched.supervising:
        if not other.from_robot:
            found += _unusable(inputs, other, config, t_ns)
    driving = _unusable(inputs, source, config, t_ns)
    found += driving
    latest = inputs.torques.get(source.name)
    if driving or latest is None or latest.torque_nm is None:
        return found
    if watched.expected_nm is not None and abs(latest.torque_nm - watched.expected_nm) > config.max_innovation_nm:
        jumped = f"{source.name} measured {latest.torque_nm:+.3f} N·m where {watched.expected_nm:+.3f} N·m was expected"
        found.append(Fault(FaultCode.ESTIMATE_JUMPED, jumped))
    for other in watched.supervising:
        found += _disagreement(inputs, source, other, config, t_ns)
    return found


def _unusable(inputs: LoopInputs, source: TorqueSource, config: LoopConfig, t_ns: int) -> list[Fault]:
    """Return the fault of a source that is silent, late, gone or invalid."""
    if reason := _stale(inputs, source, config, t_ns):
        return [Fault(FaultCode.ESTIMATE_STALE, reason)]
    latest = inputs.torques[source.name]
    if latest.torque_nm is None and source.measures_torque:
        return [Fault(FaultCode.ESTIMATE_INVALID, f"{source.name} says: {latest.reason or 'nothing'}")]
    return []


def _stale(inputs: LoopInputs, source: TorqueSource, config: LoopConfig, t_ns: int) -> str:
    """Return why a source has no fresh torque, or an empty string."""
    latest = inputs.torques.get(source.name)
    if source.name in inputs.lost:
        lost = inputs.lost[source.name]
        return f"{source.name} is not connected yet: {lost}" if latest is None else f"{source.name} is gone: {lost}"
    if latest is None:
        return f"{source.name} has not measured anything yet"
    came_s, measured_s = (t_ns - latest.t_ns) / 1e9, (t_ns - latest.t_mid_ns) / 1e9
    allowed_s = _fresh_for_s(source, config)
    if came_s > allowed_s:
        return f"the last torque of {source.name} came {came_s:.1f} s ago, {allowed_s:.1f} s are allowed"
    # A torque is half its acquisition old at its end. The rest of its age is transport: a board or an estimator that
    # falls behind sends on time, but old torques.
    oldest_s = allowed_s + 0.5 * max(source.window_s, source.period_s)
    if measured_s > oldest_s:
        return (
            f"the last torque of {source.name} was measured {measured_s:.1f} s ago, {oldest_s:.1f} s are allowed; "
            f"it took {measured_s - came_s:.1f} s to come"
        )
    return ""


def _fresh_for_s(source: TorqueSource, config: LoopConfig) -> float:
    """Return how long after its arrival a torque is fresh."""
    return max(STALE_AFTER_PERIODS * source.period_s, config.stale_after_s)


def _disagreement(
    inputs: LoopInputs, one: TorqueSource, other: TorqueSource, config: LoopConfig, t_ns: int
) -> list[Fault]:
    """Compare two torques over the window of the slower source's latest sample."""
    slow, fast = (one, other) if one.period_s >= other.period_s else (other, one)
    latest = inputs.torques.get(slow.name)
    if latest is None or latest.torque_nm is None or t_ns - latest.t_ns > _fresh_for_s(slow, config) * 1e9:
        return []
    half_ns = round(max(slow.window_s, fast.period_s) * 0.5e9)
    other_nm = inputs.mean_torque_nm(fast.name, latest.t_mid_ns - half_ns, latest.t_mid_ns + half_ns)
    if other_nm is None:
        return []
    apart_nm = abs(latest.torque_nm - other_nm)
    if apart_nm > config.disagreement_nm:
        apart = (
            f"{slow.name} measured {latest.torque_nm:+.3f} N·m and {fast.name} {other_nm:+.3f} N·m, "
            f"{apart_nm:.3f} N·m apart where {config.disagreement_nm:g} are allowed"
        )
        return [Fault(FaultCode.TORQUES_DISAGREE, apart)]
    return []


def _limit_faults(inputs: LoopInputs, watched: MonitorInputs, config: LoopConfig, t_ns: int) -> list[Fault]:
    limit_nm, limit_rad = watched.limits.torque_nm, watched.limits.angle_rad
    found: list[Fault] = []
    for source in (watched.driving, *watched.supervising):
        torque = inputs.torques.get(source.name)
        if torque is None or torque.torque_nm is None or t_ns - torque.t_ns > _fresh_for_s(source, config) * 1e9:
            continue
        if abs(torque.torque_nm) > limit_nm:
            beyond = f"{source.name} measured {torque.torque_nm:+.3f} N·m, the limit is {limit_nm:g} N·m"
            found.append(Fault(FaultCode.TORQUE_LIMIT, beyond))
    if watched.gripped and abs(watched.twisted_rad) > limit_rad:
        turned = f"turned by {watched.twisted_rad:+.3f} rad since the grip, the limit is {limit_rad:g} rad"
        found.append(Fault(FaultCode.ANGLE_LIMIT, turned))
    return found


def _awaited(inputs: LoopInputs, watched: MonitorInputs) -> tuple[str, ...]:
    """Return the devices without any state since the daemon's start; they count as awaited, not as lost."""
    robot = ("robot",) if inputs.arm is None else ()
    return (*robot, "gripper") if inputs.gripper is None and "gripper" in watched.required else robot


def _device_faults(inputs: LoopInputs, watched: MonitorInputs, t_ns: int) -> list[Fault]:
    arm, gripper = inputs.arm, inputs.gripper
    found: list[Fault] = []
    if awaited := _awaited(inputs, watched):
        # One fault for all devices that are not switched on yet.
        waits = (f"{name}, {inputs.lost[name].removesuffix('.')}" if name in inputs.lost else name for name in awaited)
        found.append(Fault(FaultCode.DEVICE_AWAITED, "; ".join(waits)))
    if arm is not None:
        found += _arm_faults(arm, t_ns)
    if gripper is not None and "gripper" in watched.required:
        found += _gripper_faults(gripper, t_ns, gripped=watched.gripped)
    return found


def _arm_faults(arm: ArmStatus, t_ns: int) -> list[Fault]:
    if t_ns - arm.t_ns > ARM_STALE_S * 1e9:
        return [Fault(FaultCode.STATE_STALE, f"the robot last reported its state {(t_ns - arm.t_ns) / 1e9:.2f} s ago")]
    if arm.emergency_stop:
        return [Fault(FaultCode.EMERGENCY_STOP, arm.blocked or "the controller reports it")]
    if arm.protective_stop:
        return [Fault(FaultCode.PROTECTIVE_STOP, arm.blocked or "the controller reports it")]
    if arm.blocked:
        return [Fault(FaultCode.ROBOT_BLOCKED, arm.blocked)]
    return []


def _gripper_faults(gripper: GripperStatus, t_ns: int, *, gripped: bool) -> list[Fault]:
    age_s = (t_ns - gripper.t_ns) / 1e9
    if age_s > HAND_STALE_S:
        return [Fault(FaultCode.STATE_STALE, f"the gripper last reported its state {age_s:.1f} s ago")]
    if gripper.fault:
        return [Fault(FaultCode.GRIPPER_FAULT, gripper.fault)]
    if gripped and not gripper.holding:
        lost = f"its fingers are {gripper.width_mm:.1f} mm apart with nothing between them"
        return [Fault(FaultCode.GRIP_LOST, lost)]
    return []
