import contextlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from shearloop.daemon.cli.demonstration import EmulatorMonitor, EventInjector, TruthFile
from shearloop.daemon.config import EmulatorConfig
from shearloop.daemon.config_file import load_yaml_model

S = 1_000_000_000


def emulator(**changes: Any) -> EmulatorConfig:
    return EmulatorConfig.model_validate({"device": "rig", **changes})


def held(t_s: float, step: int = 7, hold: int = 1, phase: str = "running") -> dict[str, Any]:
    return {"t_mono_ns": round(t_s * S), "step": step, "hold": hold, "phase": phase}


def test_what_befalls_the_rig_is_said_once_when_the_step_has_been_held_for_its_time() -> None:
    rig = emulator(events=[{"step": 7, "held_for_s": 12, "command": "kick -0.03"}])
    process = subprocess.Popen([sys.executable, "-c", "print(input())"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    events = EventInjector((rig,), [process])
    for content in (held(0, step=6), held(50, hold=0), held(60), held(71.9), held(73, phase="held")):
        events("loop.state", content)
    assert events.sent == []
    events("loop.state", held(73))
    events("loop.state", held(74))
    assert [command for _, command in events.sent] == ["kick -0.03"]
    out, _ = process.communicate(timeout=30)
    assert out == b"kick -0.03\n"


def test_a_rig_that_has_ended_is_told_nothing() -> None:
    rig = emulator(events=[{"step": 1, "command": "slip"}])
    process = subprocess.Popen([sys.executable, "-c", ""], stdin=subprocess.PIPE)
    process.wait(30)
    events = EventInjector((rig,), [process])
    events("loop.state", held(1, step=1))
    assert events.sent == []
    process.communicate()


def test_a_rig_that_ends_in_this_moment_takes_nobody_along() -> None:
    rig = emulator(events=[{"step": 1, "command": "slip"}])
    process = subprocess.Popen(
        [sys.executable, "-c", "import os, signal; os.close(0); os.close(1); signal.pause()"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.read() == b"", "its input is closed, and it lives"
    events = EventInjector((rig,), [process])
    events("loop.state", held(1, step=1))
    assert events.sent == []
    process.kill()
    with contextlib.suppress(BrokenPipeError):
        process.communicate()


def test_an_emulated_device_that_dies_is_told_once() -> None:
    with capture_logs() as told:
        living = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        dead = subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"], stdin=subprocess.PIPE)
        monitor = EmulatorMonitor((emulator(device="eit-kit"), emulator()), [living, dead])
        dead.wait(30)
        for topic in ("loop.state", "health", "health"):
            monitor(topic, {})
        living.communicate(b"\n", timeout=30)
        dead.communicate()
    ((device, status),) = [(entry["device"], entry["status"]) for entry in told]
    assert (device, status) == ("rig", 3)


def test_the_truth_is_read_up_to_its_last_whole_line() -> None:
    truth = TruthFile((emulator(),))
    try:
        assert truth.path is not None
        assert truth.arguments == ("--truth", str(truth.path))
        assert truth.torques() is None
        rows = [{"t_mono_ns": 1, "torque_nm": 0.1}, {"t_mono_ns": 2, "torque_nm": 0.2}]
        truth.path.write_text("\n".join(map(json.dumps, rows)) + '\n{"t_mono_ns": 3, "torq')
        known = truth.torques()
        assert known is not None
        assert known.torque_nm.tolist() == [0.1, 0.2]
    finally:
        truth.close()
    assert not truth.path.exists()


def test_without_an_emulated_rig_nobody_knows_the_truth() -> None:
    truth = TruthFile((emulator(device="eit-kit"), emulator(arguments=["--truth", "own.jsonl"])))
    assert truth.arguments == ()
    assert truth.torques() is None
    truth.close()


def test_an_event_of_two_lines_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "emulator.yaml"
    path.write_text('device: rig\nevents: [{step: 1, command: "slip\\nkick 3"}]\n')
    with pytest.raises(Exception, match="command"):
        load_yaml_model(path, EmulatorConfig)
