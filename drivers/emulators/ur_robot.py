"""The emulated controller without I/O: scripts, registers, faults and time in; state and events out.

Nothing here reads a clock. A process that plays more of the rig gives the robot a `WristPlant` and steps it.
"""

import math
from dataclasses import dataclass
from typing import Protocol

from shearloop.drivers.emulators.ur_arm import Arm, PathError
from shearloop.drivers.emulators.urscript import Program, ProgramEndedError, Registers

STOPPED, PLAYING, PAUSED = 1, 2, 4
MODE_POWER_OFF, MODE_IDLE, MODE_RUNNING = 3, 5, 7
SAFETY_NORMAL, SAFETY_PROTECTIVE_STOP, SAFETY_EMERGENCY_STOP = 1, 3, 7
PROGRAM_END_DECELERATION, SAFETY_DECELERATION = 10.0, 20.0


class WristPlant(Protocol):
    """What the wrist turns."""

    def step(self, dt_s: float, wrist_rad: float) -> float:
        """Advance by dt_s with the wrist's angle; return the torque on the tool about its own axis in N·m."""


@dataclass(frozen=True, slots=True)
class ControllerSpec:
    """The kind of controller."""

    unlock_wait_s: float = 5.0
    power_on_s: float = 1.0
    version: tuple[int, int, int, int] = (5, 17, 3, 0)
    # A gripper's; the arm's own pose is the flange's, so that the tool centre point is not moved.
    payload_kg: float = 1.0
    payload_cog_m: tuple[float, float, float] = (0.0, 0.0, 0.06)


@dataclass(frozen=True, slots=True)
class RobotEvent:
    """An event at the robot's own time."""

    time_s: float
    name: str
    detail: str


class SafetyController:
    """Safety mode, emergency stop button, power and brakes."""

    def __init__(self, spec: ControllerSpec) -> None:
        """Be switched on and safe."""
        self._spec = spec
        self.robot_mode, self.safety_mode = MODE_RUNNING, SAFETY_NORMAL
        self._stopped_s = 0.0
        self._power_step_s = math.inf

    def pass_time(self, now_s: float) -> None:
        """End a step of powering that has taken its time."""
        if now_s >= self._power_step_s:
            self._power_step_s = math.inf
            self.robot_mode = MODE_IDLE if self.robot_mode == MODE_POWER_OFF else MODE_RUNNING

    def stop(self, clock_s: float, mode: int = SAFETY_PROTECTIVE_STOP) -> None:
        """Begin a protective stop, or an emergency stop, which switches the power off."""
        self.safety_mode, self._stopped_s = mode, clock_s
        if mode == SAFETY_EMERGENCY_STOP:
            self.robot_mode = MODE_POWER_OFF

    def end_stop(self, mode: int, clock_s: float) -> bool:
        """End a stop of this mode; False within `unlock_wait_s` of the beginning of a protective stop."""
        if self.safety_mode != mode:
            return True
        if mode == SAFETY_PROTECTIVE_STOP and clock_s - self._stopped_s < self._spec.unlock_wait_s:
            return False
        self.safety_mode = SAFETY_NORMAL
        return True

    def begin_power_step(self, from_mode: int, now_s: float) -> None:
        """Begin to power the arm, or to release its brakes, if it is in this mode."""
        if self.robot_mode == from_mode and self.safety_mode != SAFETY_EMERGENCY_STOP:
            self._power_step_s = min(self._power_step_s, now_s + self._spec.power_on_s)


