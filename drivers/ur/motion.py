"""One motion at a time: begun, kept within the limits in each cycle, and ended.

No clock and no ur-rtde: the arm and the time are arguments. A motion that does not end as it should is left to the
robot's watchdog: nothing more is sent to the program, and only a new program may move the arm.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from shearloop.drivers.ur.messages import (
    ARRIVED,
    ROBOT_MODE_RUNNING,
    SAFETY_NORMAL,
    SAFETY_REDUCED,
    STOPPED_ON_COMMAND,
    MotionKind,
    MoveLinear,
    RtdeOutputs,
    RtdeSample,
    Stop,
    WristSpeed,
)
from shearloop.drivers.ur.poses import ONLY_TURNS_M, turn_between
from shearloop.drivers.ur.settings import Bound, InstalledTool, Six, UrLimits, UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

WRIST = 5
# The longest stop, however gentle the command.
LONGEST_STOP_S = 1.0
# Near the end of the range the speed is distance/t and takes effect after the reaction time:
# x'(s) = -x(s - reaction)/t, which approaches the end without overshoot only for t ≥ e·reaction.
_NO_OVERSHOOT = math.e
# A short straight move may never be seen moving: an arm at rest within this distance of the end (m, rad) has arrived.
CLOSE, ARRIVED_AFTER_S = 2e-3, 0.2
# An idle arm may tremble, but not move this fast for this long.
ASTRAY_RAD_PER_S, ASTRAY_S = 0.02, 0.2
# Accelerations are means over this time by the controller's clock: the difference of two samples is mostly noise.
ACCELERATION_S = 0.04
# The pendant shows grams, tenths of a millimetre and thousandths of a radian.
PAYLOAD_KG, TOOL_M_RAD = 0.01, 1e-3
# A motion has ended after this number of successive samples at rest.
REST_SAMPLES = 3
# The time allowed for a motion to end: nominal time × factor + constant. The constant is at least this number of
# silences: an emulated robot's time stands still while its computer is busy.
MOVE_SLACK_S, STOP_SLACK_S, SLACK = 2.0, 1.0, 1.5
MOVE_SILENCES, STOP_SILENCES = 6.0, 3.0
# The controller rounds its factors on speeds; the slider's steps are 1 %.
SCALING_TOLERANCE = 0.005
# A slider that is moved slows a motion that is ending; below this it would have no end.
SLOWEST_SCALING = 0.05

NOT_OURS = (
    "A program runs on the robot that someone else started or resumed: unlock to start the control program instead."
)
LEFT_TO_WATCHDOG = (
    "{reason} The control program was left to the robot's watchdog, which ends it: unlock to start it again."
)
NOT_ACCEPTED = "The robot did not accept the {command}: its control program does not answer."
NOT_STOPPING = "The arm did not come to rest in time after a stop: keep clear of it, look at the teach pendant."
ASTRAY = "The arm moved without a command: check whether a person or another program moves it."


@dataclass(slots=True)
class _Move:
    """A straight move is under way."""

    end: Six
    begun_ns: int
    deadline_ns: int
    seen: bool = False


@dataclass(slots=True)
class _Braking:
    """The arm is being stopped."""

    deceleration_rad_per_s2: float
    deadline_ns: int


class MotionExecutor:
    """Turns the wrist, moves along lines, and stops.

    `disabled_reason` is why nothing may be sent to the program on the robot; empty while it may.
    """

    def __init__(self, settings: UrSettings, arm: "UrArm", now_ns: int) -> None:
        self._settings = settings
        self._arm = arm
        # The number of the motion's command, why the motion ended, and the command last sent.
        self.motion_id = 0
        self.end_reason = ""
        self.sent: WristSpeed | MoveLinear | Stop | None = None
        self.clipped: tuple[str, ...] = ()
        self.disabled_reason = NOT_OURS
        # A wrist speed is the one last asked for, with the time of its decision.
        self._motion: WristSpeed | _Move | _Braking | None = None
        self._rejected = False
        # The script's thread for speeds runs; it has to be ended before a straight move.
        self._speed_thread = False
        self._rested_ns = now_ns
        # How many samples at rest came last.
        self._at_rest = 0
        self._accelerations = Accelerations()

    @property
    def motion(self) -> MotionKind:
        """What the arm does on command."""
        match self._motion:
            case WristSpeed():
                return "wrist"
            case _Move():
                return "linear"
            case _Braking():
                return "stopping"
        return "idle"

    def take_rejection(self) -> bool:
        """Return, once, whether the robot rejected a command, in this cycle or before it."""
        rejected, self._rejected = self._rejected, False
        return rejected

    def begin(self, motion_id: int, asked: WristSpeed | MoveLinear, sample: RtdeSample, now_ns: int) -> str:
        """Turn the wrist at a speed from now on, or begin a straight move; return why not, or the empty string."""
        match asked, self._motion:
            case WristSpeed(decided_ns=decided_ns), _ if decided_ns and self._left_s(decided_ns, now_ns) < 0:
                return f"The wrist speed was decided {(now_ns - decided_ns) / 1e9:.2f} s ago: the computer is too busy."
            case WristSpeed(_, acceleration), _ if acceleration <= 0:
                return f"An acceleration of {acceleration:g} rad/s² is not above 0."
            case WristSpeed(), None if self._is_old(sample):
                return f"T{_old(sample)[1:]}: the wrist does not begin to turn."
            case WristSpeed(), _Braking():
                return f"The arm is still stopping ({self.end_reason})."
            case WristSpeed(), _Move():
                return "A straight move is under way: stop it."
            case MoveLinear(pose), _ if outside := self._settings.limits.box.why_outside(pose[:3]):
                return f"The straight move would end at {outside}; nothing moves."
            case MoveLinear(_, speed, acceleration), _ if min(speed, acceleration) <= 0:
                return "A straight move needs a speed and an acceleration above 0."
            case MoveLinear(), motion if isinstance(motion, _Move | _Braking) or not sample.rests:
                return "The arm moves: stop it before a straight move."
        self.motion_id, self.end_reason = motion_id, ""
        if isinstance(asked, WristSpeed):
            self._motion = replace(asked, decided_ns=asked.decided_ns or now_ns)
            self._keep_turning(self._motion, sample, now_ns)
        else:
            self._end_speed_thread()
            sent, self.clipped = clip_linear(asked, sample.tcp_pose, self._settings.limits)
            self.sent = sent
            slack_s = max(MOVE_SLACK_S, MOVE_SILENCES * self._settings.silence_timeout_s)
            deadline_ns = _deadline_ns(now_ns, _nominal_move_s(sent, sample), slack_s, sample)
            self._motion = _Move(sent.pose, now_ns, deadline_ns)
            if not self._arm.move(sent):
                self._reject("straight move")
        return self.disabled_reason

    def stop_on_command(self, motion_id: int, asked: Stop, sample: RtdeSample, now_ns: int) -> str:
        """Stop at once, as hard as commanded within the needed and the allowed deceleration; return why not."""
        deceleration = clip_stop(asked.deceleration_rad_per_s2, sample, self._settings)
        if isinstance(self._motion, _Braking):
            deceleration = max(deceleration, self._motion.deceleration_rad_per_s2)
        self.motion_id, self.sent, self.clipped = motion_id, Stop(deceleration), ()
        self.stop_now(sample, now_ns, STOPPED_ON_COMMAND, deceleration)
        return self.disabled_reason

    def stop_now(self, sample: RtdeSample, now_ns: int, reason: str, deceleration: float | None = None) -> None:
        """Begin to stop and send it at once, without waiting for the next cycle."""
        self.stop(sample, now_ns, reason, deceleration)
        if isinstance(self._motion, _Braking) and self._speed_thread:
            self._keep_stopping(self._motion, sample, now_ns)

    def stop(self, sample: RtdeSample, now_ns: int, reason: str, deceleration: float | None = None) -> None:
        """Begin to stop, by default as hard as allowed (rad/s²); the harder of two stops counts."""
        deceleration = deceleration or self._settings.limits.wrist_acceleration_rad_per_s2.hard
        match self._motion:
            case None:
                return
            case _Braking(before) if before >= deceleration:
                return
            case WristSpeed() | _Move():
                self.end_reason = reason
        nominal_s = sample.fastest_rad_per_s / deceleration
        slack_s = max(STOP_SLACK_S, STOP_SILENCES * self._settings.silence_timeout_s)
        self._motion = _Braking(deceleration, _deadline_ns(now_ns, nominal_s, slack_s, sample))
        if not self._speed_thread and not self._arm.stop_move(deceleration):
            self._reject("stop")

    def enable(self) -> None:
        """Send commands from now on: our program runs."""
        self.disabled_reason = ""

    def leave_to_watchdog(self, reason: str) -> None:
        """Send nothing more to this program, so that the robot's watchdog ends it."""
        self.disable(reason, LEFT_TO_WATCHDOG.format(reason=reason))

    def disable(self, end_reason: str, disabled_reason: str = NOT_OURS) -> None:
        """End the present motion on paper, and send nothing to the program on the robot."""
        if isinstance(self._motion, WristSpeed | _Move):
            self.end_reason = end_reason
        self._motion, self._speed_thread = None, False
        self.disabled_reason = disabled_reason

    def watch(self, sample: RtdeSample, now_ns: int) -> None:
        """Note the arm's accelerations, and whether an idle arm rests; call this in every cycle."""
        if self._motion is not None or sample.fastest_rad_per_s < ASTRAY_RAD_PER_S:
            self._rested_ns = now_ns
        self._at_rest = self._at_rest + 1 if sample.rests else 0
        self._accelerations.add(sample)

    def violation(self, sample: RtdeSample) -> str:
        """Return a sentence that names the limit that the sample or the present motion exceeds, or the empty string."""
        beyond = violation(sample, self._settings)
        if not beyond and isinstance(self._motion, WristSpeed | _Move):
            beyond = self._accelerations.violation(self._settings.limits)
        return beyond

    def keep(self, sample: RtdeSample, now_ns: int, daemon_alive_ns: int) -> None:
        """Send what this cycle needs; the daemon's last message came at `daemon_alive_ns`."""
        if self.disabled_reason:
            return
        match self._motion:
            case WristSpeed() as asked:
                self._keep_turning(asked, sample, now_ns)
            case _Move() as move:
                self._keep_moving(move, sample, now_ns, daemon_alive_ns)
            case _Braking() as braking:
                self._keep_stopping(braking, sample, now_ns)
            case None if now_ns - self._rested_ns > ASTRAY_S * 1e9:
                self.end_reason = "it moved without a command"
                self.leave_to_watchdog(ASTRAY)
            case None:
                self._arm.send_heartbeat()

    @property
    def _rests(self) -> bool:
        """Whether the arm has come to rest: the noise of a single sample does not decide."""
        return self._at_rest >= REST_SAMPLES

    def _left_s(self, decided_ns: int, now_ns: int) -> float:
        """Return how long a wrist speed still holds."""
        return self._settings.command_timeout_s - (now_ns - decided_ns) / 1e9

    def _is_old(self, sample: RtdeSample) -> bool:
        """Return whether a sample is too old to turn the wrist on: nothing shows what the arm does."""
        return sample.age_ns > self._settings.command_timeout_s * 1e9

    def _keep_turning(self, asked: WristSpeed, sample: RtdeSample, now_ns: int) -> None:
        left_s = self._left_s(asked.decided_ns, now_ns)
        if left_s < 0:
            late = f"the wrist speed was not renewed within {self._settings.command_timeout_s:g} s"
            self.stop_now(sample, now_ns, late)
        elif self._is_old(sample):
            # The loop holds as well; this brakes as hard as allowed.
            self.stop_now(sample, now_ns, _old(sample))
        else:
            # The one check of all speeds that turn the wrist.
            self.sent, self.clipped = clip_wrist(asked, sample, self._settings)
            self._send_speed(self.sent, left_s)

    def _keep_moving(self, move: _Move, sample: RtdeSample, now_ns: int, daemon_alive_ns: int) -> None:
        move.seen = move.seen or sample.moving_linearly
        reason = line_violation(sample, self._settings.limits)
        if now_ns > move.deadline_ns:
            reason = "the straight move did not end within its time"
        # The end of the move and the joint speeds come over two connections, and one may lag.
        waited = now_ns - move.begun_ns > ARRIVED_AFTER_S * 1e9
        ended = move.seen or (waited and is_close(sample.tcp_pose, move.end, CLOSE))
        if ended and not sample.moving_linearly and self._rests:
            self._motion, self.end_reason = None, ARRIVED
        elif reason:
            self.stop(sample, now_ns, reason)
            return
        # Each cycle lets the script go on for a short time: when this process dies with the daemon, the script ends the
        # move before its watchdog would.
        left_s = self._settings.silence_timeout_s - (now_ns - daemon_alive_ns) / 1e9
        self._arm.send_heartbeat(min(self._settings.lease_s, left_s))

    def _keep_stopping(self, braking: _Braking, sample: RtdeSample, now_ns: int) -> None:
        if now_ns > braking.deadline_ns:
            self.leave_to_watchdog(NOT_STOPPING)
        elif self._speed_thread:
            deceleration = clip_stop(braking.deceleration_rad_per_s2, sample, self._settings)
            if self._send_speed(WristSpeed(0.0, deceleration), 0.0) and self._rests:
                self._end_speed_thread()
                self._motion = None
        else:
            if not sample.moving_linearly and self._rests:
                self._motion = None
            self._arm.send_heartbeat()

    def _send_speed(self, command: WristSpeed, left_s: float) -> bool:
        self._speed_thread = True
        accepted = self._arm.wrist(command, left_s)
        if not accepted:
            # An earlier speed may still hold.
            self._reject("wrist speed")
        return accepted

    def _reject(self, command: str) -> None:
        self._rejected = True
        self.leave_to_watchdog(NOT_ACCEPTED.format(command=command))

    def _end_speed_thread(self) -> None:
        if self._speed_thread:
            self._arm.end_speed(self._settings.limits.wrist_acceleration_rad_per_s2.inner)
            self._speed_thread = False


