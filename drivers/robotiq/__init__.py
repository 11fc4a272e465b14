"""The Robotiq 2F-140 gripper, over the URCap's socket on the robot's controller or over Modbus RTU on USB.

`ModbusClient` is in `modbus_client`: it takes 0.2 s to import, and most rigs do not use it.
"""

from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import (
    SPEED_MIN_MM_S,
    ActivationStatus,
    GripperClient,
    GripperCommand,
    GripperState,
    ObjectStatus,
)
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.drivers.robotiq.width import STROKE_MM, WidthCalibration

__all__ = [
    "SPEED_MIN_MM_S",
    "STROKE_MM",
    "ActivationStatus",
    "GripperClient",
    "GripperCommand",
    "GripperState",
    "ObjectStatus",
    "RobotiqGripper",
    "SocketClient",
    "WidthCalibration",
]
