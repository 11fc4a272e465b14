"""Executes one motion at a time: begins it, keeps it within the limits in each cycle, and ends it.

No clock and no ur-rtde: the arm and the time are arguments. A motion that does not end as it should is left to the
robot's watchdog: nothing more is sent to the program, and only a new program may move the arm.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from shearloop.drivers.ur.limits import clip_linear, clip_stop, clip_wrist, line_violation
from shearloop.drivers.ur.messages import (
    ARRIVED,
    STOPPED_ON_COMMAND,
    MotionKind,
    MoveLinear,
    RtdeSample,
    Stop,
    WristSpeed,
)
from shearloop.drivers.ur.settings import Six, UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

# A short linear move may never be seen moving: an arm at rest within this distance of the end (m, rad) has arrived.
CLOSE, ARRIVED_AFTER_S = 2e-3, 0.2
# An idle arm may tremble, but not move this fast for this long.
ASTRAY_RAD_PER_S, ASTRAY_S = 0.02, 0.2
# The time allowed for a motion to end: nominal time × factor + constant.
MOVE_SLACK_S, STOP_SLACK_S, SLACK = 2.0, 1.0, 1.5
# The pendant's speed slider slows everything; below this a motion would have no end.
SLOWEST_SCALING = 0.05

NOT_OURS = (
    "A program runs on the robot that someone else started or resumed: unlock to start the control program instead."
)
LEFT_TO_WATCHDOG = (
    "{reason} The control program was left to the robot's watchdog, which ends it: unlock to start it again."
)
NOT_TAKEN = "The robot did not take the {command}: its control program does not answer."
NOT_STOPPING = "The arm did not come to rest in time after a stop: keep clear of it, look at the teach pendant."
ASTRAY = "The arm moved without a command: check whether a person or another program moves it."


@dataclass(slots=True)
class _Turn:
    """The wrist turns at the speed last asked for."""

    asked: WristSpeed
    asked_ns: int


@dataclass(slots=True)
class _Move:
    """A linear move is under way."""

    end: Six
    begun_ns: int
    deadline_ns: int
    seen: bool = False


@dataclass(slots=True)
class _Braking:
    """The arm is being stopped."""

    asked: Stop
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
        self._motion: _Turn | _Move | _Braking | None = None
        self._rejected = False
        # The script's thread for speeds runs; it has to be ended before a linear move.
        self._speed_thread = False
        self._rested_ns = now_ns

    @property
    def motion(self) -> MotionKind:
        """What the arm does on command."""
        match self._motion:
            case _Turn():
                return "wrist"
            case _Move():
                return "linear"
            case _Braking():
                return "stopping"
        return "idle"

    def take_rejection(self) -> bool:
        """Return, once, whether the robot rejected a command."""
        rejected, self._rejected = self._rejected, False
        return rejected

    def why_refused(self, command: WristSpeed | MoveLinear, sample: RtdeSample) -> str:
        """Return why a motion cannot begin now, or the empty string."""
        match command, self._motion:
            case WristSpeed(_, acceleration), _ if acceleration <= 0:
                return f"An acceleration of {acceleration:g} rad/s² is not above 0."
            case WristSpeed(), _Braking():
                return "The arm is still stopping."
            case WristSpeed(), _Move():
                return "A linear move is under way: stop it."
            case MoveLinear(_, speed, acceleration), _ if min(speed, acceleration) <= 0:
                return "A linear move needs a speed and an acceleration above 0."
            case MoveLinear(), motion if isinstance(motion, _Move | _Braking) or not sample.rests:
                return "The arm moves: stop it before a linear move."
        return ""

    def turn(self, motion_id: int, asked: WristSpeed, sample: RtdeSample, now_ns: int) -> None:
        """Turn the wrist at this speed from now on."""
        self._motion, self.motion_id, self.end_reason = _Turn(asked, now_ns), motion_id, ""
        self._send_clipped_speed(asked, sample)

    def move(self, motion_id: int, asked: MoveLinear, sample: RtdeSample, now_ns: int) -> None:
        """Begin a linear move of an arm at rest."""
        self._end_speed_thread()
        sent, self.clipped = clip_linear(asked, self._settings.limits)
        self.sent, self.motion_id, self.end_reason = sent, motion_id, ""
        self._motion = _Move(
            sent.pose, now_ns, _deadline_ns(now_ns, _nominal_move_s(sent, sample), MOVE_SLACK_S, sample)
        )
        if not self._arm.move(sent):
            self._reject("linear move")

    def stop_on_command(self, motion_id: int, asked: Stop, sample: RtdeSample, now_ns: int) -> None:
        """Stop at once, as hard as commanded within the needed and the allowed deceleration."""
        sent = clip_stop(asked, sample, self._settings.limits, self._settings.reaction_s)
        if isinstance(self._motion, _Braking):
            sent = _harder(sent, self._motion.asked)
        self.motion_id, self.sent, self.clipped = motion_id, sent, ()
        self.stop_now(sample, now_ns, STOPPED_ON_COMMAND, sent)

    def stop_now(self, sample: RtdeSample, now_ns: int, reason: str, stop: Stop | None = None) -> None:
        """Begin to stop and send it at once, without waiting for the next cycle."""
        self.stop(sample, now_ns, reason, stop)
        if isinstance(self._motion, _Braking) and self._speed_thread:
            self._keep_stopping(self._motion, sample, now_ns)

    def stop(self, sample: RtdeSample, now_ns: int, reason: str, stop: Stop | None = None) -> None:
        """Begin to stop, by default as hard as allowed; the harder of two stops counts."""
        asked = stop or Stop(self._settings.limits.wrist_acceleration_rad_per_s2.hard)
        if self._motion is None:
            return
        if not isinstance(self._motion, _Braking):
            self.end_reason = reason
        elif _harder(self._motion.asked, asked) is self._motion.asked:
            return
        nominal_s = sample.fastest_rad_per_s / asked.deceleration_rad_per_s2
        self._motion = _Braking(asked, _deadline_ns(now_ns, nominal_s, STOP_SLACK_S, sample))
        if not self._speed_thread and not self._arm.stop_move(asked.deceleration_rad_per_s2):
            self._reject("stop")

    def enable(self) -> None:
        """Send commands from now on: our program runs."""
        self.disabled_reason = ""

    def leave_to_watchdog(self, reason: str) -> None:
        """Send nothing more to this program, so that the robot's watchdog ends it."""
        self.disable(reason, LEFT_TO_WATCHDOG.format(reason=reason))

    def disable(self, end_reason: str, disabled_reason: str = NOT_OURS) -> None:
        """End the present motion on paper, and send nothing to the program on the robot."""
        if isinstance(self._motion, _Turn | _Move):
            self.end_reason = end_reason
        self._motion, self._speed_thread = None, False
        self.disabled_reason = disabled_reason

    def watch(self, sample: RtdeSample, now_ns: int) -> None:
        """Note whether an idle arm rests; call this in every cycle."""
        if self._motion is not None or sample.fastest_rad_per_s < ASTRAY_RAD_PER_S:
            self._rested_ns = now_ns

    def keep(self, sample: RtdeSample, now_ns: int) -> None:
        """Send what this cycle needs."""
        if self.disabled_reason:
            return
        match self._motion:
            case _Turn() as turn:
                self._keep_turning(turn, sample, now_ns)
            case _Move() as move:
                self._keep_moving(move, sample, now_ns)
            case _Braking() as braking:
                self._keep_stopping(braking, sample, now_ns)
            case None if now_ns - self._rested_ns > ASTRAY_S * 1e9:
                self.end_reason = "it moved without a command"
                self.leave_to_watchdog(ASTRAY)
            case None:
                self._arm.send_heartbeat()

    def _keep_turning(self, turn: _Turn, sample: RtdeSample, now_ns: int) -> None:
        if now_ns - turn.asked_ns > self._settings.command_timeout_s * 1e9:
            late = f"the wrist speed was not renewed within {self._settings.command_timeout_s:g} s"
            self.stop_now(sample, now_ns, late, Stop(self._settings.limits.wrist_acceleration_rad_per_s2.inner))
        else:
            self._send_clipped_speed(turn.asked, sample)

    def _keep_moving(self, move: _Move, sample: RtdeSample, now_ns: int) -> None:
        move.seen = move.seen or sample.moving_linearly
        reason = line_violation(sample, self._settings.limits)
        if now_ns > move.deadline_ns:
            reason = "the linear move did not end within its time"
        # The end of the move and the joint speeds come over two connections, and one may lag.
        waited = now_ns - move.begun_ns > ARRIVED_AFTER_S * 1e9
        ended = move.seen or (waited and is_close(sample.tcp_pose, move.end, CLOSE))
        if ended and not sample.moving_linearly and sample.rests:
            self._motion, self.end_reason = None, ARRIVED
        elif reason:
            self.stop(sample, now_ns, reason)
            return
        self._arm.send_heartbeat()

    def _keep_stopping(self, braking: _Braking, sample: RtdeSample, now_ns: int) -> None:
        if now_ns > braking.deadline_ns:
            self.leave_to_watchdog(NOT_STOPPING)
        elif self._speed_thread:
            stop = clip_stop(braking.asked, sample, self._settings.limits, self._settings.reaction_s)
            if self._send_speed(WristSpeed(0.0, stop.deceleration_rad_per_s2)) and sample.rests:
                self._end_speed_thread()
                self._motion = None
        else:
            if not sample.moving_linearly and sample.rests:
                self._motion = None
            self._arm.send_heartbeat()

    def _send_clipped_speed(self, asked: WristSpeed, sample: RtdeSample) -> None:
        """Send the speed within the limits of this moment: the one check of all speeds that turn the wrist."""
        self.sent, self.clipped = clip_wrist(asked, sample, self._settings.limits, self._settings.reaction_s)
        self._send_speed(self.sent)

    def _send_speed(self, command: WristSpeed) -> bool:
        self._speed_thread = True
        accepted = self._arm.wrist(command)
        if not accepted:
            # An earlier speed may still hold.
            self._reject("wrist speed")
        return accepted

    def _reject(self, command: str) -> None:
        self._rejected = True
        self.leave_to_watchdog(NOT_TAKEN.format(command=command))

    def _end_speed_thread(self) -> None:
        if self._speed_thread:
            self._arm.end_speed(self._settings.limits.wrist_acceleration_rad_per_s2.inner)
            self._speed_thread = False


