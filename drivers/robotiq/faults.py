"""The gripper's faults by name (instruction manual of the 2F-140, table of the register gFLT)."""

from dataclasses import dataclass

from shearloop.drivers.errors import DriverError

# From this code on the gripper takes no command until it is activated anew: a rising edge of ACT.
FIRST_MAJOR_CODE = 10


class GripperFaultError(DriverError):
    """The gripper reports a fault, and what was asked of it cannot be done until it is gone."""


class GripperRefusedError(DriverError):
    """A command that makes no sense, or not now; nothing was sent."""


@dataclass(frozen=True, slots=True)
class GripperFault:
    """What a fault is called, what it means, and what the operator can do about it."""

    code: int
    name: str
    sentence: str

    @property
    def needs_activation(self) -> bool:
        """Whether only a new activation, which the operator has to ask for, ends it."""
        return self.code >= FIRST_MAJOR_CODE


NO_FAULT = GripperFault(0, "none", "")

_FAULTS = {
    fault.code: fault
    for fault in (
        NO_FAULT,
        GripperFault(
            5, "activation not finished", "The gripper is still activating; wait until it has opened and closed."
        ),
        GripperFault(7, "not activated", "The gripper has to be activated before it moves."),
        GripperFault(
            8, "over-temperature", "The gripper is too hot; let it cool down, it takes commands again by itself."
        ),
        GripperFault(
            9, "no communication", "The gripper heard nothing for a second; check its cable and who else talks to it."
        ),
        GripperFault(10, "undervoltage", "The gripper's supply is too low; check its 24 V, then activate it again."),
        GripperFault(
            11, "automatic release running", "The gripper is releasing automatically; wait, then activate it again."
        ),
        GripperFault(
            12, "internal fault", "The gripper reports an internal fault; activate it again, else ask its maker."
        ),
        GripperFault(
            13, "activation fault", "The activation failed; clear what blocks the fingers, then activate it again."
        ),
        GripperFault(
            14, "overcurrent", "The motor drew too much current; clear the fingers, then activate the gripper again."
        ),
        GripperFault(15, "automatic release done", "The gripper has released automatically; activate it again."),
    )
}


def fault_of(code: int) -> GripperFault:
    """Return the fault with this code (gFLT, 0…15); one that the manual does not list is called unknown."""
    if code in _FAULTS:
        return _FAULTS[code]
    cure = "activate it again" if code >= FIRST_MAJOR_CODE else "wait or activate it again"
    return GripperFault(
        code, f"unknown fault {code}", f"The gripper reports the fault {code}, which is not in its manual; {cure}."
    )
