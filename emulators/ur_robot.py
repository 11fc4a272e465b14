"""The emulated controller without I/O: scripts, registers, faults and time in; state and events out.

Nothing here reads a clock. A process that plays more of the rig gives the robot a `WristPlant` and steps it.
"""

import math
from collections import deque
from dataclasses import dataclass

from shearloop.drivers.defaults import EMULATED_ANSWER
from shearloop.emulators.ur_arm import CURRENTS_ERROR, SENSOR_ERROR, Arm, PathError, Vector, WristPlant, frame_of_pose
from shearloop.emulators.urscript import Interrupts, Program, ProgramEndedError, Registers

STOPPED, PLAYING, PAUSED = 1, 2, 4
MODE_POWER_OFF, MODE_IDLE, MODE_RUNNING = 3, 5, 7
SAFETY_NORMAL, SAFETY_PROTECTIVE_STOP, SAFETY_EMERGENCY_STOP = 1, 3, 7
E_SERIES_MAJOR = 5
CB3_VERSION = 3, 15, 8, 0
LOG_LINES = 100
PROGRAM_END_DECELERATION, SAFETY_DECELERATION = 10.0, 20.0


@dataclass(frozen=True, slots=True)
class ControllerSpec:
    """The kind of controller."""

    unlock_wait_s: float = 5.0
    power_on_s: float = 1.0
    version: tuple[int, int, int, int] = (5, 17, 3, 0)
    serial_number: str = EMULATED_ANSWER
    # A gripper's.
    payload_kg: float = 1.0
    payload_cog_m: tuple[float, float, float] = (0.0, 0.0, 0.06)
    # From the flange to the tool centre point: position in m, rotation vector in rad.
    tcp_offset: tuple[float, ...] = (0.0,) * 6
    # Where the arm stands when it is switched on; None for a pose of its own.
    joints_rad: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class RobotEvent:
    """An event at the robot's own time."""

    time_s: float
    name: str
    detail: str


