"""The emulated controller and arm without any I/O: commands, faults and time go in, state and events come out.

A process that plays more of the rig than the robot hosts this object, gives it a `WristPlant` and steps it.
Time is what `step` was given; nothing here reads a clock.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from shearloop.drivers.emulators.ur.kinematics import Matrix, Vector, link_frames, pose_of
from shearloop.drivers.emulators.ur.make import Make
from shearloop.drivers.emulators.ur.motion import Halt, Motion, PathError
from shearloop.drivers.emulators.ur.registers import Value, known_type
from shearloop.drivers.emulators.ur.script import ControlScript

# Torque in N m on the tool, about its own axis, from the wrist's angle in rad, its speed in rad/s and the step in s of
# the controller's time.
WristPlant = Callable[[float, float, float], float]

STOPPED, PLAYING, PAUSED = 1, 2, 4
MODE_POWER_OFF, MODE_IDLE, MODE_RUNNING = 3, 5, 7
SAFETY_NORMAL, SAFETY_PROTECTIVE_STOP, SAFETY_EMERGENCY_STOP = 1, 3, 7
_SAFETY_BITS = {
    SAFETY_NORMAL: 1 << 0,
    SAFETY_PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SAFETY_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
PROGRAM_END_DECELERATION = 10.0
# The longest stretch of its own time that the arm moves at once, however fast it is played.
LONGEST_MOVE_S = 0.008
SAFETY_DECELERATION = 20.0


@dataclass(frozen=True, slots=True)
class RobotEvent:
    """Something that happened, at the robot's own time."""

    time_s: float
    name: str
    detail: str = ""
    since_command_s: float = math.nan
    q_rad: tuple[float, ...] = field(default=())


