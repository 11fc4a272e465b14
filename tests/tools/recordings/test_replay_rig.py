"""Each recording of one daemon of the whole emulated rig is replayed bit for bit, at any pace of its boards."""

import asyncio
import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.emulators.boards import LOAD_PERIOD_S
from shearloop.emulators.emulated_rig import SIDES
from shearloop.studies.emulated_calibration import SEED, calibrate, record
from tests.daemon.test_closed_loop import HOST, experiment, running_rig, started
from tests.fixtures.daemons import robot_at

pytestmark = [pytest.mark.real_time, pytest.mark.timeout(240)]
COMPUTED = ("eit.frame.right", "eit.frame.left", "eit.estimate.right", "eit.estimate.left", "eit.estimate.combined")
TWIST = {"do": "twist", "angles_rad": [0.05], "speed_rad_per_s": 0.1, "hold_s": 1.0}
# So many frames of each fingertip, at least, between two experiments and within one.
BETWEEN, WITHIN = 3, 6


@pytest.fixture(scope="module")
def calibrations(tiny_bank, tmp_path_factory) -> dict[str, Path]:
    """Calibrations of both fingertips together and of each, from a recording of the emulated rig."""
    folder, recordings = tmp_path_factory.mktemp("rig"), list(record(tiny_bank, SEED, (20.0,)))
    paths = {}
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
        path = experiment(config.parent, TWIST, {"do": "release"})
        for number in range(3):
            await started(command, path)
            run = len(watcher.seen["loop.state"])
            await frames(WITHIN)
            state = await watcher.until(
                "loop.state", lambda one, run=run: one["seq"] >= run and one["phase"] in ("done", "stopped")
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
def test_recordings_of_three_experiments_and_a_tare(speed, config, tiny_bank, calibrations, tmp_path, ran):
    robot_at(HOST, tmp_path)
    shared: dict[str, Any] = {"bank": str(tiny_bank), "frame_period_s": FRAME_PERIOD_S / speed}
    path = config(
        emulated=True,
        fingertips={
            side: {
                "device": {"path": f"eit-{side}"},
                "calibration": str(calibrations[side]),
                "estimator": "motion_regression",
                "matching": "zero_lag",
                **shared,
            }
            for side in SIDES
        },
        combined={"calibration": str(calibrations["both"])},
        load_cell={"device": {"path": "load-cell"}, "rate_hz": speed / LOAD_PERIOD_S},
        robot="ur.yaml",
        gripper={"socket": {"host": HOST}},
        loop={"disagreement_nm": 0.2, "max_innovation_nm": 0.3},
        recording={"folder": str(tmp_path / "recordings")},
    )
    asyncio.run(record_experiments(path, tiny_bank, speed))
    recordings = sorted((tmp_path / "recordings").iterdir())
    assert len([one for one in recordings if "test" in one.name]) == 3
    for one in recordings:
        counts = count_of(one)
        publish = ("--publish", f"ipc://{tmp_path}/replay")
        out, said = ran("recording", "replay", one, "--speed", "max", *publish, "--check", "--json")
        result = json.loads(out)
        assert result["different"] == {}, (one.name, said)
        expected = Counter[str]()
        for topic in (*COMPUTED, "load.torque"):
            assert counts[topic] > 0, (one.name, topic)
            expected[topic if topic == "load.torque" else topic.rpartition(".")[0]] += counts[topic]
        assert {key: result["compared"][key] for key in expected} == expected, one.name
