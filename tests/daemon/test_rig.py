"""What belongs to the rig's parts together, without any device."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from shearloop.daemon.clock import Clock
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.loop_inputs import TorqueSource
from shearloop.daemon.rig import Rig
from shearloop.drivers.connection import LinkEvent
from tests.daemon.control.cell import Published

SOURCES = {"right": TorqueSource(name="right", period_s=0.5)}


@contextlib.asynccontextmanager
async def a_rig() -> AsyncIterator[Rig]:
    """Return a rig whose loop runs, and whose robot is never connected to."""
    config = DaemonConfig.model_construct(robot=Path("config/ur.yaml"))

    async def no_tare() -> str:
        return ""

    rig = Rig(config, Published(), Clock(), SOURCES, no_tare, {})  # type: ignore[arg-type]
    driving = asyncio.create_task(rig.runner.run())
    await asyncio.sleep(0)
    try:
        yield rig
    finally:
        driving.cancel()
        await asyncio.gather(driving, return_exceptions=True)


async def test_a_robot_that_is_lost_is_told_at_once_and_not_when_its_state_is_missed() -> None:
    async with a_rig() as rig:
        assert rig.control_loop.status.decision.faults == ()
        rig.set_link("robot", LinkEvent(up=False, sentence="the robot's process died", repeated=False))
        assert "the robot's process died" in " ".join(rig.control_loop.status.decision.reasons)


async def test_a_device_that_is_lost_before_the_loop_runs_and_after_its_end_is_noted() -> None:
    async with a_rig() as rig:
        pass
    rig.set_link("robot", LinkEvent(up=False, sentence="the robot's process died", repeated=False))
    assert rig.control_loop.inputs.lost == {"robot": "the robot's process died"}
    assert rig.control_loop.status.decision.faults == ()
