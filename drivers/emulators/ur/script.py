"""What the control script of ur-rtde does with its registers, cycle by cycle: the table in its source, played.

Input register 0 carries a command; output register 0 says 1 for ready and 2 for done. "Continuous" commands run every
cycle without an answer. The others run once, report 2, and wait for command 0. While one of them blocks, nothing reads
the registers, which is why a watchdog ends the program under a blocking move. A motion started while another thread of
the script moves the arm ends the program, as it does in URScript.
"""

import math
import re
from typing import Protocol

import numpy as np

from shearloop.drivers.emulators.ur.kinematics import Matrix, Vector, rotation_matrix
from shearloop.drivers.emulators.ur.motion import Halt, JointMove, LinearMove, Motion, Speed

READY, DONE = 1, 2
CONTINUOUS = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
MOVE_J, MOVE_J_IK, MOVE_L, MOVE_L_FK = 1, 2, 3, 4
ZERO_FT, SPEED_J, SPEED_L, SERVO_J = 8, 9, 10, 11
SPEED_STOP, SERVO_STOP = 15, 16
PROTECTIVE_STOP, STOP_L, STOP_J, SET_WATCHDOG = 31, 33, 34, 35
TCP_OFFSET, FORWARD_KINEMATICS, IS_STEADY, FLANGE_POSE = 40, 43, 47, 58
END = 255

ASYNC_RUNNING = 1 << 15


# With a number for the frequency: the script's text has the call for its command as well, with a variable.
_ARMED = re.compile(rb'rtde_set_watchdog\("input_int_register_0", ([0-9.]+), "stop"\)')


def armed_hz(text: bytes | bytearray) -> float:
    """Return what a script arms its watchdog with before its loop, or 0."""
    found = _ARMED.search(text)
    return float(found[1]) if found is not None else 0.0


class EmulatedArm(Protocol):
    """What the script reaches of the controller."""

    q_rad: Vector
    qd_rad_per_s: Vector
    motion: Motion | None

    def number(self, name: str) -> float:
        """Return an input register."""

    def put(self, name: str, value: float) -> None:
        """Set an output register."""

    def frame(self, q_rad: Vector) -> Matrix:
        """Return the tool's frame (4, 4) at these joints."""

    def pose(self) -> Vector:
        """Return the tool's pose (6,)."""

    def tool_length(self) -> float:
        """Return the tool's length in m."""

    def zero_wrench(self) -> None:
        """Take the present wrench as zero."""

    def protective_stop(self, cause: str) -> None:
        """Stop the arm for safety."""

    def arm_watchdog(self, minimum_hz: float) -> None:
        """End the program when input register 0 is written less often than this."""

    def end_program(self, cause: str) -> None:
        """End the control program."""


