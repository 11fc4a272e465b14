"""Executes one motion at a time: begins it, keeps it within the limits in each cycle, and ends it.

No clock and no ur-rtde: the arm and the time are arguments. A motion that does not end as it should is left to the
robot's watchdog: nothing more is sent to the program, and only a new program may move the arm.
"""

import math
from typing import TYPE_CHECKING

from shearloop.drivers.ur import error_messages, messages
from shearloop.drivers.ur.limits import clip_linear, clip_stop, clip_wrist, line_violation
from shearloop.drivers.ur.settings import Six, UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

# A short linear move may never be seen moving: an arm at rest within this distance of the end (m, rad) has arrived.
CLOSE, ARRIVED_AFTER_S = 2e-3, 0.2
# An idle arm may tremble, but not move this fast for this long.
ASTRAY_RAD_PER_S, ASTRAY_S = 0.02, 0.2
# The time allowed for a linear move, and for a stop: nominal time × factor + constant.
MOVE_SLACK, MOVE_SLACK_S = 1.5, 2.0
STOP_SLACK, STOP_SLACK_S = 1.5, 1.0
# The pendant's speed slider slows everything; below this a motion would have no end.
SLOWEST_SCALING = 0.05


class MotionExecutor:
    """Turns the wrist, moves along lines, and stops.

    `disabled_reason` is why nothing may be sent to the program on the robot; empty while it may.
    """

    def __init__(self, settings: UrSettings, arm: "UrArm", now_ns: int) -> None:
        self._settings = settings
        self._limits = settings.limits
        self._arm = arm
        self.motion: messages.MotionKind = "idle"
        # The number of the motion's command, why the motion ended, and the command last sent.
        self.motion_id = 0
        self.end_reason = ""
        self.sent: messages.WristSpeed | messages.MoveLinear | messages.Stop | None = None
        self.clipped: tuple[str, ...] = ()
        self.disabled_reason = error_messages.NOT_OURS
        # Whether the robot rejected a command; the caller clears it.
        self.command_rejected = False
        self._asked, self._braking = messages.WristSpeed(0.0, 0.0), messages.Stop(0.0)
        self._speed_thread = False
        self._asked_ns = self._rested_ns = now_ns
        self._deadline_ns = self._move_ns = 0
        self._move_seen = False
        self._move_end: Six = (0.0,) * 6

    def turn(self, motion_id: int, asked: messages.WristSpeed, sample: messages.RtdeSample, now_ns: int) -> bool:
        """Turn the wrist at this speed from now on; return whether the robot took it."""
        self.motion, self.motion_id, self.end_reason = "wrist", motion_id, ""
        self._asked, self._asked_ns = asked, now_ns
        return self._send_clipped_speed(sample)

    def move(self, motion_id: int, asked: messages.MoveLinear, sample: messages.RtdeSample, now_ns: int) -> bool:
        """Begin a linear move of an arm at rest; return whether the robot took it."""
        self._end_speed_thread()
        sent, clipped = clip_linear(asked, self._limits)
        self.motion, self.motion_id, self.end_reason = "linear", motion_id, ""
        self.sent, self.clipped = sent, clipped
        self._deadline_ns = now_ns + int(1e9 * _longest_move_s(sent, sample))
        self._move_seen = False
        self._move_ns, self._move_end = now_ns, sent.pose
        taken = self._arm.move(sent)
        if not taken:
            self._reject("linear move")
        return taken

    def stop_on_command(self, motion_id: int, asked: messages.Stop, sample: messages.RtdeSample, now_ns: int) -> None:
        """Stop at once, as hard as commanded within the needed and the allowed deceleration."""
        sent = clip_stop(asked, sample, self._limits, self._settings.reaction_s)
        if self.motion == "stopping":
            sent = _harder(sent, self._braking)
        self.motion_id = motion_id
        self.sent, self.clipped = sent, ()
        self.stop_now(sample, now_ns, messages.STOPPED_ON_COMMAND, sent)

    def stop_now(
        self, sample: messages.RtdeSample, now_ns: int, reason: str, stop: messages.Stop | None = None
    ) -> None:
        """Begin to stop and send it at once, without waiting for the next cycle."""
        self.stop(sample, now_ns, reason, stop)
        if self.motion == "stopping" and self._speed_thread:
            self._keep_stopping(sample, now_ns)

    def stop(self, sample: messages.RtdeSample, now_ns: int, reason: str, stop: messages.Stop | None = None) -> None:
        """Begin to stop, by default as hard as allowed; the harder of two stops counts."""
        asked = stop or messages.Stop(self._limits.wrist_acceleration_rad_per_s2.hard)
        if self.motion == "idle" or (self.motion == "stopping" and _harder(self._braking, asked) is self._braking):
            return
        if self.motion != "stopping":
            self.end_reason = reason
        self.motion = "stopping"
        self._braking = asked
        self._deadline_ns = now_ns + int(1e9 * _longest_stop_s(asked, sample))
        if not self._speed_thread and not self._arm.stop_move(asked.deceleration_rad_per_s2):
            self._reject("stop")

    def leave_to_watchdog(self, reason: str) -> None:
        """Send nothing more to this program, so that the robot's watchdog ends it."""
        self.disable(reason, error_messages.LEFT_TO_WATCHDOG.format(reason=reason))

    def disable(self, end_reason: str, disabled_reason: str) -> None:
        """End the present motion on paper, and send nothing to the program on the robot."""
        if self.motion not in ("idle", "stopping"):
            self.end_reason = end_reason
        self.motion = "idle"
        self._speed_thread = False
        self.disabled_reason = disabled_reason

    def watch(self, sample: messages.RtdeSample, now_ns: int) -> None:
        """Note whether an idle arm rests; call this in every cycle."""
        if self.motion != "idle" or sample.fastest_rad_per_s < ASTRAY_RAD_PER_S:
            self._rested_ns = now_ns

    def keep(self, sample: messages.RtdeSample, now_ns: int) -> None:
        """Send what this cycle needs."""
        if self.disabled_reason:
            return
        match self.motion:
            case "wrist":
                self._keep_turning(sample, now_ns)
            case "linear":
                self._keep_moving(sample, now_ns)
            case "stopping":
                self._keep_stopping(sample, now_ns)
            case "idle" if now_ns - self._rested_ns > ASTRAY_S * 1e9:
                self.end_reason = "it moved without a command"
                self.leave_to_watchdog(error_messages.ASTRAY)
            case "idle":
                self._arm.send_heartbeat()

    def _keep_turning(self, sample: messages.RtdeSample, now_ns: int) -> None:
        if now_ns - self._asked_ns > self._settings.command_timeout_s * 1e9:
            late = f"the wrist speed was not renewed within {self._settings.command_timeout_s:g} s"
            self.stop_now(sample, now_ns, late, messages.Stop(self._limits.wrist_acceleration_rad_per_s2.inner))
        else:
            self._send_clipped_speed(sample)

    def _keep_moving(self, sample: messages.RtdeSample, now_ns: int) -> None:
        self._move_seen = self._move_seen or sample.moving_linearly
        reason = line_violation(sample, self._limits)
        if now_ns > self._deadline_ns:
            reason = "the linear move did not end within its time"
        # The end of the move and the joint speeds come over two connections, and one may lag.
        if not sample.moving_linearly and sample.rests and (self._move_seen or self._is_at_end(sample, now_ns)):
            self.motion, self.end_reason = "idle", messages.ARRIVED
        elif reason:
            self.stop(sample, now_ns, reason)
            return
        self._arm.send_heartbeat()

    def _is_at_end(self, sample: messages.RtdeSample, now_ns: int) -> bool:
        waited = now_ns - self._move_ns > ARRIVED_AFTER_S * 1e9
        return waited and is_close(sample.tcp_pose, self._move_end, CLOSE)

    def _keep_stopping(self, sample: messages.RtdeSample, now_ns: int) -> None:
        if now_ns > self._deadline_ns:
            self.leave_to_watchdog(error_messages.NOT_STOPPING)
        elif self._speed_thread:
            braking = clip_stop(self._braking, sample, self._limits, self._settings.reaction_s)
            if self._send_speed(messages.WristSpeed(0.0, braking.deceleration_rad_per_s2)) and sample.rests:
                self._end_speed_thread()
                self.motion = "idle"
        else:
            if not sample.moving_linearly and sample.rests:
                self.motion = "idle"
            self._arm.send_heartbeat()

    def _send_clipped_speed(self, sample: messages.RtdeSample) -> bool:
        self.sent, self.clipped = clip_wrist(self._asked, sample, self._limits, self._settings.reaction_s)
        return self._send_speed(self.sent)

    def _send_speed(self, command: messages.WristSpeed) -> bool:
        self._speed_thread = True
        taken = self._arm.wrist(command)
        if not taken:
            # An earlier speed may still hold.
            self._reject("wrist speed")
        return taken

    def _reject(self, command: str) -> None:
        self.command_rejected = True
        self.leave_to_watchdog(error_messages.NOT_TAKEN.format(command=command))

    def _end_speed_thread(self) -> None:
        if self._speed_thread:
            self._arm.end_speed(self._limits.wrist_acceleration_rad_per_s2.inner)
            self._speed_thread = False


