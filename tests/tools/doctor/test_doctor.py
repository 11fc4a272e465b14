"""`shearloop doctor` and `ports`: every finding says what was found, what it means, and the next step."""

import asyncio
import json
import math
import os
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import yaml

from shearloop.cli import main
from shearloop.cli.emulator_processes import check_emulators
from shearloop.daemon.config import CurveConfig, SerialDevice, load_daemon_config
from shearloop.daemon.messaging.client import receive_messages
from shearloop.daemon.messaging.keys import make_key_pair
from shearloop.daemon.running_rig import RunningRig
from shearloop.drivers.calibration_files import save_calibration
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.tools import doctor, serial_ports
from shearloop.tools.arm_models import Arm
from shearloop.tools.doctor import devices
from shearloop.tools.doctor.boards import check_port
from shearloop.tools.doctor.devices import check_task
from shearloop.tools.doctor.findings import from_error
from shearloop.tools.serial_ports import HiddenBoard, SerialPortInfo, access_cure, has_brltty, list_hidden_boards
from tests.drivers.ur.handler_bench import AT_REST, LIMITS
from tests.emulator_process import own_address
from tests.fixtures.daemons import DEADLINE_S, robot_at, shearloop

HOST = own_address(5)
SPEED = 8


@pytest.fixture
def rig_config(config, tiny_bank, tmp_path) -> Path:
    """A whole rig whose boards are SPEED times as fast; its gripper is on the robot's address."""
    robot_at(HOST, tmp_path)
    device = {"path": "eit-right"}
    return config(
        fingertips={"right": {"device": device, "bank": str(tiny_bank), "frame_period_s": 0.5412 / SPEED}},
        load_cell={"device": {"path": "load-cell"}, "rate_hz": 5.0},
        robot="ur.yaml",
        gripper={"model": "2F-140", "socket": {"host": HOST}},
    )


async def examined(path: Path, seconds: float) -> dict[str, doctor.Finding]:
    findings = await asyncio.to_thread(lambda: list(doctor.examine(path, seconds, check_emulators)))
    for finding in findings:
        assert finding.found
        assert bool(finding.means) == bool(finding.next_step) == (finding.state != "good"), finding
    return {finding.subject: finding for finding in findings}


def answering(monkeypatch, config, **changes):
    """Let a daemon answer with this configuration's rig, and some facts of it changed."""
    facts = {"process": 4711, "folder": "/home/ann", **asdict(RunningRig.of(config, HOST)), **changes}
    tasks = {name: {"alive": True} for name in ("right", "load_cell", "robot", "gripper")}
    reply = {"ok": True, "tasks": tasks, "daemon": facts}
    monkeypatch.setattr(devices, "send_to_stop_socket", lambda *_: reply)


@pytest.mark.parametrize(
    ("changes", "differs"),
    [
        ({"rig": "bench", "emulated": True}, "`name`, `emulated`"),
        ({"devices": {"load_cell.device": "/tmp/load"}}, "`load_cell.device`, `robot`"),
        ({"publish": "tcp://127.0.0.1:9"}, "`publish`"),
    ],
)
async def test_another_rigs_daemon_is_named_and_the_devices_are_examined(rig_config, monkeypatch, changes, differs):
    answering(monkeypatch, load_daemon_config(rig_config), **changes)
    found = await examined(rig_config, 0.1)
    assert found["daemon"].state == "trouble"
    label = "EMULATED, " if "emulated" in changes else ""
    assert f": {label}process 4711 ({changes.get('rig', 'config')}) in /home/ann" in found["daemon"].found
    assert differs in found["daemon"].means
    assert "task robot" not in found
    assert found["port of right"].state == "trouble"


async def test_this_configurations_daemon_reports_on_its_devices(rig_config, monkeypatch):
    answering(monkeypatch, load_daemon_config(rig_config))
    found = await examined(rig_config, 0.1)
    assert found["daemon"].state == found["task robot"].state == "good"
    assert "port of right" not in found


@pytest.mark.parametrize("calibrated", [False, True])
async def test_a_model_that_no_measured_width_confirms_is_named(rig_config, calibrated, tmp_path):
    if calibrated:
        save_calibration(tmp_path / "gripper.yaml", WidthCalibration.nominal("2F-140"))
        content = yaml.safe_load(rig_config.read_text())
        content["gripper"]["calibration"] = "gripper.yaml"
        rig_config.write_text(yaml.safe_dump(content))
    found = await examined(rig_config, 0.1)
    assert ("gripper's model" in found) is not calibrated
    if not calibrated:
        assert found["gripper's model"].found == "a 2F-140, by the configuration alone"
        assert "type plate" in found["gripper's model"].next_step