class Robot:
    """Arm, safety mode, power, program and registers."""

    def __init__(self, spec: ControllerSpec | None = None, plant: WristPlant | None = None) -> None:
        """Be switched on, safe, at rest, without a program."""
        self.spec = spec or ControllerSpec()
        self.arm = Arm(plant, self.spec.joints_rad, frame_of_pose(self.spec.tcp_offset))
        self.robot_mode, self.safety_mode = MODE_RUNNING, SAFETY_NORMAL
        self._stopped_s, self._power_step_s = 0.0, math.inf
        self.registers = Registers()
        self.runtime_state = STOPPED
        self.time_s = 0.0
        # The controller's clock, which never stands still.
        self.clock_s = 0.0
        self.events: list[RobotEvent] = []
        self._program: Program | None = None
        # The last lines of the pendant's log.
        self.log: deque[str] = deque(maxlen=LOG_LINES)
        # Whether a program that ends by itself while the arm moves ends in a protective stop: reports differ.
        self.protects_abrupt_ends = False
        # Whether any program that ends by itself does.
        self.protects_ends = False
        # Where the threads of the next program are interrupted.
        self.interrupts: Interrupts | None = None

    def step(self, dt_s: float) -> None:
        """Run one control cycle."""
        self.time_s += dt_s
        self.clock_s += dt_s
        if self.time_s >= self._power_step_s:
            self._power_step_s = math.inf
            self.robot_mode = MODE_IDLE if self.robot_mode == MODE_POWER_OFF else MODE_RUNNING
        if self._program is not None and self.runtime_state == PLAYING:
            try:
                for event in self._program.cycle(dt_s, self.time_s):
                    self._note(*event)
            except ProgramEndedError as ended:
                self.end_program(str(ended))
                if self.protects_ends or (self.protects_abrupt_ends and self.arm.moving):
                    self.protective_stop(f"the program ended: {ended}")
        self._move(dt_s)
        self.arm.feel(dt_s, self.wrench_error)

    def stand_still(self, seconds: float) -> None:
        """Let only the clock go on."""
        self.clock_s += seconds

    def take_events(self) -> list[RobotEvent]:
        """Return what has happened since the last call."""
        events, self.events = self.events, []
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
    def wrench_error(self) -> Vector:
        """The largest errors (6,) of the measured force and torque."""
        return SENSOR_ERROR if self.is_e_series else CURRENTS_ERROR

    @property
    def is_e_series(self) -> bool:
        """Whether it has a force sensor, which it zeroes as a program starts; a CB3 estimates forces from currents."""
        return self.spec.version[0] >= E_SERIES_MAJOR

    @property
    def program_running(self) -> bool:
        """Whether a program is loaded and has not ended; a paused one counts."""
        return self._program is not None

    def upload(self, text: str) -> None:
        """Run a program in URScript."""
        if (self.safety_mode, self.robot_mode) != (SAFETY_NORMAL, MODE_RUNNING):
            modes = f"robot mode {self.robot_mode}, safety mode {self.safety_mode}"
            self._note("script-refused", modes)
            return
        self.end_program("a new script arrived")
        try:
            self._program = Program(
                text, self.registers, self.arm, self.log.append, e_series=self.is_e_series, interrupts=self.interrupts
            )
        except SyntaxError as error:
            self._note("script-refused", str(error))
            return
        self.runtime_state = PLAYING
        if self.is_e_series:
            self.arm.zero_wrench()
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
        if self.safety_mode == SAFETY_NORMAL:
            self.safety_mode, self._stopped_s = SAFETY_PROTECTIVE_STOP, self.clock_s
            self.arm.halt(SAFETY_DECELERATION)
            self._note("protective-stop", cause)
            if self._program is not None:
                self.runtime_state = PAUSED

    def emergency_stop(self) -> None:
        """Press the emergency stop button: the program ends and the power goes off."""
        if self.safety_mode != SAFETY_EMERGENCY_STOP:
            self.arm.halt(SAFETY_DECELERATION)
            self._note("emergency-stop", "the button is pressed")
            self.end_program("emergency stop")
            self.safety_mode, self.robot_mode = SAFETY_EMERGENCY_STOP, MODE_POWER_OFF

    def release(self) -> None:
        """Release the emergency stop button."""
        if self.safety_mode == SAFETY_EMERGENCY_STOP:
            self.safety_mode = SAFETY_NORMAL
            self._note("emergency-stop-released")

    def unlock(self) -> bool:
        """End a protective stop; False within `unlock_wait_s` of its beginning."""
        if self.safety_mode == SAFETY_PROTECTIVE_STOP:
            if self.clock_s - self._stopped_s < self.spec.unlock_wait_s:
                return False
            self.safety_mode = SAFETY_NORMAL
            self._note("protective-stop-unlocked")
        return True

    def begin_power_step(self, from_mode: int) -> None:
        """Begin to power the arm, or to release its brakes, if it is in this mode."""
        if self.robot_mode == from_mode and self.safety_mode != SAFETY_EMERGENCY_STOP:
            self._power_step_s = min(self._power_step_s, self.time_s + self.spec.power_on_s)

    def change(self, spec: ControllerSpec) -> None:
        """Have another version or payload from now on."""
        self.spec = spec

    def clear_faults(self) -> None:
        """Be safe and powered, without a program."""
        self.protects_abrupt_ends = self.protects_ends = False
        self.registers.counts_as_float = self.registers.watchdog_waits = False
        self.arm.mend()
        self.end_program("the faults are cleared")
        self.robot_mode, self.safety_mode, self._power_step_s = MODE_RUNNING, SAFETY_NORMAL, math.inf
        self._note("faults-cleared")

    def _note(self, name: str, detail: str = "") -> None:
        self.events.append(RobotEvent(self.time_s, name, detail))
