"""Two fingertips, one by itself and both together with the default estimator: recorded live, replayed at any speed."""

import asyncio
import math
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from shearloop.bank.channels import PAPER_TABLE
from shearloop.drivers.connection import Received, SerialLink
from shearloop.drivers.eit_kit import ADC_STEP_V, START
from shearloop.estimation import FrameSeries, Measured, fit
from tests.fixtures.daemons import DEADLINE_S, running_daemon
from tests.tools.recordings.test_replay import Gripper, Messages, measured, replayed

N_FRAMES = 120
GRIPPED = slice(25, 110)
PERIOD_S = 0.5408
PLAYED = 50
TOOL_MM = 10.0
# The gripper says that another tool is held while so many frames have been estimated.
OTHER_TOOL, OTHER_MM = range(70, 80), 14.0
SIDES = ("right", "left")
TORQUE_NM = np.zeros(N_FRAMES)
TORQUE_NM[40:104] = 0.1 * np.abs(np.sin(np.pi * np.arange(64) / 22))


class Twists(NamedTuple):
    """The lines that two boards send while a tool is twisted three times, and calibrations fitted to it."""

    lines: dict[str, list[bytes]]
    calibrations: dict[str, Path]


@pytest.fixture(scope="module")
def twists(tmp_path_factory) -> Twists:
    folder = tmp_path_factory.mktemp("twists")
    random = np.random.default_rng(4)
    t_s = PERIOD_S * np.arange(N_FRAMES)
    sent, channels = {}, []
    for side in SIDES:
        idle, grip, twist = random.integers(40, 200, 896), random.integers(-15, 16, 896), random.normal(0, 5, 896)
        steps = idle + random.integers(-1, 2, (N_FRAMES, 896)) + np.round(np.outer(TORQUE_NM / 0.1, twist)).astype(int)
        steps[GRIPPED] += grip
        lines = np.round(PAPER_TABLE.line_of_channels(steps * ADC_STEP_V), 4)
        channels.append([PAPER_TABLE.channels_of_line(line) for line in lines])
        sent[side] = ["".join(f"{value:.4f}, " for value in line).encode() + b"\r\n" for line in lines]
    series = FrameSeries(SIDES, t_s, np.array(channels).swapaxes(0, 1), t_s, TORQUE_NM, np.full(N_FRAMES, TOOL_MM))
    calibrations = {}
    for name, sides in (("both", SIDES), ("right", ("right",))):
        calibrations[name] = folder / f"{name}.cal"
        fit("motion_regression", [series.select_sides(sides)], "a test").save(calibrations[name])
    return Twists(sent, calibrations)


class Board:
    """An open port that brings a line each time that both boards are read, at times that no busy computer can delay.

    `began_ns` is the time at which both are open, for both of them.
    """

    def __init__(self, path: Path, lines: list[bytes], began_ns: list[int], both_read: asyncio.Barrier) -> None:
        self.path, self._both_read = path, both_read
        self._began_ns, self._lines = began_ns, enumerate(lines, 1)

    async def read(self, _timeout_s: float) -> Received:
        await self._both_read.wait()
        if not self._began_ns:
            self._began_ns.append(time.monotonic_ns())
        number, line = next(self._lines, (0, b""))
        if not line:
            return await asyncio.get_running_loop().create_future()
        return Received(line, self._began_ns[0] + round(number * PERIOD_S / PLAYED * 1e9))

    async def write(self, data: bytes) -> None:
        assert data == START

    def close(self) -> None:
        """Nothing is open."""


async def record(config: Path, lines: dict[str, list[bytes]], monkeypatch: pytest.MonkeyPatch) -> Messages:
    """Run a daemon on two boards until all their frames and pairs are estimated, and return what it published."""
    published: Messages = []
    estimates, all_done = Counter[str](), asyncio.Event()
    began_ns: list[int] = []
    both_read = asyncio.Barrier(len(SIDES))

    async def connect(link: SerialLink) -> Board:
        path = Path(link.path)
        return Board(path, lines[path.name], began_ns, both_read)

    def listen(topic: str, content: dict[str, Any]) -> None:
        published.append((topic, content))
        estimates.update([content["source"]] * (topic == "eit.estimate"))
        if [estimates[source] for source in (*SIDES, "combined")] == 3 * [N_FRAMES]:
            all_done.set()

    monkeypatch.setattr(SerialLink, "_connect", connect)
    async with asyncio.timeout(DEADLINE_S), running_daemon(config) as daemon:
        daemon.publisher.add_listener(listen)
        right = daemon.sensors.tasks["right"]
        right.gripper = Gripper(right, Measured(OTHER_MM, 0.5), OTHER_TOOL)
        await all_done.wait()
    return published


def test_combined_fingertips_are_replayed_at_any_speed(config, tiny_bank, twists, tmp_path, monkeypatch):
    # Over all lags, these frames would take long: they are unlike the bank.
    settings = {"bank": str(tiny_bank), "matching": "zero_lag", "frame_period_s": PERIOD_S / PLAYED}
    fingertips = {side: {"device": {"path": side}, **settings} for side in SIDES}
    fingertips["right"] |= {"calibration": str(twists.calibrations["right"]), "estimator": "motion_regression"}
    path = config(
        fingertips=fingertips,
        combined={"calibration": str(twists.calibrations["both"])},
        recording={"folder": "recordings"},
    )
    live = asyncio.run(record(path, twists.lines, monkeypatch))
    (recording,) = (tmp_path / "recordings").iterdir()
    # Recorded at many times a board's pace: at speed 1 it takes as long as it took.
    replays = {}
    for speed in (1.0, 7.0, math.inf):
        again, comparison = asyncio.run(replayed(recording, speed))
        assert comparison.different == {}, comparison.examples
        assert comparison.compared["eit.estimate"] == 3 * N_FRAMES
        replays[speed] = measured([one for one in again if one[0] == "eit.estimate"])
    assert replays[1.0] == replays[7.0] == replays[math.inf]
    for source in (*SIDES, "combined"):
        then = measured([one for one in live if one[0] == "eit.estimate" and one[1]["source"] == source])
        assert [one for one in replays[math.inf] if one[1]["source"] == source] == then
    torques = [one["torque_nm"] for _, one in replays[math.inf] if one["source"] == "right" and one["valid"]]
    assert len(torques) > 30
    assert np.ptp(torques) > 0.05
    says = [(one["source"], "the tool has 14 mm" in one["reason"]) for _, one in replays[math.inf]]
    assert not any(refused for source, refused in says if source != "right")
    right = [one for _, one in replays[math.inf] if one["source"] == "right"]
    refused = [number for number, one in enumerate(right) if "the tool has 14 mm" in one["reason"]]
    assert refused == list(OTHER_TOOL)
    assert not any(right[number]["valid"] for number in OTHER_TOOL)
