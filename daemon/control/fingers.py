"""The gripper's fingers, as those who move them share them."""

from dataclasses import dataclass

from shearloop.daemon.control.gripper_task import GripperTask


@dataclass(slots=True)
class Fingers:
    """The gripper, if there is one, and whether its fingers may be moving.

    They count as moving from a command to its success. After a failure, such as a lost connection, they may still move;
    a halt clears it.
    """

    gripper: GripperTask | None
    may_be_moving: bool = False
