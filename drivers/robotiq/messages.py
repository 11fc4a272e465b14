"""What goes to the gripper and what comes back: registers as numbers, states and commands as the loop needs them."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from shearloop.drivers.robotiq.faults import GripperFault

# Instruction manual of the 2F-140, specifications; the counts between are taken as evenly spaced.
SPEED_MIN_MM_S, SPEED_MAX_MM_S = 30.0, 250.0
FORCE_MIN_N, FORCE_MAX_N = 10.0, 125.0
MA_PER_COUNT = 10.0


class ObjectStatus(IntEnum):
    """gOBJ: what the fingers met. Values are the register's, which means nothing while GTO is 0: then UNKNOWN."""

    UNKNOWN = -1
    MOVING = 0
    CONTACT_OPENING = 1
    CONTACT_CLOSING = 2
    AT_TARGET = 3

    @property
    def text(self) -> str:
        """The same in words."""
        return self.name.replace("_", " ").lower()


class ActivationStatus(IntEnum):
    """gSTA: how far the activation is. Values are the register's; 2 is not used by the gripper."""

    RESET = 0
    ACTIVATING = 1
    UNUSED = 2
    ACTIVE = 3


@dataclass(frozen=True, slots=True)
class Readout:
    """The gripper's status registers, all from one exchange; `current` is None where the way in has none."""

    act: bool
    gto: bool
    sta: ActivationStatus
    obj: ObjectStatus
    flt: int
    pre: int
    pos: int
    current: int | None


@dataclass(frozen=True, slots=True)
class Reset:
    """ACT and ATR to 0: motion stops, faults are cleared, the gripper is no longer active."""


@dataclass(frozen=True, slots=True)
class Activate:
    """ACT to 1: after a reset the gripper opens and closes once, and is then active."""


@dataclass(frozen=True, slots=True)
class GripperHalt:
    """GTO to 0: the fingers stop where they are."""


@dataclass(frozen=True, slots=True)
class GripperMove:
    """Go to a position (0 open … 255 closed) at a speed and up to a force, in counts of 0…255."""

    position: int
    speed: int
    force: int


Request = Reset | Activate | GripperHalt | GripperMove


class GripperClient(Protocol):
    """A way to the gripper. Every call has a deadline; DeviceLostError closes the connection, and nothing repeats."""

    @property
    def name(self) -> str:
        """Where the gripper is, for sentences."""

    async def connect(self) -> None:
        """Open the connection."""

    async def close(self) -> None:
        """Close it; closing twice is allowed."""

    async def read(self) -> Readout:
        """Return the status registers."""

    async def read_again(self, before: Readout) -> Readout:
        """Return the status of a gripper that stood at `before`, and of which nothing was asked since.

        It is `before` itself where nothing has changed but what is of no consequence then, current and ACT; those may
        be as old as that.
        """

    async def write(self, request: Request) -> None:
        """Send a request and wait until it is acknowledged; what becomes of it shows in the status."""


@dataclass(frozen=True, slots=True)
class GripperCommand:
    """A width to go to, mm, with a speed and the largest force."""

    width_mm: float
    speed_mm_s: float = SPEED_MAX_MM_S
    force_n: float = FORCE_MIN_N


@dataclass(frozen=True, slots=True)
class SentCommand:
    """What was really sent, after clipping and rounding to counts; `clipped` says in sentences what was changed."""

    width_mm: float
    speed_mm_s: float
    force_n: float
    request: GripperMove
    clipped: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class GripperState:
    """The gripper at `t_ns` (CLOCK_MONOTONIC, when its registers were asked for). It is never repeated as a new one.

    The current alone may be older: it is of `current_t_ns`.

    width_mm ± width_std_mm is between the fingertips. While the fingers stand on an object, closing, diameter_mm is
    that width: a measurement of the object. `object` is MOVING until the gripper has taken up the last command.
    """

    t_ns: int
    seq: int
    position_counts: int
    target_counts: int
    width_mm: float
    width_std_mm: float
    object: ObjectStatus
    activation: ActivationStatus
    current_ma: float | None
    current_t_ns: int
    fault: GripperFault

    @property
    def diameter_mm(self) -> float | None:
        """The diameter of the object between the fingers, mm; None without one."""
        return self.width_mm if self.object is ObjectStatus.CONTACT_CLOSING else None

    @property
    def diameter_std_mm(self) -> float | None:
        """The standard deviation of the diameter, mm; None without one."""
        return self.width_std_mm if self.object is ObjectStatus.CONTACT_CLOSING else None
