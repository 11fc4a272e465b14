"""Makes a robot ready to move, knows whose program runs on it, and stops a paused program of ours.

All of it runs one step a cycle and never waits, so that states keep coming while the arm powers up. A protective stop
is unlocked only on the operator's request (UR's own rule). Without one, only the control program is started.
"""

import enum
from collections.abc import Callable
from typing import TYPE_CHECKING

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur import messages

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

# The period of a request that the robot does not follow yet.
_RETRY_S = 1.0
# A program without heartbeats has ended by its watchdog after this time.
ENDS_ITSELF_S = 2.0
# The pauses between requests to stop a paused program; each may hang for another 2.5 s.
STOP_RETRIES_S = (1.0, 2.0, 5.0, 10.0, 10.0)

STILL_PAUSED = "The paused program could not be stopped ({reason}): stop it at the teach pendant, do not resume it."


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

    def note_start(self, now_ns: int) -> None:
        """Note that a program of ours is being started."""
        self.ours, self._starting_ns = True, now_ns

    def update(self, sample: messages.RtdeSample, now_ns: int, *, starting: bool, plays_without_us: bool) -> None:
        """Take in a cycle's sample; `starting`: a program of ours is being started."""
        self._was_announced, self.stop_announced = self.stop_announced, False
        if not plays_without_us:
            self._plays_without_us_ns = None
        elif self._plays_without_us_ns is None:
            self._plays_without_us_ns = now_ns
        since_ns = self._plays_without_us_ns
        foreign = since_ns is not None and now_ns - since_ns > ENDS_ITSELF_S * 1e9
        if sample.runtime_state == messages.RUNTIME_STOPPED or foreign:
            # The next program may be anyone's, and ours may have ended between two samples.
            self.ours = starting
            self._requests, self._next_ns, self.failure = 0, 0, ""

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
            self._arm.stop_program()
        except DriverError as error:
            self._fail(str(error))

    def _fail(self, reason: str) -> None:
        self.failed_stops += 1
        self.failure = STILL_PAUSED.format(reason=reason.strip().removesuffix("."))
