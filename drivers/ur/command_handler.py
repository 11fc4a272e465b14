"""Decides in the worker which commands are sent to the robot, and refuses the others with a reason.

No clock, no pipe, no ur-rtde: the arm and the time are arguments. `tick` runs one cycle; `request` takes commands
between cycles. After a motion has ended, only a new command begins one.
"""

from typing import TYPE_CHECKING

from shearloop.drivers.ur.limits import is_recent, violation, why_unfit
from shearloop.drivers.ur.messages import (
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
from shearloop.drivers.ur.motion_executor import MotionExecutor
from shearloop.drivers.ur.recovery import Outcome, ProgramOwner, Recovery
from shearloop.drivers.ur.settings import UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

NOT_ENABLED = "Motion has not been enabled since the robot's process was started: enable it when the arm may move."
BEING_MADE_READY = "The robot is being made ready (safety, power, control program): ask again in a second."
LEAVING = "The daemon disconnects from the robot: start it again to go on."


class CommandHandler:
    """Applies the latest command within the limits."""

    def __init__(self, settings: UrSettings, arm: "UrArm", now_ns: int, *, takes_over: bool = False) -> None:
        """Begin with motion disabled, and start the control program where the robot allows it.

        `takes_over`: a paused program on the robot was left behind by the worker before this one.
        """
        self._settings = settings
        self._arm = arm
        self._executor = MotionExecutor(settings, arm, now_ns)
        self._program = ProgramOwner(arm, ours=takes_over)
        self._recovery: Recovery | None = Recovery(
            arm, now_ns, settings.recover_timeout_s, operator_asked=False, takes_over=takes_over
        )
        self._unlock_number: int | None = None
        self._held_reason = NOT_ENABLED
        self._daemon_alive_ns = now_ns
        # Whether the daemon disconnects: only stops are taken from then on.
        self.leaving = False

    @property
    def at_rest(self) -> bool:
        """Whether no motion is under way."""
        return self._executor.motion == "idle"

    @property
    def recovering(self) -> bool:
        """Whether calls may take seconds: to the dashboard, or the first one to a new program."""
        return self._recovery is not None or self._program.stop_announced

    def may_own_program(self, now_ns: int) -> bool:
        """Return whether a program that plays is ours or may be, because one was just being started."""
        return self._program.may_be_ours(now_ns)

    def owns_paused_program(self, sample: RtdeSample) -> bool:
        """Return whether a program of ours is paused and could be resumed at the pendant."""
        return self._program.ours and sample.program_paused

    def take_rejection(self) -> bool:
        """Return, once, whether the robot rejected a command.

        The control connection may see the end of the program before the sample does. The next sample may say why.
        """
        return self._executor.take_rejection()

    def note_daemon_alive(self, now_ns: int) -> None:
        """Note that the daemon sent something."""
        self._daemon_alive_ns = now_ns

    def request(self, number: int, command: Command, sample: RtdeSample, now_ns: int) -> CommandReply | None:
        """Return the reply to a command; None when `tick` returns it later (`Unlock`)."""
        if isinstance(command, Stop) and self._recovery is not None and self._unlock_number is not None:
            self._recovery.give_up("Unlocking was ended by a stop.")
        refusal = self._why_refused(command, sample)
        if refusal:
            return CommandReply(refusal=refusal)
        match command:
            case WristSpeed():
                self._executor.turn(number, command, sample, now_ns)
            case MoveLinear():
                self._executor.move(number, command, sample, now_ns)
            case Stop():
                self._executor.stop_on_command(number, command, sample, now_ns)
            case Unlock() if self._why_unfit(sample):
                self._begin_unlocking(number, sample, now_ns)
                return None
            case Enable() | Unlock():
                self._held_reason = ""
                return CommandReply()
            case ZeroForceTorque():
                zeroed = self._arm.zero_wrench()
                return CommandReply(refusal="" if zeroed else "The robot did not zero its force-torque sensor.")
            case Disconnect():
                self._leave(sample, now_ns)
                return CommandReply()
        if self._executor.disabled_reason:
            return CommandReply(refusal=self._executor.disabled_reason)
        return CommandReply(sent=self._executor.sent, clipped=self._executor.clipped)

    def tick(self, sample: RtdeSample, now_ns: int) -> tuple[int, CommandReply] | None:
        """Run one cycle: check the sample and send what is due; return the reply to an `Unlock` that has ended."""
        self._executor.watch(sample, now_ns)
        recent = is_recent(sample, self._settings)
        without_us = self._recovery is not None or bool(self._executor.disabled_reason)
        self._program.update(
            sample,
            now_ns,
            starting=self._recovery is not None and self._recovery.starts_program,
            plays_without_us=without_us and sample.program_running and recent,
        )
        if self._recovery is not None:
            # Samples may stay old for minutes without counting as lost; the operator gets an answer all the same.
            if recent or self._recovery.has_ended(now_ns):
                return self._recover(self._recovery, sample, now_ns)
            return None
        unfit = self._why_unfit(sample)
        if unfit:
            # Nothing can be sent. The arm stops by itself, or by its watchdog, which is not fed now.
            self._held_reason = unfit
            if not self.at_rest:
                # The program may turn the wrist on, also when it is resumed.
                self._executor.leave_to_watchdog(unfit)
            if not sample.program_running:
                self._executor.disable(unfit)
                if recent and self.owns_paused_program(sample) and not self.leaving:
                    self._program.stop_paused(now_ns)
            return None
        beyond = violation(sample, self._settings.limits)
        if beyond:
            self._held_reason = beyond
            self._executor.stop(sample, now_ns, beyond)
        elif now_ns - self._daemon_alive_ns > self._settings.silence_timeout_s * 1e9:
            silent = f"the daemon was silent for {self._settings.silence_timeout_s:g} s"
            self._executor.stop(sample, now_ns, silent)
        self._executor.keep(sample, now_ns)
        return None

    def state(self, sample: RtdeSample, cycle: int) -> RobotState:
        """Return the sample with the state of the driver."""
        executor = self._executor
        return RobotState(
            **sample.__dict__,
            blocked=self._why_blocked(sample),
            recovering=self.recovering,
            motion=executor.motion,
            motion_id=executor.motion_id,
            end_reason=executor.end_reason,
            sent=executor.sent,
            clipped=executor.clipped,
            cycle=cycle,
            owns_program=self._program.ours,
            failed_program_stops=self._program.failed_stops,
        )

    def _why_refused(self, command: Command, sample: RtdeSample) -> str:
        """Return why a command is not carried out, or the empty string."""
        if self.leaving and not isinstance(command, Stop | Disconnect):
            return LEAVING
        unfit = self._why_unfit(sample)
        match command:
            case WristSpeed() | MoveLinear():
                return self._why_blocked(sample) or self._executor.why_refused(command, sample)
            case Stop(deceleration) if deceleration <= 0:
                return f"A deceleration of {deceleration:g} rad/s² is not above 0."
            case Stop() if unfit:
                return f"Nothing can be sent, and the arm stops by itself. {unfit}"
            case Unlock() if self._unlock_number is not None:
                return "Unlocking is under way."
            case Unlock() if unfit:
                return ""
            case Enable() | Unlock() if self._recovery is not None:
                return BEING_MADE_READY
            case Enable() | Unlock():
                return unfit or violation(sample, self._settings.limits)
            case ZeroForceTorque():
                rests = self.at_rest and sample.rests
                moving = "" if rests else "The wrench is zeroed only at rest: stop the arm first."
                # A new zero would only hide a value beyond its limit.
                return unfit or violation(sample, self._settings.limits) or moving
        return ""

    def _why_unfit(self, sample: RtdeSample) -> str:
        """Return why nothing can be sent to the robot, or the empty string."""
        return why_unfit(sample, self._settings) or self._executor.disabled_reason

    def _why_blocked(self, sample: RtdeSample) -> str:
        """Return why motion is refused, or the empty string."""
        if self._recovery is not None:
            return BEING_MADE_READY
        reason = self._why_unfit(sample) or violation(sample, self._settings.limits) or self._held_reason
        return f"{reason} {self._program.failure}" if self._program.failure else reason

    def _leave(self, sample: RtdeSample, now_ns: int) -> None:
        self.leaving = True
        if self._recovery is not None:
            self._recovery.give_up(LEAVING)
        self._executor.stop_now(sample, now_ns, "the daemon disconnects")

    def _begin_unlocking(self, number: int, sample: RtdeSample, now_ns: int) -> None:
        unfit = self._why_unfit(sample)
        if not self._executor.disabled_reason:
            self._executor.disable(unfit)
        self._unlock_number = number
        self._recovery = Recovery(self._arm, now_ns, self._settings.recover_timeout_s, operator_asked=True)

    def _recover(self, recovery: Recovery, sample: RtdeSample, now_ns: int) -> tuple[int, CommandReply] | None:
        outcome = recovery.advance(sample, now_ns)
        if recovery.starts_program:
            self._program.note_start(now_ns)
        if outcome is Outcome.UNDER_WAY:
            return None
        self._recovery = None
        if outcome is Outcome.DONE:
            self._executor.enable()
        number, self._unlock_number = self._unlock_number, None
        if number is None:
            self._held_reason = recovery.refusal or self._held_reason
            return None
        if outcome is Outcome.DONE:
            self._held_reason = ""
        return number, CommandReply(refusal=recovery.refusal)