@pytest.mark.parametrize(
    ("payloads_kg", "state"),
    [
        ((9.0, 9.0), None),
        ((math.nan, None), None),
        ((11.0, 11.0), "note"),
        ((13.0, 13.0), "trouble"),
        ((11.0, 13.0), "trouble"),
    ],
)
def test_a_payload_is_judged_by_the_arms_that_a_model_may_be(payloads_kg, state):
    found = devices.check_payload(Arm("UR10", (10.0, 12.5)), *payloads_kg)
    assert (found.state if found is not None else None) == state
    assert state != "note" or "type plate" in found.next_step


@pytest.mark.parametrize(
    ("changes", "limit"),
    [
        ({}, ""),
        ({"tcp_pose": (-0.5, -0.1, -0.3, 0.0, 0.0, 0.0)}, "workspace"),
        ({"q_rad": (0.0, 0.0, 0.0, 0.0, 0.0, 99.0)}, "joints"),
    ],
)
def test_an_arm_outside_its_workspace_or_its_ranges_is_named_with_the_way_back(changes, limit):
    found = devices.check_place(replace(AT_REST, **changes), LIMITS)
    assert found.state == ("trouble" if limit else "good")
    if limit:
        assert "freedrive" in found.next_step
        assert f"correct `limits.{limit}`" in found.next_step


async def test_a_daemon_that_hangs_is_not_taken_for_none(rig_config, monkeypatch):
    monkeypatch.setattr(devices, "send_to_stop_socket", Mock(side_effect=TimeoutError))
    found = await examined(rig_config, 0.1)
    assert "does not answer within 1 s" in found["daemon"].found


@pytest.mark.real_time
async def test_doctor_checks_a_rig_with_and_without_its_daemon(rig_config, tiny_bank):
    found = await examined(rig_config, 0.1)
    assert "There is no serial port" in found["port of right"].found
    assert "switched on" in found["robot"].next_step
    assert found["bank of right"].state == "good"
    assert found["files of right"].found.endswith("without torque: no calibration is configured")
    options = ("--bank", str(tiny_bank), "--run-dir", str(rig_config.parent), "--host", HOST, "--speed", str(SPEED))
    async with shearloop("emulate", "rig", *options, stdin=asyncio.subprocess.PIPE) as rig:
        assert (await rig.stdout.readline()).startswith(b"rig ready")
        found = await examined(rig_config, 1.5)
        for subject in ("port of right", "channels of right", "robot", "robot's registers"):
            assert found[subject].state == "good", found[subject]
        # How near a busy computer comes to it is not the question here.
        assert f"{SPEED / 0.5412:.3g} Hz configured" in found["rate of right"].found
        assert found["channels of right"].found.startswith("0 saturated and 0 dead of the channels in ")
        assert found["remote control"].state == "good"
        # The board sends more often than the configuration says.
        assert found["rate of load_cell"].state == "note"
        assert "5 Hz configured" in found["rate of load_cell"].found
        for subject in ("speed slider", "place of the arm", "payload and tool"):
            assert found[subject].state == "good", found[subject]
        rig.stdin.write(b"slider 0.5\npayload 2\n")
        assert b"obeyed" in await rig.stdout.readline()
        assert b"obeyed" in await rig.stdout.readline()
        found = await examined(rig_config, 0.1)
        assert (found["speed slider"].state, found["payload and tool"].state) == ("trouble", "trouble")
        assert "The speed slider is at 50 %" in found["speed slider"].found
        assert "the daemon refuses every motion" in found["payload and tool"].means
        rig.stdin.write(b"slider 1\npayload 1\n")
        assert b"obeyed" in await rig.stdout.readline()
        assert b"obeyed" in await rig.stdout.readline()
        rig.stdin.write(b"registers-in-use\nlocal-control\n")
        assert b"obeyed" in await rig.stdout.readline()
        assert b"obeyed" in await rig.stdout.readline()
        found = await examined(rig_config, 0.1)
        assert found["robot's registers"].found == "in use"
        assert "remote control, top right" in found["remote control"].next_step
        rig.stdin.write(b"normal\n")
        async with shearloop("run", str(rig_config)):
            published = receive_messages(f"ipc://{rig_config.parent}/publish", ["robot.state"], DEADLINE_S)
            await asyncio.to_thread(next, published)
            published.close()
            found = await examined(rig_config, 2.0)
            assert found["daemon"].found.startswith("answers at")
            for subject in ("task right", "task robot", "channels of right"):
                assert found[subject].state == "good", found[subject]
            assert f" Hz measured, {SPEED / 0.5412:.3g} Hz configured" in found["rate of right"].found


