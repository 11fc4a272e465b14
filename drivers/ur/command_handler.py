"""What is sent to the robot and what is refused: commands, readings and the time in; calls on the arm and replies out.

No clock, no pipe, no ur-rtde: the arm is a port and the time an argument, so that every rule here is tested without a
robot. One cycle is `tick`; commands come between cycles through `request`. Whatever ends a motion, nothing begins one
but a command given after it.
"""

from shearloop.drivers.ur import error_messages as sentences
from shearloop.drivers.ur.limits import violation
from shearloop.drivers.ur.messages import (
    RUNTIME_STOPPED,
    SAFETY_EMERGENCY_STOPS,
    SAFETY_PROTECTIVE_STOP,
    Command,
    CommandReply,
    Disconnect,
    Enable,
    MoveLinear,
    RobotState,
    RtdeSample,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from shearloop.drivers.ur.motion import tool_axis_torque
from shearloop.drivers.ur.motion_executor import MotionExecutor
from shearloop.drivers.ur.paused import ForeignProgramDetector, PausedProgram
from shearloop.drivers.ur.ports import PilotArm
from shearloop.drivers.ur.recovery import ENDS_ITSELF_S, Outcome, Recovery
from shearloop.drivers.ur.settings import UrSettings


class CommandHandler:
    """Applies the latest command, within the limits, while everything is well."""

    def __init__(self, settings: UrSettings, arm: PilotArm, now_ns: int, *, takes_over: bool = False) -> None:
        """Begin with motion not enabled, and with starting the control program where the robot lets us.

        `takes_over`: a program that is there, and does not go on and on, is one that a process before has left behind.
        """
        self._settings = settings
        self._limits = settings.limits
        self._arm = arm
        self._held = sentences.NOT_ENABLED
        self._leaving = False
        # Whether a program that is there was started here, or left behind by a process before; not while one is begun.
        self._ours = takes_over
        # When one was being started here last: an upload may take after the recovery that sent it was given up.
        self._starting_ns: int | None = None
        self._paused, self._unkicked = PausedProgram(arm), ForeignProgramDetector()
        # Whether it is stopped in the next cycle, of which the daemon learns beforehand that it may take long.
        self._stops_paused = False
        self._mover = MotionExecutor(settings, arm, now_ns)
        self._heard_ns = now_ns
        self._recovery: Recovery | None = Recovery(
            arm, now_ns, settings.recover_timeout_s, operator_asked=False, takes_over=takes_over
        )
        self._unlock_number: int | None = None
        self._judged: RtdeSample | None = None
        self._beyond = ""

    @property
    def at_rest(self) -> bool:
        """Whether no motion is under way."""
        return self._mover.kind == "idle"

    @property
    def recovering(self) -> bool:
        """Whether calls may take seconds: the dashboard's, and the first one to a new program."""
        return self._recovery is not None or self._stops_paused

    @property
    def ours(self) -> bool:
        """Whether a program on the robot is one that was started here, or that a process before has left behind."""
        return self._ours or (self._recovery is not None and self._recovery.starts)

    def may_be_ours(self, now_ns: int) -> bool:
        """Return whether a program that plays is ours, or may be: one was being started here just now."""
        just_now = self._starting_ns is not None and now_ns - self._starting_ns <= ENDS_ITSELF_S * 1e9
        return self.ours or just_now

    def puzzled(self) -> bool:
        """Return, once, whether the robot did not take something: the next reading may say why.

        The connection that commands may see the end of the program before the one that reads.
        """
        puzzled, self._mover.puzzled = self._mover.puzzled, False
        return puzzled

    def left_paused(self, reading: RtdeSample) -> bool:
        """Whether a program of ours is paused, and could be resumed by anybody."""
        return self.ours and reading.program_paused

    def heard(self, now_ns: int) -> None:
        """Note a sign of life of the daemon."""
        self._heard_ns = now_ns

    def request(self, number: int, command: Command, reading: RtdeSample, now_ns: int) -> CommandReply | None:
        """Return the reply to a command; None when it comes later, from `tick` (`Unlock`)."""
        if self._leaving and not isinstance(command, Stop | Disconnect):
            return CommandReply(refused=sentences.LEAVING)
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

    def tick(self, reading: RtdeSample, now_ns: int) -> tuple[int, CommandReply] | None:
        """Let one cycle pass: judge the reading, send what is due; return the reply to an `Unlock` that is decided."""
        self._mover.watch(reading, now_ns)
        announced, self._stops_paused = self._stops_paused, False
        if self._recovery is not None and self._recovery.starts:
            self._starting_ns = now_ns
        left = self._recovery is not None or self._mover.barred
        plays = bool(left) and reading.program_running and self._is_new(reading)
        if reading.runtime_state == RUNTIME_STOPPED or self._unkicked.outlives(now_ns, plays=plays):
            # What is there next may be anybody's; and ours may have ended while nothing was read.
            self._ours = False
            self._paused.forget()
        if self._recovery is not None:
            return self._recover(self._recovery, reading, now_ns)
        trouble = self._unfit(reading)
        if trouble:
            # Nothing can be sent. The arm stops by itself, or by its watchdog, which is no longer kicked.
            self._held = trouble
            if not self.at_rest:
                # The program turns the wrist on where it knows of no trouble, and again when it is resumed.
                self._mover.let_go(trouble)
            if not reading.program_running:
                self._mover.barred = sentences.NOT_OURS
                self._end_what_is_paused(reading, now_ns, announced=announced)
            return None
        beyond = self._violation(reading)
        if beyond:
            self._held = beyond
            self._mover.stop(reading, now_ns, beyond)
        elif now_ns - self._heard_ns > self._settings.silence_timeout_s * 1e9:
            self._mover.stop(reading, now_ns, f"the daemon was silent for {self._settings.silence_timeout_s:g} s")
        self._mover.keep(reading, now_ns)
        return None

    def state(self, reading: RtdeSample, cycle: int) -> RobotState:
        """Return the reading of a cycle with everything that this pilot adds to it."""
        return RobotState(
            reading.timestamp_s,
            reading.q_rad,
            reading.qd_rad_per_s,
            reading.tcp_pose,
            reading.wrench,
            reading.robot_mode,
            reading.safety_mode,
            reading.runtime_state,
            reading.speed_scaling,
            reading.t_mono_ns,
            reading.age_ns,
            reading.connected,
            reading.moving_linearly,
            wrist_torque_nm=tool_axis_torque(reading),
            protective_stop=reading.safety_mode == SAFETY_PROTECTIVE_STOP,
            emergency_stop=reading.safety_mode in SAFETY_EMERGENCY_STOPS,
            blocked=self._blocked(reading),
            recovering=self.recovering,
            motion=self._mover.kind,
            motion_id=self._mover.number,
            ended=self._mover.ended,
            sent=self._mover.sent,
            clipped=self._mover.clipped,
            cycle=cycle,
            ours=self.ours,
            stops_in_vain=self._paused.in_vain,
        )

    # ---- commands -------------------------------------------------------------------------------------------------

    def _turn(self, number: int, asked: WristSpeed, reading: RtdeSample, now_ns: int) -> CommandReply:
        why = self._blocked(reading)
        if not why and asked.acceleration_rad_per_s2 <= 0:
            why = f"An acceleration of {asked.acceleration_rad_per_s2:g} rad/s² is not above 0."
        if not why and self._mover.kind == "stopping":
            why = "The arm is still stopping."
        if not why and self._mover.kind == "linear":
            why = "A linear move is under way: stop it."
        if why:
            return CommandReply(refused=why)
        return self._reply(taken=self._mover.turn(number, asked, reading, now_ns))

    def _move(self, number: int, asked: MoveLinear, reading: RtdeSample, now_ns: int) -> CommandReply:
        why = self._blocked(reading)
        if not why and min(asked.speed_m_per_s, asked.acceleration_m_per_s2) <= 0:
            why = "A linear move needs a speed and an acceleration above 0."
        if not why and not (self._mover.kind in ("idle", "wrist") and reading.rests):
            why = "The arm moves: stop it before a linear move."
        if why:
            return CommandReply(refused=why)
        return self._reply(taken=self._mover.move(number, asked, reading, now_ns))

    def _reply(self, *, taken: bool) -> CommandReply:
        return (
            CommandReply(sent=self._mover.sent, clipped=self._mover.clipped)
            if taken
            else CommandReply(refused=self._mover.barred)
        )

    def _stop_on_command(self, number: int, asked: Stop, reading: RtdeSample, now_ns: int) -> CommandReply:
        if asked.deceleration_rad_per_s2 <= 0:
            return CommandReply(refused=f"A deceleration of {asked.deceleration_rad_per_s2:g} rad/s² is not above 0.")
        if self._recovery is not None and self._unlock_number is not None:
            self._recovery.give_up("Unlocking was ended by a stop.")
        trouble = self._unfit(reading)
        if trouble:
            return CommandReply(refused=f"Nothing can be sent, and the arm stops by itself. {trouble}")
        self._mover.stop_as_asked(number, asked, reading, now_ns)
        return self._reply(taken=not self._mover.barred)

    def _leave(self, reading: RtdeSample, now_ns: int) -> CommandReply:
        self._leaving = True
        if self._recovery is not None:
            self._recovery.give_up(sentences.LEAVING)
        self._mover.stop_now(reading, now_ns, "the daemon disconnects")
        return CommandReply()

    def _enable(self, reading: RtdeSample) -> CommandReply:
        why = self._unfit(reading) or self._violation(reading)
        if self._recovery is not None:
            why = sentences.BEING_MADE_READY
        if not why:
            self._held = ""
        return CommandReply(refused=why)

    def _unlock(self, number: int, reading: RtdeSample, now_ns: int) -> CommandReply | None:
        if self._unlock_number is not None:
            return CommandReply(refused="Unlocking is under way.")
        if not self._unfit(reading):
            return self._enable(reading)
        self._mover.bar(self._unfit(reading), self._mover.barred or sentences.NOT_OURS)
        self._unlock_number = number
        self._ours = self.ours
        self._recovery = Recovery(self._arm, now_ns, self._settings.recover_timeout_s, operator_asked=True)
        return None

    def _zero_wrench(self, reading: RtdeSample) -> CommandReply:
        # What is beyond a limit stays so: a new zero would only hide it.
        why = self._unfit(reading) or self._violation(reading)
        if not why and not (self.at_rest and reading.rests):
            why = "The wrench is zeroed only at rest: stop the arm first."
        if not why and not self._arm.zero_wrench():
            why = "The robot did not zero its force-torque sensor."
        return CommandReply(refused=why)

    # ---- judging --------------------------------------------------------------------------------------------------

    def _unfit(self, reading: RtdeSample) -> str:
        return sentences.unfit(reading, self._settings.host, self._settings.state_timeout_s) or self._mover.barred

    def _violation(self, reading: RtdeSample) -> str:
        """Return `violation` of a reading, which several rules ask for in one cycle."""
        if reading is not self._judged:
            self._judged, self._beyond = reading, violation(reading, self._limits)
        return self._beyond

    def _blocked(self, reading: RtdeSample) -> str:
        if self._recovery is not None:
            return sentences.BEING_MADE_READY
        why = self._unfit(reading) or self._violation(reading) or self._held
        return f"{why} {self._paused.why}" if self._paused.why else why

    def _end_what_is_paused(self, reading: RtdeSample, now_ns: int, *, announced: bool) -> None:
        """Stop a program of ours that is paused, in the cycle after the one that has announced it."""
        if self._leaving or not (self._ours and reading.program_paused and self._is_new(reading)):
            return
        if self._paused.due(now_ns):
            if announced:
                self._paused.stop(now_ns)
            self._stops_paused = not announced

    def _is_new(self, reading: RtdeSample) -> bool:
        return reading.connected and reading.age_ns <= self._settings.state_timeout_s * 1e9

    def _recover(self, recovery: Recovery, reading: RtdeSample, now_ns: int) -> tuple[int, CommandReply] | None:
        # States may stay old for minutes, and not so old that the connection is given up: the operator is answered.
        if not self._is_new(reading) and not recovery.ended(now_ns):
            return None
        outcome = recovery.advance(reading, now_ns)
        if outcome is Outcome.UNDER_WAY:
            return None
        self._ours, self._recovery = self.ours, None
        if outcome is Outcome.DONE:
            self._mover.barred = ""
        number, self._unlock_number = self._unlock_number, None
        if number is None:
            self._held = recovery.why or self._held
            return None
        if outcome is Outcome.DONE:
            self._held = ""
        return number, CommandReply(refused=recovery.why)
