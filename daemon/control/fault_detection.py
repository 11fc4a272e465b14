"""Fault detection: from the loop's inputs to the faults of the safety table, with their present numbers."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum

from shearloop.daemon.control.experiment_schema import ExperimentLimits
from shearloop.daemon.control.faults import Fault, FaultCode
from shearloop.daemon.control.inputs import ArmStatus, GripperStatus, LatestInputs
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS, stale_after_s
from shearloop.daemon.torques import TorqueSample, TorqueSource
from shearloop.words import beyond

# 2.5 periods of their topics.
ARM_STALE_S = stale_after_s("robot.state")
GRIPPER_STALE_S = stale_after_s("gripper.state")
# Torques of two fingertips whose acquisitions do not meet are of two moments: a turn changes the torque between them.
LONGEST_APART_S = 0.25
# The loop decides on each of the robot's states; a longer interval is late.
LONGEST_TICK_S = 0.02
# A loop later than this turned the wrist on a stale state.
LATEST_LOOP_S = ARM_STALE_S - LONGEST_TICK_S
# After a longer time between two decisions the robot's own deadlines have stopped the wrist, and a person may have come
# to it: in 0.3 s a hand moves 0.6 m (2 m/s, ISO 13855). CLOCK_MONOTONIC stands while the computer is suspended; the
# devices that were lost report that case.
LONGEST_HANG_S = 0.3


class Grasp(Enum):
    """What the fingers do with the tool."""

    NONE = "none"
    CHANGING = "changing"  # they open or close: a fingertip measures their motion, and no torque
    POSSIBLE = "possible"  # they may hold one that is not felt: it is watched like a held one
    HELD = "held"

    @property
    def may_hold(self) -> bool:
        """Whether a turn of the wrist may turn a tool."""
        return self in (Grasp.POSSIBLE, Grasp.HELD)


@dataclass(frozen=True, slots=True, kw_only=True)
class Watched:
    """What is watched for as long as an experiment lasts: the sources and the devices, by which rules."""

    driving: TorqueSource
    supervising: tuple[TorqueSource, ...]
    config: LoopConfig
    required: tuple[str, ...] = ()
    # Factor on the deadlines for states and decisions: above 1 on an emulated rig alone, which cannot hurt.
    patience: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningStep:
    """What a running experiment needs and expects in one tick."""

    # The wrist is driven by the torque, or twists under its limit.
    torque_needed: bool
    # Whether the step needs a zero of the driving torque, and it is not known.
    lacks_zero: bool
    grasp: Grasp
    twisted_rad: float
    # The torque that the closed loop expects, None without one.
    expected_nm: float | None
    # How the torque has moved without the wrist, where that is too much.
    not_following: str
    overdue: str | None
    # Requests of other programs to the gripper before the experiment.
    others_requests: int


def compared_for_s(sources: Iterable[TorqueSource]) -> float:
    """Return the history that comparing two sources takes: the oldest fresh torque with its acquisition."""
    return max(one.fresh_s + 2.0 * max(one.window_s, one.period_s) for one in sources)


def detect_faults(
    inputs: LatestInputs, watched: Watched, limits: ExperimentLimits, step: RunningStep | None, t_ns: int
) -> list[Fault]:
    """Return every fault that the inputs show at t_ns; `step` is None while no experiment runs.

    `ControlLoop.tick` adds the faults that were reported to it.
    """
    found: list[Fault] = []
    if step is not None and step.torque_needed:
        found += _torque_faults(inputs, watched, step, t_ns)
    grasp = step.grasp if step is not None else Grasp.NONE
    found += _torque_limit_faults(inputs, watched, limits.torque_nm, grasp, t_ns)
    if step is not None and grasp.may_hold and abs(step.twisted_rad) > limits.angle_rad:
        found.append(_angle_limit_fault(inputs, watched, limits.angle_rad, step.twisted_rad))
    found += _device_faults(inputs, watched, step, t_ns)
    for name, reason in inputs.died.items():
        found.append(Fault(FaultCode.TASK_DIED, f"{name}: {reason}"))
    found += _lateness_faults(inputs.late_s, watched.patience, t_ns)
    if inputs.recording_error:
        found.append(Fault(FaultCode.RECORDING_FAILED, inputs.recording_error))
    if step is not None and step.not_following:
        found.append(Fault(FaultCode.NOT_FOLLOWING, step.not_following, t_ns=t_ns))
    if step is not None and step.overdue is not None:
        slowed = inputs.arm.slowed_by if inputs.arm is not None else ()
        found.append(Fault(FaultCode.STEP_OVERDUE, "; ".join((step.overdue, *slowed))))
    return found


def _torque_limit_faults(
    inputs: LatestInputs, watched: Watched, limit_nm: float, grasp: Grasp, t_ns: int
) -> Iterator[Fault]:
    for source in (watched.driving, *watched.supervising):
        torque = _largest(inputs, source)
        if torque is None or torque.torque_nm is None or abs(torque.torque_nm) <= limit_nm + source.noise_nm:
            continue
        if grasp is Grasp.CHANGING and source.warm_up_s:
            continue
        if t_ns - torque.t_ns <= source.fresh_s * 1e9:
            torque_nm = beyond(torque.torque_nm, limit_nm + source.noise_nm, 3, "+")
            measured = f"{source.name} measured {torque_nm} N·m, the limit is {limit_nm:g} N·m"
            if source.noise_nm:
                measured += f" and its noise {source.noise_nm:g} N·m"
            yield Fault(FaultCode.TORQUE_LIMIT, measured, t_ns=torque.t_mid_ns)


def _angle_limit_fault(inputs: LatestInputs, watched: Watched, limit_rad: float, twisted_rad: float) -> Fault:
    clamped = "gripper" not in watched.required
    since = "its angle began to count" if clamped else "the grip"
    turned = f"turned by {beyond(twisted_rad, limit_rad, 3, '+')} rad since {since}, the limit is {limit_rad:g} rad"
    if clamped:
        turned += "; if another tool has been clamped, `shearloop command release --yes` lets it count from 0"
    return Fault(FaultCode.ANGLE_LIMIT, turned, t_ns=inputs.arm.t_ns if inputs.arm is not None else None)


def _lateness_faults(late_s: float, patience: float, t_ns: int) -> Iterator[Fault]:
    longest_hang_s, stood_s = patience * LONGEST_HANG_S, late_s + LONGEST_TICK_S
    decided_ns = t_ns - round(stood_s * 1e9)
    if stood_s > longest_hang_s:
        stood = f"it stood still for {beyond(stood_s, longest_hang_s, 1)} s, and {longest_hang_s:g} s are allowed"
        yield Fault(FaultCode.DAEMON_PAUSED, stood, t_ns=decided_ns)
    elif late_s > patience * LATEST_LOOP_S:
        yield Fault(FaultCode.LOOP_LATE, f"the loop ran {late_s * 1e3:.0f} ms late", t_ns=decided_ns)


def _largest(inputs: LatestInputs, source: TorqueSource) -> TorqueSample | None:
    """Return the largest torque of a source since the latest tick, or its latest torque."""
    found = [one for one in inputs.unjudged if one.source == source.name]
    return max(found, key=lambda one: abs(one.torque_nm or 0.0), default=inputs.torques.get(source.name))


def _torque_faults(inputs: LatestInputs, watched: Watched, step: RunningStep, t_ns: int) -> list[Fault]:
    driving, robot_is_silent = watched.driving, _is_silent(inputs.arm, watched.patience, t_ns)
    # A torque that comes with the robot's state is silent with it, which is a fault of its own.
    judged = [one for one in (*watched.supervising, driving) if not (one.from_robot and robot_is_silent)]
    unusable = {one.name: fault for one in judged if (fault := source_fault(inputs, one, t_ns)) is not None}
    found = [*unusable.values()]
    if step.lacks_zero:
        lost = f"{driving.name} was disconnected, or its zero was not taken, so its torques may be off by any load"
        if why := inputs.lost.get("robot" if driving.from_robot else driving.name):
            lost = f"{driving.name} is gone, and its zero with it: {why.removesuffix('.')}"
        found.append(Fault(FaultCode.ZERO_LOST, lost))
    if driving.name not in unusable and step.expected_nm is not None:
        found += _jump(inputs.torques.get(driving.name), step.expected_nm, watched.config.max_innovation_nm)
    for other in watched.supervising:
        if not other.measures_torque:
            continue
        compared = _latest_comparison(inputs, driving, other, t_ns)
        if compared is not None:
            found += compared.disagreement(inputs, watched.config)
        elif not (unusable or robot_is_silent):
            # Two sensors that are never compared do not supervise each other.
            alone = f"no torque of {other.name} is of the same time as one of {driving.name}, to compare them"
            found.append(Fault(FaultCode.ESTIMATE_INVALID, alone))
    return found


def _jump(latest: TorqueSample | None, expected_nm: float, allowed_nm: float) -> list[Fault]:
    if latest is None or latest.torque_nm is None or abs(latest.torque_nm - expected_nm) <= allowed_nm:
        return []
    jumped = f"{latest.source} measured {latest.torque_nm:+.3f} N·m where {expected_nm:+.3f} N·m was expected"
    return [Fault(FaultCode.ESTIMATE_JUMPED, jumped, t_ns=latest.t_mid_ns)]


def _is_silent(arm: ArmStatus | None, patience: float, t_ns: int) -> bool:
    return arm is None or t_ns - arm.t_ns > patience * ARM_STALE_S * 1e9


def source_fault(inputs: LatestInputs, source: TorqueSource, t_ns: int) -> Fault | None:
    """Return the fault of a source that is gone, silent, late or invalid."""
    latest = inputs.torques.get(source.name)
    if source.name in inputs.lost:
        gone = "not connected yet" if latest is None else "gone"
        return Fault(FaultCode.SENSOR_LOST, f"{source.name} is {gone}: {inputs.lost[source.name]}")
    why_no_wrench = inputs.arm.no_torque if source.from_robot and inputs.arm is not None else ""
    if latest is None and why_no_wrench:
        return Fault(FaultCode.WRENCH_UNKNOWN, why_no_wrench)
    if latest is None:
        return Fault(FaultCode.ESTIMATE_STALE, f"{source.name} has not measured anything yet")
    what = "torque" if source.measures_torque else "frame"
    came_s, measured_s = (t_ns - latest.t_ns) / 1e9, (t_ns - latest.t_mid_ns) / 1e9
    transport_s = measured_s - came_s - source.acquired_s
    if measured_s > source.oldest_s and transport_s > came_s:
        return Fault(FaultCode.ESTIMATE_LATE, _late(source, what, came_s, measured_s), t_ns=latest.t_mid_ns)
    is_old = came_s > source.fresh_s or measured_s > source.oldest_s
    if is_old and why_no_wrench:
        return Fault(FaultCode.WRENCH_UNKNOWN, why_no_wrench, t_ns=latest.t_ns)
    if came_s > source.fresh_s:
        ago_s = beyond(came_s, source.fresh_s, 1)
        old = f"the last {what} of {source.name} came {ago_s} s ago, {source.fresh_s:.3g} s are allowed"
        return Fault(FaultCode.ESTIMATE_STALE, old, t_ns=latest.t_ns)
    if is_old:
        return Fault(FaultCode.ESTIMATE_STALE, _late(source, what, came_s, measured_s), t_ns=latest.t_mid_ns)
    if latest.torque_nm is None and source.measures_torque:
        said = f"{source.name} says: {latest.reason}" if latest.reason else f"{source.name} gives no torque"
        return Fault(FaultCode.ESTIMATE_INVALID, said, t_ns=latest.t_mid_ns)
    return None


def _late(source: TorqueSource, what: str, came_s: float, measured_s: float) -> str:
    return (
        f"the last {what} of {source.name} was measured {beyond(measured_s, source.oldest_s, 1)} s ago, "
        f"{source.oldest_s:.3g} s are allowed; it took {measured_s - came_s:.1f} s to come"
    )


@dataclass(frozen=True, slots=True)
class _Comparison:
    """The torques of two sources at one time, the slower source's first."""

    slow: TorqueSource
    fast: TorqueSource
    slow_nm: float
    fast_nm: float
    t_ns: int

    def disagreement(self, inputs: LatestInputs, config: LoopConfig) -> list[Fault]:
        """Return the fault of two torques that are too far apart; none where they agree."""
        slow, fast = self.slow, self.fast
        apart_nm = abs(fast.as_read_nm(self.slow_nm) - slow.as_read_nm(self.fast_nm))
        allowed_nm = config.disagreement_nm + slow.noise_nm + fast.noise_nm
        if apart_nm <= allowed_nm:
            return []
        apart = (
            f"{slow.name} measured {self.slow_nm:+.3f} N·m and {fast.name} {self.fast_nm:+.3f} N·m, "
            f"{beyond(apart_nm, allowed_nm, 3)} N·m apart where {allowed_nm:g} are allowed"
        )
        # A torque on another tool than the calibrated one may be off by any factor.
        latest = (inputs.torques.get(source.name) for source in (slow, fast))
        notes = [one.note for one in latest if one is not None and one.note]
        return [Fault(FaultCode.TORQUES_DISAGREE, "; ".join((apart, *notes)), t_ns=self.t_ns)]