def _harder(one: messages.Stop, other: messages.Stop) -> messages.Stop:
    return one if one.deceleration_rad_per_s2 >= other.deceleration_rad_per_s2 else other


def _longest_move_s(move: messages.MoveLinear, sample: messages.RtdeSample) -> float:
    distance_m = math.dist(move.pose[:3], sample.tcp_pose[:3])
    # At most half a turn; a move that only turns takes its speed as rad/s.
    way = max(distance_m, math.pi if distance_m < 1e-3 else 0.0)
    nominal_s = way / move.speed_m_per_s + move.speed_m_per_s / move.acceleration_m_per_s2
    return MOVE_SLACK * nominal_s / max(SLOWEST_SCALING, sample.speed_scaling) + MOVE_SLACK_S


def _longest_stop_s(stop: messages.Stop, sample: messages.RtdeSample) -> float:
    nominal_s = sample.fastest_rad_per_s / stop.deceleration_rad_per_s2
    if not math.isfinite(nominal_s):
        return STOP_SLACK_S
    return STOP_SLACK * nominal_s / max(SLOWEST_SCALING, sample.speed_scaling) + STOP_SLACK_S


def tool_axis_torque(sample: messages.RtdeSample) -> float:
    """Return the torque about the tool's z axis: the third column of the pose's rotation, times the torque."""
    x, y, z = sample.tcp_pose[3:]
    angle = math.hypot(x, y, z)
    if angle < 1e-12:
        return sample.wrench[5]
    x, y, z = x / angle, y / angle, z / angle
    sine, versine = math.sin(angle), 1 - math.cos(angle)
    _, _, _, tx, ty, tz = sample.wrench
    return (x * z * versine + y * sine) * tx + (y * z * versine - x * sine) * ty + (1 - (x * x + y * y) * versine) * tz


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
