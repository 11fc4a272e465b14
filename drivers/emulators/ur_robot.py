"""The emulated controller without I/O: commands, faults and time in; state and events out.

Nothing here reads a clock. A process that plays more of the rig gives the robot a `WristPlant` and steps it.

`ControlScript` is ur-rtde's, played cycle by cycle after the command table in its source. Input register 0 carries a
command; output register 0 is 1 for ready and 2 for done. `speedJ` runs in every cycle without an answer. Other commands
run once, report 2, and wait for command 0. While one of them blocks, nothing reads the registers, so that a watchdog
ends the program under a blocking move. A motion that starts while another thread of the script moves the arm ends the
program, as in URScript. Commands that the driver never sends end the program.
"""

import math
import re
from collections import defaultdict
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shearloop.drivers.emulators.ur_arm import Arm, Motion, PathError

# An event's name and detail.
Event = tuple[str, str]

STOPPED, PLAYING, PAUSED = 1, 2, 4
MODE_POWER_OFF, MODE_IDLE, MODE_RUNNING = 3, 5, 7
SAFETY_NORMAL, SAFETY_PROTECTIVE_STOP, SAFETY_EMERGENCY_STOP = 1, 3, 7
PROGRAM_END_DECELERATION, SAFETY_DECELERATION = 10.0, 20.0
# The longest step of the arm's motion in its own time.
LONGEST_MOVE_S = 0.008

READY, DONE = 1, 2
MOVE_L, ZERO_FT, SPEED_J, SPEED_STOP, STOP_J, SET_WATCHDOG, END = 3, 8, 9, 15, 34, 35, 255
ASYNC_RUNNING = 1 << 15
COMMAND = "input_int_register_0"
# With a number for the frequency: the script's text also has the call for its command, with a variable.
_ARMED = re.compile(rb'rtde_set_watchdog\("input_int_register_0", ([0-9.]+), "stop"\)')


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
    since_command_s: float
    q_rad: tuple[float, ...]


def armed_hz(text: bytes | bytearray) -> float:
    """Return the watchdog frequency of a script that arms it before its loop, or 0."""
    found = _ARMED.search(text)
    return float(found[1]) if found is not None else 0.0


class Registers(defaultdict[str, float]):
    """The RTDE registers by name; they outlive programs and clients."""

    def __init__(self) -> None:
        """Set every register to 0."""
        super().__init__(int)
        # The last write of the command register, which is the heartbeat too.
        self.commanded_s = 0.0

    def write(self, name: str, value: float, now_s: float) -> None:
        """Set an input register, as a client does over RTDE."""
        self[name] = value
        if name == COMMAND:
            self.commanded_s = now_s

    def doubles(self) -> list[float]:
        """Return the first eight input registers of the type double."""
        return [self[f"input_double_register_{number}"] for number in range(8)]


class ProgramEndedError(Exception):
    """The script ends by itself; the message says why."""