class Robot:
    """Arm, safety controller, program and registers.

    `pace` is how many seconds of motion the arm goes through in one of the controller's: at 20 a wrist that is told to
    turn at 0.1 rad/s says that it does, and comes 2 rad further in a second. The controller stays in its own time, and
    with it all that its clients wait for: samples, watchdog, unlocking, power.
    """

    def __init__(self, make: Make | None = None, plant: WristPlant | None = None, pace: float = 1.0) -> None:
        """Be switched on, at rest, without a program."""
        self.make = make or Make()
        self._pace = pace
        self.plant: WristPlant = plant or (lambda _angle_rad, _speed_rad_per_s, _dt_s: 0.0)
        self.time_s = 0.0
        # For how long its time has stood still, which its clock did not.
        self.stood_still_s = 0.0
        self.q_rad: Vector = np.array(self.make.start_rad)
        self.qd_rad_per_s: Vector = np.zeros(6)
        self.motion: Motion | None = None
        self.events: list[RobotEvent] = []
        self.robot_mode = MODE_RUNNING
        self.safety_mode = SAFETY_NORMAL
        self.runtime_state = STOPPED
        self.remote_control = self.make.remote_control
        self.registers_taken = False
        self._script: ControlScript | None = None
        self._registers: dict[str, float] = {}
        self._watchdog_s = math.inf
        self._kicked_s = self._commanded_s = self._safety_since_s = 0.0
        self._power_step_s = math.inf
        self._button_pressed = False
        self._frames = link_frames(self.q_rad, self.make.tool_length_m)
        self._wrench = np.zeros(6)
        self._wrench_zero = np.zeros(6)

    # ---- time -----------------------------------------------------------------------------------------------------

    def step(self, dt_s: float) -> None:
        """Let one control cycle pass."""
        self.time_s += dt_s
        self._power_up()
        if self._script is not None and self.runtime_state == PLAYING:
            if self.time_s - self._kicked_s > self._watchdog_s:
                self.end_program("the RTDE watchdog was not kicked")
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
        self._frames = link_frames(self.q_rad, self.make.tool_length_m)
        if moving != bool(self.qd_rad_per_s.any()):
            self._note("motion-stopped" if moving else "motion-started")

    def _power_up(self) -> None:
        if self.time_s < self._power_step_s:
            return
        self._power_step_s = math.inf
        self.robot_mode = MODE_IDLE if self.robot_mode == MODE_POWER_OFF else MODE_RUNNING

    # ---- program --------------------------------------------------------------------------------------------------

    def upload(self, watchdog_hz: float = 0.0) -> None:
        """Run a control script: what arrives on the script port, once it is complete.

        `watchdog_hz` is what the script itself arms its watchdog with, before it reads a register; 0 where it does not.
        """
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
            # What a client has written before counts: nobody says that the time begins anew.
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
        self._kicked_s = self.time_s
        self._note("watchdog-armed", f"{minimum_hz:g} Hz")

    @property
    def program_running(self) -> bool:
        """Whether a program is loaded and has not ended; one that is paused by a protective stop counts."""
        return self._script is not None

    # ---- faults and their cure ------------------------------------------------------------------------------------

    def protective_stop(self, cause: str) -> None:
        """Stop for safety; the program is paused."""
        if self.safety_mode == SAFETY_NORMAL:
            self._stop_for_safety(SAFETY_PROTECTIVE_STOP, "protective-stop", cause)
            if self._script is not None:
                self.runtime_state = PAUSED

    def emergency_stop(self) -> None:
        """Press the emergency stop button: the program ends and the power goes."""
        self._button_pressed = True
        if self.safety_mode != SAFETY_EMERGENCY_STOP:
            self._stop_for_safety(SAFETY_EMERGENCY_STOP, "emergency-stop", "the button is pressed")
            self.end_program("emergency stop")
            self.robot_mode = MODE_POWER_OFF

    def release(self) -> None:
        """Release the button; the power stays off until someone switches it on."""
        self._button_pressed = False
        if self.safety_mode == SAFETY_EMERGENCY_STOP:
            self.safety_mode = SAFETY_NORMAL
            self._note("emergency-stop-released")

    def unlock(self) -> bool:
        """End a protective stop; False within `unlock_wait_s` of its beginning."""
        if self.safety_mode != SAFETY_PROTECTIVE_STOP:
            return True
        if self.time_s - self._safety_since_s < self.make.unlock_wait_s:
            return False
        self.safety_mode = SAFETY_NORMAL
        self._note("protective-stop-unlocked")
        return True

    def power_on(self) -> None:
        """Begin to switch the arm's power on."""
        if self.robot_mode == MODE_POWER_OFF and not self._button_pressed:
            self._begin_power_step()

    def brake_release(self) -> None:
        """Begin to release the brakes of an arm that has power."""
        if self.robot_mode == MODE_IDLE:
            self._begin_power_step()

    def clear_faults(self) -> None:
        """Be safe, powered and in remote control again, without a program."""
        self.end_program("the faults are cleared")
        self._button_pressed = False
        self.safety_mode, self.robot_mode = SAFETY_NORMAL, MODE_RUNNING
        self._power_step_s = math.inf
        self.remote_control, self.registers_taken = self.make.remote_control, False
        self._note("faults-cleared")

    # ---- registers and variables ----------------------------------------------------------------------------------

    def write(self, name: str, value: float) -> None:
        """Set an input register, as a client does over RTDE; registers keep their values when a client goes."""
        self._registers[name] = value
        if name == "input_int_register_0":
            self._kicked_s = self.time_s
            self._commanded_s = self.time_s

    def number(self, name: str) -> float:
        """Return a register."""
        return self._registers.get(name, 0)

    def put(self, name: str, value: float) -> None:
        """Set an output register."""
        self._registers[name] = value

    def variable(self, name: str) -> Value:
        """Return the value of an RTDE variable; what is not simulated is zero."""
        if "_register_" in name:
            value = self.number(name)
            return int(value) if "_int_" in name else value
        compute = _VARIABLES.get(name)
        if compute is not None:
            return compute(self)
        kind = known_type(name, self.make.version) or "DOUBLE"
        size = int(kind[6]) if kind.startswith("VECTOR") else 0
        return (0,) * size if size else 0

    def frame(self, q_rad: Vector) -> Matrix:
        """Return the tool's frame (4, 4) at these joints."""
        return link_frames(q_rad, self.make.tool_length_m)[-1]

    def pose(self) -> Vector:
        """Return the tool's pose (6,)."""
        return pose_of(self._frames[-1])

    def tool_length(self) -> float:
        """Return the tool's length in m."""
        return self.make.tool_length_m

    def wrench(self) -> Vector:
        """Return force and torque at the tool (6,) in base coordinates, less what was zeroed."""
        return self._wrench - self._wrench_zero

    def zero_wrench(self) -> None:
        """Take the present wrench as zero."""
        self._wrench_zero = self._wrench.copy()
        self._note("wrench-zeroed")

    # ---- inside ---------------------------------------------------------------------------------------------------

    def _stop_for_safety(self, mode: int, name: str, cause: str) -> None:
        self.safety_mode = mode
        self._safety_since_s = self.time_s
        self._halt(SAFETY_DECELERATION)
        self._note(name, cause)

    def _begin_power_step(self) -> None:
        if math.isinf(self._power_step_s):
            self._power_step_s = self.time_s + self.make.power_on_s

    def _halt(self, deceleration: float) -> None:
        self.motion = Halt(deceleration) if self.qd_rad_per_s.any() else None

    def _note(self, name: str, detail: str = "") -> None:
        q_rad = tuple(float(angle) for angle in self.q_rad)
        self.events.append(RobotEvent(self.time_s, name, detail, self.time_s - self._commanded_s, q_rad))


_VARIABLES: dict[str, Callable[[Robot], Value]] = {
    "timestamp": lambda r: r.time_s + r.stood_still_s,
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
