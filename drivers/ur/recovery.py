"""Makes a robot ready to move, stops a paused program of ours, and recognises a program of another client.

All of it runs one step a cycle and never waits, so that states keep coming while the arm powers up. A protective stop
is unlocked only on the operator's request (UR's own rule). Without one, only the control program is started.
"""

import enum
from collections.abc import Callable
from typing import TYPE_CHECKING

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur import error_messages, messages

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

# The period of a request that the robot does not follow yet.
_RETRY_S = 1.0
# A program without heartbeats has ended by its watchdog after this time.
ENDS_ITSELF_S = 2.0
# The pauses between requests to stop a paused program; each may hang for another 2.5 s.
STOP_RETRIES_S = (1.0, 2.0, 5.0, 10.0, 10.0)


class Outcome(enum.Enum):
    """How far a recovery is."""

    UNDER_WAY = enum.auto()
    DONE = enum.auto()
    REFUSED = enum.auto()


class Recovery:
    """One attempt to make the robot ready: unlock, power, brakes, control program, watchdog."""

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
        self._cleared = self._uploaded = False
        self.refusal = ""

    @property
    def starts_program(self) -> bool:
        """Whether the control program is being started, so that a program on the robot may be ours."""
        return self._cleared

    def give_up(self, reason: str) -> None:
        """Do nothing more; `advance` then returns REFUSED."""
        self.refusal = reason

    def has_ended(self, now_ns: int) -> bool:
        """Whether `advance` will refuse every sample."""
        return bool(self.refusal) or now_ns > self._deadline_ns

    def advance(self, sample: messages.RtdeSample, now_ns: int) -> Outcome:
        """Do the step that is due in this cycle."""
        if self.refusal:
            return Outcome.REFUSED
        if now_ns > self._deadline_ns:
            return self._refuse(
                f"The robot did not get ready within {self._timeout_s:g} s (robot mode {sample.robot_mode}, safety "
                f"mode {sample.safety_mode}, program state {sample.runtime_state}): look at the teach pendant."
            )
        try:
            return self._step(sample, now_ns)
        except DriverError as error:
            return self._refuse(f"The controller refused: {error}")

    def _step(self, sample: messages.RtdeSample, now_ns: int) -> Outcome:
        safe = sample.safety_mode in (messages.SAFETY_NORMAL, messages.SAFETY_REDUCED)
        if not (safe and sample.robot_mode == messages.ROBOT_MODE_RUNNING):
            return self._make_safe(sample, now_ns)
        self._close_popups(now_ns)
        if self._uploaded and sample.program_running:
            # The control connection may see the program a sample later; then try again in the next cycle.
            return Outcome.DONE if self._arm.arm_watchdog() else Outcome.UNDER_WAY
        if sample.runtime_state != messages.RUNTIME_STOPPED:
            if not (self._operator_asked or (self._takes_over and sample.program_paused)):
                return self._await_foreign_program(now_ns)
            self._every_second("stop", now_ns, self._arm.stop_program)
        elif not self._cleared:
            # Registers outlive the program: a new one would first execute the last command.
            self._cleared = self._arm.clear_command()
        else:
            if self._uploaded:
                # A heartbeat, for a script that arms its watchdog before its loop.
                self._arm.clear_command()
            # The controller may be busy and drop an upload.
            self._every_second("upload", now_ns, self._arm.upload)
            self._uploaded = True
        return Outcome.UNDER_WAY

    def _await_foreign_program(self, now_ns: int) -> Outcome:
        """Wait for the end of a program that we may not stop; after its daemon's death its watchdog ends it."""
        since_ns = self._asked_ns.setdefault("end", now_ns)
        return self._refuse("") if now_ns > since_ns + int(ENDS_ITSELF_S * 1e9) else Outcome.UNDER_WAY

    def _make_safe(self, sample: messages.RtdeSample, now_ns: int) -> Outcome:
        if not self._operator_asked:
            return self._refuse("")
        if sample.safety_mode in messages.SAFETY_EMERGENCY_STOPS:
            return self._refuse(
                "The emergency stop is still pressed: make the cell safe, release it, and unlock again."
            )
        if sample.safety_mode == messages.SAFETY_PROTECTIVE_STOP:
            if "unlock" not in self._asked_ns:
                self._asked_ns["unlock"] = now_ns
                self._arm.unlock()
            return Outcome.UNDER_WAY
        if sample.safety_mode not in (messages.SAFETY_NORMAL, messages.SAFETY_REDUCED):
            return self._refuse(f"Safety mode {sample.safety_mode} cannot be cured from here: look at the pendant.")
        self._close_popups(now_ns)
        if sample.robot_mode == messages.ROBOT_MODE_POWER_OFF:
            self._every_second("power", now_ns, self._arm.power_on)
        elif sample.robot_mode == messages.ROBOT_MODE_IDLE:
            self._every_second("brakes", now_ns, self._arm.release_brakes)
        return Outcome.UNDER_WAY

    def _close_popups(self, now_ns: int) -> None:
        if self._operator_asked and "popups" not in self._asked_ns:
            self._asked_ns["popups"] = now_ns
            self._arm.close_popups()

    def _every_second(self, name: str, now_ns: int, act: Callable[[], object]) -> None:
        if now_ns >= self._asked_ns.get(name, -(1 << 62)) + int(_RETRY_S * 1e9):
            self._asked_ns[name] = now_ns
            act()

    def _refuse(self, reason: str) -> Outcome:
        self.refusal = reason
        return Outcome.REFUSED


class PausedProgramStopper:
    """Stops our program while it is paused: resumed at the pendant, it would go on with its last motion.

    Requests repeat less and less often, a limited number of times. `failure` is the message for the operator.
    """

    def __init__(self, arm: "UrArm") -> None:
        self._arm = arm
        self._requests, self._next_ns = 0, 0
        self.failure = ""
        self.failed_stops = 0

    def reset(self) -> None:
        """Note that no program is there."""
        self._requests, self._next_ns, self.failure = 0, 0, ""

    def is_due(self, now_ns: int) -> bool:
        """Return whether to request a stop now."""
        return now_ns >= self._next_ns and self._requests <= len(STOP_RETRIES_S)

    def stop(self, now_ns: int) -> None:
        """Request a stop, which may take seconds."""
        if self._requests and not self.failure:
            self._fail("the dashboard said that it is stopped, and it is not")
        self._next_ns = now_ns + int(1e9 * STOP_RETRIES_S[min(self._requests, len(STOP_RETRIES_S) - 1)])
        self._requests += 1
        try:
            self._arm.stop_program()
        except DriverError as error:
            self._fail(str(error))

    def _fail(self, reason: str) -> None:
        self.failed_stops += 1
        self.failure = error_messages.STILL_PAUSED.format(reason=reason.strip().removesuffix("."))


class ForeignProgramDetector:
    """Recognises another client's program: it plays on without our heartbeats, and ours would end."""

    def __init__(self) -> None:
        self._since_ns: int | None = None

    def update(self, now_ns: int, *, plays_without_us: bool) -> bool:
        """Return whether a foreign program plays; call this in every cycle."""
        if not plays_without_us:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = now_ns
        return self._since_ns is not None and now_ns - self._since_ns > ENDS_ITSELF_S * 1e9
