"""The way back to a robot that can move: unlock, power, brakes, control program, watchdog; one step at a time.

It waits by being asked again every cycle, never by blocking: states keep flowing while the arm powers up. A protective
stop is unlocked on the operator's word only (UR's own rule); without it just the program is started, where nothing
stands against that, such as a program that somebody else runs.
"""

import enum
from typing import Protocol

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.messages import (
    ROBOT_MODE_IDLE,
    ROBOT_MODE_POWER_OFF,
    ROBOT_MODE_RUNNING,
    RUNTIME_STOPPED,
    SAFETY_EMERGENCY_STOPS,
    SAFETY_NORMAL,
    SAFETY_PROTECTIVE_STOP,
    SAFETY_REDUCED,
    RtdeSample,
)
from shearloop.drivers.ur.ports import CureArm


class Outcome(enum.Enum):
    """How far a recovery is."""

    UNDER_WAY = enum.auto()
    DONE = enum.auto()
    REFUSED = enum.auto()


# How often a step is asked for again while the robot does not follow: the controller needs a moment after each.
_AGAIN_S = 1.0
# A program that nobody kicks has ended by its watchdog after so long.
ENDS_ITSELF_S = 2.0


class Recovery:
    """One attempt to get the robot ready."""

    def __init__(
        self, arm: CureArm, now_ns: int, timeout_s: float, *, operator_asked: bool, takes_over: bool = False
    ) -> None:
        """Begin; `operator_asked` allows unlocking, powering and stopping any program, `takes_over` a paused one."""
        self._arm = arm
        self._deadline_ns = now_ns + int(timeout_s * 1e9)
        self._timeout_s = timeout_s
        self._operator_asked = operator_asked
        self._takes_over = takes_over
        self._asked_ns: dict[str, int] = {}
        self._cleared = self._uploaded = False
        self.why = ""

    @property
    def starts(self) -> bool:
        """Whether the control program is started now, or has been: one that is there may be ours."""
        return self._cleared

    def give_up(self, why: str) -> None:
        """Do nothing more, and say so when asked again."""
        self.why = why

    def ended(self, now_ns: int) -> bool:
        """Whether nothing more is done, whatever the robot says."""
        return bool(self.why) or now_ns > self._deadline_ns

    def advance(self, reading: RtdeSample, now_ns: int) -> Outcome:
        """Do what is due in this cycle."""
        if self.why:
            return Outcome.REFUSED
        if now_ns > self._deadline_ns:
            return self._refuse(
                f"The robot did not get ready within {self._timeout_s:g} s (robot mode {reading.robot_mode}, safety "
                f"mode {reading.safety_mode}, program state {reading.runtime_state}): look at the teach pendant."
            )
        try:
            return self._step(reading, now_ns)
        except DriverError as error:
            return self._refuse(f"The controller refused: {error}")

    def _step(self, reading: RtdeSample, now_ns: int) -> Outcome:
        safe = reading.safety_mode in (SAFETY_NORMAL, SAFETY_REDUCED)
        if not (safe and reading.robot_mode == ROBOT_MODE_RUNNING):
            return self._make_safe(reading, now_ns)
        self._close_popups(now_ns)
        if self._uploaded and reading.program_running:
            # The control connection may see the program start a sample later than the one that reads; then once more.
            return Outcome.DONE if self._arm.arm_watchdog() else Outcome.UNDER_WAY
        if reading.runtime_state != RUNTIME_STOPPED:
            if not (self._operator_asked or (self._takes_over and reading.program_paused)):
                return self._leave_it_alone(now_ns)
            self._every_second("stop", now_ns, self._arm.stop_program)
        elif not self._cleared:
            # The registers outlive the program: a new one would carry out in its first cycle whatever was commanded
            # last, and turn the wrist again, before its watchdog is armed. A cycle for what replaces it.
            self._cleared = self._arm.clear_command()
        else:
            if self._uploaded:
                # A sign of life, too: the program arms its watchdog by itself, whenever it begins.
                self._arm.clear_command()
            # Not every upload takes: the controller may still be in the middle of something.
            self._every_second("upload", now_ns, self._arm.upload)
            self._uploaded = True
        return Outcome.UNDER_WAY

    def _leave_it_alone(self, now_ns: int) -> Outcome:
        """Wait for the end of a program that is not ours to stop; one whose daemon has died ends by its watchdog."""
        since_ns = self._asked_ns.setdefault("end", now_ns)
        return self._refuse("") if now_ns > since_ns + int(ENDS_ITSELF_S * 1e9) else Outcome.UNDER_WAY

    def _make_safe(self, reading: RtdeSample, now_ns: int) -> Outcome:
        if not self._operator_asked:
            return self._refuse("")
        if reading.safety_mode in SAFETY_EMERGENCY_STOPS:
            return self._refuse(
                "The emergency stop is still pressed: make the cell safe, release it, and unlock again."
            )
        if reading.safety_mode == SAFETY_PROTECTIVE_STOP:
            if "unlock" not in self._asked_ns:
                self._asked_ns["unlock"] = now_ns
                self._arm.unlock()
            return Outcome.UNDER_WAY
        if reading.safety_mode not in (SAFETY_NORMAL, SAFETY_REDUCED):
            return self._refuse(f"Safety mode {reading.safety_mode} cannot be cured from here: look at the pendant.")
        self._close_popups(now_ns)
        if reading.robot_mode == ROBOT_MODE_POWER_OFF:
            self._every_second("power", now_ns, self._arm.power_on)
        elif reading.robot_mode == ROBOT_MODE_IDLE:
            self._every_second("brakes", now_ns, self._arm.release_brakes)
        return Outcome.UNDER_WAY

    def _close_popups(self, now_ns: int) -> None:
        if self._operator_asked and "popups" not in self._asked_ns:
            self._asked_ns["popups"] = now_ns
            self._arm.close_popups()

    def _every_second(self, name: str, now_ns: int, act: "_Act") -> None:
        if now_ns >= self._asked_ns.get(name, -(1 << 62)) + int(_AGAIN_S * 1e9):
            self._asked_ns[name] = now_ns
            act()

    def _refuse(self, why: str) -> Outcome:
        self.why = why
        return Outcome.REFUSED


class _Act(Protocol):
    def __call__(self) -> object:
        """Ask the robot for something."""