def _old(sample: RtdeSample) -> str:
    return f"the robot's last state is {sample.age_ns / 1e9:.2f} s old"


def _nominal_move_s(move: MoveLinear, sample: RtdeSample) -> float:
    way = math.dist(move.pose[:3], sample.tcp_pose[:3])
    if way <= ONLY_TURNS_M:
        way = turn_between(move.pose, sample.tcp_pose)
    return way / move.speed_m_per_s + move.speed_m_per_s / move.acceleration_m_per_s2


def _deadline_ns(now_ns: int, nominal_s: float, slack_s: float, sample: RtdeSample) -> int:
    longest_s = SLACK * nominal_s / max(SLOWEST_SCALING, sample.speed_scaling)
    return now_ns + int(1e9 * (slack_s + (longest_s if math.isfinite(longest_s) else 0.0)))


def is_close(pose: Six, other: Six, within: float) -> bool:
    """Return whether two poses are less than `within` metres and radians apart.

    A turn has several rotation vectors: at half a turn, as of a tool that points down, both signs are the same.
    """
    angle = math.hypot(*other[3:])
    backwards = [x * (1.0 - 2.0 * math.pi / angle) if angle else x for x in other[3:]]
    apart = min(math.dist(pose[3:], other[3:]), math.dist(pose[3:], backwards))
    return math.dist(pose[:3], other[:3]) < within and apart < within


