"""The whole emulated rig, recorded by a daemon whose wall clock is set on the way: every command gives the same."""

import asyncio
import io
import json
import math
import re
from collections.abc import Callable, Mapping
from contextlib import closing, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
import zmq.asyncio
from numpy.typing import NDArray

from shearloop.cli import main
from shearloop.daemon.clock import Clock, ClockReading
from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.recorder.recorder import Recorder, daemon_identity
from shearloop.daemon.sensors import open_sessions
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.emulators.boards import format_line
from shearloop.emulators.synthetic_frames import RigFrames
from shearloop.studies.emulated_calibration import ACTIVATE, GRIP, TwistPlayer
from shearloop.tools.recordings.replay import RecordedRun, Replay, ReplayClock

pytest.importorskip("pyarrow", reason="needs the extra `export`")

UNIX_NS = 1_795_000_000 * 10**9
TOOL_MM, STEP_AT_S = 20.0, 25.0
STEPS = {"back by 5 s": -5.0, "back by 30 s": -30.0, "forward by two days": 2 * 86400.0}
TOPICS = ("eit.frame.right", "eit.estimate.right", "load.torque", "input.right")

Record = Callable[[Recorder], None]


@dataclass
class SetClock(Clock):
    """A clock in simulated time, whose wall clock is set at STEP_AT_S."""

    set_s: float = 0.0
    t_ns: int = 0

    def __post_init__(self) -> None:
        super().__init__()

    def now_ns(self) -> int:
        return self.t_ns

    def _measured(self) -> ClockReading:
        return ClockReading(UNIX_NS + round(self.set_s * 1e9) * (self.t_ns >= STEP_AT_S * 1e9), 0)


class FewTwists(TwistPlayer):
    """A grip with a few twists: some hundred frames."""

    def run(self) -> None:
        self._gripper.write(ACTIVATE)
        while self._gripper.sta != 3:
            self._step()
        self._hold_still(6.0)
        self._gripper.write(GRIP)
        self._hold_still(6.0)
        for angle_rad in (0.2, 0.0, -0.1, 0.15, 0.05, 0.25, 0.0):
            self._turn_to(angle_rad, 0.2)
            self._hold_still(4.0)


class Wires:
    """Takes what the emulated boards send, as bytes with their times, in the place of a recording's file."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, RawEvent]] = [
            (source, RawEvent(InputKind.OPENED, 0)) for source in ("right", "left", "load_cell")
        ]

    def add_frame(self, side: str, _t_mid_ns: int, arrival_ns: int, line: NDArray[np.float64]) -> None:
        self.sent.append((side, RawEvent(InputKind.DATA, arrival_ns, format_line(line))))

    def add_torque(self, t_ns: int, torque_nm: float) -> None:
        self.sent.append(("load_cell", RawEvent(InputKind.DATA, t_ns, f"{torque_nm:.5f}\r\n".encode())))


@dataclass
class RigRun:
    """A run of the rig: what a daemon with this configuration recorded, each with its time by CLOCK_MONOTONIC."""

    config: DaemonConfig
    recorded: list[tuple[int, Record]]

    def record(self, folder: Path, set_s: float) -> Path:
        """Return the file of a daemon whose wall clock was set by so much."""
        clock = SetClock(set_s)
        recorder = Recorder(folder, daemon_identity(self.config, open_sessions(self.config).fingertips), clock)
        recorder.record_experiment("twist", tool_mm=TOOL_MM)
        measured_ns = 0
        for number, (t_ns, record) in enumerate(self.recorded):
            clock.t_ns = t_ns
            if t_ns - measured_ns >= 10**9:
                measured_ns = t_ns
                clock.synchronise()
            record(recorder)
            if number % 500 == 0:
                recorder.write()
        recorder.close()
        assert recorder.failure == ""
        (path,) = recorder.closed_files
        return path


async def run_rig(config: DaemonConfig, bank: Path, folder: Path) -> RigRun:
    """Play twists of the emulated rig in simulated time, with the messages that a daemon makes of its boards' bytes."""
    wires = Wires()
    FewTwists(RigFrames(bank, seed=3), TOOL_MM, 5, wires).run()
    inputs = [
        (event.t_ns, lambda to, source=source, event=event: to.input_recorder(source).record(event))
        for source, event in wires.sent
    ]
    raw = RigRun(config, inputs).record(folder / "raw", 0.0)
    clock = ReplayClock()
    published: list[tuple[int, Record]] = []

    def listen(topic: str, content: Mapping[str, Any]) -> None:
        published.append((clock.now_ns(), lambda to: to.record_message(topic, content)))

    with zmq.asyncio.Context() as context, closing(Publisher(context, f"ipc://{folder}/publish", clock)) as publisher:
        publisher.add_listener(listen)
        await Replay(RecordedRun(raw), config, publisher, clock).play(math.inf)
    # A message follows from the input of its time; the order of the others stays.
    return RigRun(config, sorted([*inputs, *published], key=lambda one: one[0]))