def _latest_comparison(
    inputs: LatestInputs, driving: TorqueSource, other: TorqueSource, t_ns: int
) -> _Comparison | None:
    """Compare two sources over the window of the slower one's latest sample that can be compared; None without one.

    A sample that is late or lost must not lift a disagreement, so the comparison before it counts.
    """
    slow, fast = (other, driving) if driving.period_s < other.period_s else (driving, other)
    times_ns, torques_nm = inputs.history.get(slow.name, ([], []))
    oldest_ns = t_ns - round(1e9 * compared_for_s((slow, fast)))
    half_s = 0.5 * max(slow.window_s, fast.period_s)
    for at in range(len(times_ns) - 1, bisect_left(times_ns, oldest_ns) - 1, -1):
        if (fast_nm := _torque_at(inputs, fast, times_ns[at], half_s)) is not None:
            return _Comparison(slow, fast, torques_nm[at], fast_nm, times_ns[at])
    return None


def _torque_at(inputs: LatestInputs, source: TorqueSource, t_ns: int, half_s: float) -> float | None:
    """Return a source's mean torque within `half_s` of a time, else its nearest one; None if that is too far away."""
    times_ns, torques_nm = inputs.history.get(source.name, ([], []))
    half_ns = round(half_s * 1e9)
    first, end = bisect_left(times_ns, t_ns - half_ns), bisect_right(times_ns, t_ns + half_ns)
    if end > first:
        return sum(torques_nm[first:end]) / (end - first)
    neighbours = [at for at in (first - 1, first) if 0 <= at < len(times_ns)]
    if not neighbours:
        return None
    nearest = min(neighbours, key=lambda at: abs(times_ns[at] - t_ns))
    farthest_ns = half_ns + min(STALE_AFTER_PERIODS * source.period_s, LONGEST_APART_S) * 1e9
    return torques_nm[nearest] if abs(times_ns[nearest] - t_ns) <= farthest_ns else None