def clip_wrist(asked: WristSpeed, sample: RtdeSample, settings: UrSettings) -> tuple[WristSpeed, tuple[str, ...]]:
    """Return the wrist speed within the limits of speed, acceleration, force and range, and each reason for a change.

    Near the end of the range the speed is the one that can still be braked within it: v·t + v²/2a = distance, with
    t = e·`reaction_s`. Between the inner and the hard limit of force or torque the speed falls linearly to zero.
    """
    limits = settings.limits
    reasons: list[str] = []
    acceleration = _at_most(
        asked.acceleration_rad_per_s2, limits.wrist_acceleration_rad_per_s2, "acceleration", reasons
    )
    braking = limits.wrist_acceleration_rad_per_s2.inner
    if asked.rad_per_s == 0 and acceleration < braking:
        acceleration = braking
        reasons.append(f"a wrist that is to stand brakes at {braking:g} rad/s²")
    room = max(_room(asked.rad_per_s, sample, limits), 0.0)
    lag_s = _NO_OVERSHOOT * settings.reaction_s
    brakeable = braking * (math.sqrt(lag_s**2 + 2 * room / braking) - lag_s)
    top = limits.wrist_speed_rad_per_s.inner
    speed = _at_most(abs(asked.rad_per_s), limits.wrist_speed_rad_per_s, "wrist speed", reasons, " rad/s")
    if brakeable < speed:
        speed = brakeable
        reasons.append(f"wrist 3 at {sample.wrist_rad:.3f} rad is near the end of its range")
    for share, reason in _fading(sample, limits):
        if top * share < speed:
            speed = top * share
            reasons.append(reason)
    target = math.copysign(speed, asked.rad_per_s)
    ramp = _safe_ramp(acceleration, target, sample, settings)
    if ramp > acceleration:
        reasons.append(f"wrist 3 at {sample.wrist_rad:.3f} rad has to brake harder to stay within its range")
    return WristSpeed(target, ramp), tuple(reasons)


