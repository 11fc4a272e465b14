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
    MoveLinear,
    RobotState,
    RtdeSample,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from shearloop.drivers.ur.motion import MotionExecutor, is_recent, why_unfit
from shearloop.drivers.ur.settings import UrSettings

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

# The period of a request that the robot does not follow yet.
_RETRY_S = 1.0
# A program without heartbeats has ended by its watchdog after this time.
ENDS_ITSELF_S = 2.0
# The pauses between requests to stop a paused program; each may hang for another 2.5 s.
STOP_RETRIES_S = (1.0, 2.0, 5.0, 10.0, 10.0)

STILL_PAUSED = "The paused program could not be stopped ({reason}): stop it at the teach pendant, do not resume it."

NOT_ENABLED = "Motion has not been enabled since the robot's process was started: enable it when the arm may move."
BEING_MADE_READY = "The robot is being made ready (safety, power, control program); this takes some seconds."
LEAVING = "The daemon disconnects from the robot: start it again to go on."


class Recovery:
    """One attempt to make the robot ready: unlock, power, brakes, control program, watchdog.

    Each cycle runs one step, and none waits, so that states keep coming while the arm powers up. A protective stop is
    unlocked only on the operator's request (UR's own rule). Without one, only the control program is started.
    """

    def __init__(
        self, arm: "UrArm", now_ns: int, timeout_s: float, *, operator_asked: bool, takes_over: bool = False
    ) -> None:
        """Begin. `operator_asked` allows unlocking, powering and stopping any program, `takes_over` a paused one."""
        self._arm = arm
        self._deadline_ns = now_ns + int(timeout_s * 1e9)
        self._timeout_s = timeout_s
        self._operator_asked = operator_asked
        self._takes_over = takes_over
        self._asked_ns: dict[str, int] = {}
        # Whether the control program is being started, so that a program on the robot may be ours.
        self.starts_program = self._uploaded = False
        # Whether the attempt has succeeded, or why it has ended otherwise.
        self.ready = False
        self.refusal: str | None = None

    def give_up(self, reason: str) -> None:
        """End the attempt."""
        self.refusal = reason

    def advance(self, sample: RtdeSample, now_ns: int, *, recent: bool) -> bool:
        """Do the step that is due in this cycle, unless the sample is old; return whether the attempt has ended."""
        if self.refusal is None and now_ns > self._deadline_ns:
            self.refusal = (
                f"The robot did not get ready within {self._timeout_s:g} s (robot mode {sample.robot_mode}, safety "
                f"mode {sample.safety_mode}, program state {sample.runtime_state}): look at the teach pendant."
            )
        if self.refusal is None and recent:
            try:
                self._step(sample, now_ns)
            except DriverError as error:
                self.refusal = str(error)
        return self.ready or self.refusal is not None

    def _step(self, sample: RtdeSample, now_ns: int) -> None:
        safe = sample.safety_mode in (SAFETY_NORMAL, SAFETY_REDUCED)
        if not (safe and sample.robot_mode == ROBOT_MODE_RUNNING):
            self._make_safe(sample, now_ns, safe)
            return
        self._close_popups(now_ns)
        if self._uploaded and sample.program_running:
            # The control connection may see the program a sample later; then try again in the next cycle.
            self.ready = self._arm.arm_watchdog()
        elif sample.runtime_state != RUNTIME_STOPPED:
            if self._operator_asked or (self._takes_over and sample.program_paused):
                self._ask_dashboard(now_ns, "stop")
            elif now_ns > self._asked_ns.setdefault("end", now_ns) + int(ENDS_ITSELF_S * 1e9):
                # Not ours to stop. After the death of its daemon its watchdog would have ended it.
                self.refusal = ""
        elif not self.starts_program:
            # Registers outlive the program: a new one would first execute the last command.
            self.starts_program = self._arm.clear_command()
        else:
            if self._uploaded:
                # A heartbeat, for a script that arms its watchdog before its loop.
                self._arm.clear_command()
            # The controller may be busy and drop an upload.
            if self._is_due("upload", now_ns):
                self._arm.upload()
            self._uploaded = True

    def _make_safe(self, sample: RtdeSample, now_ns: int, safe: bool) -> None:
        if not self._operator_asked:
            self.refusal = ""
        elif sample.emergency_stop:
            self.refusal = "The emergency stop is still pressed: make the cell safe, release it, and unlock again."
        elif sample.protective_stop:
            # Once: the controller refuses it in the first 5 s.
            if "unlock protective stop" not in self._asked_ns:
                self._ask_dashboard(now_ns, "unlock protective stop")
        elif not safe:
            self.refusal = f"Safety mode {sample.safety_mode} cannot be cured from here: look at the pendant."
        else:
            self._close_popups(now_ns)
            if sample.robot_mode == ROBOT_MODE_POWER_OFF:
                self._ask_dashboard(now_ns, "power on")
            elif sample.robot_mode == ROBOT_MODE_IDLE:
                self._ask_dashboard(now_ns, "brake release")

    def _close_popups(self, now_ns: int) -> None:
        if self._operator_asked and "close popup" not in self._asked_ns:
            self._ask_dashboard(now_ns, "close popup", "close safety popup")

    def _ask_dashboard(self, now_ns: int, *requests: str) -> None:
        if self._is_due(requests[0], now_ns):
            self._arm.ask_dashboard(*requests)

    def _is_due(self, step: str, now_ns: int) -> bool:
        """Return whether a step is due, and note that it is taken: the robot may not follow a request at once."""
        due = now_ns >= self._asked_ns.get(step, -(1 << 62)) + int(_RETRY_S * 1e9)
        if due:
            self._asked_ns[step] = now_ns
        return due


