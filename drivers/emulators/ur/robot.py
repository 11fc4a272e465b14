"""The emulated controller and arm without I/O: commands, faults and time in; state and events out.

Nothing here reads a clock. A process that plays more of the rig gives the robot a `WristPlant` and steps it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from shearloop.drivers.emulators.ur.control_script import ControlScript
from shearloop.drivers.emulators.ur.motion import Halt, Matrix, Motion, PathError, Vector, link_frames, pose_of

# Torque in N·m on the tool about its own axis, from the wrist's angle in rad, its speed in rad/s and the step in s.
WristPlant = Callable[[float, float, float], float]
Value = int | float | Sequence[float]

STOPPED, PLAYING, PAUSED = 1, 2, 4
MODE_POWER_OFF, MODE_IDLE, MODE_RUNNING = 3, 5, 7
SAFETY_NORMAL, SAFETY_PROTECTIVE_STOP, SAFETY_EMERGENCY_STOP = 1, 3, 7
_SAFETY_BITS = {
    SAFETY_NORMAL: 1 << 0,
    SAFETY_PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SAFETY_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
PROGRAM_END_DECELERATION, SAFETY_DECELERATION = 10.0, 20.0
# The longest step of the arm's motion in its own time.
LONGEST_MOVE_S = 0.008


@dataclass(frozen=True, slots=True)
class ControllerSpec:
    """The kind of controller."""

    version: tuple[int, ...] = (5, 17, 3, 0)
    serial_number: str = "20235500001"
    unlock_wait_s: float = 5.0
    power_on_s: float = 1.0
    tool_length_m: float = 0.0
    remote_control: bool = True
    # Elbow up, the tool pointing straight down.
    start_rad: tuple[float, ...] = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)


@dataclass(frozen=True, slots=True)
class RobotEvent:
    """An event at the robot's own time."""

    time_s: float
    name: str
    detail: str = ""
    since_command_s: float = math.nan
    q_rad: tuple[float, ...] = field(default=())