def clip_stop(asked: float, sample: RtdeSample, settings: UrSettings) -> float:
    """Return a deceleration (rad/s²) between the needed one and the hard limit.

    The needed one is the inner limit at least, as in the script on the robot. It keeps the wrist within its range and
    ends the fastest joint's motion within `LONGEST_STOP_S`.
    """
    bound = settings.limits.wrist_acceleration_rad_per_s2
    brisk = max(asked, bound.inner, sample.fastest_rad_per_s / LONGEST_STOP_S)
    return min(_safe_ramp(brisk, 0.0, sample, settings), bound.hard)


def clip_linear(asked: MoveLinear, here: Six, limits: UrLimits) -> tuple[MoveLinear, tuple[str, ...]]:
    """Return the straight move within the inner speeds and accelerations, and each reason for a change.

    The tool turns evenly on its way: a short one with a large turn is slowed to the wrist's limits.
    """
    reasons: list[str] = []
    speed = _at_most(asked.speed_m_per_s, limits.linear_speed_m_per_s, "linear speed", reasons)
    acceleration = _at_most(
        asked.acceleration_m_per_s2, limits.linear_acceleration_m_per_s2, "linear acceleration", reasons
    )
    way_m, turn_rad = math.dist(here[:3], asked.pose[:3]), turn_between(here, asked.pose)
    if turn_rad > 0:
        # The speed of a move that only turns is one in rad/s.
        m_per_rad = way_m / turn_rad if way_m > ONLY_TURNS_M else 1.0
        turning_m_per_s = m_per_rad * limits.wrist_speed_rad_per_s.inner
        if speed > turning_m_per_s:
            reasons.append(f"linear speed is limited to {turning_m_per_s:.2g}: the tool turns by {turn_rad:.2g} rad")
            speed = turning_m_per_s
        acceleration = min(acceleration, m_per_rad * limits.wrist_acceleration_rad_per_s2.inner)
    return MoveLinear(asked.pose, speed, acceleration), tuple(reasons)


