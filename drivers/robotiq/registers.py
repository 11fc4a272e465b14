"""The gripper's Modbus registers (instruction manual of the 2F-140, "Gripper register mapping"): bytes in pairs."""

from collections.abc import Sequence

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.robotiq.messages import (
    Activate,
    ActivationStatus,
    GripperHalt,
    GripperMove,
    ObjectStatus,
    Readout,
    Request,
    Reset,
)

BAUD_RATE = 115200
DEVICE_ID = 9
FIRST_COMMAND_REGISTER = 0x03E8
FIRST_STATUS_REGISTER = 0x07D0
N_STATUS_REGISTERS = 3

_ACT, _GTO = 1 << 0, 1 << 3


def command_registers(request: Request, last: GripperMove) -> list[int]:
    """Return the three registers from 0x03E8 that carry a request.

    All three are written each time; where a request has no target, the last one stays.
    """
    match request:
        case Reset():
            action = 0
        case Activate() | GripperHalt():
            action = _ACT
        case GripperMove():
            action, last = _ACT | _GTO, request
    return [action << 8, last.position, last.speed << 8 | last.force]


def readout_of(registers: Sequence[int]) -> Readout:
    """Return the readout of the three registers from 0x07D0; ProtocolError for values the manual does not know."""
    if len(registers) != N_STATUS_REGISTERS:
        raise ProtocolError(f"The gripper answered with {len(registers)} registers instead of {N_STATUS_REGISTERS}.")
    status, fault_and_echo, position_and_current = registers
    gripper = status >> 8
    return Readout(
        act=bool(gripper & _ACT),
        gto=bool(gripper & _GTO),
        sta=ActivationStatus(gripper >> 4 & 3),
        obj=ObjectStatus(gripper >> 6 & 3),
        # The upper four bits are the fault of an optional controller that a USB gripper does not have.
        flt=fault_and_echo >> 8 & 0x0F,
        pre=fault_and_echo & 0xFF,
        pos=position_and_current >> 8,
        current=position_and_current & 0xFF,
    )
