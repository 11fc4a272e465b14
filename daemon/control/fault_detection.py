"""From what is sensed to what is wrong: the events of the safety table, with the numbers of this moment."""

from collections.abc import Iterable
from dataclasses import dataclass

from shearloop.daemon.control.experiment_schema import ExperimentLimits
from shearloop.daemon.control.loop_inputs import ArmStatus, GripperStatus, LoopInputs, TorqueSource
from shearloop.daemon.control.safety import Fault, FaultCode
from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS, stale_after_s

# 2.5 periods of their topics. The arm stands still by itself when it hears nothing for 0.3 s.
ARM_STALE_S = stale_after_s("robot.state")
HAND_STALE_S = stale_after_s("gripper.state")
# While an experiment runs the brain is asked at each state that the robot's process tells, of at least two cycles in
# five (`shearloop.drivers.ur.pace`), and is late where that takes longer than this.
LONGEST_TICK_S = 0.03
# Later than this, and the state that was last decided upon had become stale while the wrist turned on it.
LATEST_LOOP_S = ARM_STALE_S - LONGEST_TICK_S
# A loop that is away for longer was hardly slow: its process was paused. The robot's process has stopped the arm
# meanwhile. While the computer is suspended CLOCK_MONOTONIC stands still: of that devices tell that were lost by it.
AWAY_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorSettings:
    """How far two torques may be apart, and how fast one may change without the wrist's doing."""

    disagreement_nm: float = 0.05
    jump_nm: float = 0.08
    # A sensor that is quicker than this is not silent yet where the computer was late.
    freshness_s: float = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class MonitorInputs:
    """What is watched at present: the sources, the limits, and what the experiment relies on."""

    driving: TorqueSource
    supervising: tuple[TorqueSource, ...]
    limits: ExperimentLimits
    # Whether the torque is needed now: while the wrist is driven by it or twists under its limit.
    torque_needed: bool
    gripped: bool
    twisted_rad: float
    expected_nm: float | None = None
    overdue: str = ""
    required: tuple[str, ...] = ()


def troubles(senses: LoopInputs, watched: MonitorInputs, settings: MonitorSettings, t_ns: int) -> list[Fault]:
    """Return everything that is wrong at t_ns, in the order of the table."""
    # In each of the robot's cycles, and nearly always nothing: generators would cost more than what they look at.
    found: list[Fault] = []
    if watched.torque_needed:
        found += _torque(senses, watched, settings, t_ns)
    found += _limits(senses, watched, settings, t_ns)
    found += _arm_and_hand(senses, watched, t_ns)
    for name, why in senses.lost.items():
        if name in watched.required and name not in _awaited(senses, watched):
            lost = (FaultCode.ROBOT_LOST, why) if name == "robot" else (FaultCode.DEVICE_LOST, f"{name}: {why}")
            found.append(Fault(*lost))
    for name, why in senses.died.items():
        found.append(Fault(FaultCode.TASK_DIED, f"{name}: {why}"))
    if senses.late_s > AWAY_S:
        found.append(Fault(FaultCode.DAEMON_PAUSED, f"it stood still for {senses.late_s:.1f} s"))
    elif senses.late_s > LATEST_LOOP_S:
        found.append(Fault(FaultCode.LOOP_LATE, f"the loop was woken {senses.late_s * 1e3:.0f} ms late"))
    if senses.recording_failed:
        found.append(Fault(FaultCode.RECORDING_FAILED, senses.recording_failed))
    if watched.overdue:
        found.append(Fault(FaultCode.STEP_OVERDUE, watched.overdue))
    return found


