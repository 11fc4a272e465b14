"""The skin recorded by a running daemon, with faults and tares, and replayed from its raw inputs."""

import asyncio
import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from shearloop.tools.recordings.tables import RecordedTopics
from tests.daemon.sensing.test_skin_run import played
from tests.tools.recordings.test_replay import measured, replayed

# The daemon publishes at least one force for each push.
PUSHES, FORCES_AFTER_STATE = 20, 5


async def recorded(
    folder: Path, *, socket: bool, average_s: float, experiments: Sequence[str] = ()
) -> list[tuple[str, dict[str, Any]]]:
    """Return what a daemon published while a skin was loaded, tared and ill-treated, all of it recorded."""
    published: list[tuple[str, dict[str, Any]]] = []
    recording = {"recording": {"folder": "recordings"}}
    async with played(folder, socket=socket, average_s=average_s, daemon=recording) as bench:
        bench.daemon.publisher.add_listener(lambda topic, content: published.append((topic, content)))
        await bench.valid()
        for name in experiments:
            # A file begins with an experiment, unless the current one has none.
            bench.daemon.recorder.record_experiment(name)
            bench.fresh()
            # The file's state comes with its first input; what follows is compared.
            for _ in range(FORCES_AFTER_STATE):
                await bench.valid()
        for number in range(PUSHES):
            bench.skin.push(0.8 * number / (PUSHES - 1))
            await bench.shear.get()
        await bench.until(lambda content: content["valid"] and content["shear_n"] > 0.6)
        bench.instruments.command("open 1")
        await bench.says("gauge 1 is open")
        bench.instruments.command("normal")
        await bench.valid()
        bench.skin.push(0.0)
        await bench.until(lambda content: content["valid"] and abs(content["response"]) < 0.01)
        bench.fresh()
        assert (await bench.command("tare", source="skin"))["ok"]
        await bench.says("taking the zero")
        bench.instruments.command("daq unplug 0.05")
        await bench.until(lambda content: content["missed"] > 3)
        bench.instruments.command("daq normal")
        bench.fresh()
        await bench.valid()
    return published


def test_a_later_file_continues_to_count_samples(tmp_path):
    live = asyncio.run(recorded(tmp_path, socket=True, average_s=0.0, experiments=("first", "second")))
    (later,) = (path for path in (tmp_path / "recordings").iterdir() if "second" in path.name)
    again, _ = asyncio.run(replayed(later, math.inf))
    then, now = (
        {content["t_mono_ns"]: content["sample"] for topic, content in run if topic == "skin.shear"}
        for run in (live, again)
    )
    assert min(now.values()) > 0
    assert len(now.keys() & then.keys()) >= PUSHES
    assert [now[t_ns] for t_ns in now if t_ns in then] == [then[t_ns] for t_ns in now if t_ns in then]


@pytest.mark.parametrize(("socket", "average_s"), [(False, 0.02), (True, 0.0)])
def test_a_skin_replay_gives_equal_forces(tmp_path, socket, average_s, ran):
    live = asyncio.run(recorded(tmp_path, socket=socket, average_s=average_s))
    times_ns = [content["t_mono_ns"] for topic, content in live if topic == "skin.shear" and content["valid"]]
    assert median(after - before for before, after in pairwise(times_ns)) > 0.6e9 * average_s
    (path,) = (tmp_path / "recordings").iterdir()
    assert {"skin.shear", "input.skin", "input.skin.source", "input.skin.daq"} <= set(RecordedTopics(path).counts)
    again, comparison = asyncio.run(replayed(path, math.inf))
    assert comparison.different == Counter(), comparison.examples
    assert comparison.compared["skin.shear"] > 50
    then, now = (measured([one for one in run if one[0] == "skin.shear"]) for run in (live, again))
    begin = next(i for i, (_, content) in enumerate(now) if content["sample"] == then[0][1]["sample"])
    assert now[begin : begin + len(then)] == then
    reasons = {content["reason"].split(",")[0] for _, content in now}
    assert {"", "taking the zero"} <= reasons
    assert any("gauge 1 is open" in why for why in reasons)
    said = ran("recording", "replay", path, "--speed", "max", "--publish", f"ipc://{tmp_path}/replay", "--check").err
    count = comparison.compared["skin.shear"]
    assert f"skin.shear: {count} of {count} equal the recorded ones" in said


@pytest.mark.parametrize(("socket", "average_s"), [(False, 0.02), (True, 0.0)])
def test_each_of_a_daemons_recordings_gives_equal_forces(tmp_path, socket, average_s):
    asyncio.run(recorded(tmp_path, socket=socket, average_s=average_s, experiments=("first", "second", "third")))
    paths = list((tmp_path / "recordings").iterdir())
    assert {path.stem.rpartition("_")[2] for path in paths} == {"first", "second", "third"}
    for path in paths:
        _, comparison = asyncio.run(replayed(path, math.inf))
        assert comparison.different == Counter(), (path, comparison.examples)
        # The pushes are in the third.
        assert comparison.compared["skin.shear"] >= (PUSHES if "third" in path.stem else 1)


def test_a_zero_that_was_given_up_early_is_given_up_in_the_replay(tmp_path):
    async def record() -> None:
        async with played(tmp_path, daemon={"recording": {"folder": "recordings"}}) as bench:
            await bench.valid()
            bench.instruments.command("open 1")
            await bench.says("gauge 1 is open")
            why_not = await bench.daemon.sensors.tareable["skin"].tare_and_wait(0.05)
            assert "could not be taken within 0.05 s" in (why_not or "")
            bench.instruments.command("normal")
            await bench.says("no zero: it took too long")
            assert (await bench.command("tare", source="skin"))["ok"]
            await bench.valid()

    asyncio.run(record())
    (path,) = (tmp_path / "recordings").iterdir()
    again, comparison = asyncio.run(replayed(path, math.inf))
    assert comparison.different == Counter(), comparison.examples
    assert any("no zero" in content["reason"] for topic, content in again if topic == "skin.shear")