class ControlScript:
    """One run of the control script, from its upload to its end."""

    def __init__(self, arm: EmulatedArm) -> None:
        """Start with every register as the script sets it in its first cycle."""
        self._arm = arm
        self._executing = False
        self._blocked_on: Motion | None = None
        self._thread: str = ""
        self._writes = self._operations = 0
        self._report_async(running=False)
        arm.put("output_int_register_0", READY)

    def cycle(self) -> None:
        """Run the main loop once."""
        arm = self._arm
        self._watch_thread()
        if self._blocked_on is not None:
            if arm.motion is self._blocked_on:
                return
            self._blocked_on = None
            arm.put("output_int_register_0", DONE)
        command = int(arm.number("input_int_register_0"))
        if command in CONTINUOUS:
            self._continuous(command)
            arm.put("output_int_register_0", READY)
        elif command == 0:
            self._executing = False
            arm.put("output_int_register_0", READY)
        elif not self._executing:
            self._executing = True
            self._once(command)
            if self._blocked_on is None:
                arm.put("output_int_register_0", DONE)

    def _watch_thread(self) -> None:
        if self._thread == "move" and self._arm.motion is None:
            self._thread = ""
            self._report_async(running=False)

    def _continuous(self, command: int) -> None:
        arm, target = self._arm, self._vector(0)
        if command == SPEED_J:
            self._speed(target)
        elif command == SERVO_J:
            # Look-ahead and gain smooth the way there; the time step bounds the speed. A target per cycle is reached
            # within a tenth of a second here, which is servoJ with its default look-ahead.
            self._servo(target)
        elif command == FLANGE_POSE:
            for index, value in enumerate(arm.pose()):
                arm.put(f"output_double_register_{index}", float(value))
        else:
            arm.end_program(f"the emulated controller does not play command {command}")

    def _speed(self, target: Vector) -> None:
        if not self._may_move("speed"):
            return
        acceleration = self._arm.number("input_double_register_6")
        if isinstance(self._arm.motion, Speed):
            self._arm.motion.target_rad_per_s, self._arm.motion.acceleration_rad_per_s2 = target, acceleration
        else:
            self._arm.motion = Speed(target, acceleration)

    def _servo(self, target: Vector) -> None:
        if self._may_move("servo"):
            self._arm.motion = Speed(np.clip((target - self._arm.q_rad) / 0.1, -math.pi, math.pi), 40.0)

    def _once(self, command: int) -> None:
        arm = self._arm
        if command in (MOVE_J, MOVE_L):
            self._move(command)
        elif command in (SPEED_STOP, SERVO_STOP):
            self._thread = ""
            self._halt(arm.number("input_double_register_0"), asynchronous=False)
        elif command in (STOP_L, STOP_J):
            self._stop_command()
        elif command == ZERO_FT:
            arm.zero_wrench()
        elif command == PROTECTIVE_STOP:
            arm.protective_stop("the control script asked for it")
        elif command == SET_WATCHDOG:
            arm.arm_watchdog(arm.number("input_double_register_0"))
        elif command == IS_STEADY:
            arm.put("output_int_register_1", 0 if arm.qd_rad_per_s.any() else 1)
        elif command in (FORWARD_KINEMATICS, TCP_OFFSET):
            offset = np.array([0.0, 0.0, arm.tool_length(), 0.0, 0.0, 0.0])
            for index, value in enumerate(arm.pose() if command == FORWARD_KINEMATICS else offset):
                arm.put(f"output_double_register_{index}", float(value))
        elif command == END:
            arm.end_program("the client ended it")
        else:
            # A command that is answered but does nothing would let a test pass for the wrong reason.
            arm.end_program(f"the emulated controller does not play command {command}")

    def _move(self, command: int) -> None:
        arm, target = self._arm, self._vector(0)
        speed, acceleration = arm.number("input_double_register_6"), arm.number("input_double_register_7")
        self._end_move()
        if not self._may_move("move"):
            return
        if command == MOVE_J:
            motion: Motion = JointMove(arm.q_rad, target, speed, acceleration)
        else:
            goal = np.eye(4)
            goal[:3, :3], goal[:3, 3] = rotation_matrix(target[3:]), target[:3]
            motion = LinearMove(arm.frame(arm.q_rad), goal, speed, acceleration, arm.tool_length())
        arm.motion = motion
        if arm.number("input_int_register_1") == 1:
            self._operations = (self._operations + 1) % 128
            self._report_async(running=True)
        else:
            self._thread, self._blocked_on = "", motion

    def _stop_command(self) -> None:
        if self._thread not in ("", "move"):
            self._arm.end_program("another thread is already controlling the robot")
            return
        asynchronous = self._arm.number("input_int_register_1") == 1
        self._end_move()
        self._halt(self._arm.number("input_double_register_0"), asynchronous=asynchronous)

    def _halt(self, deceleration: float, *, asynchronous: bool) -> None:
        motion = Halt(deceleration)
        self._arm.motion = motion
        if asynchronous:
            self._thread = "move"
            self._operations = (self._operations + 1) % 128
            self._report_async(running=True)
        else:
            self._blocked_on = motion

    def _end_move(self) -> None:
        if self._thread == "move":
            self._thread = ""
            self._report_async(running=False)

    def _may_move(self, thread: str) -> bool:
        if self._thread not in ("", thread):
            self._arm.end_program("another thread is already controlling the robot")
            return False
        self._thread = thread
        return True

    def _report_async(self, *, running: bool) -> None:
        self._writes = (self._writes + 1) % 128
        status = (self._writes << 16) | (self._operations << 24) | (ASYNC_RUNNING if running else 0)
        self._arm.put("output_int_register_2", status)

    def _vector(self, first: int) -> Vector:
        return np.array([self._arm.number(f"input_double_register_{first + k}") for k in range(6)])
