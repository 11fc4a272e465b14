"""One motion at a time: begun, kept within the limits in each cycle, and ended.

No clock and no ur-rtde: the arm and the time are arguments. A motion that does not end as it should is left to the
robot's watchdog: nothing more is sent to the program, and only a new program may move the arm.
"""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from shearloop.drivers.ur.limits import Accelerations, clip_linear, clip_stop, clip_wrist, line_violation, violation
from shearloop.drivers.ur.messages import (
    ARRIVED,
    STOPPED_ON_COMMAND,
    MotionKind,
    MoveLinear,
    RtdeSample,
    Stop,
    WristSpeed,
)
from shearloop.drivers.ur.poses import ONLY_TURNS_M, is_close, turn_between
from shearloop.drivers.ur.settings import Six, UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

# A short straight move may never be seen moving: an arm at rest within this distance of the end (m, rad) has arrived.
CLOSE, ARRIVED_AFTER_S = 2e-3, 0.2
# An idle arm may tremble, but not move this fast for this long.
ASTRAY_RAD_PER_S, ASTRAY_S = 0.02, 0.2
# A motion has ended after this number of successive samples at rest.
REST_SAMPLES = 3
# The time allowed for a motion to end: nominal time × factor + constant. The constant is at least this number of
# silences: an emulated robot's time stands still while its computer is busy.
MOVE_SLACK_S, STOP_SLACK_S, SLACK = 2.0, 1.0, 1.5
MOVE_SILENCES, STOP_SILENCES = 6.0, 3.0
# A slider that is moved slows a motion that is ending; below this it would have no end.
SLOWEST_SCALING = 0.05

