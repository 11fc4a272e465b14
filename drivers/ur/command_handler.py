"""Decides in the worker which commands are sent to the robot, and refuses the others with a reason.

No clock, no pipe, no ur-rtde: the arm and the time are arguments. `tick` runs one cycle; `request` takes commands
between cycles. After a motion has ended, only a new command begins one.
"""

from dataclasses import fields
from typing import TYPE_CHECKING, Final

from shearloop.drivers.ur import error_messages, messages
from shearloop.drivers.ur.limits import violation
from shearloop.drivers.ur.motion_executor import MotionExecutor, tool_axis_torque
from shearloop.drivers.ur.recovery import (
    ENDS_ITSELF_S,
    ForeignProgramDetector,
    Outcome,
    PausedProgramStopper,
    Recovery,
)
from shearloop.drivers.ur.settings import UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

_SAMPLE_FIELDS: Final = tuple(field.name for field in fields(messages.RtdeSample))


class CommandHandler:
    """Applies the latest command within the limits."""

    def __init__(self, settings: UrSettings, arm: "UrArm", now_ns: int, *, takes_over: bool = False) -> None:
        """Begin with motion disabled, and start the control program where the robot allows it.

        `takes_over`: a paused program on the robot was left behind by the worker before this one.
        """
        self._settings = settings
        self._limits = settings.limits
        self._arm = arm
        self._held_reason = error_messages.NOT_ENABLED
        # Whether the daemon disconnects: only stops are taken from then on.
        self.leaving = False
        self._owns_program = takes_over
        # When a program was being started last: an upload may take effect after its recovery was given up.
        self._starting_ns: int | None = None
        self._paused_program = PausedProgramStopper(arm)
        self._foreign_program = ForeignProgramDetector()
        # The next cycle stops a paused program; the state before it announces that the cycle may take long.
        self._stops_paused = False
        self._executor = MotionExecutor(settings, arm, now_ns)
        self._daemon_alive_ns = now_ns
        self._recovery: Recovery | None = Recovery(
            arm, now_ns, settings.recover_timeout_s, operator_asked=False, takes_over=takes_over
        )
        self._unlock_number: int | None = None

    @property
    def at_rest(self) -> bool:
        """Whether no motion is under way."""
        return self._executor.motion == "idle"

    @property
    def recovering(self) -> bool:
        """Whether calls may take seconds: to the dashboard, or the first one to a new program."""
        return self._recovery is not None or self._stops_paused

    @property
    def owns_program(self) -> bool:
        """Whether a program on the robot was started by this worker or the one before it."""
        return self._owns_program or (self._recovery is not None and self._recovery.starts_program)

    def may_own_program(self, now_ns: int) -> bool:
        """Return whether a program that plays is ours or may be, because one was just being started."""
        just_now = self._starting_ns is not None and now_ns - self._starting_ns <= ENDS_ITSELF_S * 1e9
        return self.owns_program or just_now

    def owns_paused_program(self, sample: messages.RtdeSample) -> bool:
        """Return whether a program of ours is paused and could be resumed at the pendant."""
        return self.owns_program and sample.program_paused

    def take_command_rejected(self) -> bool:
        """Return, once, whether the robot rejected a command.

        The control connection may see the end of the program before the sample does. The next sample may say why.
        """
        rejected, self._executor.command_rejected = self._executor.command_rejected, False
        return rejected

    def note_daemon_alive(self, now_ns: int) -> None:
        """Note that the daemon sent something."""
        self._daemon_alive_ns = now_ns

    def request(
        self, number: int, command: messages.Command, sample: messages.RtdeSample, now_ns: int
    ) -> messages.CommandReply | None:
        """Return the reply to a command; None when `tick` returns it later (`Unlock`)."""
        if self.leaving and not isinstance(command, messages.Stop | messages.Disconnect):
            return messages.CommandReply(refusal=error_messages.LEAVING)
        match command:
            case messages.Stop():
                return self._stop(number, command, sample, now_ns)
            case messages.Enable():
                return self._enable(sample)
            case messages.Unlock():
                return self._unlock(number, sample, now_ns)
            case messages.ZeroForceTorque():
                return self._zero_wrench(sample)
            case messages.WristSpeed():
                return self._turn(number, command, sample, now_ns)
            case messages.MoveLinear():
                return self._move(number, command, sample, now_ns)
            case messages.Disconnect():
                return self._leave(sample, now_ns)

    def tick(self, sample: messages.RtdeSample, now_ns: int) -> tuple[int, messages.CommandReply] | None:
        """Run one cycle: check the sample and send what is due; return the reply to an `Unlock` that has ended."""
        self._executor.watch(sample, now_ns)
        announced, self._stops_paused = self._stops_paused, False
        if self._recovery is not None and self._recovery.starts_program:
            self._starting_ns = now_ns
        without_us = self._recovery is not None or bool(self._executor.disabled_reason)
        foreign = self._foreign_program.update(
            now_ns, plays_without_us=without_us and sample.program_running and self._is_recent(sample)
        )
        if sample.runtime_state == messages.RUNTIME_STOPPED or foreign:
            # The next program may be anyone's, and ours may have ended between two samples.
            self._owns_program = False
            self._paused_program.reset()
        if self._recovery is not None:
            return self._recover(self._recovery, sample, now_ns)
        unfit = self._why_unfit(sample)
        if unfit:
            # Nothing can be sent. The arm stops by itself, or by its watchdog, which is not fed now.
            self._held_reason = unfit
            if not self.at_rest:
                # The program may turn the wrist on, also when it is resumed.
                self._executor.leave_to_watchdog(unfit)
            if not sample.program_running:
                self._executor.disabled_reason = error_messages.NOT_OURS
                self._stop_paused_program(sample, now_ns, announced=announced)
            return None
        beyond = violation(sample, self._limits)
        if beyond:
            self._held_reason = beyond
            self._executor.stop(sample, now_ns, beyond)
        elif now_ns - self._daemon_alive_ns > self._settings.silence_timeout_s * 1e9:
            silent = f"the daemon was silent for {self._settings.silence_timeout_s:g} s"
            self._executor.stop(sample, now_ns, silent)
        self._executor.keep(sample, now_ns)
        return None

    def state(self, sample: messages.RtdeSample, cycle: int) -> messages.RobotState:
        """Return the sample with the state of the driver."""
        executor = self._executor
        return messages.RobotState(
            **{name: getattr(sample, name) for name in _SAMPLE_FIELDS},
            wrist_torque_nm=tool_axis_torque(sample),
            protective_stop=sample.safety_mode == messages.SAFETY_PROTECTIVE_STOP,
            emergency_stop=sample.safety_mode in messages.SAFETY_EMERGENCY_STOPS,
            blocked=self._why_blocked(sample),
            recovering=self.recovering,
            motion=executor.motion,
            motion_id=executor.motion_id,
            end_reason=executor.end_reason,
            sent=executor.sent,
            clipped=executor.clipped,
            cycle=cycle,
            owns_program=self.owns_program,
            failed_program_stops=self._paused_program.failed_stops,
        )

    def _turn(
        self, number: int, asked: messages.WristSpeed, sample: messages.RtdeSample, now_ns: int
    ) -> messages.CommandReply:
        refusal = self._why_blocked(sample)
        if not refusal and asked.acceleration_rad_per_s2 <= 0:
            refusal = f"An acceleration of {asked.acceleration_rad_per_s2:g} rad/s² is not above 0."
        if not refusal and self._executor.motion == "stopping":
            refusal = "The arm is still stopping."
        if not refusal and self._executor.motion == "linear":
            refusal = "A linear move is under way: stop it."
        if refusal:
            return messages.CommandReply(refusal=refusal)
        return self._reply(taken=self._executor.turn(number, asked, sample, now_ns))

    def _move(
        self, number: int, asked: messages.MoveLinear, sample: messages.RtdeSample, now_ns: int
    ) -> messages.CommandReply:
        refusal = self._why_blocked(sample)
        if not refusal and min(asked.speed_m_per_s, asked.acceleration_m_per_s2) <= 0:
            refusal = "A linear move needs a speed and an acceleration above 0."
        if not refusal and not (self._executor.motion in ("idle", "wrist") and sample.rests):
            refusal = "The arm moves: stop it before a linear move."
        if refusal:
            return messages.CommandReply(refusal=refusal)
        return self._reply(taken=self._executor.move(number, asked, sample, now_ns))

    def _reply(self, *, taken: bool) -> messages.CommandReply:
        if not taken:
            return messages.CommandReply(refusal=self._executor.disabled_reason)
        return messages.CommandReply(sent=self._executor.sent, clipped=self._executor.clipped)

    def _stop(
        self, number: int, asked: messages.Stop, sample: messages.RtdeSample, now_ns: int
    ) -> messages.CommandReply:
        if asked.deceleration_rad_per_s2 <= 0:
            return messages.CommandReply(
                refusal=f"A deceleration of {asked.deceleration_rad_per_s2:g} rad/s² is not above 0."
            )
        if self._recovery is not None and self._unlock_number is not None:
            self._recovery.give_up("Unlocking was ended by a stop.")
        unfit = self._why_unfit(sample)
        if unfit:
            return messages.CommandReply(refusal=f"Nothing can be sent, and the arm stops by itself. {unfit}")
        self._executor.stop_on_command(number, asked, sample, now_ns)
        return self._reply(taken=not self._executor.disabled_reason)

    def _leave(self, sample: messages.RtdeSample, now_ns: int) -> messages.CommandReply:
        self.leaving = True
        if self._recovery is not None:
            self._recovery.give_up(error_messages.LEAVING)
        self._executor.stop_now(sample, now_ns, "the daemon disconnects")
        return messages.CommandReply()

    def _enable(self, sample: messages.RtdeSample) -> messages.CommandReply:
        refusal = self._why_unfit(sample) or violation(sample, self._limits)
        if self._recovery is not None:
            refusal = error_messages.BEING_MADE_READY
        if not refusal:
            self._held_reason = ""
        return messages.CommandReply(refusal=refusal)

    def _unlock(self, number: int, sample: messages.RtdeSample, now_ns: int) -> messages.CommandReply | None:
        if self._unlock_number is not None:
            return messages.CommandReply(refusal="Unlocking is under way.")
        unfit = self._why_unfit(sample)
        if not unfit:
            return self._enable(sample)
        self._executor.disable(unfit, self._executor.disabled_reason or error_messages.NOT_OURS)
        self._unlock_number = number
        self._owns_program = self.owns_program
        self._recovery = Recovery(self._arm, now_ns, self._settings.recover_timeout_s, operator_asked=True)
        return None

    def _zero_wrench(self, sample: messages.RtdeSample) -> messages.CommandReply:
        # A new zero would only hide a value beyond its limit.
        refusal = self._why_unfit(sample) or violation(sample, self._limits)
        if not refusal and not (self.at_rest and sample.rests):
            refusal = "The wrench is zeroed only at rest: stop the arm first."
        if not refusal and not self._arm.zero_wrench():
            refusal = "The robot did not zero its force-torque sensor."
        return messages.CommandReply(refusal=refusal)

    def _why_unfit(self, sample: messages.RtdeSample) -> str:
        """Return why nothing can be sent to the robot, or the empty string."""
        unfit = error_messages.why_unfit(sample, self._settings.host, self._settings.state_timeout_s)
        return unfit or self._executor.disabled_reason

    def _why_blocked(self, sample: messages.RtdeSample) -> str:
        """Return why motion is refused, or the empty string."""
        if self._recovery is not None:
            return error_messages.BEING_MADE_READY
        reason = self._why_unfit(sample) or violation(sample, self._limits) or self._held_reason
        return f"{reason} {self._paused_program.failure}" if self._paused_program.failure else reason

    def _stop_paused_program(self, sample: messages.RtdeSample, now_ns: int, *, announced: bool) -> None:
        """Stop a paused program of ours, in the cycle after the one that has announced it."""
        if self.leaving or not (self._owns_program and sample.program_paused and self._is_recent(sample)):
            return
        if self._paused_program.is_due(now_ns):
            if announced:
                self._paused_program.stop(now_ns)
            self._stops_paused = not announced

    def _is_recent(self, sample: messages.RtdeSample) -> bool:
        return sample.connected and sample.age_ns <= self._settings.state_timeout_s * 1e9

    def _recover(
        self, recovery: Recovery, sample: messages.RtdeSample, now_ns: int
    ) -> tuple[int, messages.CommandReply] | None:
        # Samples may stay old for minutes without counting as lost; the operator gets an answer all the same.
        if not self._is_recent(sample) and not recovery.has_ended(now_ns):
            return None
        outcome = recovery.advance(sample, now_ns)
        if outcome is Outcome.UNDER_WAY:
            return None
        self._owns_program, self._recovery = self.owns_program, None
        if outcome is Outcome.DONE:
            self._executor.disabled_reason = ""
        number, self._unlock_number = self._unlock_number, None
        if number is None:
            self._held_reason = recovery.refusal or self._held_reason
            return None
        if outcome is Outcome.DONE:
            self._held_reason = ""
        return number, messages.CommandReply(refusal=recovery.refusal)
