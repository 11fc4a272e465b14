"""A whole twist over real ports, and the wrist that a lost sensor holds."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from shearloop.daemon.control.faults import FaultCode
from shearloop.estimation import Calibration
from tests.fixtures.rigs import SLOW_TWIST, experiment, running_rig, started

pytestmark = pytest.mark.real_time


async def test_a_tool_is_gripped_twisted_released_and_left(rig_config, tiny_bank, tmp_path):
    twist = {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.3, "hold_s": 1.0}
    leave = {"do": "approach", "along_tool_m": -0.03, "speed_m_per_s": 0.05}
    # The daemon activates the gripper.
    async with running_rig(rig_config, tiny_bank, activated=False) as (_, watcher, fault, command):
        fault("robot wrench-error 0")
        seen = len(watcher.seen["robot.state"])
        await started(watcher, command, experiment(tmp_path, twist, {"do": "release"}, leave))
        state = await watcher.until("loop.state", lambda state: state["phase"] in ("done", "stopped"))
    assert state["phase"] == "done", state["activity"]
    torques = [message["torque_nm"] for message in watcher.seen["load.torque"]]
    # Gel and joint in series, and what a held gel loses.
    assert max(torques) == pytest.approx(0.1 * 0.8 * 20 / 20.8, rel=0.1)
    assert abs(torques[-1]) < 0.01
    held = [message["diameter_mm"] for message in watcher.seen["gripper.state"] if message["diameter_mm"] is not None]
    assert held[-1] == pytest.approx(20.0, abs=1.0)
    valid = [message["torque_nm"] for message in watcher.seen["eit.estimate"] if message["valid"]]
    assert max(valid) == pytest.approx(max(torques), abs=0.03)
    exact = watcher.seen["robot.state"][seen + 10 :]
    wrench = max(abs(message["wrist_torque_nm"]) for message in exact if message["wrist_torque_valid"])
    assert wrench == pytest.approx(max(torques), rel=0.1)
    heights_m = [np.frombuffer(message["tcp_pose"], "<f4")[2] for message in watcher.seen["robot.state"]]
    assert max(heights_m) - heights_m[0] == pytest.approx(0.03, abs=0.005)


async def test_a_board_that_is_unplugged_holds_the_wrist(rig_config, tiny_bank, tmp_path):
    async with running_rig(rig_config, tiny_bank) as (_, watcher, fault, command):
        await started(watcher, command, experiment(tmp_path, SLOW_TWIST))
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        fault("unplug load")
        state = await watcher.until("loop.state", lambda state: FaultCode.SENSOR_LOST.text in state["faults"])
        assert state["phase"] in ("held", "stopped")
        assert state["speed_command_rad_per_s"] == 0.0


def driven_by_right(folder: Path, name: str, tool_mm: float | None, *steps: Mapping[str, Any]) -> str:
    """Write an experiment that states a tool, or none, and takes these steps."""
    path, content = folder / f"{name}.yaml", {"name": name, "torque_source": "right", "steps": [*map(dict, steps)]}
    path.write_text(yaml.safe_dump(content if tool_mm is None else {**content, "tool_mm": tool_mm}))
    return str(path)


async def test_another_tool_than_the_calibrated_one_does_not_start_and_an_unknown_one_is_said(
    rig_config, tiny_bank, tmp_path
):
    calibration = tmp_path / "rig.cal"
    replace(Calibration.load(calibration), tool_mm=20.0).save(calibration)
    begin = {"do": "release"}, {"do": "tare"}, {"do": "grip", "width_mm": 5, "force_n": 60}
    twist = {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.3, "hold_s": 1.0}
    unstated = driven_by_right(tmp_path, "unstated", None, *begin, twist)
    stated, another = (driven_by_right(tmp_path, f"of-{mm}", mm, twist) for mm in (20, 40))
    unknown = "the tool's diameter is not known, and the torque of right holds for a tool of 20 mm alone"
    async with running_rig(rig_config, tiny_bank) as (_, watcher, _fault, command):
        await started(watcher, command, unstated)
        await watcher.until("loop.state", lambda state: unknown in state["torque_note"])
        await watcher.until("loop.state", lambda state: state["phase"] in ("done", "stopped"))
        for request in ({}, {"ask": True}):
            reply = await command("start", experiment=another, **request)
            assert "right has no torque on this tool: the tool has 40 mm" in reply["reason"]
        assert unknown in str((await command("start", experiment=unstated, ask=True))["plan"])
        seen = watcher.count("loop.state")
        await started(watcher, command, stated)
        state = await watcher.until("loop.state", lambda state: state["phase"] in ("done", "stopped"), seen + 1)
    assert state["phase"] == "done", state["activity"]
    assert state["torque_note"] == ""