NOT_OURS = (
    "A program runs on the robot that someone else started or resumed. It may be another daemon's, of another user or "
    "computer, whose stop waits for its operator: look at the pendant, and for other daemons (`pgrep -af shearloop`). "
    "End what commands the robot, then unlock to start the control program instead."
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

    `why_not_ours` is why the program on the robot is not ours, and nothing may be sent to it; empty while it is ours.
    """

    def __init__(self, settings: UrSettings, arm: "UrArm", now_ns: int) -> None:
        self._settings = settings
        self._arm = arm
        # The number of the motion's command, why the motion ended, and the command last sent.
        self.motion_id = 0
        self.end_reason = ""
        self.sent: WristSpeed | MoveLinear | Stop | None = None
        self.clipped: tuple[str, ...] = ()
        self.why_not_ours = NOT_OURS
        # A wrist speed is the one last asked for, with the time of its decision.
        self._motion: WristSpeed | _Move | _Braking | None = None
        self._rejected = False
        # The script's thread for speeds runs; it has to be ended before a straight move.
        self._speed_thread = False
        self._rested_ns = now_ns
        # How many samples at rest came last.
        self._at_rest = 0
        self._accelerations = Accelerations()
        # The limits that the latest sample exceeds, as sentences: in any case, and by the acceleration of a motion.
        self._beyond = self._too_fast = ""

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
        if refused := self._why_not_begun(asked, sample, now_ns):
            return refused
        self.motion_id, self.end_reason = motion_id, ""
        if isinstance(asked, WristSpeed):
            self._motion = replace(asked, decided_ns=asked.decided_ns or now_ns)
            self._keep_turning(self._motion, sample, now_ns)
        else:
            self._begin_move(asked, sample, now_ns)
        return self.why_not_ours

    def _why_not_begun(self, asked: WristSpeed | MoveLinear, sample: RtdeSample, now_ns: int) -> str:
        """Return why a wrist speed or a straight move cannot begin now, or the empty string."""
        motion = self._motion
        if isinstance(asked, WristSpeed):
            if asked.decided_ns and self._left_s(asked.decided_ns, now_ns) < 0:
                age_s = (now_ns - asked.decided_ns) / 1e9
                return f"The wrist speed was decided {age_s:.2f} s ago: the computer is too busy."
            if asked.acceleration_rad_per_s2 <= 0:
                return f"An acceleration of {asked.acceleration_rad_per_s2:g} rad/s² is not above 0."
            if motion is None and self._is_old(sample):
                return f"T{_old(sample)[1:]}: the wrist does not begin to turn."
            if isinstance(motion, _Braking):
                return f"The arm is still stopping ({self.end_reason})."
            return "A straight move is under way: stop it." if isinstance(motion, _Move) else ""
        if outside := self._settings.limits.box.why_outside(asked.pose[:3]):
            return f"The straight move would end at {outside}; nothing moves."
        if min(asked.speed_m_per_s, asked.acceleration_m_per_s2) <= 0:
            return "A straight move needs a speed and an acceleration above 0."
        moves = isinstance(motion, _Move | _Braking) or not sample.rests
        return "The arm moves: stop it before a straight move." if moves else ""

    def _begin_move(self, asked: MoveLinear, sample: RtdeSample, now_ns: int) -> None:
        """Begin a straight move within the limits."""
        self._end_speed_thread()
        sent, self.clipped = clip_linear(asked, sample.tcp_pose, self._settings.limits)
        self.sent = sent
        slack_s = max(MOVE_SLACK_S, MOVE_SILENCES * self._settings.silence_timeout_s)
        deadline_ns = _deadline_ns(now_ns, _nominal_move_s(sent, sample), slack_s, sample)
        self._motion = _Move(sent.pose, now_ns, deadline_ns)
        if not self._arm.move(sent):
            self._reject("straight move")

    def stop_on_command(self, motion_id: int, asked: Stop, sample: RtdeSample, now_ns: int) -> str:
        """Stop at once, as hard as commanded within the needed and the allowed deceleration; return why not."""
        deceleration = clip_stop(asked.deceleration_rad_per_s2, sample, self._settings)
        if isinstance(self._motion, _Braking):
            deceleration = max(deceleration, self._motion.deceleration_rad_per_s2)
        self.motion_id, self.sent, self.clipped = motion_id, Stop(deceleration), ()
        self.stop_now(sample, now_ns, STOPPED_ON_COMMAND, deceleration)
        return self.why_not_ours

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
        self.why_not_ours = ""

    def leave_to_watchdog(self, reason: str) -> None:
        """Send nothing more to this program, so that the robot's watchdog ends it."""
        self.disable(reason, LEFT_TO_WATCHDOG.format(reason=reason))

    def disable(self, end_reason: str, why_not_ours: str = NOT_OURS) -> None:
        """End the present motion on paper, and send nothing to the program on the robot."""
        if isinstance(self._motion, WristSpeed | _Move):
            self.end_reason = end_reason
        self._motion, self._speed_thread = None, False
        self.why_not_ours = why_not_ours

    def take(self, sample: RtdeSample) -> None:
        """Compare the latest sample, and the accelerations up to it, with the limits."""
        self._accelerations.add(sample)
        self._beyond = violation(sample, self._settings)
        self._too_fast = self._accelerations.violation(self._settings.limits)

    def watch(self, sample: RtdeSample, now_ns: int) -> None:
        """Note whether an idle arm rests; call this in every cycle."""
        if self._motion is not None or sample.fastest_rad_per_s < ASTRAY_RAD_PER_S:
            self._rested_ns = now_ns
        self._at_rest = self._at_rest + 1 if sample.rests else 0

    @property
    def violation(self) -> str:
        """A sentence that names the limit that the latest sample or the present motion exceeds, or an empty string."""
        if not self._beyond and isinstance(self._motion, WristSpeed | _Move):
            return self._too_fast
        return self._beyond

    def keep(self, sample: RtdeSample, now_ns: int, daemon_alive_ns: int) -> None:
        """Send what this cycle needs; the daemon's last message came at `daemon_alive_ns`."""
        if self.why_not_ours:
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