@pytest.fixture(scope="module")
def rig_run(tiny_bank, tiny_calibration, tmp_path_factory) -> RigRun:
    """A run of two fingertips and a load cell that sends N·m."""
    folder = tmp_path_factory.mktemp("rig")
    fingertip = {"bank": str(tiny_bank), "calibration": str(tiny_calibration), "matching": "zero_lag"}
    content = {
        "publish": f"ipc://{folder}/unused",
        "commands": f"ipc://{folder}/commands",
        "fingertips": {side: {**fingertip, "device": {"path": side}} for side in ("right", "left")},
        "load_cell": {"device": {"path": "load"}},
    }
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    return asyncio.run(run_rig(load_daemon_config(folder / "rig.yaml"), tiny_bank, folder))


def said(*arguments: object) -> str:
    """Run a command, which must succeed, and return what it prints."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        assert main([*map(str, arguments)]) == 0
    return printed.getvalue()


def results(recording: Path, calibration: Path | None, out: Path) -> dict[str, Any]:
    """Return what every command says of a recording, or writes; `calibration` is of another one, or made here."""
    out.mkdir()
    made = out / "rig.cal"
    found: dict[str, Any] = {}
    printed = said("calibrate", recording, "--sides", "right,left", "--out", made, "--json")
    found["calibrate"] = json.loads(printed.replace(str(made), "").replace(str(recording), ""))
    found["calibration"] = made.read_bytes()
    printed = said("evaluate", calibration or made, recording, "--estimates", out / "estimates.csv", "--json")
    judged = json.loads(printed.replace(str(recording), ""))
    # How long this computer takes.
    found["evaluate"] = {key: value for key, value in judged.items() if not key.startswith("latency")}
    found["estimates"] = (out / "estimates.csv").read_text().replace(str(recording), "")
    chosen = [part for topic in TOPICS for part in ("--topic", topic)]
    for form in ("csv", "lerobot"):
        said("recording", "export", recording, "--format", form, "--out", out / form, *chosen)
    found |= {topic: (out / "csv" / f"{topic}.csv").read_bytes() for topic in TOPICS}
    found["lerobot"] = (out / "lerobot" / "data" / "chunk-000" / "file-000.parquet").read_bytes()
    address = f"ipc://{out}/publish"
    found["replay"] = json.loads(
        said("recording", "replay", recording, "--speed", "max", "--check", "--json", "--publish", address)
    )
    return found


@pytest.fixture(scope="module")
def plain(rig_run, tmp_path_factory) -> Path:
    """The recording of a daemon whose clock is not set."""
    return rig_run.record(tmp_path_factory.mktemp("plain"), 0.0)


@pytest.fixture(scope="module")
def truth(plain, tmp_path_factory) -> dict[str, Any]:
    """What the commands say of it."""
    found = results(plain, None, tmp_path_factory.mktemp("truth") / "out")
    # They have something to say.
    assert found["replay"]["compared"]["eit.estimate"] > 100
    assert found["replay"]["different"] == {}
    # The first line after opening may lack its beginning.
    (left_out,) = found["calibrate"]["readings_left_out"]
    assert re.search(r"1 of \d+ readings of the load cell, not valid", left_out)
    assert found["estimates"].count("\n") > 50
    return found


@pytest.mark.parametrize("set_s", STEPS.values(), ids=STEPS)
def test_every_command_gives_the_same_numbers(rig_run, truth, set_s, tmp_path):
    calibration = tmp_path / "truth.cal"
    calibration.write_bytes(truth["calibration"])
    found = results(rig_run.record(tmp_path / "stepped", set_s), calibration, tmp_path / "found")
    for name, value in truth.items():
        assert found[name] == value, name


def test_evaluate_says_that_a_calibration_knows_the_recording(plain, tmp_path, ran):
    whole, part, renamed = tmp_path / "whole.cal", tmp_path / "part.cal", tmp_path / "other.mcap"
    renamed.write_bytes(plain.read_bytes())
    ran("calibrate", plain, "--sides", "right,left", "--out", whole)
    ran("calibrate", plain, "--sides", "right,left", "--time-range", "0:0.7", "--out", part)
    known = re.compile(r"Warning: the calibration has learned from (\d+) of (\d+) judged frames of (\S+); errors on")
    for calibration, recording, options, is_whole in (
        (whole, plain, (), True),
        (whole, renamed, (), True),
        (whole, plain, ("--time-range", "0.7:1"), True),
        (part, plain, (), False),
    ):
        found = known.search(ran("evaluate", calibration, recording, *options).err)
        n, of, name = found.groups()
        assert name == str(recording)
        assert (n == of) is is_whole
    # Another part is new, whatever its name.
    assert "learned from" not in ran("evaluate", part, plain, "--time-range", "0.7:1").err