class ControlScript:
    """One run of the control script, from its upload to its end."""

    def __init__(self, registers: Registers, arm: Arm, watchdog_hz: float) -> None:
        """Set the registers as the script does in its first cycle; `watchdog_hz` is 0 for one that arms none."""
        self._registers = registers
        self._arm = arm
        # Heartbeats from before the program count: the manual does not say that the time begins here.
        self._watchdog_s = 1.0 / watchdog_hz if watchdog_hz else math.inf
        self._watched_since_s = -math.inf
        self._executing = False
        self._blocked_on: Motion | None = None
        # The thread that moves the arm: "speed", "move" or none.
        self._thread = ""
        self._writes = self._operations = 0
        self._report_async(running=False)
        registers["output_int_register_0"] = READY

    def cycle(self, now_s: float) -> Event | None:
        """Run the main loop once and return what happened; ProgramEndedError where the program ends."""
        registers = self._registers
        if now_s - max(registers.commanded_s, self._watched_since_s) > self._watchdog_s:
            raise ProgramEndedError("the RTDE watchdog was not fed")
        if self._thread == "move" and self._arm.motion is None:
            self._end_move()
        if self._blocked_on is not None:
            if self._arm.motion is self._blocked_on:
                return None
            self._blocked_on = None
            registers["output_int_register_0"] = DONE
        command = int(registers[COMMAND])
        event = None
        if command == SPEED_J:
            self._claim_arm("speed")
            doubles = registers.doubles()
            self._arm.turn(np.array(doubles[:6]), doubles[6])
            registers["output_int_register_0"] = READY
        elif command == 0:
            self._executing = False
            registers["output_int_register_0"] = READY
        elif not self._executing:
            self._executing = True
            event = self._run_once(command, now_s)
            if self._blocked_on is None:
                registers["output_int_register_0"] = DONE
        return event

    def _run_once(self, command: int, now_s: float) -> Event | None:
        registers, doubles = self._registers, self._registers.doubles()
        asynchronous = registers["input_int_register_1"] == 1
        if command == MOVE_L:
            self._end_move()
            self._claim_arm("move")
            self._arm.move_to(np.array(doubles[:6]), *doubles[6:])
            self._begin(asynchronous=asynchronous)
        elif command == SPEED_STOP:
            self._arm.halt(doubles[0])
            self._begin(asynchronous=False)
        elif command == STOP_J:
            self._end_move()
            self._claim_arm("move")
            self._arm.halt(doubles[0])
            self._begin(asynchronous=asynchronous)
        elif command == ZERO_FT:
            self._arm.zero_wrench()
            return "wrench-zeroed", ""
        elif command == SET_WATCHDOG:
            self._watchdog_s, self._watched_since_s = 1.0 / doubles[0], now_s
            return "watchdog-armed", f"{doubles[0]:g} Hz"
        elif command == END:
            raise ProgramEndedError("the client ended it")
        else:
            raise ProgramEndedError(f"the emulated controller does not play command {command}")
        return None

    def _begin(self, *, asynchronous: bool) -> None:
        """Go on during the motion just begun, or wait for its end."""
        if asynchronous:
            self._thread = "move"
            self._operations = (self._operations + 1) % 128
            self._report_async(running=True)
        else:
            self._thread, self._blocked_on = "", self._arm.motion

    def _end_move(self) -> None:
        if self._thread == "move":
            self._thread = ""
            self._report_async(running=False)

    def _claim_arm(self, thread: str) -> None:
        if self._thread not in ("", thread):
            raise ProgramEndedError("another thread is already controlling the robot")
        self._thread = thread

    def _report_async(self, *, running: bool) -> None:
        self._writes = (self._writes + 1) % 128
        status = (self._writes << 16) | (self._operations << 24) | (ASYNC_RUNNING if running else 0)
        self._registers["output_int_register_2"] = status


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
    """Arm, safety controller, program and registers.

    `pace` is the seconds of arm motion in one second of the controller: at 20 a wrist at 0.1 rad/s turns by 2 rad a
    second. Samples, watchdog, unlocking and power stay in the controller's time.
    """

    def __init__(self, spec: ControllerSpec | None = None, plant: WristPlant | None = None, pace: float = 1.0) -> None:
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
        self._pace = pace
        self._plant = plant
        self._script: ControlScript | None = None

    def step(self, dt_s: float) -> None:
        """Run one control cycle."""
        self.time_s += dt_s
        self.clock_s += dt_s
        self.safety.pass_time(self.time_s)
        if self._script is not None and self.runtime_state == PLAYING:
            try:
                event = self._script.cycle(self.time_s)
            except ProgramEndedError as ended:
                self.end_program(str(ended))
            else:
                if event is not None:
                    self._note(*event)
        parts = max(1, math.ceil(dt_s * self._pace / LONGEST_MOVE_S - 1e-9))
        for _ in range(parts):
            self._move(dt_s * self._pace / parts)
            if self._plant is not None:
                self.arm.load(self._plant.step(dt_s / parts, float(self.arm.q_rad[5])))

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
        return self._script is not None

    def upload(self, watchdog_hz: float = 0.0) -> None:
        """Run a control script that arms its watchdog at `watchdog_hz` by itself; 0 for one that does not."""
        if (self.safety.safety_mode, self.safety.robot_mode) != (SAFETY_NORMAL, MODE_RUNNING):
            modes = f"robot mode {self.safety.robot_mode}, safety mode {self.safety.safety_mode}"
            self._note("script-refused", modes)
            return
        self.end_program("a new script arrived")
        self._script = ControlScript(self.registers, self.arm, watchdog_hz)
        self.runtime_state = PLAYING
        self._note("program-started")
        if watchdog_hz:
            self._note("script-armed-watchdog", f"{watchdog_hz:g} Hz")

    def end_program(self, cause: str) -> None:
        """End the program; the arm slows down by itself."""
        if self._script is not None:
            self._script = None
            self.runtime_state = STOPPED
            self.arm.halt(PROGRAM_END_DECELERATION)
            self._note("program-ended", cause)

    def protective_stop(self, cause: str) -> None:
        """Stop for safety and pause the program."""
        if self.safety.safety_mode == SAFETY_NORMAL:
            self.safety.stop(self.clock_s)
            self.arm.halt(SAFETY_DECELERATION)
            self._note("protective-stop", cause)
            if self._script is not None:
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
        q_rad = tuple(float(angle) for angle in self.arm.q_rad)
        self._events.append(RobotEvent(self.time_s, name, detail, self.time_s - self.registers.commanded_s, q_rad))