def is_recent(sample: RtdeSample, settings: UrSettings) -> bool:
    """Return whether the connection is up and the sample is young enough to act on."""
    return sample.connected and sample.age_ns <= settings.state_timeout_s * 1e9


def why_unfit(sample: RtdeSample, settings: UrSettings) -> str:
    """Return why the controller cannot take motion commands, or the empty string."""
    if not sample.connected:
        return f"The connection to the robot at {settings.host} is lost."
    if not is_recent(sample, settings):
        return (
            f"The latest state from the controller at {settings.host} is {sample.age_ns / 1e9:.2f} s old: check its "
            "cable, other traffic on the network, and with a simulator whether its clock is slower than real time."
        )
    if sample.protective_stop:
        return "Protective stop: look for its cause, clear the workspace, then unlock (not in the first 5 s)."
    if sample.emergency_stop:
        return (
            "Emergency stop: make the cell safe, release the button, keep hands out of the gripper, then unlock: a "
            "gripper that lost its power opens and closes its fingers once."
        )
    if sample.safety_mode not in (SAFETY_NORMAL, SAFETY_REDUCED):
        other = f"The robot's safety system is in the mode “{sample.safety_mode_name}”: look at the teach pendant."
        return _SAFETY.get(sample.safety_mode, other)
    if sample.robot_mode != ROBOT_MODE_RUNNING:
        return f"The arm is not powered and released (robot mode: {sample.robot_mode_name}): unlock to power it."
    if sample.program_paused:
        return (
            "A program on the robot is paused, and continues its motion if a person resumes it: stop it at the teach "
            "pendant, or unlock, which stops it and starts the control program."
        )
    if not sample.program_running:
        return (
            "The control program on the robot does not run: it was stopped at the pendant, or by the watchdog when "
            "commands came late. Unlock to start it again."
        )
    return ""


