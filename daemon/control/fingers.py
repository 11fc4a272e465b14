"""The gripper's fingers, as those who move them share them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.drivers.robotiq.gripper import Permit


@dataclass(slots=True)
class Fingers:
    """The gripper, if there is one, and whether its fingers may be moving.

    After a motion that failed, such as by a lost connection, they may still move; a halt clears it. A halt of fingers
    that rest would only make the gripper forget that it holds something.
    """

    gripper: GripperTask | None
    may_be_moving: bool = False

    @contextmanager
    def moving(self, permit: Permit) -> Iterator[Permit]:
        """Yield a permit that counts the fingers as moving, until this context ends without an error."""

        def begin() -> None:
            permit()
            self.may_be_moving = True

        yield begin
        self.may_be_moving = False