def _device_faults(inputs: LatestInputs, watched: Watched, step: RunningStep | None, t_ns: int) -> list[Fault]:
    arm, gripper, lost = inputs.arm, inputs.gripper, inputs.lost
    has_gripper = "gripper" in watched.required
    found: list[Fault] = []
    # Devices without any state since the daemon's start count as awaited, not as lost; one fault for all of them.
    awaited = ["robot"] if arm is None else []
    if gripper is None and has_gripper:
        awaited.append("gripper")
    if awaited:
        waits = (f"{name}, {lost[name].removesuffix('.')}" if name in lost else name for name in awaited)
        found.append(Fault(FaultCode.DEVICE_AWAITED, "; ".join(waits)))
    # Before the last states of a lost device.
    for name, reason in lost.items():
        if name in watched.required and name not in awaited:
            gone = (FaultCode.ROBOT_LOST, reason) if name == "robot" else (FaultCode.DEVICE_LOST, f"{name}: {reason}")
            found.append(Fault(*gone))
    if arm is not None:
        if _is_silent(arm, watched.patience, t_ns):
            stale = f"the robot last reported its state {(t_ns - arm.t_ns) / 1e9:.2f} s ago"
            found.append(Fault(FaultCode.STATE_STALE, stale, t_ns=arm.t_ns))
        elif arm.emergency_stop:
            found.append(Fault(FaultCode.EMERGENCY_STOP, arm.blocked or "the controller reports it", t_ns=arm.t_ns))
        elif arm.protective_stop:
            found.append(Fault(FaultCode.PROTECTIVE_STOP, arm.blocked or "the controller reports it", t_ns=arm.t_ns))
        elif arm.blocked and arm.starting:
            found.append(Fault(FaultCode.ROBOT_STARTING, arm.blocked, t_ns=arm.t_ns))
        elif arm.blocked:
            code = FaultCode.ROBOT_UNCONTROLLED if arm.late else FaultCode.ROBOT_BLOCKED
            found.append(Fault(code, arm.blocked, t_ns=arm.t_ns))
    if gripper is not None and has_gripper:
        found += _gripper_faults(gripper, step, watched.patience, t_ns)
    return found


def _gripper_faults(gripper: GripperStatus, step: RunningStep | None, patience: float, t_ns: int) -> list[Fault]:
    age_s = (t_ns - gripper.t_ns) / 1e9
    if age_s > patience * GRIPPER_STALE_S:
        silent = f"the gripper last reported its state {age_s:.1f} s ago"
        return [Fault(FaultCode.STATE_STALE, silent, t_ns=gripper.t_ns)]
    if gripper.fault:
        return [Fault(FaultCode.GRIPPER_FAULT, gripper.fault, t_ns=gripper.t_ns)]
    if step is None:
        return []
    if gripper.others_requests != step.others_requests:
        return [Fault(FaultCode.GRIPPER_COMMANDED, gripper.fingers, t_ns=gripper.t_ns)]
    if step.grasp is Grasp.HELD and not gripper.holding:
        return [Fault(FaultCode.GRIP_LOST, gripper.fingers, t_ns=gripper.t_ns)]
    return []
