"""ur-rtde's control script, played cycle by cycle after the command table in its source.

Input register 0 carries a command; output register 0 is 1 for ready and 2 for done. `speedJ` runs in every cycle
without an answer. Other commands run once, report 2, and wait for command 0. While one of them blocks, nothing reads
the registers, so that a watchdog ends the program under a blocking move. A motion that starts while another thread of
the script moves the arm ends the program, as in URScript. Commands that the driver never sends end the program.
"""

import re
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from shearloop.drivers.emulators.ur.motion import Halt, LinearMove, Motion, Speed, Vector

if TYPE_CHECKING:
    from shearloop.drivers.emulators.ur.robot import Robot

READY, DONE = 1, 2
MOVE_L, ZERO_FT, SPEED_J, SPEED_STOP, STOP_J, SET_WATCHDOG, END = 3, 8, 9, 15, 34, 35, 255
# Continuous commands that are not played.
_CONTINUOUS = frozenset({6, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
ASYNC_RUNNING = 1 << 15

# With a number for the frequency: the script's text also has the call for its command, with a variable.
_ARMED = re.compile(rb'rtde_set_watchdog\("input_int_register_0", ([0-9.]+), "stop"\)')


def armed_hz(text: bytes | bytearray) -> float:
    """Return the watchdog frequency of a script that arms it before its loop, or 0."""
    found = _ARMED.search(text)
    return float(found[1]) if found is not None else 0.0


class ControlScript:
    """One run of the control script, from its upload to its end."""

    def __init__(self, robot: "Robot") -> None:
        """Set the registers as the script does in its first cycle."""
        self._robot = robot
        self._executing = False
        self._blocked_on: Motion | None = None
        # The thread that moves the arm: "speed", "move" or none.
        self._thread = ""
        self._writes = self._operations = 0
        self._report_async(running=False)
        robot.put("output_int_register_0", READY)

    def cycle(self) -> None:
        """Run the main loop once."""
        robot = self._robot
        if self._thread == "move" and robot.motion is None:
            self._end_move()
        if self._blocked_on is not None:
            if robot.motion is self._blocked_on:
                return
            self._blocked_on = None
            robot.put("output_int_register_0", DONE)
        command = int(robot.number("input_int_register_0"))
        if command == SPEED_J:
            self._turn(self._vector())
            robot.put("output_int_register_0", READY)
        elif command in _CONTINUOUS:
            robot.end_program(f"the emulated controller does not play command {command}")
        elif command == 0:
            self._executing = False
            robot.put("output_int_register_0", READY)
        elif not self._executing:
            self._executing = True
            self._run_once(command)
            if self._blocked_on is None:
                robot.put("output_int_register_0", DONE)

    def _turn(self, target: Vector) -> None:
        if not self._may_move("speed"):
            return
        acceleration = self._robot.number("input_double_register_6")
        self._robot.motion = Speed(target, acceleration)

    def _run_once(self, command: int) -> None:
        robot = self._robot
        asynchronous = robot.number("input_int_register_1") == 1
        if command == MOVE_L:
            self._move(asynchronous=asynchronous)
        elif command == SPEED_STOP:
            self._thread = ""
            self._halt(asynchronous=False)
        elif command == STOP_J:
            if self._thread not in ("", "move"):
                robot.end_program("another thread is already controlling the robot")
                return
            self._end_move()
            self._halt(asynchronous=asynchronous)
        elif command == ZERO_FT:
            robot.zero_wrench()
        elif command == SET_WATCHDOG:
            robot.arm_watchdog(robot.number("input_double_register_0"))
        elif command == END:
            robot.end_program("the client ended it")
        else:
            robot.end_program(f"the emulated controller does not play command {command}")

    def _move(self, *, asynchronous: bool) -> None:
        robot, target = self._robot, self._vector()
        speed, acceleration = robot.number("input_double_register_6"), robot.number("input_double_register_7")
        self._end_move()
        if not self._may_move("move"):
            return
        goal = np.eye(4)
        goal[:3, :3], goal[:3, 3] = Rotation.from_rotvec(target[3:]).as_matrix(), target[:3]
        robot.motion = LinearMove(robot.frame(), goal, speed, acceleration, robot.spec.tool_length_m)
        if asynchronous:
            self._begin_async()
        else:
            self._thread, self._blocked_on = "", robot.motion

    def _halt(self, *, asynchronous: bool) -> None:
        self._robot.motion = motion = Halt(self._robot.number("input_double_register_0"))
        if asynchronous:
            self._thread = "move"
            self._begin_async()
        else:
            self._blocked_on = motion

    def _begin_async(self) -> None:
        self._operations = (self._operations + 1) % 128
        self._report_async(running=True)

    def _end_move(self) -> None:
        if self._thread == "move":
            self._thread = ""
            self._report_async(running=False)

    def _may_move(self, thread: str) -> bool:
        if self._thread not in ("", thread):
            self._robot.end_program("another thread is already controlling the robot")
            return False
        self._thread = thread
        return True

    def _report_async(self, *, running: bool) -> None:
        self._writes = (self._writes + 1) % 128
        status = (self._writes << 16) | (self._operations << 24) | (ASYNC_RUNNING if running else 0)
        self._robot.put("output_int_register_2", status)

    def _vector(self) -> Vector:
        return np.array([self._robot.number(f"input_double_register_{k}") for k in range(6)])
