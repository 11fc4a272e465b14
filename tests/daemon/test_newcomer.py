"""The README's path from the demo to a calibration of one's own: its commands, on one board that plays twists.

The board is played at twenty times its pace. What a load cell reads beside it, which takes a whole rig, is written
into the recording before it is calibrated on; the whole rig is `make demo`.
"""

import json
import re
import shlex
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zmq
from scipy.io import savemat

from bank.channels import LINE_SLOTS, line_of_channels
from daemon.cli import main
from daemon.recording.reader import read_recording
from daemon.recording.writer import RecordingWriter
from drivers.eit_format import ADC_STEP_V
from tests.daemon.conftest import DEADLINE_S

pytestmark = pytest.mark.real_time

PROGRAM = ".venv/bin/shearloop"
N_FRAMES = 180
GRIPPED = slice(40, 160)
TORQUE_NM = np.zeros(N_FRAMES)
TORQUE_NM[60:150] = 0.1 * np.abs(np.sin(np.pi * np.arange(90) / 30))
PERIOD_NS = 541_200_000


def commands() -> list[list[str]]:
    """Return the commands of the README's section, in order."""
    section = Path("README.md").read_text().partition("## Record, replay, calibrate")[2].partition("\n## ")[0]
    found = [shlex.split(line) for line in re.findall(rf"^    {re.escape(PROGRAM)} (.*)$", section, re.MULTILINE)]
    assert [command[0] for command in found] == ["run", "recording", "replay", "calibrate", "evaluate"]
    assert f"{PROGRAM} view" in section
    return found


def stream(folder: Path) -> Path:
    """A board's frames before, in and after a grip in which the tool is twisted three times."""
    random = np.random.default_rng(4)
    idle, grip, twist = random.integers(40, 200, 896), random.integers(-15, 16, 896), random.normal(0, 5, 896)
    steps = idle + random.integers(-1, 2, (N_FRAMES, 896)) + np.round(np.outer(TORQUE_NM / 0.1, twist)).astype(int)
    steps[GRIPPED] += grip
    days = 739_588 + np.arange(N_FRAMES) * PERIOD_NS / 1e9 / 86_400
    lines = np.round(line_of_channels(steps * ADC_STEP_V), 4)
    assert lines.shape[1] > len(LINE_SLOTS)
    savemat(folder / "stream.mat", {"Right_Data": np.column_stack([days, lines])})
    return folder / "stream.mat"


@contextmanager
def started(*arguments: str, cwd: Path) -> Iterator["subprocess.Popen[str]"]:
    """Run a command in a folder, the code being this one's; it is ended at the end."""
    process = subprocess.Popen(
        [sys.executable, "-m", "daemon", *arguments],
        cwd=cwd,
        env={"PYTHONPATH": str(Path.cwd()), "PATH": "/usr/bin:/bin", "HOME": str(cwd), "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)


def page_of(view: "subprocess.Popen[str]") -> str:
    assert view.stdout is not None
    address = json.loads(view.stdout.readline())["url"]
    with urllib.request.urlopen(address, timeout=DEADLINE_S) as answer:  # noqa: S310 - it is ours
        return str(answer.read().decode())


def with_load_cell(recorded: Path, out: Path) -> None:
    """Write the recorded frames, at the board's own pace, with the torque that a load cell would have read."""
    side = read_recording(recorded).sides["right"]
    assert len(side.lines) == N_FRAMES
    with RecordingWriter(out, "a test") as writer:
        for n, line in enumerate(side.lines):
            middle_ns = 10**18 + n * PERIOD_NS
            writer.frame("right", middle_ns, middle_ns + PERIOD_NS // 2, line)
            for part in range(5):
                writer.torque(middle_ns + part * PERIOD_NS // 5, float(TORQUE_NM[n]))


@pytest.mark.usefixtures("fonts")
def test_the_readmes_path_from_demo_to_a_calibration_of_ones_own(
    config: Callable[..., Path],
    subscriber: Callable[[str, str], "zmq.Socket[bytes]"],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("aiohttp", reason="the live view needs the extra `view`")
    path = commands()
    (tmp_path / "run").mkdir()
    play = ["--link", "eit-right", "--recording", str(stream(tmp_path)), "--once", "--speed", "20"]
    demo = config(emulators=[{"device": "eit-kit", "arguments": play}])
    run = [str(demo) if word == "config/demo.yaml" else word for word in path[0]]
    view = ("view", "--connect", f"ipc://{tmp_path}/publish", "--commands", f"ipc://{tmp_path}/commands")
    estimates = subscriber(f"ipc://{tmp_path}/publish", "eit.estimate")
    with started(*run, cwd=tmp_path), started(*view, "--port", "0", "--json", cwd=tmp_path) as viewer:
        assert "<html" in page_of(viewer)
        for _ in range(N_FRAMES - 20):
            estimates.recv_multipart()
        # The last of them are at the daemon within a second, and a stopped daemon has recorded all that it had.
        while estimates.poll(1000):
            estimates.recv_multipart()
    (recording,) = (tmp_path / "recordings").iterdir()
    assert recording.name.endswith("Z.mcap")
    twists = tmp_path / "recordings" / "twists.mcap"
    with_load_cell(recording, twists)
    monkeypatch.chdir(tmp_path)
    said = {}
    for command in path[1:]:
        made = recording if command[0] in ("recording", "replay") else twists
        words = [str(made) if word == "recordings/*.mcap" else word for word in command]
        if words[0] == "replay":
            words += ["--publish", f"ipc://{tmp_path}/replay"]
        capfd.readouterr()
        assert main(words) == 0, capfd.readouterr().err
        said[words[0]] = "".join(capfd.readouterr())
    assert f"eit.frame.right           {N_FRAMES} messages" in said["recording"]
    assert f"eit.estimate: {N_FRAMES} of {N_FRAMES} are the same as recorded, bit for bit" in said["replay"]
    figures = dict(line.split(maxsplit=1) for line in said["evaluate"].splitlines() if re.match(r"\w+ +\S+$", line))
    assert float(figures["rmse_nm"]) < 0.01
    assert float(figures["r"]) > 0.95
    assert (tmp_path / "run" / "my.png").read_bytes().startswith(b"\x89PNG")