def _torque(senses: LoopInputs, watched: MonitorInputs, settings: MonitorSettings, t_ns: int) -> list[Fault]:
    source = watched.driving
    found: list[Fault] = []
    for other in watched.supervising:
        # The wrench comes with the arm's state, which is watched by itself.
        if not other.of_the_arm:
            found += _unusable(senses, other, settings, t_ns)
    driving = _unusable(senses, source, settings, t_ns)
    found += driving
    latest = senses.torques.get(source.name)
    if driving or latest is None or latest.torque_nm is None:
        return found
    if watched.expected_nm is not None and abs(latest.torque_nm - watched.expected_nm) > settings.jump_nm:
        jumped = (
            f"{source.name} says {latest.torque_nm:+.3f} N·m where {watched.expected_nm:+.3f} N·m was to be expected"
        )
        found.append(Fault(FaultCode.ESTIMATE_JUMPED, jumped))
    for other in watched.supervising:
        found += _disagreement(senses, source, other, settings, t_ns)
    return found


def _unusable(senses: LoopInputs, source: TorqueSource, settings: MonitorSettings, t_ns: int) -> list[Fault]:
    """Return why a source says nothing about the torque of now: it is silent, late or gone, or what it says is void."""
    if why := _not_fresh(senses, source, settings, t_ns):
        return [Fault(FaultCode.ESTIMATE_STALE, why)]
    latest = senses.torques[source.name]
    if latest.torque_nm is None and source.measures_torque:
        return [Fault(FaultCode.ESTIMATE_INVALID, f"{source.name} says: {latest.why or 'nothing'}")]
    return []


def _not_fresh(senses: LoopInputs, source: TorqueSource, settings: MonitorSettings, t_ns: int) -> str:
    """Return why a source says nothing about the present, or the empty string."""
    latest = senses.torques.get(source.name)
    if source.name in senses.lost:
        lost = senses.lost[source.name]
        return f"{source.name} has not been there yet: {lost}" if latest is None else f"{source.name} is gone: {lost}"
    if latest is None:
        return f"{source.name} has not measured anything yet"
    came_s, measured_s = (t_ns - latest.t_ns) / 1e9, (t_ns - latest.t_mid_ns) / 1e9
    allowed_s = _fresh_for_s(source, settings)
    if came_s > allowed_s:
        return f"the last torque of {source.name} came {came_s:.1f} s ago, {allowed_s:.1f} s are allowed"
    # What belongs to the middle of an acquisition is half of it old when that ends. The rest is for its way here: a
    # board or an estimator that runs ever later sends in time, and of a past that is over.
    oldest_s = allowed_s + 0.5 * max(source.window_s, source.period_s)
    if measured_s > oldest_s:
        return (
            f"the last torque of {source.name} was measured {measured_s:.1f} s ago, {oldest_s:.1f} s are allowed; "
            f"it took {measured_s - came_s:.1f} s to come"
        )
    return ""


def _fresh_for_s(source: TorqueSource, settings: MonitorSettings) -> float:
    """Return how long a torque of a source speaks of the present after it has come."""
    return max(STALE_AFTER_PERIODS * source.period_s, settings.freshness_s)


def compared_for_s(sources: Iterable[TorqueSource], settings: MonitorSettings) -> float:
    """Return for how long torques are compared with others: the oldest that counts as new, with its acquisition."""
    return max(_fresh_for_s(one, settings) + 2.0 * max(one.window_s, one.period_s) for one in sources)


def _disagreement(
    senses: LoopInputs, one: TorqueSource, other: TorqueSource, settings: MonitorSettings, t_ns: int
) -> list[Fault]:
    """Compare two torques at the time of the slower one's latest frame, over its own window."""
    slow, fast = (one, other) if one.period_s >= other.period_s else (other, one)
    latest = senses.torques.get(slow.name)
    if latest is None or latest.torque_nm is None or t_ns - latest.t_ns > _fresh_for_s(slow, settings) * 1e9:
        return []
    half_ns = round(max(slow.window_s, fast.period_s) * 0.5e9)
    beside_nm = senses.mean_torque_nm(fast.name, latest.t_mid_ns - half_ns, latest.t_mid_ns + half_ns)
    if beside_nm is None:
        return []
    apart_nm = abs(latest.torque_nm - beside_nm)
    if apart_nm > settings.disagreement_nm:
        apart = (
            f"{slow.name} says {latest.torque_nm:+.3f} N·m and {fast.name} {beside_nm:+.3f} N·m, "
            f"{apart_nm:.3f} N·m apart where {settings.disagreement_nm:g} are allowed"
        )
        return [Fault(FaultCode.TORQUES_DISAGREE, apart)]
    return []