def may_be_late(sample: RtdeSample, settings: UrSettings) -> bool:
    """Return whether messages that came late can be why a sample is unfit; not where the robot says another reason."""
    if not sample.connected or not is_recent(sample, settings):
        return True
    is_ready = sample.safety_mode in (SAFETY_NORMAL, SAFETY_REDUCED) and sample.robot_mode == ROBOT_MODE_RUNNING
    # The watchdog ends the program when commands come late.
    return is_ready and not sample.program_paused and not sample.program_running


_SAFETY = {
    4: "The robot is in recovery mode: move it back within its safety limits at the teach pendant.",
    5: "A safeguard stop holds the robot: close the safeguard, then unlock.",
    8: "The robot's safety system reports a violation: restart it at the teach pendant.",
    9: "The robot's safety system reports a fault: restart the controller.",
    10: "The robot validates a joint: follow the teach pendant, and restart the robot.",
    12: "A safeguard stop of the automatic mode holds the robot: close the safeguard, reset it, then unlock.",
    13: (
        "The three-position enabling device holds the robot: hold it in its middle position, or select the automatic "
        "mode, then unlock."
    ),
}


class Accelerations:
    """The measured accelerations of wrist and tool: the changes of their speeds over `ACCELERATION_S`. No clock.

    What gets slower does not count: a stop brakes up to the hard limit, and the robot's own stops brake harder.
    """

    def __init__(self) -> None:
        self._samples: deque[RtdeSample] = deque()

    def add(self, sample: RtdeSample) -> None:
        """Take a sample; a sample without a later timestamp starts again, unless it is the latest one."""
        samples = self._samples
        if samples and sample.timestamp_s <= samples[-1].timestamp_s:
            if sample.timestamp_s == samples[-1].timestamp_s:
                return
            samples.clear()
        samples.append(sample)
        while len(samples) > 2 and sample.timestamp_s - samples[1].timestamp_s > ACCELERATION_S - 1e-6:
            samples.popleft()

    def violation(self, limits: UrLimits) -> str:
        """Return a sentence that names the hard limit that an acceleration exceeds, or the empty string."""
        first, last = self._samples[0], self._samples[-1]
        span_s = last.timestamp_s - first.timestamp_s
        if span_s < ACCELERATION_S - 1e-6:
            return ""
        before, after = first.qd_rad_per_s[WRIST], last.qd_rad_per_s[WRIST]
        wrist = abs(after - before) / span_s if abs(after) >= abs(before) else 0.0
        faster = last.tcp_speed_m_per_s >= first.tcp_speed_m_per_s
        tool = math.dist(last.tcp_speed[:3], first.tcp_speed[:3]) / span_s if faster else 0.0
        return _beyond("wrist acceleration", wrist, limits.wrist_acceleration_rad_per_s2, "rad/s²") or _beyond(
            "tool acceleration", tool, limits.linear_acceleration_m_per_s2, "m/s²"
        )


