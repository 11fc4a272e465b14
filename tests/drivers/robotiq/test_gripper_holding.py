"""A gripper that holds an object, and another master."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from shearloop.drivers.robotiq.messages import (
    GripperCommand,
    GripperState,
    ObjectStatus,
)
from tests.drivers.robotiq.gripper_rig import STEP_S, WAYS, Rig, a_rig


@contextlib.asynccontextmanager
async def holding(way: str, tmp_path: Path) -> AsyncIterator[tuple[Rig, AsyncIterator[GripperState]]]:
    """Return a rig whose gripper holds an object and stands, with time stopped, and its states."""
    async with a_rig(way, tmp_path) as rig, contextlib.aclosing(rig.driver.states()) as states, asyncio.timeout(20):
        await anext(states)
        await rig.driver.activate()
        rig.object_mm = 20.0
        await rig.driver.finish(await rig.driver.move(GripperCommand(0.0)))
        rig.stopped = True
        while (await anext(states)).object is not ObjectStatus.CONTACT_CLOSING:
            pass
        yield rig, states


@WAYS
@pytest.mark.parametrize("asked", [{"gto": False}, {"pos": 250}], ids=["halted", "sent further"])
async def test_command_of_another_master_is_seen_at_the_next_poll(
    way: str, tmp_path: Path, asked: dict[str, Any]
) -> None:
    """It holds as before, which is what position and object tell; but whether it does is no longer what we asked."""
    async with holding(way, tmp_path) as (rig, states):
        for name, wanted in asked.items():
            setattr(rig.model.command, name, wanted)
        rig.model.step(STEP_S)
        assert rig.model.obj == ObjectStatus.CONTACT_CLOSING
        assert (await anext(states)).diameter_mm is None
