"""The UR arm: `UrRobot` in the daemon's event loop, and ur-rtde in a worker process behind a pipe.

`worker` runs 125 cycles a second; `CommandHandler` decides in each what the robot is sent; `UrArm` wraps ur-rtde.
"""

from shearloop.drivers.ur.client import UrLinkEvent, UrRobot
from shearloop.drivers.ur.controller import ControllerInfo, query_controller
from shearloop.drivers.ur.messages import (
    ARRIVED,
    STOPPED_ON_COMMAND,
    Command,
    CommandReply,
    Enable,
    MoveLinear,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from shearloop.drivers.ur.settings import UrSettings, read_settings

__all__ = [
    "ARRIVED",
    "STOPPED_ON_COMMAND",
    "Command",
    "CommandReply",
    "ControllerInfo",
    "Enable",
    "MoveLinear",
    "RobotState",
    "Stop",
    "Unlock",
    "UrLinkEvent",
    "UrRobot",
    "UrSettings",
    "WristSpeed",
    "ZeroForceTorque",
    "query_controller",
    "read_settings",
]