def test_doctor_stops_at_an_invalid_configuration(tmp_path, ran, result_of, mistake):
    path = tmp_path / "a.yaml"
    path.write_text("other: 1\n")
    said = ran("doctor", path, status=1).out
    assert "WRONG configuration" in said
    assert "next: " in said
    assert result_of("doctor", path, status=1)[-1]["subject"] == "configuration"
    assert "the configuration cannot be read: No such file" in mistake("doctor", tmp_path / "no.yaml")
    assert "the mesh cannot be read: No such file" in mistake("doctor", path, "--geometry", tmp_path / "no.npz")
    assert main(["doctor", "--seconds", "nan"]) == 2


@pytest.mark.parametrize("emulated", [False, True])
def test_doctor_says_that_the_rig_is_emulated(config, emulated, ran):
    path = config(emulated=emulated, load_cell={"device": {"path": "load"}})
    told = ran("doctor", path, "--seconds", "0.1", status=1).out
    assert ("EMULATED" in told) is emulated
    found = json.loads(ran("doctor", path, "--seconds", "0.1", "--json", status=1).out)
    assert {finding["emulated"] for finding in found} == {emulated}


def test_the_clock_is_judged_by_its_year_and_its_synchronisation():
    assert doctor.check_clock(1e9, 0).state == "trouble"
    assert doctor.check_clock(1.8e9, 5).state == "note"
    assert doctor.check_clock(1.8e9, 0).state == "good"
    assert doctor.clock_state() in range(-1, 6)


def test_the_disk_is_judged_by_its_free_space(tmp_path, monkeypatch):
    for free, state in ((1e8, "trouble"), (1e9, "note"), (1e11, "good")):
        monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        assert doctor.check_disk(tmp_path / "not/yet/there").state == state


@pytest.mark.parametrize(
    ("facts", "state", "part"),
    [
        ({"alive": True, "errors": {}}, "good", "alive"),
        ({"alive": False, "restarts": 3, "last_error": "E: x"}, "trouble", "DEAD, restarted 3 times, E: x"),
        ({"alive": True, "connected": False, "last_loss": "unplugged"}, "trouble", "not connected, unplugged"),
        ({"alive": True, "restarts": 1, "last_error": "x"}, "note", "restarted once"),
        ({"alive": True, "connected": True, "errors": {"nan": 2}}, "note", "nan twice"),
    ],
)
def test_tasks_are_judged_by_their_counters(facts, state, part):
    finding = check_task("right", facts)
    assert finding.state == state
    assert part in finding.found


def test_a_bank_of_another_geometry_is_reported(config):
    fingertip = load_daemon_config(config()).fingertips["right"]
    assert doctor.check_bank("right", fingertip).state == "good"
    geometry = doctor.GivenGeometry.read(Path("config/fingertips/paper.yaml"))
    other = doctor.check_bank("right", fingertip, geometry)
    assert (other.state, "another fingertip" in other.means) == ("trouble", True)


def test_a_missing_bank_is_reported_once_for_each_fingertip(config, tmp_path):
    path = config(fingertips={"right": {"device": {"path": "eit"}, "bank": "no.bank"}})
    findings = list(doctor.check_files(load_daemon_config(path), path, check_emulators, None))
    (wrong,) = (one for one in findings if one.state == "trouble")
    assert wrong.subject == "bank of right"
    assert wrong.next_step.endswith(f"--out {tmp_path}/no.bank`, from a FILE such as banks/paper.yaml")


def test_an_experiment_that_check_refuses_is_wrong(config, tmp_path):
    steps = "[{do: hold_torque, torque_nm: 0.1}, {do: grip}]"
    (tmp_path / "one.yaml").write_text(f"name: one\nsteps: {steps}\n")
    path = config(robot="ur.yaml", experiment="one.yaml")
    findings = doctor.check_files(load_daemon_config(path), path, check_emulators, None)
    (found,) = (one for one in findings if one.subject == "files of experiment")
    first, second = found.found.splitlines()
    assert "hold_torque needs an identified tool" in first
    assert "grip needs a gripper" in second
    assert found.next_step.startswith("correct the file")