class Robot:
    """Arm, safety controller, program and registers."""

    def __init__(self, spec: ControllerSpec | None = None, plant: WristPlant | None = None) -> None:
        """Be switched on, at rest, without a program."""
        self.spec = self._first_spec = spec or ControllerSpec()
        self.arm = Arm()
        self.safety = SafetyController(self.spec)
        self.registers = Registers()
        self.runtime_state = STOPPED
        self.time_s = 0.0
        # The controller's clock, which never stands still.
        self.clock_s = 0.0
        self._events: list[RobotEvent] = []
        self._plant = plant
        self._program: Program | None = None

    def step(self, dt_s: float) -> None:
        """Run one control cycle."""
        self.time_s += dt_s
        self.clock_s += dt_s
        self.safety.pass_time(self.time_s)
        if self._program is not None and self.runtime_state == PLAYING:
            try:
                for event in self._program.cycle(dt_s, self.time_s):
                    self._note(*event)
            except ProgramEndedError as ended:
                self.end_program(str(ended))
        self._move(dt_s)
        if self._plant is not None:
            self.arm.load(self._plant.step(dt_s, float(self.arm.q_rad[5])))

    def stand_still(self, seconds: float) -> None:
        """Let only the clock go on."""
        self.clock_s += seconds

    def take_events(self) -> list[RobotEvent]:
        """Return what has happened since the last call."""
        events, self._events = self._events, []
        return events

    def _move(self, dt_s: float) -> None:
        moving = self.arm.moving
        try:
            self.arm.advance(dt_s)
        except PathError as error:
            self.protective_stop(str(error))
        if moving != self.arm.moving:
            self._note("motion-stopped" if moving else "motion-started")

    @property
    def program_running(self) -> bool:
        """Whether a program is loaded and has not ended; a paused one counts."""
        return self._program is not None

    def upload(self, text: str) -> None:
        """Run a program in URScript."""
        if (self.safety.safety_mode, self.safety.robot_mode) != (SAFETY_NORMAL, MODE_RUNNING):
            modes = f"robot mode {self.safety.robot_mode}, safety mode {self.safety.safety_mode}"
            self._note("script-refused", modes)
            return
        self.end_program("a new script arrived")
        try:
            self._program = Program(text, self.registers, self.arm)
        except SyntaxError as error:
            self._note("script-refused", str(error))
            return
        self.runtime_state = PLAYING
        self._note("program-started")

    def end_program(self, cause: str) -> None:
        """End the program; the arm slows down by itself."""
        if self._program is not None:
            self._program = None
            self.runtime_state = STOPPED
            self.arm.halt(PROGRAM_END_DECELERATION)
            self._note("program-ended", cause)

    def protective_stop(self, cause: str) -> None:
        """Stop for safety and pause the program."""
        if self.safety.safety_mode == SAFETY_NORMAL:
            self.safety.stop(self.clock_s)
            self.arm.halt(SAFETY_DECELERATION)
            self._note("protective-stop", cause)
            if self._program is not None:
                self.runtime_state = PAUSED

    def emergency_stop(self) -> None:
        """Press the emergency stop button: the program ends and the power goes off."""
        if self.safety.safety_mode != SAFETY_EMERGENCY_STOP:
            self.arm.halt(SAFETY_DECELERATION)
            self._note("emergency-stop", "the button is pressed")
            self.end_program("emergency stop")
            self.safety.stop(self.clock_s, SAFETY_EMERGENCY_STOP)

    def release(self) -> None:
        """Release the emergency stop button."""
        if self.safety.safety_mode == SAFETY_EMERGENCY_STOP:
            self._note("emergency-stop-released")
        self.safety.end_stop(SAFETY_EMERGENCY_STOP, self.clock_s)

    def unlock(self) -> bool:
        """End a protective stop; False within `unlock_wait_s` of its beginning."""
        stopped = self.safety.safety_mode == SAFETY_PROTECTIVE_STOP
        unlocked = self.safety.end_stop(SAFETY_PROTECTIVE_STOP, self.clock_s)
        if stopped and unlocked:
            self._note("protective-stop-unlocked")
        return unlocked

    def change(self, spec: ControllerSpec) -> None:
        """Have another version or payload from now on."""
        self.spec = spec

    def clear_faults(self) -> None:
        """Be safe and powered, without a program, as it was at first."""
        self.end_program("the faults are cleared")
        self.spec = self._first_spec
        self.safety = SafetyController(self.spec)
        self._note("faults-cleared")

    def _note(self, name: str, detail: str = "") -> None:
        self._events.append(RobotEvent(self.time_s, name, detail))
