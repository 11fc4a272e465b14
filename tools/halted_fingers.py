"""Fingers that stand still once the program that moves them is interrupted."""

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator

from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.gripper import RobotiqGripper


@contextlib.asynccontextmanager
async def halted_if_interrupted(gripper: RobotiqGripper) -> AsyncIterator[None]:
    """Halt the fingers if a motion in this context is interrupted: they would finish it without this program."""
    try:
        yield
    except (asyncio.CancelledError, KeyboardInterrupt):
        try:
            await _halt(gripper)
        except DriverError as error:
            print(f"The fingers may still move: they could not be halted. {error}", file=sys.stderr, flush=True)
        except (asyncio.CancelledError, KeyboardInterrupt):
            print("The fingers may still move: a second interrupt ended their halt.", file=sys.stderr, flush=True)
        raise


async def _halt(gripper: RobotiqGripper) -> None:
    try:
        await gripper.halt()
    except DriverError:
        # The connection is lost, perhaps by the interrupt.
        await gripper.connect()
        await gripper.halt()
