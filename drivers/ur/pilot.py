"""What is sent to the robot and what is refused: commands, readings and the time in; calls on the arm and replies out.

No clock, no pipe, no ur-rtde: the arm is a port and the time an argument, so that every rule here is tested without a
robot. One cycle is `tick`; commands come between cycles through `request`. Whatever ends a motion, nothing begins one
but a command given after it. A motion that does not end as it should ends by the robot's watchdog: nothing is sent to
the program any more, and only `Unlock` starts another.
"""

import math

from drivers.ur import sentences
from drivers.ur.limits import clip_linear, clip_stop, clip_wrist, line_violation, violation
from drivers.ur.messages import (
    RUNTIME_PLAYING,
    RUNTIME_STOPPED,
    SAFETY_EMERGENCY_STOPS,
    SAFETY_PROTECTIVE_STOP,
    Command,
    Disconnect,
    Enable,
    MotionKind,
    MoveLinear,
    Reading,
    Reply,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from drivers.ur.motion import longest_move_s, longest_stop_s, tool_axis_torque
from drivers.ur.ports import PilotArm
from drivers.ur.recovery import Outcome, Recovery
from drivers.ur.settings import Six, UrSettings

# A linear move may be too short to be seen under way: who rests at its end (in m and rad) after so long has arrived.
ARRIVED, ARRIVED_AFTER_S = 2e-3, 0.2
# An arm that nothing was asked of may tremble, but not move as fast as this for so long.
ASTRAY_RAD_PER_S, ASTRAY_S = 0.02, 0.2


class Pilot:
    """Applies the latest command, within the limits, while everything is well."""

    def __init__(self, settings: UrSettings, arm: PilotArm, now_ns: int, *, takes_over: bool = False) -> None:
        """Begin with motion not enabled, and with starting the control program where the robot lets us.

        `takes_over`: a program that runs there is one that we may stop for that.
        """
        self._settings = settings
        self._limits = settings.limits
        self._arm = arm
        self._held = sentences.NOT_ENABLED
        # Why the program on the robot is not ours to send anything to, as long as it is not.
        self._not_ours = sentences.NOT_OURS
        self._started = self._leaving = False
        self._motion: MotionKind = "idle"
        self._motion_id = 0
        self._ended = ""
        self._asked, self._braking = WristSpeed(0.0, 0.0), Stop(0.0)
        self._speed_thread = False
        self._asked_ns = self._heard_ns = self._rested_ns = now_ns
        self._deadline_ns = self._move_ns = 0
        self._move_seen = False
        self._move_end: Six = (0.0,) * 6
        self._sent: WristSpeed | MoveLinear | Stop | None = None
        self._clipped: tuple[str, ...] = ()
        self._recovery: Recovery | None = Recovery(
            arm, now_ns, settings.recover_timeout_s, operator_asked=False, may_stop_program=takes_over
        )
        self._unlock_number: int | None = None
        self._judged: Reading | None = None
        self._beyond = ""

    @property
    def at_rest(self) -> bool:
        """Whether no motion is under way."""
        return self._motion == "idle"

    @property
    def recovering(self) -> bool:
        """Whether calls may take seconds: the dashboard's, and the first one to a new program."""
        return self._recovery is not None

    def left_paused(self, reading: Reading) -> bool:
        """Whether the program that was started here is paused, and could be resumed by anybody."""
        return self._started and reading.runtime_state not in (RUNTIME_STOPPED, RUNTIME_PLAYING)

    def heard(self, now_ns: int) -> None:
        """Note a sign of life of the daemon."""
        self._heard_ns = now_ns

    def request(self, number: int, command: Command, reading: Reading, now_ns: int) -> Reply | None:
        """Return the reply to a command; None when it comes later, from `tick` (`Unlock`)."""
        if self._leaving and not isinstance(command, Stop | Disconnect):
            return Reply(refused=sentences.LEAVING)
        match command:
            case Stop():
                return self._stop_on_command(number, command, reading, now_ns)
            case Enable():
                return self._enable(reading)
            case Unlock():
                return self._unlock(number, reading, now_ns)
            case ZeroForceTorque():
                return self._zero_wrench(reading)
            case WristSpeed():
                return self._turn(number, command, reading, now_ns)
            case MoveLinear():
                return self._move(number, command, reading, now_ns)
            case Disconnect():
                return self._leave(reading, now_ns)

    def tick(self, reading: Reading, now_ns: int) -> tuple[int, Reply] | None:
        """Let one cycle pass: judge the reading, send what is due; return the reply to an `Unlock` that is decided."""
        if self._motion != "idle" or reading.fastest_rad_per_s < ASTRAY_RAD_PER_S:
            self._rested_ns = now_ns
        if self._recovery is not None:
            return self._recover(self._recovery, reading, now_ns)
        trouble = self._unfit(reading)
        if trouble:
            # Nothing can be sent. The arm stops by itself, or by its watchdog, which is no longer kicked.
            self._held = trouble
            if self._motion != "idle":
                # The program turns the wrist on where it knows of no trouble, and again when it is resumed.
                self._let_go(trouble)
            if not reading.program_running:
                self._not_ours = sentences.NOT_OURS
                self._started = self._started and reading.runtime_state != RUNTIME_STOPPED
            return None
        beyond = self._violation(reading)
        if beyond:
            self._held = beyond
            self._stop(reading, now_ns, beyond)
        elif now_ns - self._heard_ns > self._settings.silence_timeout_s * 1e9:
            self._stop(reading, now_ns, f"the daemon was silent for {self._settings.silence_timeout_s:g} s")
        if self._not_ours:
            return None
        match self._motion:
            case "wrist":
                self._keep_turning(reading, now_ns)
            case "linear":
                self._watch_move(reading, now_ns)
            case "stopping":
                self._keep_stopping(reading, now_ns)
            case "idle":
                self._keep_resting(now_ns)
        return None

    def state(self, reading: Reading) -> RobotState:
        """Return the reading with everything that this pilot adds to it."""
        return RobotState(
            reading.t_mono_ns,
            reading.timestamp_s,
            reading.age_ns,
            reading.connected,
            reading.q_rad,
            reading.qd_rad_per_s,
            reading.tcp_pose,
            reading.wrench,
            reading.robot_mode,
            reading.safety_mode,
            reading.runtime_state,
            reading.speed_scaling,
            reading.moving_linearly,
            wrist_torque_nm=tool_axis_torque(reading),
            protective_stop=reading.safety_mode == SAFETY_PROTECTIVE_STOP,
            emergency_stop=reading.safety_mode in SAFETY_EMERGENCY_STOPS,
            blocked=self._blocked(reading),
            recovering=self.recovering,
            motion=self._motion,
            motion_id=self._motion_id,
            ended=self._ended,
            sent=self._sent,
            clipped=self._clipped,
        )

    # ---- commands -------------------------------------------------------------------------------------------------

    def _turn(self, number: int, asked: WristSpeed, reading: Reading, now_ns: int) -> Reply:
        why = self._blocked(reading)
        if not why and asked.acceleration_rad_per_s2 <= 0:
            why = f"An acceleration of {asked.acceleration_rad_per_s2:g} rad/s² is not above 0."
        if not why and self._motion not in ("idle", "wrist"):
            why = "The arm is still stopping." if self._motion == "stopping" else "A linear move is under way: stop it."
        if why:
            return Reply(refused=why)
        self._begin("wrist", number)
        self._asked, self._asked_ns = asked, now_ns
        if not self._send_wrist(reading):
            return Reply(refused=self._not_ours)
        return Reply(sent=self._sent, clipped=self._clipped)

    def _move(self, number: int, asked: MoveLinear, reading: Reading, now_ns: int) -> Reply:
        why = self._blocked(reading)
        if not why and min(asked.speed_m_per_s, asked.acceleration_m_per_s2) <= 0:
            why = "A linear move needs a speed and an acceleration above 0."
        if not why and not (self._motion in ("idle", "wrist") and reading.rests):
            why = "The arm moves: stop it before a linear move."
        if why:
            return Reply(refused=why)
        self._end_speed_thread()
        sent, clipped = clip_linear(asked, self._limits)
        self._begin("linear", number)
        self._sent, self._clipped = sent, clipped
        self._deadline_ns = now_ns + int(1e9 * longest_move_s(sent, reading))
        self._move_seen = False
        self._move_ns, self._move_end = now_ns, sent.pose
        if not self._arm.move(sent):
            self._let_go(sentences.not_taken("linear move"))
            return Reply(refused=self._not_ours)
        return Reply(sent=sent, clipped=clipped)

    def _stop_on_command(self, number: int, asked: Stop, reading: Reading, now_ns: int) -> Reply:
        if asked.deceleration_rad_per_s2 <= 0:
            return Reply(refused=f"A deceleration of {asked.deceleration_rad_per_s2:g} rad/s² is not above 0.")
        if self._recovery is not None and self._unlock_number is not None:
            self._recovery.give_up("Unlocking was ended by a stop.")
        trouble = self._unfit(reading)
        if trouble:
            return Reply(refused=f"Nothing can be sent, and the arm stops by itself. {trouble}")
        sent = clip_stop(asked, reading, self._limits, self._settings.reaction_s)
        if self._motion == "stopping":
            sent = _harder(sent, self._braking)
        self._motion_id = number
        self._sent, self._clipped = sent, ()
        self._stop_now(reading, now_ns, "stopped on command", sent)
        return Reply(refused=self._not_ours) if self._not_ours else Reply(sent=sent)

    def _leave(self, reading: Reading, now_ns: int) -> Reply:
        self._leaving = True
        if self._recovery is not None:
            self._recovery.give_up(sentences.LEAVING)
        self._stop_now(reading, now_ns, "the daemon disconnects")
        return Reply()

    def _enable(self, reading: Reading) -> Reply:
        why = self._unfit(reading) or self._violation(reading)
        if self._recovery is not None:
            why = sentences.BEING_MADE_READY
        if not why:
            self._held = ""
        return Reply(refused=why)

    def _unlock(self, number: int, reading: Reading, now_ns: int) -> Reply | None:
        if self._unlock_number is not None:
            return Reply(refused="Unlocking is under way.")
        if not self._unfit(reading):
            return self._enable(reading)
        self._end(self._unfit(reading))
        self._speed_thread = False
        self._not_ours = self._not_ours or sentences.NOT_OURS
        self._unlock_number = number
        self._recovery = Recovery(
            self._arm, now_ns, self._settings.recover_timeout_s, operator_asked=True, may_stop_program=True
        )
        return None

    def _zero_wrench(self, reading: Reading) -> Reply:
        # What is beyond a limit stays so: a new zero would only hide it.
        why = self._unfit(reading) or self._violation(reading)
        if not why and not (self._motion == "idle" and reading.rests):
            why = "The wrench is zeroed only at rest: stop the arm first."
        if not why and not self._arm.zero_wrench():
            why = "The robot did not zero its force-torque sensor."
        return Reply(refused=why)

    # ---- motion under way -----------------------------------------------------------------------------------------

    def _keep_turning(self, reading: Reading, now_ns: int) -> None:
        if now_ns - self._asked_ns > self._settings.command_timeout_s * 1e9:
            late = f"the wrist speed was not renewed within {self._settings.command_timeout_s:g} s"
            self._stop_now(reading, now_ns, late, Stop(self._limits.wrist_acceleration_rad_per_s2.inner))
        else:
            self._send_wrist(reading)

    def _send_wrist(self, reading: Reading) -> bool:
        self._sent, self._clipped = clip_wrist(self._asked, reading, self._limits, self._settings.reaction_s)
        return self._speed(self._sent)

    def _speed(self, command: WristSpeed) -> bool:
        self._speed_thread = True
        taken = self._arm.wrist(command)
        if not taken:
            # An earlier speed may still hold.
            self._let_go(sentences.not_taken("wrist speed"))
        return taken

    def _watch_move(self, reading: Reading, now_ns: int) -> None:
        self._move_seen = self._move_seen or reading.moving_linearly
        why = line_violation(reading, self._limits)
        if now_ns > self._deadline_ns:
            why = "the linear move did not end within its time"
        # The end of the move and the joints' speeds come over two connections, of which one may lag.
        if not reading.moving_linearly and reading.rests and (self._move_seen or self._is_there(reading, now_ns)):
            self._end("arrived")
        elif why:
            self._stop(reading, now_ns, why)
            return
        self._arm.kick()

    def _is_there(self, reading: Reading, now_ns: int) -> bool:
        waited = now_ns - self._move_ns > ARRIVED_AFTER_S * 1e9
        return waited and math.dist(reading.tcp_pose, self._move_end) < ARRIVED

    def _keep_resting(self, now_ns: int) -> None:
        if now_ns - self._rested_ns > ASTRAY_S * 1e9:
            self._ended = "it moved although nothing was asked of it"
            self._let_go(sentences.ASTRAY)
        else:
            self._arm.kick()

    def _keep_stopping(self, reading: Reading, now_ns: int) -> None:
        if now_ns > self._deadline_ns:
            self._let_go(sentences.NOT_STOPPING)
        elif self._speed_thread:
            braking = clip_stop(self._braking, reading, self._limits, self._settings.reaction_s)
            if self._speed(WristSpeed(0.0, braking.deceleration_rad_per_s2)) and reading.rests:
                self._end_speed_thread()
                self._motion = "idle"
        else:
            self._arm.kick()
            if not reading.moving_linearly and reading.rests:
                self._motion = "idle"

    def _stop_now(self, reading: Reading, now_ns: int, why: str, stop: Stop | None = None) -> None:
        """Begin to stop, and send it: the next cycle may be a whole one away."""
        self._stop(reading, now_ns, why, stop)
        if self._motion == "stopping" and self._speed_thread:
            self._keep_stopping(reading, now_ns)

    def _stop(self, reading: Reading, now_ns: int, why: str, stop: Stop | None = None) -> None:
        """Begin to stop, as hard as may be unless told how; of two stops the harder one counts."""
        asked = stop or Stop(self._limits.wrist_acceleration_rad_per_s2.hard)
        if self._motion == "idle" or (self._motion == "stopping" and _harder(self._braking, asked) is self._braking):
            return
        if self._motion != "stopping":
            self._ended = why
        self._motion = "stopping"
        self._braking = asked
        self._deadline_ns = now_ns + int(1e9 * longest_stop_s(asked, reading))
        if not self._speed_thread and not self._arm.stop_move(asked.deceleration_rad_per_s2):
            self._let_go(sentences.not_taken("stop"))

    def _begin(self, motion: MotionKind, number: int) -> None:
        self._motion, self._motion_id, self._ended = motion, number, ""

    def _end(self, why: str) -> None:
        if self._motion != "idle":
            if self._motion != "stopping":
                self._ended = why
            self._motion = "idle"

    def _end_speed_thread(self) -> None:
        if self._speed_thread:
            self._arm.end_speed(self._limits.wrist_acceleration_rad_per_s2.inner)
            self._speed_thread = False

    def _let_go(self, why: str) -> None:
        """Send nothing to this program any more: whatever it does now, the robot's watchdog ends it."""
        self._end(why)
        self._speed_thread = False
        self._not_ours = sentences.left_to_watchdog(why)

    # ---- judging --------------------------------------------------------------------------------------------------

    def _unfit(self, reading: Reading) -> str:
        return sentences.unfit(reading, self._settings.host, self._settings.state_timeout_s) or self._not_ours

    def _violation(self, reading: Reading) -> str:
        """Return `violation` of a reading, which several rules ask for in one cycle."""
        if reading is not self._judged:
            self._judged, self._beyond = reading, violation(reading, self._limits)
        return self._beyond

    def _blocked(self, reading: Reading) -> str:
        if self._recovery is not None:
            return sentences.BEING_MADE_READY
        return self._unfit(reading) or self._violation(reading) or self._held

    def _recover(self, recovery: Recovery, reading: Reading, now_ns: int) -> tuple[int, Reply] | None:
        if not recovery.why and (not reading.connected or reading.age_ns > self._settings.state_timeout_s * 1e9):
            return None
        outcome = recovery.advance(reading, now_ns)
        if outcome is Outcome.UNDER_WAY:
            return None
        self._recovery = None
        if outcome is Outcome.DONE:
            self._not_ours, self._started = "", True
        number, self._unlock_number = self._unlock_number, None
        if number is None:
            self._held = recovery.why or self._held
            return None
        if outcome is Outcome.DONE:
            self._held = ""
        return number, Reply(refused=recovery.why)


def _harder(one: Stop, other: Stop) -> Stop:
    return one if one.deceleration_rad_per_s2 >= other.deceleration_rad_per_s2 else other
