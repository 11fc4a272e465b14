"""What the control loop decides in a tick: to drive, to stand still, or to end all motion."""

from dataclasses import dataclass
from typing import TypeAlias

from shearloop.daemon.control.experiment import Action


@dataclass(frozen=True, slots=True)
class Drive:
    """The wrist turns at a speed, and a straight move continues; `action` begins in this tick."""

    rad_per_s: float
    action: Action | None = None


@dataclass(frozen=True, slots=True)
class StandStill:
    """The wrist stands, and a straight move is interrupted until the next `Drive`."""


@dataclass(frozen=True, slots=True)
class End:
    """Motion and action end; `release`: then the gripper opens, which one tick of a stop asks for."""

    release: bool = False


ControlOutput: TypeAlias = Drive | StandStill | End
