"""Each recording of one daemon of the whole emulated rig is replayed bit for bit, at any pace of its boards."""

import asyncio
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader

from shearloop.bank.build import build_bank
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.emulators.boards import LOAD_PERIOD_S
from shearloop.emulators.emulated_rig import SIDES
from shearloop.studies.emulated_calibration import SEED, calibrate, record
from shearloop.tools.bank_config import load_bank_plan
from tests.daemon.test_closed_loop import HOST, running_rig, started
from tests.fixtures.daemons import robot_at

pytestmark = [pytest.mark.real_time, pytest.mark.timeout(400)]
COMPUTED = ("eit.frame.right", "eit.frame.left", "eit.estimate.right", "eit.estimate.left", "eit.estimate.combined")
STEPS = (
    {"do": "grip", "width_mm": 5, "force_n": 60},
    {"do": "twist", "angles_rad": [0.05], "speed_rad_per_s": 0.1, "hold_s": 1.0},
    {"do": "release"},
)
# The boards' rated pace takes a minute, and a busy computer several times as long.
PATIENCE_S = 200
# So many frames of each fingertip, at least, between two experiments and within one.
BETWEEN, WITHIN = 3, 6


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

        async def frames(count: int) -> None:
            """Wait for so many further estimates of both fingertips together."""
            first = len(watcher.seen.get("eit.estimate", ()))
            await watcher.until(
                "eit.estimate",
                lambda _: Counter(one["source"] for one in watcher.seen["eit.estimate"][first:])["combined"] >= count,
            )

        await frames(BETWEEN)
        path = config.with_name("experiment.yaml")
        path.write_text(
            yaml.safe_dump({"name": "test", "torque_source": "load_cell", "tool_mm": 20, "steps": [*STEPS]})
        )
        for number in range(3):
            await started(command, str(path))
            await frames(WITHIN)
            state = await watcher.until(
                "loop.state", lambda one, run=number + 1: one["run"] == run and one["phase"] in ("done", "stopped")
            )
            assert state["phase"] == "done", state["activity"]
            if number == 0:
                reply = await command("tare")
                assert reply["ok"], reply
            await frames(BETWEEN)


def count_of(path: Path) -> dict[str, int]:
    """Return the messages by topic, read without this program."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    return {summary.channels[number].topic: n for number, n in summary.statistics.channel_message_counts.items()}


@pytest.mark.parametrize("speed", [1, 30])
def test_recordings_of_three_experiments_and_a_tare(speed, config, files, tmp_path, ran, monkeypatch):
    monkeypatch.setattr("tests.fixtures.daemons.DEADLINE_S", PATIENCE_S)
    robot_at(HOST, tmp_path)
    shared: dict[str, Any] = {"bank": str(files["bank"]), "frame_period_s": FRAME_PERIOD_S / speed}
    path = config(
        emulated=True,
        fingertips={
            side: {
                "device": {"path": f"eit-{side}"},
                "calibration": str(files[side]),
                "estimator": "motion_regression",
                "matching": "zero_lag",
                **shared,
            }
            for side in SIDES
        },
        combined={"calibration": str(files["both"])},
        load_cell={"device": {"path": "load-cell"}, "rate_hz": speed / LOAD_PERIOD_S},
        robot="ur.yaml",
        gripper={"socket": {"host": HOST}},
        loop={"disagreement_nm": 0.2, "max_innovation_nm": 0.3},
        recording={"folder": str(tmp_path / "recordings")},
    )
    asyncio.run(record_experiments(path, files["bank"], speed))
    recordings = sorted((tmp_path / "recordings").iterdir())
    assert len([one for one in recordings if "test" in one.name]) == 3
    for one in recordings:
        counts = count_of(one)
        publish = ("--publish", f"ipc://{tmp_path}/replay")
        out, said = ran("recording", "replay", one, "--speed", "max", *publish, "--check", "--json")
        # The daemon's log stands before it.
        result = json.loads(out.splitlines()[-1])
        assert result["different"] == {}, (one.name, said)
        expected = Counter[str]()
        for topic in (*COMPUTED, "load.torque"):
            assert counts[topic] > 0, (one.name, topic)
            expected[topic if topic == "load.torque" else topic.rpartition(".")[0]] += counts[topic]
        assert {key: result["compared"][key] for key in expected} == expected, one.name
