"""Decides in the worker which commands are sent to the robot, and refuses the others with a reason.

No clock, no pipe, no ur-rtde: the arm and the time are arguments. `take` judges each of the robot's samples, once.
`tick` runs one cycle; `request` takes commands between cycles. Both act on the sample that was taken last. After a
motion has ended, only a new command begins one.
"""

from typing import TYPE_CHECKING

from shearloop.drivers.ur.fitness import is_recent, may_be_late, why_unfit
from shearloop.drivers.ur.messages import (
    Command,
    CommandReply,
    Disconnect,
    Enable,
    Heartbeat,
    Held,
    MoveLinear,
    RobotState,
    RtdeSample,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from shearloop.drivers.ur.motion import MotionExecutor
from shearloop.drivers.ur.recovery import Recovery
from shearloop.drivers.ur.settings import UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

NOT_ENABLED = "Motion has not been enabled since the robot's worker was started: `start` or `unlock` enables it."
BEING_MADE_READY = "The robot is being made ready (safety, power, control program); this takes some seconds."
PROGRAM_STARTS = "The robot is being made ready (its control program starts); this takes some seconds."
LEAVING = "The daemon disconnects from the robot: start it again to continue."


class CommandHandler:
    """Applies the latest command within the limits; each sample has to be taken first."""

    def __init__(self, settings: UrSettings, arm: "UrArm", now_ns: int) -> None:
        """Begin with motion disabled, and start the control program where the robot allows it."""
        self._settings = settings
        self._arm = arm
        self._sample: RtdeSample
        # Why the controller cannot take motion commands, by the sample; empty while it can.
        self._unfit = ""
        self._executor = MotionExecutor(settings, arm, now_ns)
        self._recovery: Recovery | None = Recovery(arm, now_ns, settings.recover_timeout_s)
        # Why motion waits for an `Enable` or an `Unlock`; empty while it is enabled.
        self._why_not_enabled = NOT_ENABLED
        # Whether messages that came late can be that reason.
        self._disabled_late = False
        self._daemon_alive_ns = now_ns
        # Whether the program on the robot is known to be the one that was started here, also while it is paused.
        self._program_is_ours = False
        # Whether a tool may load the wrench, as the daemon says.
        self._held_tool = False
        # Whether the daemon disconnects: only stops are accepted from then on.
        self.leaving = False

    @property
    def at_rest(self) -> bool:
        """Whether no motion is under way."""
        return self._executor.motion == "idle"

    @property
    def recovering(self) -> bool:
        """Whether calls may take seconds: to the dashboard, or the first one to a new program."""
        return self._recovery is not None

    def take_rejection(self) -> bool:
        """Return, once, whether the robot rejected a command.

        The control connection may see the end of the program before the sample does. The next sample may say why.
        """
        return self._executor.take_rejection()

    def take(self, sample: RtdeSample) -> None:
        """Take and judge the robot's latest sample; `request`, `tick` and `state` are about it."""
        self._program_is_ours = self._program_is_ours and self._shows_same_program(sample)
        self._sample, self._unfit = sample, why_unfit(sample, self._settings)
        self._executor.take(sample)

    def _shows_same_program(self, sample: RtdeSample) -> bool:
        """Return whether a sample certainly shows the same program as the sample before.

        A program that plays after a pause can be another one. So can any program after a time without samples, as
        during a slow request.
        """
        unseen_s = sample.timestamp_s - self._sample.timestamp_s
        was_seen = is_recent(sample, self._settings) and 0 <= unseen_s <= self._settings.state_timeout_s
        plays_again = self._sample.program_paused and sample.program_running
        return sample.has_program and was_seen and not plays_again

    def request(self, number: int, command: Command | Heartbeat, now_ns: int) -> CommandReply | None:
        """Return the reply to a command; None for a heartbeat, and when `tick` returns it later (`Unlock`)."""
        self._daemon_alive_ns = now_ns
        sample, unfit = self._sample, self._why_unsent
        match command:
            case Heartbeat():
                return None
            case Disconnect():
                self.leaving = True
                if self._recovery is not None:
                    self._recovery.give_up(LEAVING)
                self._executor.stop_now(sample, now_ns, "the daemon disconnects")
                return CommandReply()
            case Stop():
                refusal = self._stop(number, command, now_ns)
            case _ if self.leaving:
                refusal = LEAVING
            case WristSpeed() | MoveLinear():
                refusal = self._why_blocked or self._executor.begin(number, command, sample, now_ns)
            case Unlock() if self._recovery is not None and self._recovery.operator_asked:
                refusal = "Unlocking is under way."
            case Unlock() if unfit:
                if not self._executor.why_not_ours:
                    self._executor.disable(unfit)
                self._recovery = Recovery(self._arm, now_ns, self._settings.recover_timeout_s, number)
                self._recovery.held = self._held_tool
                return None
            case _ if self._recovery is not None:
                refusal = self._why_blocked
            case Enable() | Unlock():
                refusal = unfit or self._executor.violation
                if not refusal:
                    self._why_not_enabled = ""
                return CommandReply(refusal=refusal)
            case ZeroForceTorque():
                return CommandReply(refusal=unfit or self._zero_wrench())
        if refusal:
            return CommandReply(refusal=refusal)
        return CommandReply(sent=self._executor.sent, clipped=self._executor.clipped)

    def take_held(self, message: Held) -> None:
        """Note whether something is held, for the next start of the program, and the zero of another worker."""
        self._held_tool = message.held
        if message.wrench_zero is not None:
            self._arm.wrench_zero = message.wrench_zero
        if not message.held:
            self._arm.forget_load()
        if self._recovery is not None:
            self._recovery.held = message.held

    def _stop(self, number: int, command: Stop, now_ns: int) -> str:
        """Stop on command; return why not, or an empty string."""
        if self._recovery is not None and self._recovery.operator_asked:
            self._recovery.give_up("Unlocking was ended by a stop.")
        if command.deceleration_rad_per_s2 <= 0:
            return f"A deceleration of {command.deceleration_rad_per_s2:g} rad/s² is not above 0."
        if unfit := self._why_unsent:
            if not self.at_rest:
                # The next sample may be fit again; a refused stop stops the arm all the same.
                self._executor.leave_to_watchdog(unfit)
            return f"{unfit} Nothing can be sent, and the arm stops by itself."
        return self._executor.stop_on_command(number, command, self._sample, now_ns)

    def _zero_wrench(self) -> str:
        """Zero the wrench; return why not, or an empty string."""
        # A new zero would only hide a value beyond its limit.
        if beyond := self._executor.violation:
            return beyond
        if not (self.at_rest and self._sample.rests):
            return "The wrench is zeroed only at rest: stop the arm first."
        return "" if self._arm.zero_wrench() else "The robot did not zero its force-torque sensor."

    def tick(self, now_ns: int) -> tuple[int, CommandReply] | None:
        """Run one cycle: send the due command, or stop; return the reply to an `Unlock` that has ended."""
        sample = self._sample
        self._executor.watch(sample, now_ns)
        if sample.program_paused:
            # Resumed at the pendant, it would go on with its last motion until the deadline.
            self._arm.withdraw_deadline()
        recovery = self._recovery
        if recovery is not None:
            recent, ours = is_recent(sample, self._settings), self._program_is_ours
            return self._end_recovery(recovery) if recovery.advance(sample, now_ns, recent=recent, ours=ours) else None
        unfit = self._why_unsent
        if unfit:
            # Nothing can be sent. The arm stops by itself, or by its watchdog, which is not fed now.
            self._why_not_enabled = unfit
            if self._unfit:
                self._disabled_late = may_be_late(sample, self._settings)
            if not self.at_rest:
                # The program may turn the wrist on, also when it is resumed.
                self._executor.leave_to_watchdog(unfit)
            if not sample.program_running:
                self._executor.disable(unfit)
            return None
        beyond = self._executor.violation
        if beyond:
            self._why_not_enabled = beyond
            self._disabled_late = False
            self._executor.stop(sample, now_ns, beyond)
        elif now_ns - self._daemon_alive_ns > self._settings.silence_timeout_s * 1e9:
            silent = f"the daemon was silent for {self._settings.silence_timeout_s:g} s"
            self._executor.stop(sample, now_ns, silent)
        self._executor.keep(sample, now_ns, self._daemon_alive_ns)
        return None

    def state(self, cycle: int) -> RobotState:
        """Return the sample with the state of the driver."""
        executor, blocked = self._executor, self._why_blocked
        return RobotState(
            **self._sample.__dict__,
            blocked=blocked,
            awaits_enable=blocked == NOT_ENABLED,
            late=bool(blocked) and self._may_be_late,
            recovering=self.recovering,
            motion=executor.motion,
            motion_id=executor.motion_id,
            end_reason=executor.end_reason,
            sent=executor.sent,
            clipped=executor.clipped,
            cycle=cycle,
            wrench_zero=self._arm.wrench_zero,
        )

    @property
    def _why_unsent(self) -> str:
        """Why nothing can be sent to the robot, or the empty string."""
        return self._unfit or self._executor.why_not_ours

    @property
    def _why_blocked(self) -> str:
        """Why motion is refused, or the empty string."""
        if self._recovery is not None:
            return BEING_MADE_READY if self._recovery.operator_asked else PROGRAM_STARTS
        return self._why_unsent or self._executor.violation or self._why_not_enabled

    @property
    def _may_be_late(self) -> bool:
        """Whether messages that came late can be why motion is refused."""
        if self._unfit:
            return may_be_late(self._sample, self._settings)
        is_beyond = not self._executor.why_not_ours and self._executor.violation != ""
        return self._recovery is None and not is_beyond and self._disabled_late

    def _end_recovery(self, recovery: Recovery) -> tuple[int, CommandReply] | None:
        self._recovery = None
        if recovery.ready:
            self._executor.enable()
            self._program_is_ours = True
        if recovery.unlock_number is None:
            self._why_not_enabled = recovery.refusal or self._why_not_enabled
            return None
        if recovery.ready:
            self._why_not_enabled = ""
        return recovery.unlock_number, CommandReply(refusal=recovery.refusal or "")

    def end_program(self) -> None:
        """End our program. One that has no heartbeats now ends by its watchdog, also when it starts or is resumed."""
        if self._sample.program_running and not self._executor.why_not_ours:
            self._arm.end_program()
