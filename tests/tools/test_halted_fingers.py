"""Fingers whose program is interrupted: they stand still, even where the interrupt has cost the connection."""

import asyncio

import pytest

from shearloop.drivers.robotiq.messages import GripperCommand
from shearloop.tools.halted_fingers import halted_if_interrupted
from tests.drivers.robotiq.gripper_rig import WAYS, a_rig


@WAYS
async def test_a_lost_connection_is_opened_again_to_halt_the_fingers(way, tmp_path):
    async with a_rig(way, tmp_path, active=True, reply_deadline_s=2.0) as rig:

        async def close_fingers() -> None:
            async with halted_if_interrupted(rig.driver):
                await rig.driver.finish(await rig.driver.move(GripperCommand(0.0, 20.0, 20.0)))

        motion = asyncio.create_task(close_fingers())
        while (await rig.driver.read()).width_mm > 120.0:
            continue
        await rig.driver.client.close()
        motion.cancel()
        with pytest.raises(asyncio.CancelledError):
            await motion
        halted_mm = rig.model.width_mm
        assert halted_mm > 20.0
        for _ in range(100):
            await asyncio.sleep(0)
        assert rig.model.width_mm == halted_mm


@WAYS
async def test_fingers_that_cannot_be_halted_are_told(way, tmp_path, capsys):
    async with a_rig(way, tmp_path, active=True, reply_deadline_s=2.0) as rig:
        await rig.server.disconnect()
        with pytest.raises(asyncio.CancelledError):
            async with halted_if_interrupted(rig.driver):
                raise asyncio.CancelledError
    assert "may still move" in capsys.readouterr().err


async def test_a_halt_that_a_second_interrupt_ends_is_told(tmp_path, capsys, monkeypatch):
    async with a_rig("socket", tmp_path, active=True, reply_deadline_s=2.0) as rig:
        halting = asyncio.Event()

        async def halt_that_waits() -> None:
            halting.set()
            await asyncio.Event().wait()

        async def interrupted() -> None:
            async with halted_if_interrupted(rig.driver):
                raise asyncio.CancelledError

        monkeypatch.setattr(rig.driver, "halt", halt_that_waits)
        motion = asyncio.create_task(interrupted())
        await halting.wait()
        motion.cancel()
        with pytest.raises(asyncio.CancelledError):
            await motion
    assert "may still move: a second interrupt ended their halt" in capsys.readouterr().err
