"""The motion under way: begun, kept within the limits cycle by cycle, and ended. Which may begin is the pilot's to say.

No clock and no ur-rtde: the arm is a port and the time an argument. A motion that does not end as it should ends by the
robot's watchdog: nothing is sent to the program any more, and only another one may move the arm again.
"""

from shearloop.drivers.ur import error_messages as sentences
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
from shearloop.drivers.ur.motion import is_close, longest_move_s, longest_stop_s
from shearloop.drivers.ur.ports import PilotArm
from shearloop.drivers.ur.settings import Six, UrSettings

# A linear move may be too short to be seen under way: who rests at its end (in m and rad) after so long has arrived.
CLOSE, ARRIVED_AFTER_S = 2e-3, 0.2
# An arm that nothing was asked of may tremble, but not move as fast as this for so long.
ASTRAY_RAD_PER_S, ASTRAY_S = 0.02, 0.2


class MotionExecutor:
    """Turns the wrist, moves along lines, stops; `kind` is what it is at, and idle means that the arm rests.

    `number` is the command's that the motion belongs to, `ended` why it ended, `sent` and `clipped` what was last sent
    for it. `barred` is why nothing may be sent to the program on the robot, and empty while it may.
    """

    def __init__(self, settings: UrSettings, arm: PilotArm, now_ns: int) -> None:
        self._settings = settings
        self._limits = settings.limits
        self._arm = arm
        self.kind: MotionKind = "idle"
        self.number = 0
        self.ended = ""
        self.sent: WristSpeed | MoveLinear | Stop | None = None
        self.clipped: tuple[str, ...] = ()
        self.barred = sentences.NOT_OURS
        # Whether the robot did not take something since this was last set back.
        self.puzzled = False
        self._asked, self._braking = WristSpeed(0.0, 0.0), Stop(0.0)
        self._speed_thread = False
        self._asked_ns = self._rested_ns = now_ns
        self._deadline_ns = self._move_ns = 0
        self._move_seen = False
        self._move_end: Six = (0.0,) * 6

    # ---- what is asked of it --------------------------------------------------------------------------------------

    def turn(self, number: int, asked: WristSpeed, reading: RtdeSample, now_ns: int) -> bool:
        """Turn the wrist so from now on; return whether the robot took it."""
        self._begin("wrist", number)
        self._asked, self._asked_ns = asked, now_ns
        return self._send_wrist(reading)

    def move(self, number: int, asked: MoveLinear, reading: RtdeSample, now_ns: int) -> bool:
        """Begin a linear move of an arm that rests; return whether the robot took it."""
        self._end_speed_thread()
        sent, clipped = clip_linear(asked, self._limits)
        self._begin("linear", number)
        self.sent, self.clipped = sent, clipped
        self._deadline_ns = now_ns + int(1e9 * longest_move_s(sent, reading))
        self._move_seen = False
        self._move_ns, self._move_end = now_ns, sent.pose
        taken = self._arm.move(sent)
        if not taken:
            self._not_taken("linear move")
        return taken

    def stop_as_asked(self, number: int, asked: Stop, reading: RtdeSample, now_ns: int) -> None:
        """Stop at once, as hard as asked within what is needed and allowed."""
        sent = clip_stop(asked, reading, self._limits, self._settings.reaction_s)
        if self.kind == "stopping":
            sent = _harder(sent, self._braking)
        self.number = number
        self.sent, self.clipped = sent, ()
        self.stop_now(reading, now_ns, STOPPED_ON_COMMAND, sent)

    def stop_now(self, reading: RtdeSample, now_ns: int, why: str, stop: Stop | None = None) -> None:
        """Begin to stop, and send it: the next cycle may be a whole one away."""
        self.stop(reading, now_ns, why, stop)
        if self.kind == "stopping" and self._speed_thread:
            self._keep_stopping(reading, now_ns)

    def stop(self, reading: RtdeSample, now_ns: int, why: str, stop: Stop | None = None) -> None:
        """Begin to stop, as hard as may be unless told how; of two stops the harder one counts."""
        asked = stop or Stop(self._limits.wrist_acceleration_rad_per_s2.hard)
        if self.kind == "idle" or (self.kind == "stopping" and _harder(self._braking, asked) is self._braking):
            return
        if self.kind != "stopping":
            self.ended = why
        self.kind = "stopping"
        self._braking = asked
        self._deadline_ns = now_ns + int(1e9 * longest_stop_s(asked, reading))
        if not self._speed_thread and not self._arm.stop_move(asked.deceleration_rad_per_s2):
            self._not_taken("stop")

    def let_go(self, why: str) -> None:
        """Send nothing to this program any more: whatever it does now, the robot's watchdog ends it."""
        self.bar(why, sentences.left_to_watchdog(why))

    def bar(self, why_ended: str, why_barred: str) -> None:
        """Take a motion under way for ended, and send nothing to the program on the robot."""
        if self.kind not in ("idle", "stopping"):
            self.ended = why_ended
        self.kind = "idle"
        self._speed_thread = False
        self.barred = why_barred

    # ---- cycle by cycle -------------------------------------------------------------------------------------------

    def watch(self, reading: RtdeSample, now_ns: int) -> None:
        """Note in every cycle, whatever else is done in it, whether the arm moves although it should rest."""
        if self.kind != "idle" or reading.fastest_rad_per_s < ASTRAY_RAD_PER_S:
            self._rested_ns = now_ns

    def keep(self, reading: RtdeSample, now_ns: int) -> None:
        """Send what is due in this cycle."""
        if self.barred:
            return
        match self.kind:
            case "wrist":
                self._keep_turning(reading, now_ns)
            case "linear":
                self._keep_moving(reading, now_ns)
            case "stopping":
                self._keep_stopping(reading, now_ns)
            case "idle":
                self._keep_resting(now_ns)

    def _keep_turning(self, reading: RtdeSample, now_ns: int) -> None:
        if now_ns - self._asked_ns > self._settings.command_timeout_s * 1e9:
            late = f"the wrist speed was not renewed within {self._settings.command_timeout_s:g} s"
            self.stop_now(reading, now_ns, late, Stop(self._limits.wrist_acceleration_rad_per_s2.inner))
        else:
            self._send_wrist(reading)

    def _keep_moving(self, reading: RtdeSample, now_ns: int) -> None:
        self._move_seen = self._move_seen or reading.moving_linearly
        why = line_violation(reading, self._limits)
        if now_ns > self._deadline_ns:
            why = "the linear move did not end within its time"
        # The end of the move and the joints' speeds come over two connections, of which one may lag.
        if not reading.moving_linearly and reading.rests and (self._move_seen or self._is_there(reading, now_ns)):
            self.kind, self.ended = "idle", ARRIVED
        elif why:
            self.stop(reading, now_ns, why)
            return
        self._arm.kick()

    def _is_there(self, reading: RtdeSample, now_ns: int) -> bool:
        waited = now_ns - self._move_ns > ARRIVED_AFTER_S * 1e9
        return waited and is_close(reading.tcp_pose, self._move_end, CLOSE)

    def _keep_stopping(self, reading: RtdeSample, now_ns: int) -> None:
        if now_ns > self._deadline_ns:
            self.let_go(sentences.NOT_STOPPING)
        elif self._speed_thread:
            braking = clip_stop(self._braking, reading, self._limits, self._settings.reaction_s)
            if self._speed(WristSpeed(0.0, braking.deceleration_rad_per_s2)) and reading.rests:
                self._end_speed_thread()
                self.kind = "idle"
        else:
            if not reading.moving_linearly and reading.rests:
                self.kind = "idle"
            self._arm.kick()

    def _keep_resting(self, now_ns: int) -> None:
        if now_ns - self._rested_ns > ASTRAY_S * 1e9:
            self.ended = "it moved although nothing was asked of it"
            self.let_go(sentences.ASTRAY)
        else:
            self._arm.kick()

    # ---- calls on the arm -----------------------------------------------------------------------------------------

    def _begin(self, kind: MotionKind, number: int) -> None:
        self.kind, self.number, self.ended = kind, number, ""

    def _send_wrist(self, reading: RtdeSample) -> bool:
        self.sent, self.clipped = clip_wrist(self._asked, reading, self._limits, self._settings.reaction_s)
        return self._speed(self.sent)

    def _speed(self, command: WristSpeed) -> bool:
        self._speed_thread = True
        taken = self._arm.wrist(command)
        if not taken:
            # An earlier speed may still hold.
            self._not_taken("wrist speed")
        return taken

    def _not_taken(self, what: str) -> None:
        self.puzzled = True
        self.let_go(sentences.not_taken(what))

    def _end_speed_thread(self) -> None:
        if self._speed_thread:
            self._arm.end_speed(self._limits.wrist_acceleration_rad_per_s2.inner)
            self._speed_thread = False


def _harder(one: Stop, other: Stop) -> Stop:
    return one if one.deceleration_rad_per_s2 >= other.deceleration_rad_per_s2 else other
