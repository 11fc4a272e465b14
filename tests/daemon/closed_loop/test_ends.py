"""The end of a daemon over real ports: asked for in mid-experiment, and with its experiment."""

from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
import yaml

from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.run_summary import RunSummary
from tests.fixtures.rigs import running_rig

pytestmark = pytest.mark.real_time

BY_ITSELF = {"emulated": True, "autostart": True, "stop_when_done": True}


def ending_with(rig_config: Path, *steps: Mapping[str, Any]) -> Path:
    """Return a configuration whose experiment, of these steps, begins by itself and ends the daemon."""
    path, folder = rig_config.with_name("ending.yaml"), rig_config.parent
    (folder / "own.yaml").write_text(
        yaml.safe_dump({"name": "own", "torque_source": "wrench", "steps": [*map(dict, steps)]})
    )
    content = yaml.safe_load(rig_config.read_text())
    path.write_text(yaml.safe_dump({**content, **BY_ITSELF, "experiment": "own.yaml"}))
    return path


async def test_a_daemon_that_is_ended_during_an_experiment_stops_the_arm_and_reports_the_end(
    rig_config, tiny_bank, log
):
    out = StringIO()
    path = ending_with(rig_config, {"do": "release"}, {"do": "turn_to", "angle_rad": 3.0, "speed_rad_per_s": 0.2})
    async with running_rig(path, tiny_bank) as (daemon, watcher, _cause, _command):
        daemon.publisher.add_listener(RunSummary(out))
        await watcher.until("robot.state", lambda state: abs(state["wrist_speed_rad_per_s"]) > 0.1)
        daemon.stop()
        await daemon.ending.wait()
    why = "the daemon ended: the wrist is stopped, a gripped tool stays gripped"
    assert not daemon.finished
    assert (watcher.seen["loop.state"][-1]["phase"], watcher.seen["loop.state"][-1]["activity"]) == ("stopped", why)
    assert "stopped as asked" in out.getvalue()
    assert f"  {why}\n" in out.getvalue()
    assert "the experiment has ended" in log.said


async def test_a_daemon_that_ends_with_its_experiment_lets_the_tool_go_first(rig_config, tiny_bank):
    """The stop that opens the gripper ends the experiment, and that the daemon, within the same millisecond."""
    twist = {"do": "twist", "angles_rad": [0.3], "speed_rad_per_s": 0.1, "limits": {"torque_nm": 0.1}}
    grip = {"do": "grip", "width_mm": 5, "force_n": 60}
    path = ending_with(rig_config, {"do": "release"}, {"do": "tare"}, grip, twist)
    async with running_rig(path, tiny_bank) as (daemon, watcher, _cause, _command):
        await daemon.ending.wait()
    assert not daemon.finished
    states = watcher.seen["gripper.state"]
    assert FaultCode.TORQUE_LIMIT.text in watcher.seen["loop.state"][-1]["faults"]
    held_mm = [state["diameter_mm"] for state in states if state["diameter_mm"] is not None][-1]
    assert states[-1]["width_mm"] > held_mm + 5.0