@pytest.mark.parametrize(
    ("flags", "blocks", "free", "writable", "part"),
    [
        (os.ST_RDONLY, 9, 9, False, "you may not write in {folder} (Read-only file system)"),
        (0, 9, 9, False, "you may not write in {folder} (Permission denied)"),
        (0, 9, 0, True, "the disk of {folder} is full"),
        # As of /proc.
        (0, 0, 0, True, "{folder} keeps no files"),
    ],
)
def test_a_folder_in_which_nothing_can_be_recorded_is_wrong(
    config, tmp_path, monkeypatch, mistake, flags, blocks, free, writable, part
):
    path = config(recording={"folder": str(tmp_path / "later/recordings")})
    monkeypatch.setattr(os, "statvfs", lambda _: SimpleNamespace(f_flag=flags, f_blocks=blocks, f_bavail=free))
    monkeypatch.setattr(os, "access", lambda *_: writable)
    part = part.format(folder=tmp_path)
    assert f"`recording.folder: {tmp_path}/later/recordings`: {part}" in mistake("check", path)
    finding = doctor.check_recording(tmp_path / "later/recordings")
    assert (finding.state, finding.found, finding.means) == ("trouble", part, "the daemon does not start")


def test_a_recording_folder_that_is_a_lost_link_is_wrong(config, tmp_path, mistake):
    (tmp_path / "recordings").symlink_to(tmp_path / "unmounted")
    path = config(recording={"folder": str(tmp_path / "recordings")})
    assert f"is a link to {tmp_path}/unmounted, which does not exist" in mistake("check", path)
    found = {finding.subject: finding for finding in doctor.examine(path, 0.1, check_emulators)}
    assert found["disk"].state == "trouble"
    assert "files of recording" not in found


def test_a_secret_key_that_others_can_read_is_reported(tmp_path):
    _, secret = make_key_pair(tmp_path, "server")
    (tmp_path / "clients").mkdir()
    curve = CurveConfig(server_key=secret, clients=tmp_path / "clients")
    assert "no client could connect" in doctor.check_keys(curve, {}).found
    make_key_pair(tmp_path / "clients", "ada")
    assert doctor.check_keys(curve, {"publish": "tcp://0.0.0.0:1"}).found == "ada may connect to tcp://0.0.0.0:1"
    assert doctor.check_keys(curve, {}).state == "note"
    secret.chmod(0o640)
    assert "mode 640" in doctor.check_keys(curve, {}).found
    assert doctor.check_keys(None, {}).state == "good"


def test_an_error_sentence_becomes_a_finding_with_its_cure():
    finding = from_error("bank", "a.bank: it is cut off; build it anew.", "nothing")
    assert (finding.found, finding.next_step) == ("a.bank: it is cut off", "build it anew")
    finding = from_error("robot", "No controller at arm: refused. Look at the pendant.", "nothing")
    assert (finding.found, finding.next_step) == ("No controller at arm: refused", "Look at the pendant")
    for sentence in ("oh no", "c.yaml: `bnk` is not a known key, did you mean `bank`?"):
        finding = from_error("x", sentence, "nothing")
        assert finding.found == sentence
        assert "shearloop doctor CONFIG" in finding.next_step
    missing = from_error("experiment", "e.yaml: the experiment cannot be read: No such file or directory", "nothing")
    assert missing.next_step.startswith("make the file, or correct its name")
    absent = check_port("right", SerialDevice(path=Path("/nowhere/eit")))
    assert absent.next_step.startswith("plug the board in")


def port(**changes: Any) -> Any:
    fields = {"device": "/dev/null", "serial_number": "12345670", "vid": 0x16C0, "pid": 0x0483, "description": "USB"}
    return SimpleNamespace(**{**fields, **changes})


def test_ports_are_listed_with_their_configuration_entry(monkeypatch, ran, result_of):
    there: list[Any] = []
    monkeypatch.setattr("shearloop.tools.serial_ports.sorted", lambda ports: ports, raising=False)
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: there)
    assert "there is no serial port" in ran("ports").out
    there += [port(), port(serial_number=None, vid=0x1A86, pid=0x7523), port(device="/dev/ttyS0", vid=None, pid=None)]
    first, second = result_of("ports")
    assert first["named_by"] == '{serial_number: "12345670"}'
    assert (first["likely"], first["usb"], first["error"]) == ("EIT-kit (Teensy)", "16c0:0483", "")
    assert second["named_by"] == "{path: /dev/null}"
    there[:] = [port(device="/dev/gone")]
    assert "No such file or directory" in ran("ports").out


def test_each_denied_port_is_reported_with_its_reason(monkeypatch):
    def port(path: str, trouble: str) -> SerialPortInfo:
        return SerialPortInfo(path, "1", "", "", "", "", trouble)

    there = [
        port("/dev/ttyACM0", ""),
        port("/dev/ttyUSB0", "another program holds it"),
        port("/dev/ttyUSB1", "no right"),
    ]
    monkeypatch.setattr("shearloop.tools.doctor.list_serial_ports", lambda: there)
    monkeypatch.setattr("shearloop.tools.doctor.list_hidden_boards", list)
    (found,) = doctor.check_ports()
    assert (found.state, found.means) == ("note", "/dev/ttyUSB0: another program holds it; /dev/ttyUSB1: no right")


