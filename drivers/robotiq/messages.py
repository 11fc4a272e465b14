"""Requests to the gripper, its status registers, states and faults (instruction manuals of the 2F and the Hand-E)."""

from dataclasses import dataclass
from enum import Enum, IntEnum

from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.models import FORCES_N, SPEEDS_MM_PER_S

MA_PER_COUNT = 10.0
# The fingers open by themselves.
_RELEASING_CODE = 11
# From this fault code on the gripper takes no command before a new activation: a rising edge of ACT.
FIRST_MAJOR_CODE = 10
OVER_TEMPERATURE_CODE = 8


class GripperFaultError(DriverError):
    """The gripper reports a fault that prevents the request."""


class GripperTooHotError(GripperFaultError):
    """The gripper has to cool down; nothing was sent."""


class GripperInactiveError(GripperFaultError):
    """The gripper has to be activated, which opens and closes its fingers; nothing was sent."""


class GripperRefusedError(DriverError):
    """A command that is invalid, or invalid now; nothing was sent."""


@dataclass(frozen=True, slots=True)
class GripperFault:
    """A fault's code, and a sentence with its meaning and cure."""

    code: int
    sentence: str

    @property
    def needs_activation(self) -> bool:
        """Whether only a new activation, requested by the operator, ends it."""
        return self.code >= FIRST_MAJOR_CODE

    @property
    def too_hot(self) -> bool:
        """Whether the gripper takes no commands until it has cooled down; an activation would open its fingers."""
        return self.code == OVER_TEMPERATURE_CODE


_FAULTS = {
    0: "",
    5: "The gripper is still activating; wait until it has opened and closed.",
    7: "The gripper has to be activated before it moves.",
    8: "The gripper is too hot; let it cool down, it takes commands again by itself.",
    9: "The gripper received nothing for a second; check its cable and other programs using it.",
    10: "The gripper's supply is too low; check its 24 V, then activate it again.",
    11: "The gripper is releasing automatically; wait, then activate it again.",
    12: "The gripper reports an internal fault; activate it again, else ask its maker.",
    13: "The activation failed; clear what blocks the fingers, then activate it again.",
    14: "The motor drew too much current; clear the fingers, then activate the gripper again.",
    15: "The gripper has released automatically; activate it again.",
}


def fault_of(code: int) -> GripperFault:
    """Return the fault with this code (gFLT, 0…15); a code that is not in the manual is called unknown."""
    cure = "activate it again" if code >= FIRST_MAJOR_CODE else "wait or activate it again"
    unknown = f"The gripper reports the fault {code}, which is not in its manual; {cure}."
    return GripperFault(code, _FAULTS.get(code, unknown))


class ObjectStatus(IntEnum):
    """gOBJ: what the fingers met. The register means nothing while GTO is 0: then UNKNOWN."""

    UNKNOWN = -1
    MOVING = 0
    CONTACT_OPENING = 1
    CONTACT_CLOSING = 2
    AT_TARGET = 3

    @property
    def text(self) -> str:
        """The status in words."""
        return self.name.replace("_", " ").lower()


class ActivationStatus(IntEnum):
    """gSTA: the state of the activation; the gripper does not use 2."""

    RESET = 0
    ACTIVATING = 1
    UNUSED = 2
    ACTIVE = 3


@dataclass(frozen=True, slots=True)
class Readout:
    """The status registers of one exchange; `current` is None if the connection does not report it."""

    act: bool
    gto: bool
    sta: ActivationStatus
    obj: ObjectStatus
    flt: int
    pre: int
    pos: int
    current: int | None


class GripperAction(Enum):
    """A request without a target."""

    RESET = "ACT and ATR to 0: motion stops, faults are cleared, the gripper is no longer active"
    ACTIVATE = "ACT to 1: after a reset the gripper opens and closes once, and is then active"
    HALT = "GTO to 0: the fingers stop where they are"


@dataclass(frozen=True, slots=True)
class GripperMove:
    """Go to a position (0 open … 255 closed) with a speed and a force limit, in counts of 0…255.

    The counts of speed and force are linear in mm/s and N.
    """

    position: int
    speed: int
    force: int


Request = GripperAction | GripperMove


@dataclass(frozen=True, slots=True)
class GripperCommand:
    """A target width, a speed, and the largest force; by default as fast and as gently as the model can."""

    width_mm: float
    speed_mm_per_s: float = SPEEDS_MM_PER_S.high
    force_n: float = FORCES_N.low


@dataclass(frozen=True, slots=True)
class GripperState:
    """The gripper at `t_ns` (CLOCK_MONOTONIC, when its registers were requested).

    width_mm ± width_std_mm is the width between the fingertips. `object` is MOVING until the gripper has taken up the
    last command. `requested_counts` is the position of the last request of any program. `others_requests` is the
    number of requests of other programs since the process began. `opened`: whether the fingers' latest motion has
    opened them; None where none was seen over this connection.
    """

    t_ns: int
    position_counts: int
    width_mm: float
    width_std_mm: float
    object: ObjectStatus
    activation: ActivationStatus
    current_ma: float | None
    fault: GripperFault
    requested_counts: int | None = None
    others_requests: int = 0
    opened: bool | None = None

    @property
    def moves(self) -> bool:
        """Whether the fingers move: on command, in an activation, or in a release of the gripper's own."""
        by_itself = self.activation is ActivationStatus.ACTIVATING or self.fault.code == _RELEASING_CODE
        return by_itself or self.object is ObjectStatus.MOVING

    @property
    def diameter_mm(self) -> float | None:
        """The diameter of the object between the fingers, or None: their width after a contact while closing."""
        return self.width_mm if self.object is ObjectStatus.CONTACT_CLOSING else None

    @property
    def diameter_std_mm(self) -> float | None:
        """The standard deviation of the diameter, or None."""
        return self.width_std_mm if self.object is ObjectStatus.CONTACT_CLOSING else None
