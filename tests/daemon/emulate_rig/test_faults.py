"""The emulated rig's faults, as the real clients meet them."""

import asyncio
import contextlib
from contextlib import AsyncExitStack

import pytest

from shearloop.drivers.connection import LinkMonitor
from shearloop.drivers.errors import DeviceLostError, DriverError
from shearloop.drivers.load_cell import LoadCell
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import ObjectStatus
from shearloop.drivers.ur.messages import Unlock
from tests.daemon.emulate_rig import rig as played
from tests.running import LinkEvents

pytestmark = pytest.mark.real_time


async def test_disturbances_reach_the_tool_and_robot_faults_the_robot(rig):
    async with AsyncExitStack() as stack:
        gripper = await stack.enter_async_context(played.open_gripper_at(rig))
        load = await stack.enter_async_context(
            played.Reader(LoadCell(played.COUNTS, path=rig.run_dir / "load-cell").readings())
        )
        await played.grip(gripper)
        await rig.fault("kick 0.05")
        truth = await rig.truth(lambda truth: bool(truth["torque_nm"]))
        assert truth["torque_nm"] == pytest.approx(0.05, rel=0.05)
        assert await played.torque_of(load) == pytest.approx(0.05, rel=0.08)
        link = LinkEvents()
        async with played.arm_at(rig, link) as arm:
            await played.until(arm, lambda state: state.wrist_torque_nm < -0.04)
            await rig.fault("slip 0.01")
            await played.until(arm, lambda state: -0.02 < state.wrist_torque_nm < 0.0)
            assert (await rig.truth())["slipped_rad"] > 0.02
            await rig.fault("protective-stop")
            await played.until(arm, lambda state: state.protective_stop)
            await rig.event("protective-stop", 0)
            await rig.fault("robot emergency-stop")
            await played.until(arm, lambda state: state.emergency_stop)
            await rig.fault("release")
            async with asyncio.timeout(played.DEADLINE_S):
                while not (await arm.send(Unlock())).accepted:
                    await arm.next_state()
            await rig.fault("drop-rtde")
            await link.down()
        await rig.fault("joint seized")
        assert (await rig.truth())["joint"] == "seized"
        await rig.fault("joint lever")


async def test_gripper_faults_reach_the_gripper(rig):
    async with asyncio.timeout(played.DEADLINE_S), played.open_gripper_at(rig) as gripper:
        await played.grip(gripper)
        await rig.fault("gripper drop")
        while (await gripper.read()).object is not ObjectStatus.AT_TARGET:
            continue
        assert not (await rig.truth())["gripped"]
        await rig.fault("object 30")
        await rig.fault("gripper fault 12")
        state = await gripper.read()
        assert (state.fault.code, state.fault.needs_activation) == (12, True)
        await gripper.activate(operator_confirmed=True)
        assert (await played.grip(gripper)).diameter_mm == pytest.approx(30.0, abs=1.0)
        await rig.fault("unplug gripper")
        with pytest.raises(DeviceLostError):
            await _read_on(gripper)
        await rig.fault("replug gripper")
        while not gripper.connected:
            with contextlib.suppress(DriverError):
                await gripper.connect()
        await rig.fault("silence gripper")
        with pytest.raises(DeviceLostError, match="gave no whole answer"):
            await gripper.read()
        await rig.fault("object 20")


async def _read_on(gripper: RobotiqGripper) -> None:
    while True:
        await gripper.read()


async def test_boards_fall_silent_vanish_and_come_back(rig):
    async with AsyncExitStack() as stack:
        of_right, of_left, losses = LinkEvents(), LinkEvents(), LinkEvents()
        kit, other = played.kit_at(rig, "right", of_right), played.kit_at(rig, "left", of_left)
        cell = LoadCell(played.COUNTS, path=rig.run_dir / "load-cell", monitor=LinkMonitor(losses))
        right = await stack.enter_async_context(played.Reader(kit.readings()))
        left = await stack.enter_async_context(played.Reader(other.readings()))
        load = await stack.enter_async_context(played.Reader(cell.readings()))
        for each in (right, left, load):
            await each.take(1)
        assert [event.up for event in (*of_right.events, *losses.events)] == [True, True]
        for line in ("unplug right", "silence left", "silence load"):
            await rig.fault(line)
        async with asyncio.timeout(played.DEADLINE_S):
            await of_right.down()
            for link in (of_left, losses):
                assert "has sent nothing" in (await link.down()).sentence
            # Its driver has started the silent board again.
            await left.take(2)
            await rig.fault("replug right")
            await rig.fault("normal")
            for link in (of_right, losses):
                await link.until(lambda link=link: link.events[-1].up)
            for each in (right, left, load):
                await each.take(2)
            await rig.fault("right cut-line")
            while "wrong_count" not in kit.diagnostics()["errors"]:
                await right.take(1)
            assert other.diagnostics()["errors"] == {}
