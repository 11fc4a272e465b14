"""A daemon over real ports after one that ended or was killed with a gripped tool: nothing moves by itself."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.messaging.bound_requests import meant_for
from shearloop.daemon.messaging.client import Subscriber, send_command
from shearloop.drivers.robotiq.gripper import RobotiqGripper
from shearloop.drivers.robotiq.messages import GripperCommand
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.drivers.robotiq.widths import WidthCalibration
from tests.fixtures.daemons import DEADLINE_S, ask, running_daemon, shearloop
from tests.fixtures.rigs import HOST, SLOW_TWIST, Watcher, emulated_rig, experiment, running_rig, started, truth

pytestmark = pytest.mark.real_time


def second_config(rig_config: Path) -> Path:
    """Return the same configuration with sockets of its own."""
    path, folder = rig_config.with_name("second.yaml"), rig_config.parent
    content = yaml.safe_load(rig_config.read_text())
    sockets = {name: f"ipc://{folder}/second-{name}" for name in ("publish", "commands")}
    path.write_text(yaml.safe_dump({**content, **sockets}))
    return path


def spelt_otherwise(config: Path) -> Path:
    """Write another spelling of the robot's address into a configuration."""
    content = yaml.safe_load(config.read_text())
    settings = config.with_name("spelt-otherwise.yaml")
    robot = yaml.safe_load(config.with_name(content["robot"]).read_text())
    first, _, others = robot["host"].partition(".")
    settings.write_text(yaml.safe_dump({**robot, "host": f"{int(first):#x}.{others}"}))
    config.write_text(yaml.safe_dump({**content, "robot": settings.name}))
    return config


@asynccontextmanager
async def twisting_process(config: Path, rig: asyncio.subprocess.Process) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run the daemon as a process of its own, which twists a gripped tool."""
    addresses = load_daemon_config(config)
    experiment(config.parent, SLOW_TWIST)
    start = {"command": "start", "experiment": str(config.with_name("experiment.yaml"))}
    silent = {"stdout": asyncio.subprocess.DEVNULL, "stderr": asyncio.subprocess.DEVNULL}
    async with shearloop("run", str(config), **silent) as own:
        with Subscriber(addresses.publish, ("loop.state", "load.torque")) as published:
            async for topic, content in published:
                # A change of the loop's state comes at once, and every second one comes.
                if topic == "loop.state" and content["phase"] != "running":
                    status = await asyncio.to_thread(
                        send_command, addresses.commands, {"command": "status"}, DEADLINE_S
                    )
                    bound = start | meant_for(status, 0.0, DEADLINE_S)
                    await asyncio.to_thread(send_command, addresses.commands, bound, DEADLINE_S)
                if topic == "load.torque" and content["valid"] and abs(content["torque_nm"]) > 0.01:
                    break
        assert (await truth(rig))["gripped"]
        yield own


async def nothing_moves(watcher: Watcher, rig: asyncio.subprocess.Process, before: dict[str, Any]) -> None:
    """Two seconds of the robot's states later wrist and fingers are where they were."""
    last = watcher.seen["robot.state"][-1]["seq"]
    await watcher.until("robot.state", lambda state: state["seq"] > last + 50)
    after = await truth(rig)
    assert after["gripped"]
    assert after["wrist_rad"] == pytest.approx(before["wrist_rad"], abs=1e-4)
    assert after["width_mm"] == before["width_mm"]


async def standing(rig: asyncio.subprocess.Process) -> dict[str, Any]:
    """Return the truth once the wrist stands."""
    before = await truth(rig)
    while (now := await truth(rig))["wrist_rad"] != before["wrist_rad"] or now["time_s"] < before["time_s"] + 0.3:
        before = before if now["wrist_rad"] == before["wrist_rad"] else now
    return now


async def exchange_tool(rig: asyncio.subprocess.Process, width_mm: float) -> None:
    """Open the gripper, put another object between its fingers, and close them, as the pendant does."""
    hand = RobotiqGripper(SocketClient(HOST), WidthCalibration.nominal())
    await hand.connect()
    await hand.finish(await hand.move(GripperCommand(140.0)))
    rig.stdin.write(f"gripper object {width_mm}\n".encode())
    state = await hand.finish(await hand.move(GripperCommand(0.0)))
    assert state.diameter_mm == pytest.approx(width_mm, abs=1.0)
    await hand.close()


