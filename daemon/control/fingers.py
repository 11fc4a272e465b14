"""The gripper's fingers, as those who move them share them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.errors import NotBegunError


@dataclass(slots=True)
class Fingers:
    """The gripper, if there is one, and whether its fingers may be moving.

    After a motion that failed, such as by a lost connection, they may still move; a halt clears it.
    """

    gripper: GripperTask | None
    may_be_moving: bool = False

    @contextmanager
    def moving(self) -> Iterator[None]:
        """Count the fingers as moving until this context ends without an error, or with a motion that has not begun."""
        self.may_be_moving = True
        try:
            yield
        except NotBegunError:
            # A halt would only make the gripper forget that it holds something.
            self.may_be_moving = False
            raise
        self.may_be_moving = False
