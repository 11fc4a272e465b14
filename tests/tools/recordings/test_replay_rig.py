"""Each recording of one daemon of the whole emulated rig is replayed bit for bit, at any pace of its boards."""

import asyncio
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from shearloop.bank.build import build_bank
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.drivers.serial_sensor import InputKind
from shearloop.emulators.boards import LOAD_PERIOD_S
from shearloop.emulators.emulated_rig import SIDES
from shearloop.estimation.session import FINGERS_MOVED
from shearloop.studies.emulated_calibration import SEED, calibrate, record
from shearloop.tools.bank_config import load_bank_plan
from tests.fixtures.daemons import robot_at
from tests.fixtures.rigs import HOST, running_rig, started

pytestmark = [pytest.mark.real_time, pytest.mark.timeout(600)]
SOURCES = {"eit.frame": ("right", "left"), "eit.estimate": ("right", "left", "combined"), "load.torque": ("load_cell",)}
GRIP = {"do": "grip", "width_mm": 5, "force_n": 60, "speed_mm_per_s": 150}
TWIST = {"do": "twist", "angles_rad": [0.05], "speed_rad_per_s": 0.2, "hold_s": 0.1}
RELEASE = {"do": "release", "width_mm": 30}
# By the boards' pace. A twist waits for the torques of several frames, which would take long at the rated pace.
STEPS = {1: (GRIP, RELEASE), 30: ({"do": "tare"}, GRIP, TWIST, RELEASE)}
IDLE_FRAMES = 3
TAKEN = f"taking the idle frame, {IDLE_FRAMES} of {IDLE_FRAMES}"
# A busy computer takes several times as long as an idle one.
PATIENCE_S = 200
# So many estimates of both fingertips together, at least, come before, between and within the experiments.
BETWEEN, WITHIN = 2, 4
# A load cell's zero is of 22 readings after four that settle.
ZERO_READINGS = 30

Contents = dict[str, list[dict[str, Any]]]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    """A coarse bank of the emulated fingertips, and the calibrations of both together and of each."""
    folder = tmp_path_factory.mktemp("rig")
    plan = yaml.safe_load(Path("config/banks/demo.yaml").read_text())
    fingertip = (Path("config/banks") / plan["fingertip"]).resolve()
    coarse = {axis: {**plan[axis], "count": 24} for axis in ("k", "sigma")}
    (folder / "bank.yaml").write_text(yaml.safe_dump({**plan, **coarse, "fingertip": str(fingertip)}))
    paths = {"bank": folder / "rig.bank"}
    build_bank(*load_bank_plan(folder / "bank.yaml"), paths["bank"], jobs=1)
    recordings = list(record(paths["bank"], SEED, (20.0,)))
    for name, sides in {"both": tuple(SIDES), **{side: (side,) for side in SIDES}}.items():
        paths[name] = folder / f"{name}.cal"
        calibrate(recordings, sides).save(paths[name])
    return paths


async def record_experiments(config: Path, bank: Path, speed: int) -> None:
    """Run a daemon through three experiments, with a tare after the first; frames come before, within and after."""
    async with running_rig(config, bank, speed) as (_, watcher, _fault, command):

        async def further(topic: str, source: str, count: int) -> None:
            """Wait for so many further messages of a source."""
            first = len(watcher.seen.get(topic, ()))
            await watcher.until(
                topic, lambda _: sum(one["source"] == source for one in watcher.seen[topic][first:]) >= count
            )

        await further("eit.estimate", "combined", BETWEEN)
        path = config.with_name("experiment.yaml")
        content = {"name": "test", "torque_source": "load_cell", "tool_mm": 20, "steps": [*STEPS[speed]]}
        path.write_text(yaml.safe_dump(content))
        for run in (1, 2, 3):
            await started(watcher, command, str(path))
            await further("eit.estimate", "combined", WITHIN)
            state = await watcher.until(
                "loop.state", lambda one, run=run: one["run"] == run and one["phase"] in ("done", "stopped")
            )
            if state["phase"] == "stopped":
                # On a busy computer boards as fast as these lose frames. Such a recording replays all the same.
                assert speed > 1, state["activity"]
                assert (reply := await command("unlock"))["ok"], reply
                assert (reply := await command("release", confirmed=True))["ok"], reply
            if run == 1:
                tared = watcher.count("eit.estimate")
                reply = await command("tare")
                assert reply["ok"], reply
                await further("load.torque", "load_cell", ZERO_READINGS)
                for source in SOURCES["eit.estimate"]:
                    await watcher.until(
                        "eit.estimate",
                        lambda one, source=source: (one["source"], one["reason"]) == (source, TAKEN),
                        first=tared,
                    )
            await further("eit.estimate", "combined", BETWEEN)


