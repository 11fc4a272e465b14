"""Stops by the robot, the gripper and the pendant over real ports, and what an operator's unlocking does."""

import time
from typing import Any

import pytest

from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.control.loop_runner import ControlLoopRunner
from shearloop.daemon.control.operator_action import MotionPermit
from shearloop.daemon.messaging.deadlines import Deadline
from shearloop.drivers.robotiq.socket_client import SocketClient
from tests.fixtures.rigs import SLOW_TWIST, experiment, pendant, running_rig, started

pytestmark = pytest.mark.real_time


async def test_a_protective_stop_ends_the_experiment_and_the_operator_unlocks_it(rig_config, tiny_bank, tmp_path):
    async with running_rig(rig_config, tiny_bank) as (daemon, watcher, fault, command):
        path = experiment(tmp_path, SLOW_TWIST)
        await started(watcher, command, path)
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.01)
        fault("protective-stop")
        state = await watcher.until("loop.state", lambda state: state["phase"] == "stopped")
        assert FaultCode.PROTECTIVE_STOP.text in state["faults"]
        refused = await command("start", experiment=path)
        assert not refused["ok"]
        reply = await command("unlock")
        while not reply["ok"]:
            reply = await command("unlock")
        with pytest.raises(
            AssertionError, match=r"step 1 \(release\) opens the gripper, and a tool in it drops; its fingers"
        ):
            await started(watcher, command, path)
        await started(watcher, command, path, confirmed=True)
        assert (await command("pause"))["ok"]
        assert (await command("resume"))["ok"]
        turning = watcher.seen["robot.state"][-1]["seq"]
        await watcher.until(
            "robot.state", lambda state: state["seq"] > turning and state["wrist_speed_rad_per_s"] > 0.01
        )
        # As the page's stop: a second one leaves the daemon running.
        assert (await command("stop", spare_daemon=True))["stopped"] == "test"
        last = watcher.seen["robot.state"][-1]["seq"]
        still = await watcher.until(
            "robot.state", lambda state: state["seq"] > last and abs(state["wrist_speed_rad_per_s"]) < 1e-3
        )
        later = await watcher.until("robot.state", lambda state: state["seq"] > still["seq"] + 10)
        assert later["wrist_rad"] == pytest.approx(still["wrist_rad"], abs=1e-3)
        assert (await command("stop", spare_daemon=True))["stopped"] == ""
        await watcher.until("robot.state", lambda state: state["seq"] > later["seq"])
        assert not daemon.supervisor.records["loop"].restarts


async def test_a_program_that_does_not_start_is_named_by_answer_and_state(rig_config, tiny_bank, tmp_path):
    async with running_rig(rig_config, tiny_bank) as (_, watcher, fault, command):
        await started(watcher, command, experiment(tmp_path, SLOW_TWIST))
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        fault("drop-scripts")
        fault("stop")
        await watcher.until("loop.state", lambda state: "stopped at the pendant" in state["cause"])
        # A worker gives up after some seconds; what is sent while a new one begins is refused at once.
        while "does not play it" not in (reply := await command("unlock"))["reason"]:
            await watcher.next("health", watcher.count("health"))
        assert reply["reason"].startswith("The controller took the control program and does not play it: look at the")
        for code in (FaultCode.ROBOT_LOST, FaultCode.ROBOT_STARTING):
            since = watcher.count("loop.state")
            state = await watcher.until(
                "loop.state",
                lambda state, code=code: code.text in state["faults"] and "does not play it" in state["cause"],
                since,
            )
            assert "stopped at the pendant" in state["reasons"], "what stopped it before is known too"
        fault("normal")
        while not (reply := await command("unlock"))["ok"]:
            await watcher.next("health", watcher.count("health"))