class Robot:
    """Arm, safety controller, program and registers.

    `pace` is the seconds of arm motion in one second of the controller: at 20 a wrist at 0.1 rad/s turns by 2 rad a
    second. Samples, watchdog, unlocking and power stay in the controller's time.
    """

    def __init__(self, spec: ControllerSpec | None = None, plant: WristPlant | None = None, pace: float = 1.0) -> None:
        """Be switched on, at rest, without a program."""
        self.spec = spec or ControllerSpec()
        self._pace = pace
        self.plant: WristPlant = plant or (lambda _angle_rad, _speed_rad_per_s, _dt_s: 0.0)
        self.time_s = 0.0
        # How long its time has stood still while its clock went on.
        self.stood_still_s = 0.0
        self.q_rad: Vector = np.array(self.spec.start_rad)
        self.qd_rad_per_s: Vector = np.zeros(6)
        self.motion: Motion | None = None
        self.events: list[RobotEvent] = []
        self.robot_mode = MODE_RUNNING
        self.safety_mode = SAFETY_NORMAL
        self.runtime_state = STOPPED
        self.remote_control = self.spec.remote_control
        self.registers_taken = False
        self._script: ControlScript | None = None
        self._registers: dict[str, float] = {}
        self._watchdog_s = math.inf
        self._heartbeat_s = self._commanded_s = self._safety_since_s = 0.0
        self._power_step_s = math.inf
        self._button_pressed = False
        self._frames = link_frames(self.q_rad, self.spec.tool_length_m)
        self._wrench = np.zeros(6)
        self._wrench_zero = np.zeros(6)

    @property
    def clock_s(self) -> float:
        """The controller's clock, which never stands still."""
        return self.time_s + self.stood_still_s

    def step(self, dt_s: float) -> None:
        """Run one control cycle."""
        self.time_s += dt_s
        if self.time_s >= self._power_step_s:
            self._power_step_s = math.inf
            self.robot_mode = MODE_IDLE if self.robot_mode == MODE_POWER_OFF else MODE_RUNNING
        if self._script is not None and self.runtime_state == PLAYING:
            if self.time_s - self._heartbeat_s > self._watchdog_s:
                self.end_program("the RTDE watchdog was not fed")
            else:
                self._script.cycle()
        parts = max(1, math.ceil(dt_s * self._pace / LONGEST_MOVE_S - 1e-9))
        for _ in range(parts):
            self._move(dt_s * self._pace / parts)
            torque_nm = self.plant(float(self.q_rad[5]), float(self.qd_rad_per_s[5]), dt_s / parts)
        self._wrench = np.concatenate([np.zeros(3), torque_nm * self._frames[-1][:3, 2]])

    def _move(self, dt_s: float) -> None:
        if self.motion is None:
            return
        moving = bool(self.qd_rad_per_s.any())
        try:
            self.q_rad, self.qd_rad_per_s, finished = self.motion.advance(self.q_rad, self.qd_rad_per_s, dt_s)
        except PathError as error:
            self.protective_stop(str(error))
            return
        if finished:
            self.motion = None
        self._frames = link_frames(self.q_rad, self.spec.tool_length_m)
        if moving != bool(self.qd_rad_per_s.any()):
            self._note("motion-stopped" if moving else "motion-started")

    def upload(self, watchdog_hz: float = 0.0) -> None:
        """Run a control script that arms its watchdog at `watchdog_hz` by itself; 0 for one that does not."""
        if self.safety_mode != SAFETY_NORMAL or self.robot_mode != MODE_RUNNING:
            self._note("script-refused", f"robot mode {self.robot_mode}, safety mode {self.safety_mode}")
            return
        if self._script is not None:
            self.end_program("a new script arrived")
        self._script = ControlScript(self)
        self._watchdog_s = math.inf
        self.runtime_state = PLAYING
        self._note("program-started")
        if watchdog_hz:
            # Heartbeats from before the program count: the manual does not say that the time begins here.
            self._watchdog_s = 1.0 / watchdog_hz
            self._note("script-armed-watchdog", f"{watchdog_hz:g} Hz")

    def end_program(self, cause: str) -> None:
        """End the program; the arm slows down by itself."""
        if self._script is None:
            return
        self._script = None
        self._watchdog_s = math.inf
        self.runtime_state = STOPPED
        self._halt(PROGRAM_END_DECELERATION)
        self._note("program-ended", cause)

    def arm_watchdog(self, minimum_hz: float) -> None:
        """End the program when input register 0 is written less often than this."""
        self._watchdog_s = 1.0 / minimum_hz
        self._heartbeat_s = self.time_s
        self._note("watchdog-armed", f"{minimum_hz:g} Hz")

    @property
    def program_running(self) -> bool:
        """Whether a program is loaded and has not ended; a paused one counts."""
        return self._script is not None

    def protective_stop(self, cause: str) -> None:
        """Stop for safety and pause the program."""
        if self.safety_mode == SAFETY_NORMAL:
            self._stop_for_safety(SAFETY_PROTECTIVE_STOP, "protective-stop", cause)
            if self._script is not None:
                self.runtime_state = PAUSED

    def emergency_stop(self) -> None:
        """Press the emergency stop button: the program ends and the power goes off."""
        self._button_pressed = True
        if self.safety_mode != SAFETY_EMERGENCY_STOP:
            self._stop_for_safety(SAFETY_EMERGENCY_STOP, "emergency-stop", "the button is pressed")
            self.end_program("emergency stop")
            self.robot_mode = MODE_POWER_OFF

    def release(self) -> None:
        """Release the button; the power stays off."""
        self._button_pressed = False
        if self.safety_mode == SAFETY_EMERGENCY_STOP:
            self.safety_mode = SAFETY_NORMAL
            self._note("emergency-stop-released")

    def unlock(self) -> bool:
        """End a protective stop; False within `unlock_wait_s` of its beginning."""
        if self.safety_mode != SAFETY_PROTECTIVE_STOP:
            return True
        if self.clock_s - self._safety_since_s < self.spec.unlock_wait_s:
            return False
        self.safety_mode = SAFETY_NORMAL
        self._note("protective-stop-unlocked")
        return True

    def power_on(self) -> None:
        """Begin to power the arm."""
        if self.robot_mode == MODE_POWER_OFF and not self._button_pressed:
            self._begin_power_step()

    def brake_release(self) -> None:
        """Begin to release the brakes of a powered arm."""
        if self.robot_mode == MODE_IDLE:
            self._begin_power_step()

    def clear_faults(self) -> None:
        """Be safe, powered and in remote control, without a program."""
        self.end_program("the faults are cleared")
        self._button_pressed = False
        self.safety_mode, self.robot_mode = SAFETY_NORMAL, MODE_RUNNING
        self._power_step_s = math.inf
        self.remote_control, self.registers_taken = self.spec.remote_control, False
        self._note("faults-cleared")

    def write(self, name: str, value: float) -> None:
        """Set an input register, as a client does over RTDE; registers outlive their client."""
        self._registers[name] = value
        if name == "input_int_register_0":
            self._heartbeat_s = self._commanded_s = self.time_s

    def number(self, name: str) -> float:
        """Return a register."""
        return self._registers.get(name, 0)

    def put(self, name: str, value: float) -> None:
        """Set an output register."""
        self._registers[name] = value

    def variable(self, name: str) -> Value | None:
        """Return the value of a register or an RTDE variable, or None where it is not simulated."""
        if "_register_" in name:
            value = self.number(name)
            return int(value) if "_int_" in name else value
        compute = _VARIABLES.get(name)
        return compute(self) if compute is not None else None

    def frame(self) -> Matrix:
        """Return the tool's frame (4, 4)."""
        return self._frames[-1]

    def pose(self) -> Vector:
        """Return the tool's pose (6,)."""
        return pose_of(self._frames[-1])

    def wrench(self) -> Vector:
        """Return force and torque at the tool (6,) in base coordinates, relative to the zero."""
        return self._wrench - self._wrench_zero

    def zero_wrench(self) -> None:
        """Make the present wrench zero."""
        self._wrench_zero = self._wrench.copy()
        self._note("wrench-zeroed")

    def _stop_for_safety(self, mode: int, name: str, cause: str) -> None:
        self.safety_mode = mode
        self._safety_since_s = self.clock_s
        self._halt(SAFETY_DECELERATION)
        self._note(name, cause)

    def _begin_power_step(self) -> None:
        if math.isinf(self._power_step_s):
            self._power_step_s = self.time_s + self.spec.power_on_s

    def _halt(self, deceleration: float) -> None:
        self.motion = Halt(deceleration) if self.qd_rad_per_s.any() else None

    def _note(self, name: str, detail: str = "") -> None:
        q_rad = tuple(float(angle) for angle in self.q_rad)
        self.events.append(RobotEvent(self.time_s, name, detail, self.time_s - self._commanded_s, q_rad))


_VARIABLES: dict[str, Callable[[Robot], Value]] = {
    "timestamp": lambda r: r.clock_s,
    "actual_q": lambda r: [*r.q_rad],
    "target_q": lambda r: [*r.q_rad],
    "actual_qd": lambda r: [*r.qd_rad_per_s],
    "target_qd": lambda r: [*r.qd_rad_per_s],
    "actual_TCP_pose": lambda r: [*r.pose()],
    "target_TCP_pose": lambda r: [*r.pose()],
    "actual_TCP_force": lambda r: [*r.wrench()],
    "robot_mode": lambda r: r.robot_mode,
    "safety_mode": lambda r: r.safety_mode,
    "safety_status_bits": lambda r: _SAFETY_BITS[r.safety_mode],
    "runtime_state": lambda r: r.runtime_state,
    "robot_status_bits": lambda r: int(r.robot_mode == MODE_RUNNING) | r.program_running << 1,
    "speed_scaling": lambda _: 1.0,
    "target_speed_fraction": lambda _: 1.0,
    "speed_scaling_combined": lambda _: 1.0,
}
