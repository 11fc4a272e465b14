"""Fingers that stand still once the program that moves them is interrupted."""

import asyncio
import contextlib
from collections.abc import AsyncIterator

from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.gripper import RobotiqGripper


@contextlib.asynccontextmanager
async def halted_if_interrupted(gripper: RobotiqGripper) -> AsyncIterator[None]:
    """Halt the fingers if a motion in this context is interrupted: they would finish it without this program."""
    try:
        yield
    except (asyncio.CancelledError, KeyboardInterrupt):
        with contextlib.suppress(DriverError):
            await gripper.halt()
        raise