def _harder(one: Stop, other: Stop) -> Stop:
    return one if one.deceleration_rad_per_s2 >= other.deceleration_rad_per_s2 else other


def _nominal_move_s(move: MoveLinear, sample: RtdeSample) -> float:
    distance_m = math.dist(move.pose[:3], sample.tcp_pose[:3])
    # At most half a turn; a move that only turns takes its speed as rad/s.
    way = max(distance_m, math.pi if distance_m < 1e-3 else 0.0)
    return way / move.speed_m_per_s + move.speed_m_per_s / move.acceleration_m_per_s2


def _deadline_ns(now_ns: int, nominal_s: float, slack_s: float, sample: RtdeSample) -> int:
    longest_s = SLACK * nominal_s / max(SLOWEST_SCALING, sample.speed_scaling)
    return now_ns + int(1e9 * (slack_s + (longest_s if math.isfinite(longest_s) else 0.0)))


def is_close(pose: Six, other: Six, within: float) -> bool:
    """Return whether two poses are less than `within` metres and radians apart.

    A turn has several rotation vectors: at half a turn, as of a tool that points down, both signs are the same.
    """
    same = abs(sum(a * b for a, b in zip(_quaternion(pose), _quaternion(other), strict=True)))
    return math.dist(pose[:3], other[:3]) < within and 2.0 * math.acos(min(same, 1.0)) < within


def _quaternion(pose: Six) -> tuple[float, float, float, float]:
    x, y, z = pose[3:]
    angle = math.hypot(x, y, z)
    share = math.sin(angle / 2) / angle if angle > 0.0 else 0.5
    return math.cos(angle / 2), x * share, y * share, z * share