def violation(sample: RtdeSample, settings: UrSettings) -> str:
    """Return a sentence that names the hard limit or the setting that the sample contradicts, or the empty string."""
    measured = (*sample.q_rad, *sample.qd_rad_per_s, *sample.tcp_pose, *sample.tcp_speed, *sample.wrench)
    if not all(map(math.isfinite, measured)):
        return "The controller reports values that are no numbers."
    limits = settings.limits
    joints, box = limits.joints, limits.box
    for number, (q, low, high) in enumerate(zip(sample.q_rad, joints.lower_rad, joints.upper_rad, strict=True), 1):
        if not low <= q <= high:
            return f"Joint {number} is at {q:.3f} rad, beyond its hard limits of {low:g} and {high:g} rad."
    for axis, value, low, high in zip("xyz", sample.tcp_pose[:3], box.lower_m, box.upper_m, strict=True):
        if not low <= value <= high:
            return f"The tool is at {axis} = {value:.3f} m, beyond the workspace's {low:g} to {high:g} m."
    speeds = [
        (f"joint {number} speed" if number <= WRIST else "wrist speed", abs(qd), limits.wrist_speed_rad_per_s, "rad/s")
        for number, qd in enumerate(sample.qd_rad_per_s, 1)
    ]
    tool = ("tool speed", sample.tcp_speed_m_per_s, limits.linear_speed_m_per_s, "m/s")
    for one in (*speeds, tool, *_loads(sample, limits)):
        if beyond := _beyond(*one):
            return beyond
    return slowed_sentence(sample) or tool_difference(sample, settings.tool)


def slowed_sentence(sample: RtdeSample) -> str:
    """Return why the arm turns slower than commanded, or the empty string: a factor on speeds is a gain of the loop."""
    if abs(sample.speed_slider - 1.0) > SCALING_TOLERANCE:
        return (
            f"The speed slider is at {100 * sample.speed_slider:.0f} %, which slows every motion and changes the "
            "control loop's gain: set it to 100 % at the bottom of the teach pendant's screen (on a CB3, of its tabs "
            "Run and Move)."
        )
    if abs(sample.limiter_scaling - 1.0) > SCALING_TOLERANCE:
        return (
            f"The controller slows every motion to {100 * sample.limiter_scaling:.0f} % by itself, which changes the "
            "control loop's gain: look at the teach pendant for its limits of speed and power."
        )
    return ""


def tool_difference(sample: RtdeOutputs, tool: InstalledTool) -> str:
    """Return how payload, centre of gravity or tool centre point differ from the settings, or the empty string.

    A value that the controller does not report is NaN and differs.
    """
    load, cog, tcp = tool.payload_kg, tool.payload_cog_m, tool.tcp_offset
    if not tool.reported and _is_reported(sample.payload_kg):
        return (
            "The controller reports its payload, and the robot's settings say that it does not: enter payload_kg, "
            "payload_cog_m and tcp_offset of `tool` in the place of `reported`."
        )
    checks = (
        ("payload_kg", load, sample.payload_kg, load is None or abs(sample.payload_kg - load) < PAYLOAD_KG),
        ("payload_cog_m", cog, sample.payload_cog_m, cog is None or math.dist(sample.payload_cog_m, cog) < TOOL_M_RAD),
        ("tcp_offset", tcp, sample.tcp_offset, tcp is None or is_close(sample.tcp_offset, tcp, TOOL_M_RAD)),
    )  # fmt: skip
    for name, configured, found, same in checks:
        if not same and not _is_reported(found):
            return (
                f"The controller does not report {name}, and the robot's settings have {_rounded(configured)}: install "
                "PolyScope 3.12 (CB3) or 5.5.1 (e-Series), or write `tool: {reported: false}` into the settings."
            )
        if not same:
            return (
                f"The controller has {name} {_rounded(found)}, the robot's settings have {_rounded(configured)}: "
                "correct the payload and the tool centre point at the teach pendant, or the settings."
            )
    return ""


