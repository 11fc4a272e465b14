"""A disk that is full: what runs goes on, nothing new is begun, and with room again nothing is missing."""

import contextlib
from pathlib import Path

import pytest
import yaml

from shearloop.daemon.control.faults import FaultCode
from shearloop.tools.recordings.summary import summarise
from tests.fixtures.rigs import experiment, running_rig, started

pytestmark = pytest.mark.real_time
TWIST = {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.01, "hold_s": 60.0}


@pytest.fixture
def recorded_rig(rig_config, small_disk) -> Path:
    """The whole rig's configuration, with recording on the small disk."""
    config = yaml.safe_load(rig_config.read_text())
    rig_config.write_text(yaml.safe_dump({**config, "recording": {"folder": str(small_disk)}}))
    return rig_config


def fill(disk: Path) -> Path:
    """Write to a file until the disk takes no more, and return it."""
    filler = disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    return filler


def check_recordings(disk: Path, torques: int) -> None:
    """Hold the two experiments' recordings to have all that came, and so many torques at least."""
    recordings = [summarise(path) for path in sorted(disk.glob("*.mcap"))]
    assert [one.experiments for one in recordings] == [["test"], ["test"]]
    assert [one.tool_mm for one in recordings] == ["20", "20"], "as their experiments name it"
    assert not any(one.dropped for one in recordings)
    # The second was stopped at once.
    found = [one.topics["load.torque"].messages for one in recordings if "load.torque" in one.topics]
    assert sum(found) >= torques


@pytest.mark.parametrize("small_disk", ["8m"], indirect=True)
async def test_a_full_disk_refuses_only_the_next_experiment(recorded_rig, tiny_bank, tmp_path, small_disk):
    async with running_rig(recorded_rig, tiny_bank) as (_, watcher, _fault, command):
        path = experiment(tmp_path, TWIST)
        await started(watcher, command, path)
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        filler = fill(small_disk)
        health = await watcher.until("health", lambda health: bool(health["tasks"]["recording"]["error"]))
        assert "No space left on device" in health["tasks"]["recording"]["error"]
        # What runs goes on. (A busy computer may hold the wrist for a moment meanwhile, as it must.)
        await watcher.until(
            "loop.state",
            lambda state: FaultCode.RECORDING_FAILED.text in state["faults"] and state["phase"] == "running",
        )
        seq = watcher.seen["robot.state"][-1]["seq"]
        await watcher.until(
            "robot.state", lambda state: state["seq"] > seq + 5 and state["wrist_speed_rad_per_s"] > 0.005
        )
        assert (await command("stop"))["stopped"] == "test"
        while not (await command("unlock"))["ok"]:
            pass
        refused = await command("start", experiment=path)
        assert not refused["ok"]
        assert FaultCode.RECORDING_FAILED.value.kind in refused["reason"]
        assert "No space left on device" in refused["reason"]
        filler.unlink()
        unwritten = FaultCode.RECORDING_FAILED.value.kind
        while unwritten in (reply := await command("start", experiment=path, confirmed=True)).get("reason", ""):
            # It is tried again three times a second.
            heard = len(watcher.seen["health"])
            await watcher.until("health", lambda health, heard=heard: health["seq"] >= heard)
        assert reply["ok"], reply
        torques = len(watcher.seen["load.torque"])
        assert (await command("stop"))["stopped"] == "test"
    # What waited for room was written.
    check_recordings(small_disk, torques)
