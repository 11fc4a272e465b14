"""A device, a pipe or an endless file in place of a file ends every command with one sentence, and soon."""

import os
import signal
from collections.abc import Iterator
from types import FrameType

import pytest

from tests.fixtures.daemons import robot_at

FORMS = ("csv", "parquet", "mat", "rrd", "lerobot", "slices")
# Ten times as long as a command takes on a busy computer.
TOO_LONG_S = 60
# {} is the path; {rec}, {cal}, {rig} and {steps} are a recording, a calibration, a configuration and an experiment;
# {out} and {folder} are paths to write.
COMMANDS = (
    *(f"recording export {{}} --format {form} --out {{out}}" for form in FORMS),
    "recording export {rec} --format rrd --out {out} --fingertip {}",
    "recording info {}",
    "recording list {}",
    "recording repair {} --out {out}",
    "recording replay {} --publish ipc://{out}",
    "recording replay {rec} --publish ipc://{out} --config {}",
    "recording import mat {} --out {out}",
    "check {}",
    "check {steps} --config {}",
    "doctor {}",
    "doctor {rig} --geometry {}",
    "calibrate {} --out {out}",
    "calibrate {rec} --estimator bank --bank {} --out {out}",
    "calibrate {rec} --estimator reconstruction --mesh {} --out {out}",
    "calibrate creep {} --calibration {cal}",
    "calibrate creep {rec} --calibration {}",
    "adapt {} {rec} --out {out}",
    "adapt {cal} {} --out {out}",
    "evaluate {} {rec}",
    "evaluate {cal} {}",
    "evaluate --leave-out twists {}",
    "run {}",
    "run {} --emulate",
    "run {rig} --play {}",
    "demo --play {} --folder {folder}",
    "commission {} --out {out}",
    "commission {rig} --out {}",
    "bank build --config {} --out {out}",
    "bank info {}",
    "bank design {}",
    "bank design {rec} --fingertip {}",
    "bank solve --mesh {} --model step --k 1 --sigma 1 --out {out}",
    "chart speed-accuracy {} --out {folder}",
    "chart speed-accuracy --bank {} --out {folder}",
    "reproduce {} --out {out}",
    "skin calibrate {} --out {out}",
    "emulate eit-kit --recording {}",
    "emulate eit-kit --bank {}",
    "emulate rig --bank {} --run-dir {folder}",
    "emulate hx711 --load-calibration {}",
    "keys allow {} --name ada --dir {out}",
    "listen --connect tcp://192.0.2.1:7761 --key {} --server-key {rec}",
    "command status --connect tcp://192.0.2.1:7762 --key {} --server-key {rec}",
    "init {}",
)


@pytest.fixture
def alarm() -> Iterator[None]:
    """End a command that reads without end, or that waits for a writer."""

    def late(_signal: int, _frame: FrameType | None) -> None:
        pytest.fail(f"it took longer than {TOO_LONG_S} s")

    before = signal.signal(signal.SIGALRM, late)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("alarm")
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_a_device_or_pipe_in_the_place_of_a_file(
    command, tmp_path, config, tiny_calibration, imported, mistake
):
    (tmp_path / "steps.yaml").write_text("name: one\nsteps: [{do: wait, wait_s: 1}]\n")
    os.mkfifo(tmp_path / "pipe")
    robot_at("127.0.0.1", tmp_path)
    emulated = [{"device": "eit-kit", "arguments": ["--link", "eit-right"]}]
    names = {
        "rec": imported,
        "cal": tiny_calibration,
        "rig": config(emulators=emulated, emulated=True, robot="ur.yaml"),
        "steps": tmp_path / "steps.yaml",
        "out": tmp_path / "out",
        "folder": tmp_path / "folder",
    }
    for strange in ("/dev/zero", "/dev/tty", tmp_path / "pipe", "/proc/kmsg"):
        signal.alarm(TOO_LONG_S)
        said = mistake(*command.format(strange, **names).split())
        assert str(strange) in said
        assert len(said.splitlines()) == 1
        assert not names["out"].exists()