async def test_nothing_moves_after_a_restart_a_reconnection_and_an_acknowledgement(
    rig_config, tiny_bank, tmp_path, log
):
    """A tool is gripped, an experiment is configured, the daemon ends in the middle, and nobody asks for a motion."""
    path = experiment(tmp_path, SLOW_TWIST)
    content = {**yaml.safe_load(rig_config.read_text()), "experiment": path}
    rig_config.write_text(yaml.safe_dump(content))
    async with running_rig(rig_config, tiny_bank) as (first, watcher, fault, command):
        await started(watcher, command, path)
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        first.stop()
        await first.ending.wait()
        # It has the robot to itself until it has ended.
        await log.says_only("stopped")
        async with running_daemon(second_config(rig_config)) as daemon:
            again, ask_again = Watcher(daemon), partial(ask, daemon)
            still = await again.until("robot.state", lambda state: abs(state["wrist_speed_rad_per_s"]) < 1e-3)
            tool = await again.until("gripper.state", lambda state: state["diameter_mm"] is not None)
            state = await again.until("loop.state", lambda state: FaultCode.TOOL_GRIPPED.text in state["faults"])
            assert FaultCode.DAEMON_ENDED.text in state["faults"]
            assert not (await ask_again("start"))["ok"]
            fault("unplug gripper 0.5")
            await again.until("loop.state", lambda state: "gripper" in state["reasons"])
            reply = await ask_again("unlock")
            while not reply["ok"]:
                reply = await ask_again("unlock")
            last = again.seen["robot.state"][-1]["seq"]
            later = await again.until("robot.state", lambda state: state["seq"] > last + 50)
            assert later["wrist_rad"] == pytest.approx(still["wrist_rad"], abs=1e-3)
            assert again.seen["gripper.state"][-1]["width_mm"] == pytest.approx(tool["width_mm"], abs=1.0)
            # Its first frames are of the gripped tool, and no idle frame.
            await again.until("eit.estimate", lambda one: one["reason"].startswith("no idle frame"))
            assert not any(one["valid"] for one in again.seen["eit.estimate"][-10:])
            assert "drops" in (await ask_again("release"))["reason"]
            reply = await ask_again("release", confirmed=True)
            assert reply["ok"], reply
            assert again.seen["gripper.state"][-1]["width_mm"] > tool["width_mm"] + 50


async def test_after_a_kill_with_a_gripped_tool_nothing_moves_and_start_waits_for_unlock(rig_config, tiny_bank):
    content = {**yaml.safe_load(rig_config.read_text()), "experiment": "experiment.yaml"}
    rig_config.write_text(yaml.safe_dump(content))
    second = spelt_otherwise(second_config(rig_config))
    async with emulated_rig(rig_config.parent, tiny_bank) as rig:
        async with twisting_process(rig_config, rig) as killed:
            async with shearloop("run", str(second)) as refused:
                _, errors = await refused.communicate()
            assert refused.returncode == 2
            assert f"is driven by another program of this computer (process {killed.pid})" in errors.decode()
            killed.kill()
            await killed.wait()
        still = await standing(rig)
        async with running_daemon(second) as daemon:
            watcher, command = Watcher(daemon), partial(ask, daemon)
            await watcher.until("loop.state", lambda state: FaultCode.TOOL_GRIPPED.text in state["faults"])
            await watcher.until("robot.state", lambda _: True)
            await nothing_moves(watcher, rig, still)
            assert "while 'test' was under way" in (await command("start"))["reason"]
            assert (await command("unlock"))["ok"]
            await nothing_moves(watcher, rig, still)


async def test_a_tool_that_is_exchanged_while_no_daemon_runs_has_no_force_and_no_angle(rig_config, tiny_bank):
    content = {**yaml.safe_load(rig_config.read_text()), "experiment": "experiment.yaml"}
    rig_config.write_text(yaml.safe_dump(content))
    async with emulated_rig(rig_config.parent, tiny_bank) as rig:
        async with twisting_process(rig_config, rig) as killed:
            killed.kill()
            await killed.wait()
        await standing(rig)
        await exchange_tool(rig, 40.0)
        async with running_daemon(rig_config) as daemon:
            watcher = Watcher(daemon)
            state = await watcher.until("loop.state", lambda state: FaultCode.GRIP_UNKNOWN.text in state["faults"])
            assert "mm wide, with an unknown force" in state["reasons"]
            assert daemon.rig.control_loop.tool.grip.origin_rad is None


async def test_a_daemon_of_another_user_that_gets_the_arm_after_a_kill_moves_nothing(
    rig_config, tiny_bank, monkeypatch, tmp_path
):
    """It keeps its memory elsewhere: the robot's registers lock it out until the first one is killed."""
    content = {**yaml.safe_load(rig_config.read_text()), "experiment": "experiment.yaml"}
    rig_config.write_text(yaml.safe_dump(content))
    async with emulated_rig(rig_config.parent, tiny_bank) as rig, twisting_process(rig_config, rig) as killed:
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
        async with running_daemon(second_config(rig_config)) as daemon:
            watcher = Watcher(daemon)
            await watcher.until("gripper.state", lambda _: True)
            killed.kill()
            await killed.wait()
            still = await standing(rig)
            await watcher.until("robot.state", lambda _: True)
            await nothing_moves(watcher, rig, still)


async def test_no_grip_begins_that_a_later_daemon_would_not_find(rig_config, tiny_bank, tmp_path, monkeypatch):
    """It would go on with the angle and the zeros of the grip before."""
    second_grip = {"do": "grip", "width_mm": 5, "force_n": 60}
    async with running_rig(rig_config, tiny_bank) as (_, watcher, _order, command):
        await started(watcher, command, experiment(tmp_path, {"do": "release"}, second_grip))
        await watcher.until("gripper.state", lambda state: state["diameter_mm"] is not None)
        (tmp_path / "no-folder").write_text("")
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "no-folder"))
        state = await watcher.until("loop.state", lambda state: state["phase"] == "stopped")
        assert "the fingers were not closed: the rig's state cannot be kept" in state["reasons"]
        seen = watcher.count("gripper.state")
        await watcher.until("gripper.state", lambda state: state["object"] != "moving", seen + 5)
        assert watcher.seen["gripper.state"][-1]["object"] == "at target"