class ProgramOwner:
    """Knows whether the program on the robot is ours, and stops ours while it is paused.

    Resumed at the pendant, a paused program would go on with its last motion. Requests to stop it repeat less and less
    often, a limited number of times; `failure` is the message for the operator. A program is another client's when it
    plays on without our heartbeats: ours would end.
    """

    def __init__(self, arm: "UrArm", *, ours: bool) -> None:
        self._arm = arm
        self.ours = ours
        # Whether the next cycle stops a paused program; the state before it announces that it may take long.
        self.stop_announced = self._was_announced = False
        self.failure = ""
        self.failed_stops = 0
        self._requests, self._next_ns = 0, 0
        # When a program was being started last: an upload may take effect after its recovery was given up.
        self._starting_ns: int | None = None
        self._plays_without_us_ns: int | None = None

    def may_be_ours(self, now_ns: int) -> bool:
        """Return whether a program that plays is ours or may be, because one was just being started."""
        return self.ours or (self._starting_ns is not None and now_ns - self._starting_ns <= ENDS_ITSELF_S * 1e9)

    def update(self, sample: RtdeSample, now_ns: int, *, starting: bool, plays_without_us: bool) -> None:
        """Take in a cycle's sample; `starting`: a program of ours is being started."""
        self._was_announced, self.stop_announced = self.stop_announced, False
        if not plays_without_us:
            self._plays_without_us_ns = None
        elif self._plays_without_us_ns is None:
            self._plays_without_us_ns = now_ns
        since_ns = self._plays_without_us_ns
        foreign = since_ns is not None and now_ns - since_ns > ENDS_ITSELF_S * 1e9
        if sample.runtime_state == RUNTIME_STOPPED or foreign:
            # The next program may be anyone's, and ours may have ended between two samples.
            self.ours = False
            self._requests, self._next_ns, self.failure = 0, 0, ""
        if starting:
            self.ours, self._starting_ns = True, now_ns

    def stop_paused(self, now_ns: int) -> None:
        """Request a stop when it is due, in the cycle after the one that has announced it: it may take seconds."""
        if now_ns < self._next_ns or self._requests > len(STOP_RETRIES_S):
            return
        if not self._was_announced:
            self.stop_announced = True
            return
        if self._requests and not self.failure:
            self._fail("the dashboard said that it is stopped, and it is not")
        self._next_ns = now_ns + int(1e9 * STOP_RETRIES_S[min(self._requests, len(STOP_RETRIES_S) - 1)])
        self._requests += 1
        try:
            self._arm.ask_dashboard("stop")
        except DriverError as error:
            self._fail(str(error))

    def _fail(self, reason: str) -> None:
        self.failed_stops += 1
        self.failure = STILL_PAUSED.format(reason=reason.strip().removesuffix("."))


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
        # Whether the daemon disconnects: only stops are accepted from then on.
        self.leaving = False

    @property
    def at_rest(self) -> bool:
        """Whether no motion is under way."""
        return self._executor.motion == "idle"

    @property
    def recovering(self) -> bool:
        """Whether calls may take seconds: to the dashboard, or the first one to a new program."""
        return self._recovery is not None or self._program.stop_announced

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
            case Unlock() if self._unlock_number is not None:
                refusal = "Unlocking is under way."
            case Unlock() if unfit:
                if not self._executor.disabled_reason:
                    self._executor.disable(unfit)
                self._unlock_number = number
                self._recovery = Recovery(self._arm, now_ns, self._settings.recover_timeout_s, operator_asked=True)
                return None
            case _ if self._recovery is not None:
                refusal = BEING_MADE_READY
            case Enable() | Unlock():
                refusal = unfit or self._executor.violation(sample)
                if not refusal:
                    self._held_reason = ""
                return CommandReply(refusal=refusal)
            case ZeroForceTorque():
                return CommandReply(refusal=unfit or self._zero_wrench(sample))
        if refusal:
            return CommandReply(refusal=refusal)
        return CommandReply(sent=self._executor.sent, clipped=self._executor.clipped)

    def _stop(self, number: int, command: Stop, sample: RtdeSample, now_ns: int) -> str:
        """Stop on command; return why not, or an empty string."""
        if self._recovery is not None and self._unlock_number is not None:
            self._recovery.give_up("Unlocking was ended by a stop.")
        if command.deceleration_rad_per_s2 <= 0:
            return f"A deceleration of {command.deceleration_rad_per_s2:g} rad/s² is not above 0."
        if unfit := self._why_unfit(sample):
            if not self.at_rest:
                # The next sample may be fit again; a refused stop stops the arm all the same.
                self._executor.leave_to_watchdog(unfit)
            return f"Nothing can be sent, and the arm stops by itself. {unfit}"
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
        """Run one cycle: check the sample and send what is due; return the reply to an `Unlock` that has ended."""
        self._executor.watch(sample, now_ns)
        recent = is_recent(sample, self._settings)
        recovery = self._recovery
        without_us = recovery is not None or bool(self._executor.disabled_reason)
        self._program.update(
            sample,
            now_ns,
            starting=recovery is not None and recovery.starts_program,
            plays_without_us=without_us and sample.program_running and recent,
        )
        if recovery is not None:
            return self._end_recovery(recovery) if recovery.advance(sample, now_ns, recent=recent) else None
        unfit = self._why_unfit(sample)
        if unfit:
            # Nothing can be sent. The arm stops by itself, or by its watchdog, which is not fed now.
            self._held_reason = unfit
            if not self.at_rest:
                # The program may turn the wrist on, also when it is resumed.
                self._executor.leave_to_watchdog(unfit)
            if not sample.program_running:
                self._executor.disable(unfit)
                if recent and self._program.ours and sample.program_paused and not self.leaving:
                    self._program.stop_paused(now_ns)
            return None
        beyond = self._executor.violation(sample)
        if beyond:
            self._held_reason = beyond
            self._executor.stop(sample, now_ns, beyond)
        elif now_ns - self._daemon_alive_ns > self._settings.silence_timeout_s * 1e9:
            silent = f"the daemon was silent for {self._settings.silence_timeout_s:g} s"
            self._executor.stop(sample, now_ns, silent)
        self._executor.keep(sample, now_ns, self._daemon_alive_ns)
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

    def _why_unfit(self, sample: RtdeSample) -> str:
        """Return why nothing can be sent to the robot, or the empty string."""
        return why_unfit(sample, self._settings) or self._executor.disabled_reason

    def _why_blocked(self, sample: RtdeSample) -> str:
        """Return why motion is refused, or the empty string."""
        if self._recovery is not None:
            return BEING_MADE_READY
        reason = self._why_unfit(sample) or self._executor.violation(sample) or self._held_reason
        return f"{reason} {self._program.failure}" if self._program.failure else reason

    def _end_recovery(self, recovery: Recovery) -> tuple[int, CommandReply] | None:
        self._recovery = None
        if recovery.ready:
            self._executor.enable()
        number, self._unlock_number = self._unlock_number, None
        if number is None:
            self._held_reason = recovery.refusal or self._held_reason
            return None
        if recovery.ready:
            self._held_reason = ""
        return number, CommandReply(refusal=recovery.refusal or "")

    def end_program(self, sample: RtdeSample, now_ns: int) -> None:
        """End our program: also one that a late upload has started, and one that is paused. Leave other clients' alone.

        Stopping a paused one may take seconds.
        """
        if sample.program_running:
            if self._program.may_be_ours(now_ns):
                self._arm.end_program()
        elif self._program.ours and sample.program_paused:
            self._arm.ask_dashboard("stop")
