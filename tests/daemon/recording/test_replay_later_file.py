"""The file of a further experiment, which begins in the middle of a run, replayed by itself."""

import asyncio
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from shearloop.bank.estimation import Measured
from shearloop.daemon.control.gripper_task import GripperTask
from shearloop.daemon.recording.replay import RecordedRun
from shearloop.daemon.sensing.estimators import LiveEstimator
from tests.daemon.recording.test_replay import Gripper, recording_daemon, replayed

OTHER_TOOL = Measured(14.0, 0.5)
# The frames after which another tool is held, a further experiment is begun, and a zero is taken.
HELD, BEGUN, ZEROED, ENOUGH = 6, 12, 18, 40


async def record(config: Path) -> list[dict[str, Any]]:
    """Run a daemon through two experiments; return what was published as estimates."""
    async with recording_daemon(config) as (daemon, published, until):
        recorder, right = daemon.recorder, daemon.sensors.fingertips["right"].estimates
        assert recorder is not None
        right._gripper = cast(GripperTask, Gripper(right, OTHER_TOOL, range(HELD, 10 * ENOUGH)))
        recorder.record_experiment("first")
        await until(BEGUN)
        recorder.record_experiment("second")
        await until(ZEROED)
        right.tare()
        await until(ENOUGH)
    return [content for topic, content in published if topic == "eit.estimate"]


def test_a_later_file_replays_frame_numbers_tares_and_tools(
    config: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = asyncio.run(record(config(recording={"folder": "recordings"})))
    (later,) = (path for path in (tmp_path / "recordings").iterdir() if "second" in path.name)
    ((zeroed,),) = RecordedRun(later).replay_events().tares.values()
    assert zeroed >= ZEROED
    held: list[object] = []
    monkeypatch.setattr(LiveEstimator, "set_tool", lambda _self, tool: held.append(tool))
    again, _ = asyncio.run(replayed(later, math.inf))
    assert held == [OTHER_TOOL], "which was told before the file began"
    estimates = {content["frame"]: content for topic, content in again if topic == "eit.estimate"}
    assert min(estimates) >= BEGUN
    said = ("reason", "valid", "k", "sigma", "score", "torque_nm")
    after = [one for one in live if one["frame"] >= zeroed]
    assert len(after) > ENOUGH - ZEROED - 10
    for one in after:
        assert [estimates[one["frame"]][key] for key in said] == [one[key] for key in said]
    assert estimates[zeroed]["reason"].startswith("taking the homogeneous frame, 1 of")
