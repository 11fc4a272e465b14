"""The gripper of a commissioning: one motion after the other, each to its end."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import GripperCommand, GripperState
from shearloop.drivers.robotiq.models import GripperModel
from shearloop.tools.commission.opened import Opened
from shearloop.tools.halted_fingers import halted_if_interrupted

FINGERS_MM_PER_S: Final = 60.0
# For gauges and objects that are held by hand, and for a tool.
GENTLE_N: Final = 20.0
GRIP_N: Final = 60.0


class Gripper(Protocol):
    """A connected gripper."""

    @property
    def model(self) -> GripperModel:
        """The gripper's model."""

    def activate(self, *, operator_confirmed: bool = False) -> None:
        """Return once the gripper is active; see `RobotiqGripper.activate`."""

    def poll(self) -> GripperState:
        """Return the gripper's state as the daemon polls it."""

    def move(self, command: GripperCommand) -> GripperState:
        """Move the fingers, and return the state at their target or on an object."""


class ConnectedGripper(Opened):
    """The gripper through its driver; a context, which opens and closes the connection. A grip stays."""

    def __init__(self, gripper: RobotiqGripper) -> None:
        """Take a gripper that is not connected yet."""
        self._gripper = gripper
        self._runner = asyncio.Runner()

    def open(self) -> None:
        """Connect; raises DriverError."""
        self._runner.run(self._gripper.connect())

    def close(self) -> None:
        """Close the connection."""
        self._runner.run(self._close())
        self._runner.close()

    async def _close(self) -> None:
        # A signal that ends the program may leave a motion, which halts the fingers as it is cancelled.
        motions = asyncio.all_tasks() - {asyncio.current_task()}
        for motion in motions:
            motion.cancel()
        await asyncio.gather(*motions, return_exceptions=True)
        await self._gripper.close()

    @property
    def model(self) -> GripperModel:
        """The gripper's model."""
        return self._gripper.model

    def activate(self, *, operator_confirmed: bool = False) -> None:
        """Return once the gripper is active."""
        self._runner.run(self._activate(operator_confirmed=operator_confirmed))

    def poll(self) -> GripperState:
        """Return the gripper's state as the daemon polls it."""
        return self._runner.run(self._gripper.poll())

    def move(self, command: GripperCommand) -> GripperState:
        """Move the fingers, and return the state at their target or on an object."""
        return self._runner.run(self._move(command))

    async def _activate(self, *, operator_confirmed: bool) -> None:
        async with halted_if_interrupted(self._gripper):
            # The operator is asked before each motion.
            await self._gripper.activate(operator_confirmed=operator_confirmed, may_drop=True)

    async def _move(self, command: GripperCommand) -> GripperState:
        async with halted_if_interrupted(self._gripper):
            return await self._gripper.finish(await self._gripper.move(command))


@dataclass(frozen=True, slots=True)
class AskedGripper:
    """A gripper that calls `before_motion` before each motion of its fingers."""

    gripper: Gripper
    before_motion: Callable[[], None]

    @property
    def model(self) -> GripperModel:
        """The gripper's model."""
        return self.gripper.model

    def activate(self, *, operator_confirmed: bool = False) -> None:
        """Return once the gripper is active."""
        self.before_motion()
        self.gripper.activate(operator_confirmed=operator_confirmed)

    def poll(self) -> GripperState:
        """Return the gripper's state as the daemon polls it."""
        return self.gripper.poll()

    def move(self, command: GripperCommand) -> GripperState:
        """Move the fingers, and return the state at their target or on an object."""
        self.before_motion()
        return self.gripper.move(command)


def open_fingers(gripper: Gripper, force_n: float = GENTLE_N) -> None:
    """Open the fingers over the whole stroke."""
    gripper.move(GripperCommand(gripper.model.stroke_mm, FINGERS_MM_PER_S, force_n))


def close_fingers(gripper: Gripper, force_n: float = GENTLE_N) -> GripperState:
    """Close the fingers, onto something if it is there, and return the state."""
    return gripper.move(GripperCommand(0.0, FINGERS_MM_PER_S, force_n))
