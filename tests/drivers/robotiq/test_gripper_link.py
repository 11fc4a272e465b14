"""A lost, silent, garbled or absent gripper, on both connections."""

import asyncio
import contextlib

import pytest

from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, DriverError
from shearloop.drivers.robotiq.messages import ActivationStatus, GripperCommand
from shearloop.emulators.gripper import ModbusSlave
from tests.drivers.robotiq.gripper_rig import WAYS, a_rig

# A reply over Modbus has 0.3 s, which a busy computer exceeds.
pytestmark = pytest.mark.real_time


@WAYS
async def test_silence_is_a_loss_and_clears_the_state(way, tmp_path):
    async with a_rig(way, tmp_path, reply_deadline_s=0.2, connected=True) as rig:
        assert rig.driver.latest is not None
        rig.silence(True)
        with pytest.raises(DeviceLostError, match=r"within 0\.2 s"):
            await rig.driver.read()
        assert rig.driver.latest is None
        assert not rig.driver.connected
        # A reply that comes too late must not be taken for the next one's: the connection is closed.
        rig.silence(False)
        with pytest.raises(DeviceLostError, match="no connection"):
            await rig.driver.read()
        with pytest.raises(DeviceLostError, match="no connection"):
            await rig.driver.move(GripperCommand(10.0))
        await rig.driver.connect()
        assert rig.driver.connected


async def test_a_gripper_that_lets_itself_be_connected_and_answers_nothing_is_not_connected(tmp_path):
    async with a_rig("socket", tmp_path, reply_deadline_s=0.2) as rig:
        rig.silence(True)
        first = asyncio.create_task(rig.driver.connect())
        async with asyncio.timeout(20):
            while not rig.driver.connected:
                await asyncio.wait([first], timeout=0)
        assert rig.driver.diagnostics()["connected"] is False
        with pytest.raises(DeviceLostError):
            await first
        rig.silence(False)
        await rig.driver.connect()
        assert rig.driver.diagnostics()["connected"] is True


@WAYS
async def test_lost_gripper_reconnects_and_reports_it(way, tmp_path):
    async with a_rig(way, tmp_path) as rig, contextlib.aclosing(rig.driver.states()) as states, asyncio.timeout(20):
        first = await anext(states)
        assert rig.driver.latest == first
        await rig.server.disconnect()
        # The next states are awaited, not made up.
        coming = asyncio.create_task(anext(states))
        await rig.link.down()
        assert rig.driver.latest is None
        assert not coming.done()
        lost_ns = round(rig.t_s * 1e9)
        await rig.server.restore()
        second = await coming
        assert second.t_ns >= lost_ns
        openings = rig.driver.diagnostics()["connections"]
        assert openings == 2
        ups = [event.up for event in rig.link.events]
        assert ups[0]
        assert ups[-1]
        assert not all(ups)
        # A loss and its first failed attempt are news, the repetitions of that are not.
        losses = rig.link.losses
        assert not losses[0].repeated
        assert [event.repeated for event in losses[2:]] == [True] * len(losses[2:])


@WAYS
async def test_loss_during_a_command_is_reported(way, tmp_path):
    async with (
        a_rig(way, tmp_path, reply_deadline_s=0.2) as rig,
        contextlib.aclosing(rig.driver.states()) as states,
        asyncio.timeout(20),
    ):
        await anext(states)
        await rig.driver.activate(may_drop=True)
        rig.silence(True)
        with pytest.raises(DeviceLostError) as met:
            await rig.driver.move(GripperCommand(50.0))
        rig.silence(False)
        await anext(states)
        assert [(event.up, event.sentence == str(met.value)) for event in rig.link.events] == [
            (True, False),
            (False, True),
            (True, False),
        ]
        assert rig.driver.diagnostics()["last_loss"] == str(met.value)


@WAYS
async def test_states_are_polled_while_a_command_runs(way, tmp_path):
    async with a_rig(way, tmp_path) as rig, contextlib.aclosing(rig.driver.states()) as states, asyncio.timeout(20):
        await anext(states)
        activating = asyncio.create_task(rig.driver.activate(may_drop=True))
        seen = [await anext(states)]
        while not activating.done():
            seen.append(await anext(states))
        assert ActivationStatus.ACTIVATING in {state.activation for state in seen}
        assert (await activating).activation is ActivationStatus.ACTIVE
        assert [state.t_ns for state in seen] == sorted(state.t_ns for state in seen)


@WAYS
async def test_cancelled_call_leaves_no_stale_answer(way, tmp_path):
    async with a_rig(way, tmp_path, reply_deadline_s=0.2, connected=True) as rig:
        rig.silence(True)
        reading = asyncio.create_task(rig.driver.read())
        await asyncio.sleep(0)
        reading.cancel()
        await asyncio.wait([reading])
        rig.silence(False)
        with contextlib.suppress(DriverError):
            await rig.driver.read()
        await rig.driver.connect()
        assert (await rig.driver.read()).position_counts == rig.model.pos


@WAYS
async def test_absent_gripper_is_explained(way, tmp_path):
    async with a_rig(way, tmp_path) as rig:
        await rig.server.disconnect()
        with pytest.raises(DeviceNotFoundError, match="There is no"):
            await rig.driver.connect()


async def test_gripper_without_power_is_not_read_as_zero(tmp_path):
    async with a_rig("socket", tmp_path, connected=True) as rig:
        rig.model.powered = False
        with pytest.raises(DeviceLostError, match="no data of the gripper"):
            await rig.driver.read()


async def test_damaged_modbus_reply_is_rejected(tmp_path, monkeypatch):
    feed = ModbusSlave.feed

    def damaged(slave: ModbusSlave, data: bytes) -> bytes:
        *reply, last = feed(slave, data)
        return bytes([*reply, last ^ 0xFF])

    async with a_rig("modbus", tmp_path, reply_deadline_s=0.2, connected=True) as rig:
        with monkeypatch.context() as patched:
            patched.setattr(ModbusSlave, "feed", damaged)
            with pytest.raises(DeviceLostError):
                await rig.driver.read()
        await rig.driver.connect()
