"""A UR controller for the real ur-rtde client: RTDE on 30004, control scripts on 30003, dashboard on 29999.

Run it in a process of its own (`shearloop emulate ur`): the client's constructors hold the interpreter lock while they
wait for answers.
"""

from shearloop.drivers.emulators.ur.robot import ControllerSpec, Robot, RobotEvent
from shearloop.drivers.emulators.ur.server import FAULTS, Controller, apply_fault

__all__ = ["FAULTS", "Controller", "ControllerSpec", "Robot", "RobotEvent", "apply_fault"]