@pytest.mark.parametrize("group", ["dialout", "uucp", "shearloop", "root", "tty", "1234"])
@pytest.mark.parametrize("mode", [0o660, 0o600, 0o640])
@pytest.mark.parametrize("joined", [False, True])
def test_the_cure_of_a_denied_port_belongs_to_its_group_and_mode(group, mode, joined):
    said = access_cure(group, mode, joined=joined)
    usual = group in ("dialout", "uucp", "shearloop") and mode == 0o660
    assert (f"usermod -aG {group} " in said) == ((usual and not joined) or (group == "shearloop" and not usual))
    assert ("log out and in again" in said) == (usual and joined)
    assert ("sudo shearloop install" in said) == (not usual)
    assert "; " in said


def usb_bus(folder: Path, *, port: bool, vendor: str = "1a86") -> Path:
    """Write what the system says of a CH340, of a mouse, and of an interface."""
    for name, numbers in (("1-2", (vendor, "7523")), ("1-3", ("046d", "c077"))):
        (folder / name).mkdir(parents=True)
        for file, number in zip(("idVendor", "idProduct"), numbers, strict=True):
            (folder / name / file).write_text(f"{number}\n")
    (folder / "1-2" / "1-2:1.0" / "ttyUSB0" if port else folder / "1-2" / "1-2:1.0").mkdir(parents=True)
    (folder / "1-2:1.0").mkdir()
    return folder


def test_only_a_board_without_a_port_is_listed_as_hidden(tmp_path):
    assert list_hidden_boards(usb_bus(tmp_path / "with", port=True)) == []
    (found,) = list_hidden_boards(usb_bus(tmp_path / "without", port=False))
    assert (found.usb, found.likely) == ("1a86:7523", "load cell (CH340)")
    assert list_hidden_boards(tmp_path / "none") == []


def test_brltty_is_recognised_by_its_process_or_its_rule(tmp_path):
    processes, rules = tmp_path / "proc", tmp_path / "rules.d"
    (processes / "42").mkdir(parents=True)
    rules.mkdir()
    (processes / "42/comm").write_text("python3\n")
    assert not has_brltty(processes, [rules, tmp_path / "none"])
    (rules / "85-brltty.rules").touch()
    assert has_brltty(processes, [rules])
    (rules / "85-brltty.rules").unlink()
    (processes / "42/comm").write_text("brltty\n")
    assert has_brltty(processes, [rules])


@pytest.mark.parametrize("brltty", [True, False])
def test_the_doctor_says_who_took_a_board(monkeypatch, brltty):
    monkeypatch.setattr("shearloop.tools.doctor.list_hidden_boards", lambda: [HiddenBoard("1a86:7523", "load cell")])
    monkeypatch.setattr("shearloop.tools.doctor.list_serial_ports", list)
    monkeypatch.setattr("shearloop.tools.doctor.has_brltty", lambda: brltty)
    (found,) = doctor.check_ports()
    assert found.subject == "USB 1a86:7523"
    assert ("apt remove brltty" in found.next_step) == brltty
    assert ("dmesg" in found.next_step) != brltty


def test_boards_without_a_serial_number_are_named_by_their_socket(tmp_path, monkeypatch):
    """By identity, two copies have the same name."""
    port = tmp_path / "ttyUSB1"
    port.touch()
    for name, link in (("by-id", "usb-1a86_USB_Serial-if00"), ("by-path", "pci-0000:00:14.0-usb-0:2:1.0")):
        (tmp_path / name).mkdir()
        (tmp_path / name / link).symlink_to(port)
    monkeypatch.setattr(serial_ports, "OWN_LINKS", tmp_path / "own")
    monkeypatch.setattr(serial_ports, "UDEV_LINKS", {"by-id": tmp_path / "by-id", "by-path": tmp_path / "by-path"})
    assert serial_ports.stable_name_of(str(port), None).endswith("by-path/pci-0000:00:14.0-usb-0:2:1.0")
    assert serial_ports.stable_name_of(str(port), "123").endswith("by-id/usb-1a86_USB_Serial-if00")
    (tmp_path / "own").mkdir()
    (tmp_path / "own/pci-0000:00:14.0-usb-0:2:1.0").symlink_to(port)
    assert serial_ports.stable_name_of(str(port), None).startswith(str(tmp_path / "own"))