async def test_an_unlock_after_a_fault_of_the_gripper_asks_before_it_drops_the_tool(rig_config, tiny_bank, tmp_path):
    async with running_rig(rig_config, tiny_bank) as (_, watcher, fault, command):
        await started(watcher, command, experiment(tmp_path, SLOW_TWIST))
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        fault("gripper fault 14")
        await watcher.until("loop.state", lambda state: FaultCode.GRIPPER_FAULT.text in state["faults"])
        held_mm = watcher.seen["gripper.state"][-1]["width_mm"]
        refused = await command("unlock")
        assert "which opens its fingers, and a tool in it drops; its fingers hold something" in refused["reason"]
        assert "with at most 60 N" in refused["question"]
        seen = len(watcher.seen["gripper.state"])
        await watcher.until("gripper.state", lambda _: len(watcher.seen["gripper.state"]) > seen + 5)
        assert watcher.seen["gripper.state"][-1]["width_mm"] == held_mm
        reply = await command("unlock", confirmed=True, digest=refused["digest"])
        while not reply["ok"]:
            reply = await command("unlock", confirmed=True)
        assert watcher.seen["gripper.state"][-1]["width_mm"] > held_mm + 50


async def test_a_pendant_that_commands_the_gripper_stops_the_twist_and_its_grips_are_seen(
    rig_config, tiny_bank, tmp_path
):
    async with running_rig(rig_config, tiny_bank) as (_, watcher, _fault, command):
        await started(watcher, command, experiment(tmp_path, SLOW_TWIST))
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        await pendant("SET POS 250")
        state = await watcher.until("loop.state", lambda state: state["phase"] == "stopped")
        assert state["cause"].startswith(FaultCode.GRIPPER_COMMANDED.value.kind)
        assert "nothing between them" not in state["reasons"]
        await watcher.until("loop.state", lambda state: FaultCode.TOOL_GRIPPED.text in state["faults"])
        stop = await watcher.until("loop.stop", lambda _: True)
        # A frame during the motion has no estimate.
        assert stop["faults"].split(", ")[0] == FaultCode.GRIPPER_COMMANDED.text
        reply = await command("release", ask=True)
        while not reply["ok"]:
            reply = await command("release", ask=True)
        question = reply["question"]
        assert "its fingers hold something 19." in question or "its fingers hold something 20." in question
        assert "with an unknown force" in question
        assert (await command("unlock"))["ok"]
        for position, status in ((0, "at target"), (240, "contact closing")):
            last = watcher.seen["gripper.state"][-1]["seq"]
            await pendant(f"SET POS {position}")
            # The state after the request may be from before it.
            moving = await watcher.until(
                "gripper.state", lambda state, last=last: state["seq"] > last and state["object"] == "moving"
            )
            stands = await watcher.until(
                "gripper.state", lambda state, last=moving["seq"]: state["seq"] > last and state["object"] != "moving"
            )
            assert stands["object"] == status
        assert stands["diameter_mm"] == pytest.approx(20.0, abs=1.0)
        assert "its fingers hold something" in (await command("tare", confirmed=True))["reason"]


async def test_a_release_from_before_the_daemon_stood_still_opens_nothing(rig_config, tiny_bank, tmp_path, monkeypatch):
    """It is read in time, and the process stands still before the gripper's answer."""
    async with running_rig(rig_config, tiny_bank) as (daemon, watcher, _fault, command):
        await started(watcher, command, experiment(tmp_path))
        await watcher.until("loop.state", lambda state: state["phase"] == "done")
        await watcher.next("gripper.state", watcher.count("gripper.state"))
        held = watcher.seen["gripper.state"][-1]
        read = SocketClient.read

        async def read_late(client: SocketClient, **given: Any) -> Any:
            monkeypatch.setattr(SocketClient, "read", read)
            time.sleep(1.0)  # noqa: ASYNC251 - the process stands still
            return await read(client, **given)

        permit = ControlLoopRunner.permit

        def permit_before_standstill(runner: ControlLoopRunner, deadline: Deadline) -> MotionPermit:
            monkeypatch.setattr(ControlLoopRunner, "permit", permit)
            monkeypatch.setattr(SocketClient, "read", read_late)
            return permit(runner, deadline)

        monkeypatch.setattr(ControlLoopRunner, "permit", permit_before_standstill)
        until_ns = daemon.commands.now_ns() + 500_000_000
        reply = await command("release", confirmed=True, until_ns=until_ns)
        assert not reply["ok"], reply
        assert "the request had expired" in reply["reason"]
        for _ in range(5):
            await watcher.next("gripper.state", watcher.count("gripper.state"))
            assert watcher.seen["gripper.state"][-1]["width_mm"] == held["width_mm"]
        assert (await command("release", confirmed=True))["ok"]
        await watcher.until("gripper.state", lambda state: state["width_mm"] > held["width_mm"] + 20)