def _limits(senses: LoopInputs, watched: MonitorInputs, settings: MonitorSettings, t_ns: int) -> list[Fault]:
    limit_nm, limit_rad = watched.limits.torque_nm, watched.limits.angle_rad
    found: list[Fault] = []
    for source in (watched.driving, *watched.supervising):
        torque = senses.torques.get(source.name)
        if torque is None or torque.torque_nm is None or t_ns - torque.t_ns > _fresh_for_s(source, settings) * 1e9:
            continue
        if abs(torque.torque_nm) > limit_nm:
            beyond = f"{source.name} says {torque.torque_nm:+.3f} N·m, the limit is {limit_nm:g} N·m"
            found.append(Fault(FaultCode.TORQUE_LIMIT, beyond))
    if watched.gripped and abs(watched.twisted_rad) > limit_rad:
        turned = f"turned by {watched.twisted_rad:+.3f} rad since the grip, the limit is {limit_rad:g} rad"
        found.append(Fault(FaultCode.ANGLE_LIMIT, turned))
    return found


def _awaited(senses: LoopInputs, watched: MonitorInputs) -> tuple[str, ...]:
    """Return the devices that have not told anything since the daemon began: of those none can be gone."""
    robot = ("robot",) if senses.arm is None else ()
    return (*robot, "gripper") if senses.hand is None and "gripper" in watched.required else robot


def _arm_and_hand(senses: LoopInputs, watched: MonitorInputs, t_ns: int) -> list[Fault]:
    arm, hand = senses.arm, senses.hand
    found: list[Fault] = []
    if awaited := _awaited(senses, watched):
        # All at once: before they are switched on there is one thing to say.
        told = (f"{name}, {senses.lost[name].removesuffix('.')}" if name in senses.lost else name for name in awaited)
        found.append(Fault(FaultCode.DEVICE_AWAITED, "; ".join(told)))
    if arm is not None:
        found += _arm(arm, t_ns)
    if hand is not None and "gripper" in watched.required:
        found += _hand(hand, t_ns, gripped=watched.gripped)
    return found


def _arm(arm: ArmStatus, t_ns: int) -> list[Fault]:
    if t_ns - arm.t_ns > ARM_STALE_S * 1e9:
        return [Fault(FaultCode.STATE_STALE, f"the robot last reported its state {(t_ns - arm.t_ns) / 1e9:.2f} s ago")]
    if arm.emergency_stop:
        return [Fault(FaultCode.EMERGENCY_STOP, arm.blocked or "the controller reports it")]
    if arm.protective_stop:
        return [Fault(FaultCode.PROTECTIVE_STOP, arm.blocked or "the controller reports it")]
    if arm.blocked:
        return [Fault(FaultCode.ROBOT_BLOCKED, arm.blocked)]
    return []


def _hand(hand: GripperStatus, t_ns: int, *, gripped: bool) -> list[Fault]:
    if t_ns - hand.t_ns > HAND_STALE_S * 1e9:
        return [
            Fault(FaultCode.STATE_STALE, f"the gripper last reported its state {(t_ns - hand.t_ns) / 1e9:.1f} s ago")
        ]
    if hand.fault:
        return [Fault(FaultCode.GRIPPER_FAULT, hand.fault)]
    if gripped and not hand.holding:
        return [Fault(FaultCode.GRIP_LOST, f"its fingers are {hand.width_mm:.1f} mm apart with nothing between them")]
    return []