def contents(path: Path) -> Contents:
    """Return what the topics hold, read without this program."""
    found: Contents = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append(json.loads(message.data))
    return found


def early_frames(found: Contents, side: str) -> int:
    """Return how many frames of a side arrived before the file's first input of it."""
    first_ns = min(one["t_mono_ns"] for one in found[f"input.{side}"] if one["kind"] == InputKind.DATA.value)
    arrivals_ns = [frame["t_mono_ns"] + round(frame["age_s"] * 1e9) for frame in found[f"eit.frame.{side}"]]
    return sum(arrival_ns < first_ns for arrival_ns in arrivals_ns)


def check_replay(path: Path, found: Contents, result: dict[str, Any]) -> None:
    """Hold a replay to have compared every message that follows from the file's own inputs."""
    early = result["before_state"]
    assert result["different"] == {}, (path.name, result)
    for topic, sources in SOURCES.items():
        counts = {
            source: len(found["load.torque" if source == "load_cell" else f"{topic}.{source}"]) for source in sources
        }
        assert all(counts.values()), (path.name, topic, counts)
        left_out = sum(early.get(f"{topic}.{source}", 0) for source in sources)
        assert result["compared"][topic] == sum(counts.values()) - left_out, (path.name, topic, early)
    assert "load.torque.load_cell" not in early
    for side in SIDES:
        assert early.get(f"eit.frame.{side}", 0) == early_frames(found, side), (path.name, early)
        # Its estimate is published before a frame, perhaps in the file before.
        assert early.get(f"eit.estimate.{side}", 0) <= early_frames(found, side), (path.name, early)
    assert early.get("eit.estimate.combined", 0) < len(found["eit.estimate.combined"]) / 2, (path.name, early)


def count_moved(found: Contents, period_s: float) -> int:
    """Hold every estimate to be void that is of a frame during which the gripper's states show motion; count them."""
    # The first state of a motion may have been asked for before the command.
    moving_ns = np.array(
        [
            one["t_mono_ns"]
            for before, one in pairwise(found["gripper.state"])
            if before["object"] == one["object"] == "moving"
        ]
    )
    moved = 0
    for side in SIDES:
        for one in found[f"eit.estimate.{side}"]:
            if (np.abs(moving_ns - one["t_mono_ns"]) < 0.49e9 * period_s).any():
                assert not one["valid"], one
                assert FINGERS_MOVED in one["reason"] or "the same frame again" in one["reason"], one
                moved += 1
    return moved


@pytest.mark.parametrize("speed", [1, 30])
def test_recordings_of_three_experiments_and_a_tare(speed, config, files, tmp_path, ran, monkeypatch):
    monkeypatch.setattr("tests.fixtures.daemons.DEADLINE_S", PATIENCE_S)
    robot_at(HOST, tmp_path)
    shared: dict[str, Any] = {
        "bank": str(files["bank"]),
        "matching": "zero_lag",
        "estimator": "motion_regression",
        "frame_period_s": FRAME_PERIOD_S / speed,
        "baseline_frames": IDLE_FRAMES,
    }
    path = config(
        emulated=True,
        fingertips={
            side: {"device": {"path": f"eit-{side}"}, "calibration": str(files[side]), **shared} for side in SIDES
        },
        combined={"calibration": str(files["both"])},
        load_cell={"device": {"path": "load-cell"}, "rate_hz": speed / LOAD_PERIOD_S},
        robot="ur.yaml",
        gripper={"model": "2F-140", "socket": {"host": HOST}},
        loop={"disagreement_nm": 0.2, "max_innovation_nm": 0.3},
        recording={"folder": str(tmp_path / "recordings")},
    )
    asyncio.run(record_experiments(path, files["bank"], speed))
    recordings = sorted((tmp_path / "recordings").iterdir())
    assert ["test" in one.name for one in recordings] == [True] * 3
    found = {one: contents(one) for one in recordings}
    for one in recordings:
        publish = ("--publish", f"ipc://{tmp_path}/replay")
        out = ran("recording", "replay", one, "--speed", "max", *publish, "--check", "--json").out
        # The daemon's log stands before it.
        check_replay(one, found[one], json.loads(out.splitlines()[-1]))
    moved = [count_moved(content, FRAME_PERIOD_S / speed) for content in found.values()]
    # Frames as fast as 30 times fall between two states of the gripper.
    assert speed > 1 or sum(moved) >= len(SIDES)
    if TWIST in STEPS[speed]:
        assert any(row["valid"] for content in found.values() for row in content["eit.estimate.combined"])
