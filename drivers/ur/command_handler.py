"""Decides in the worker which commands are sent to the robot, and refuses the others with a reason.

No clock, no pipe, no ur-rtde: the arm and the time are arguments. `tick` runs one cycle; `request` takes commands
between cycles. After a motion has ended, only a new command begins one.
"""

from typing import TYPE_CHECKING

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.messages import (
    ROBOT_MODE_IDLE,
    ROBOT_MODE_POWER_OFF,
    ROBOT_MODE_RUNNING,
    RUNTIME_STOPPED,
    SAFETY_NORMAL,
    SAFETY_REDUCED,
    Command,
    CommandReply,
    Disconnect,
    Enable,
    Heartbeat,
    Held,
    MoveLinear,
    RobotLostError,
    RobotState,
    RtdeSample,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from shearloop.drivers.ur.motion import MotionExecutor, is_recent, may_be_late, why_unfit
from shearloop.drivers.ur.settings import UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

# The period of a request that the robot does not follow yet.
_RETRY_S = 1.0
# A program without heartbeats has ended by its watchdog after this time.
ENDS_ITSELF_S = 2.0
# A program that does not play within this time after its first upload does not start with this worker.
STARTS_WITHIN_S = 2.0
# An arm that does not come to rest has no load that could be measured for longer than this.
LOAD_WITHIN_S = 5.0

NOT_ENABLED = "Motion has not been enabled since the robot's worker was started: enable it when the arm may move."
BEING_MADE_READY = "The robot is being made ready (safety, power, control program); this takes some seconds."
NOT_STARTING = (
    "The controller took the control program and does not play it: look at the teach pendant for a message, for local "
    "control, and for the log's last lines. The robot's worker is started again with motion disabled."
)
LEAVING = "The daemon disconnects from the robot: start it again to continue."


class Recovery:
    """One attempt to make the robot ready: unlock, power, brakes, control program, watchdog.

    Each cycle runs one step, and none waits, so that states keep coming while the arm powers up. A protective stop is
    unlocked only on the operator's request (UR's own rule). Without one, only the control program is started.
    """

    def __init__(self, arm: "UrArm", now_ns: int, timeout_s: float, unlock_number: int | None = None) -> None:
        """Begin. The number of an operator's `Unlock` allows unlocking, powering and stopping any program."""
        self.unlock_number = unlock_number
        self._arm = arm
        self._deadline_ns = now_ns + int(timeout_s * 1e9)
        self._timeout_s = timeout_s
        self._load_by_ns = now_ns + int(LOAD_WITHIN_S * 1e9)
        self._asked_ns: dict[str, int] = {}
        self._cleared = False
        # When the control program was first sent.
        self._uploaded_ns: int | None = None
        # The controller's latest refusal of a request that could be done without.
        self._answered = ""
        # Whether the attempt has succeeded, or why it has ended otherwise.
        self.ready = False
        self.refusal: str | None = None
        # Whether a tool may load the wrench.
        self.held = False
        # The daemon sees that the zero of the wrench may change, a second before the program starts.
        arm.measure_load_anew()

    @property
    def operator_asked(self) -> bool:
        """Whether the attempt is an operator's."""
        return self.unlock_number is not None

    def give_up(self, reason: str) -> None:
        """End the attempt."""
        self.refusal = reason

    def advance(self, sample: RtdeSample, now_ns: int, *, recent: bool) -> bool:
        """Do the step that is due in this cycle, unless the sample is old; return whether the attempt has ended.

        Raises:
            RobotLostError: the control program cannot be sent, or does not start.
        """
        if self.refusal is None and now_ns > self._deadline_ns:
            self.refusal = (
                f"The robot did not get ready within {self._timeout_s:g} s (robot mode: {sample.robot_mode_name}, "
                f"safety mode: {sample.safety_mode_name}, program: {sample.runtime_name}). {self._answered}Look at the "
                "teach pendant."
            )
        if self.refusal is None and recent:
            try:
                self._step(sample, now_ns)
            except RobotLostError:
                raise
            except DriverError as error:
                self.refusal = str(error)
        return self.ready or self.refusal is not None

    def _step(self, sample: RtdeSample, now_ns: int) -> None:
        safe = sample.safety_mode in (SAFETY_NORMAL, SAFETY_REDUCED)
        if not (safe and sample.robot_mode == ROBOT_MODE_RUNNING):
            self._make_safe(sample, now_ns, safe)
            return
        self._close_popups(now_ns)
        if self._uploaded_ns is not None and sample.program_running:
            # The control connection may see the program a sample later; then try again in the next cycle.
            self.ready = self._arm.arm_watchdog()
        elif sample.runtime_state != RUNTIME_STOPPED:
            if self.operator_asked:
                self._ask_dashboard(now_ns, "stop")
            elif now_ns > self._asked_ns.setdefault("end", now_ns) + int(ENDS_ITSELF_S * 1e9):
                # Not ours to stop. After the death of its daemon its watchdog would have ended it.
                self.refusal = ""
        elif not self._cleared:
            # Registers outlive the program: a new one would first execute the last command.
            self._cleared = self._arm.clear_command()
        else:
            if self._uploaded_ns is None and not self._arm.knows_load(held=self.held) and now_ns < self._load_by_ns:
                return
            if self._uploaded_ns is None:
                self._uploaded_ns = now_ns
            elif now_ns >= self._uploaded_ns + int(STARTS_WITHIN_S * 1e9):
                raise RobotLostError("script", NOT_STARTING)
            else:
                # A heartbeat, for a script that arms its watchdog before its loop.
                self._arm.clear_command()
            # The controller may be busy and drop an upload.
            if self._is_due("upload", now_ns):
                self._arm.upload(held=self.held)

    def _make_safe(self, sample: RtdeSample, now_ns: int, safe: bool) -> None:
        if not self.operator_asked:
            self.refusal = ""
        elif sample.emergency_stop:
            self.refusal = "The emergency stop is still pressed: make the cell safe, release it, and unlock again."
        elif sample.protective_stop:
            # Once: the controller refuses it in the first 5 s.
            if "unlock protective stop" not in self._asked_ns:
                self._ask_dashboard(now_ns, "unlock protective stop")
        elif not safe:
            self.refusal = (
                f"The safety mode “{sample.safety_mode_name}” cannot be cured from here: look at the pendant."
            )
        else:
            self._close_popups(now_ns)
            if sample.robot_mode == ROBOT_MODE_POWER_OFF:
                self._ask_dashboard(now_ns, "power on")
            elif sample.robot_mode == ROBOT_MODE_IDLE:
                self._ask_dashboard(now_ns, "brake release")

    def _close_popups(self, now_ns: int) -> None:
        if self.operator_asked and "close popup" not in self._asked_ns:
            self._ask_dashboard(now_ns, "close popup", "close safety popup")

    def _ask_dashboard(self, now_ns: int, *requests: str) -> None:
        if self._is_due(requests[0], now_ns) and (refused := self._arm.ask_dashboard(*requests)):
            self._answered = f"{refused}. "

    def _is_due(self, step: str, now_ns: int) -> bool:
        """Return whether a step is due, and note that it is taken: the robot may not follow a request at once."""
        due = now_ns >= self._asked_ns.get(step, -(1 << 62)) + int(_RETRY_S * 1e9)
        if due:
            self._asked_ns[step] = now_ns
        return due


class CommandHandler:
    """Applies the latest command within the limits."""

    def __init__(self, settings: UrSettings, arm: "UrArm", now_ns: int) -> None:
        """Begin with motion disabled, and start the control program where the robot allows it."""
        self._settings = settings
        self._arm = arm
        self._executor = MotionExecutor(settings, arm, now_ns)
        self._recovery: Recovery | None = Recovery(arm, now_ns, settings.recover_timeout_s)
        self._disabled_reason = NOT_ENABLED
        # Whether messages that came late can be that reason.
        self._disabled_late = False
        self._daemon_alive_ns = now_ns
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

    def request(
        self, number: int, command: Command | Heartbeat, sample: RtdeSample, now_ns: int
    ) -> CommandReply | None:
        """Return the reply to a command; None for a heartbeat, and when `tick` returns it later (`Unlock`)."""
        self._daemon_alive_ns = now_ns
        unfit = self._why_unfit(sample)
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
                refusal = self._stop(number, command, sample, now_ns)
            case _ if self.leaving:
                refusal = LEAVING
            case WristSpeed() | MoveLinear():
                refusal = self._why_blocked(sample) or self._executor.begin(number, command, sample, now_ns)
            case Unlock() if self._recovery is not None and self._recovery.operator_asked:
                refusal = "Unlocking is under way."
            case Unlock() if unfit:
                if not self._executor.disabled_reason:
                    self._executor.disable(unfit)
                self._recovery = Recovery(self._arm, now_ns, self._settings.recover_timeout_s, number)
                self._recovery.held = self._held_tool
                return None
            case _ if self._recovery is not None:
                refusal = BEING_MADE_READY
            case Enable() | Unlock():
                refusal = unfit or self._executor.violation(sample)
                if not refusal:
                    self._disabled_reason = ""
                return CommandReply(refusal=refusal)
            case ZeroForceTorque():
                return CommandReply(refusal=unfit or self._zero_wrench(sample))
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

    def _stop(self, number: int, command: Stop, sample: RtdeSample, now_ns: int) -> str:
        """Stop on command; return why not, or an empty string."""
        if self._recovery is not None and self._recovery.operator_asked:
            self._recovery.give_up("Unlocking was ended by a stop.")
        if command.deceleration_rad_per_s2 <= 0:
            return f"A deceleration of {command.deceleration_rad_per_s2:g} rad/s² is not above 0."
        if unfit := self._why_unfit(sample):
            if not self.at_rest:
                # The next sample may be fit again; a refused stop stops the arm all the same.
                self._executor.leave_to_watchdog(unfit)
            return f"{unfit} Nothing can be sent, and the arm stops by itself."
        return self._executor.stop_on_command(number, command, sample, now_ns)

    def _zero_wrench(self, sample: RtdeSample) -> str:
        """Zero the wrench; return why not, or an empty string."""
        # A new zero would only hide a value beyond its limit.
        if beyond := self._executor.violation(sample):
            return beyond
        if not (self.at_rest and sample.rests):
            return "The wrench is zeroed only at rest: stop the arm first."
        return "" if self._arm.zero_wrench() else "The robot did not zero its force-torque sensor."

    def tick(self, sample: RtdeSample, now_ns: int) -> tuple[int, CommandReply] | None:
        """Run one cycle: check the sample and send the due command; return the reply to an `Unlock` that has ended."""
        self._executor.watch(sample, now_ns)
        if sample.program_paused:
            # Resumed at the pendant, it would go on with its last motion until the deadline.
            self._arm.withdraw_deadline()
        recovery = self._recovery
        if recovery is not None:
            recent = is_recent(sample, self._settings)
            return self._end_recovery(recovery) if recovery.advance(sample, now_ns, recent=recent) else None
        unfit = self._why_unfit(sample)
        if unfit:
            # Nothing can be sent. The arm stops by itself, or by its watchdog, which is not fed now.
            self._disabled_reason = unfit
            if why_unfit(sample, self._settings):
                self._disabled_late = may_be_late(sample, self._settings)
            if not self.at_rest:
                # The program may turn the wrist on, also when it is resumed.
                self._executor.leave_to_watchdog(unfit)
            if not sample.program_running:
                self._executor.disable(unfit)
            return None
        beyond = self._executor.violation(sample)
        if beyond:
            self._disabled_reason = beyond
            self._disabled_late = False
            self._executor.stop(sample, now_ns, beyond)
        elif now_ns - self._daemon_alive_ns > self._settings.silence_timeout_s * 1e9:
            silent = f"the daemon was silent for {self._settings.silence_timeout_s:g} s"
            self._executor.stop(sample, now_ns, silent)
        self._executor.keep(sample, now_ns, self._daemon_alive_ns)
        return None

    def state(self, sample: RtdeSample, cycle: int) -> RobotState:
        """Return the sample with the state of the driver."""
        executor, blocked = self._executor, self._why_blocked(sample)
        return RobotState(
            **sample.__dict__,
            blocked=blocked,
            awaits_enable=blocked == NOT_ENABLED,
            late=bool(blocked) and self._may_be_late(sample),
            recovering=self.recovering,
            motion=executor.motion,
            motion_id=executor.motion_id,
            end_reason=executor.end_reason,
            sent=executor.sent,
            clipped=executor.clipped,
            cycle=cycle,
            wrench_zero=self._arm.wrench_zero,
        )

    def _why_unfit(self, sample: RtdeSample) -> str:
        """Return why nothing can be sent to the robot, or the empty string."""
        return why_unfit(sample, self._settings) or self._executor.disabled_reason

    def _why_blocked(self, sample: RtdeSample) -> str:
        """Return why motion is refused, or the empty string."""
        if self._recovery is not None:
            return BEING_MADE_READY
        return self._why_unfit(sample) or self._executor.violation(sample) or self._disabled_reason

    def _may_be_late(self, sample: RtdeSample) -> bool:
        """Return whether messages that came late can be why motion is refused."""
        if why_unfit(sample, self._settings):
            return may_be_late(sample, self._settings)
        is_beyond = not self._executor.disabled_reason and self._executor.violation(sample) != ""
        return self._recovery is None and not is_beyond and self._disabled_late

    def _end_recovery(self, recovery: Recovery) -> tuple[int, CommandReply] | None:
        self._recovery = None
        if recovery.ready:
            self._executor.enable()
        if recovery.unlock_number is None:
            self._disabled_reason = recovery.refusal or self._disabled_reason
            return None
        if recovery.ready:
            self._disabled_reason = ""
        return recovery.unlock_number, CommandReply(refusal=recovery.refusal or "")

    def end_program(self, sample: RtdeSample) -> None:
        """End our program. One that has no heartbeats now ends by its watchdog, also when it starts or is resumed."""
        if sample.program_running and not self._executor.disabled_reason:
            self._arm.end_program()
