import json
import os
import sys
from collections.abc import Callable
from typing import Any

import pytest

from shearloop.cli.emulator_processes import EmulatedDevices
from shearloop.daemon.config import EmulatorConfig
from shearloop.daemon.config_file import load_yaml_model
from shearloop.errors import UserError

S = 1_000_000_000
Devices = Callable[..., EmulatedDevices]
OBEYING = "print(input(), file=open('obeyed', 'w'))"
SLIP = {"step": 1, "command": "slip"}


def emulator(**changes: Any) -> EmulatorConfig:
    return EmulatorConfig.model_validate({"device": "rig", **changes})


def held(t_s: float, step: int = 7, hold: int = 1, phase: str = "running") -> dict[str, Any]:
    return {"t_mono_ns": round(t_s * S), "step": step, "hold": hold, "phase": phase}


@pytest.fixture
def played(tmp_path, monkeypatch) -> Devices:
    """Return devices whose processes run these programs."""

    def devices(
        emulators: tuple[EmulatorConfig, ...], *programs: str, ready: str = "print('ready', flush=True); "
    ) -> EmulatedDevices:
        commands = [[sys.executable, "-c", ready + program] for program in programs]
        monkeypatch.setattr(EmulatedDevices, "_command", lambda _, one: commands[emulators.index(one)])
        return EmulatedDevices(emulators, tmp_path)

    return devices


def test_an_event_is_sent_once_when_its_step_is_held_for_its_time(played, tmp_path):
    rig = emulator(events=[{"step": 7, "held_for_s": 12, "command": "kick -0.03"}])
    os.mkfifo(tmp_path / "obeyed")
    with played((rig,), OBEYING) as devices:
        for content in (held(0, step=6), held(50, hold=0), held(60), held(71.9), held(73, phase="held")):
            devices("loop.state", content)
        assert devices.sent == []
        devices("loop.state", held(73))
        devices("loop.state", held(74))
        assert [command for _, command in devices.sent] == ["kick -0.03"]
        assert (tmp_path / "obeyed").read_text() == "kick -0.03\n"


READY = "print('ready', flush=True)\n"
OBEDIENT = """import json, sys
for line in sys.stdin:
    print(json.dumps({"event": "obeyed", "detail": line.strip()}), flush=True)
"""


def test_an_order_is_carried_out_before_it_returns_and_the_end_of_the_device_is_said(played):
    # The robot is played by the last device.
    with played((emulator(), emulator(arguments=("2",))), "input()", OBEDIENT, ready=READY) as devices:
        devices.order("object none")
        devices.order("robot slider 0.5")
    with played((emulator(),), "input()") as devices, pytest.raises(UserError, match="an emulated device has ended"):
        devices.order("robot stop")


@pytest.mark.parametrize("then", ["", "signal.pause()"])
def test_a_rig_that_ended_or_closed_its_input_gets_no_event(played, tmp_path, then):
    os.mkfifo(tmp_path / "closed")
    program = f"import os, signal; os.close(0); open('closed', 'w').close(); {then}"
    with played((emulator(events=[SLIP]),), program) as devices:
        assert (tmp_path / "closed").read_text() == ""
        devices("loop.state", held(1, step=1))
        assert devices.sent == []


def test_devices_are_awaited_until_they_are_ready_and_may_end_later(played, tmp_path):
    late = f"import time; time.sleep(0.5); open({str(tmp_path / 'late')!r}, 'w'); print('more', flush=True); input()"
    ended = "print('ready', flush=True); raise SystemExit(3)"
    with played((emulator(device="eit-kit"), emulator()), late, ended, ready=""):
        assert (tmp_path / "late").exists()


def test_a_device_that_does_not_start_begins_nothing(played, tmp_path):
    """Its address may have another program's robot, which a daemon would take for its own."""
    runs = f"import time; open({str(tmp_path / 'runs')!r}, 'w'); print('ready', flush=True); input()"
    devices = played((emulator(device="eit-kit"), emulator()), runs, "raise SystemExit(3)", ready="")
    with pytest.raises(UserError, match="the emulated device `rig` did not start"), devices:
        pytest.fail("it began")


def test_ctrl_c_reaches_no_device(played, tmp_path):
    os.mkfifo(tmp_path / "group")
    with played((emulator(),), "import os; print(os.getpgrp(), file=open('group', 'w')); input()"):
        assert int((tmp_path / "group").read_text()) != os.getpgrp()


def test_the_truth_is_read_up_to_its_last_complete_line(played):
    rows = [{"t_mono_ns": 1, "torque_nm": 0.1}, {"t_mono_ns": 2, "torque_nm": 0.2}]
    with played((emulator(),), "input()") as devices:
        path = devices.truth
        assert devices.torques() is None
        path.write_text("\n".join(map(json.dumps, rows)) + '\n{"t_mono_ns": 3, "torq')
        known = devices.torques()
        assert known.torque_nm.tolist() == [0.1, 0.2]
    assert not path.parent.exists()


def test_the_truth_is_unknown_without_a_rig_or_in_a_file_of_its_own(played):
    own = emulator(device="eit-kit"), emulator(arguments=["--truth", "own.jsonl"])
    with played(own, "input()", "input()") as devices:
        assert devices.torques() is None


def test_an_event_of_two_lines_is_refused(tmp_path):
    path = tmp_path / "emulator.yaml"
    path.write_text('device: rig\nevents: [{step: 1, command: "slip\\nkick 3"}]\n')
    with pytest.raises(Exception, match="command"):
        load_yaml_model(path, EmulatorConfig)
