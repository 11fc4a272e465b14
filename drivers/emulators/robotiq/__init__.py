"""An emulated Robotiq 2F-140 behind the URCap's socket or Modbus RTU."""

from shearloop.drivers.emulators.robotiq.gripper import Gripper, GripperMechanics, GripperRegisters
from shearloop.drivers.emulators.robotiq.servers import (
    URCAP_PORT,
    GripperPlayer,
    GripperServer,
    ModbusServer,
    UrcapServer,
)

__all__ = [
    "URCAP_PORT",
    "Gripper",
    "GripperMechanics",
    "GripperPlayer",
    "GripperRegisters",
    "GripperServer",
    "ModbusServer",
    "UrcapServer",
]