def _is_reported(value: float | tuple[float, ...]) -> bool:
    values = value if isinstance(value, tuple) else (value,)
    return not any(map(math.isnan, values))


def _rounded(value: float | tuple[float, ...] | None) -> str:
    values = value if isinstance(value, tuple) else (value,)
    return ", ".join("unknown" if one is None else f"{one:.4g}" for one in values)


def _beyond(name: str, value: float, bound: Bound, unit: str) -> str:
    # Rounding errors do not count.
    if round(value, 9) <= bound.hard:
        return ""
    return f"{name.capitalize()} is {value:.2f} {unit}, beyond the hard limit of {bound.hard:g} {unit}."


def line_violation(sample: RtdeSample, limits: UrLimits) -> str:
    """Return a sentence that names the inner limit that a straight move has reached, or the empty string.

    The joint angles and forces along a line are not known in advance, so that the move stops at the inner limits.
    """
    joints = limits.joints
    braking = limits.wrist_acceleration_rad_per_s2.inner
    for number, (q, qd, low, high) in enumerate(
        zip(sample.q_rad, sample.qd_rad_per_s, joints.lower_rad, joints.upper_rad, strict=True), 1
    ):
        stops_at = q + math.copysign(qd * qd / (2 * braking), qd)
        if (qd > 0 and stops_at > high - joints.margin_rad) or (qd < 0 and stops_at < low + joints.margin_rad):
            return f"joint {number} at {q:.3f} rad came to the inner limit of its range"
    fading = _fading(sample, limits)
    return fading[0][1] if fading else ""


def _at_most(asked: float, bound: Bound, name: str, reasons: list[str], unit: str = "") -> float:
    if asked > bound.inner:
        reasons.append(f"{name} is limited to {bound.inner:g}{unit}")
    return min(asked, bound.inner)


def _safe_ramp(asked: float, target: float, sample: RtdeSample, settings: UrSettings) -> float:
    """Return the acceleration asked for, or full braking where the gentle ramp would leave the range."""
    speed = sample.qd_rad_per_s[WRIST]
    if target * math.copysign(1.0, speed) >= abs(speed):
        return asked
    room = _room(speed, sample, settings.limits) - abs(speed) * _NO_OVERSHOOT * settings.reaction_s
    needed = math.inf if room <= 0 else speed * speed / (2 * room)
    # Twice, because the needed braking only grows as the room shrinks.
    return asked if asked >= 2 * needed else max(asked, settings.limits.wrist_acceleration_rad_per_s2.inner)


def _room(direction: float, sample: RtdeSample, limits: UrLimits) -> float:
    margin = limits.joints.margin_rad
    if direction >= 0:
        return limits.joints.upper_rad[WRIST] - margin - sample.wrist_rad
    return sample.wrist_rad - limits.joints.lower_rad[WRIST] - margin


def _fading(sample: RtdeSample, limits: UrLimits) -> list[tuple[float, str]]:
    """Return the share of the speed left, and the reason, for each of force and torque above its inner limit."""
    found = []
    for name, value, bound, unit in _loads(sample, limits):
        if value > bound.inner:
            share = max(0.0, (bound.hard - value) / (bound.hard - bound.inner))
            found.append((share, f"{name} of {value:.2f} {unit} is above the inner limit of {bound.inner:g} {unit}"))
    return found


def _loads(sample: RtdeSample, limits: UrLimits) -> tuple[tuple[str, float, Bound, str], ...]:
    force_n, torque_nm = math.hypot(*sample.wrench[:3]), math.hypot(*sample.wrench[3:])
    return ("force", force_n, limits.force_n, "N"), ("torque", torque_nm, limits.torque_nm, "N m")
