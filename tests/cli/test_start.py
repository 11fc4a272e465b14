"""What a user starts with: `init`, `schema`, and the files of `demo`."""

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft202012Validator

from shearloop.cli import demo
from shearloop.cli.config_schema import MODELS
from shearloop.cli.emulator_processes import running
from shearloop.cli.rehearsal import rehearsal
from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.config_file import load_yaml_model
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.rig import open_settings
from shearloop.drivers.hosts import is_loopback_host
from shearloop.estimation import fit
from shearloop.estimation.skin.calibration import load_calibration
from shearloop.tools.doctor import check_gripper_address
from tests.estimation.conftest import twisting
from tests.fixtures.daemons import robot_at
from tests.fixtures.robots import TOOL, write_filled_in

CONFIG = Path(__file__).parents[2] / "config"
# A calibration is written by a command, not by people.
WRITTEN_BY_PEOPLE = sorted(set(CONFIG.rglob("*.yaml")) - set(CONFIG.glob("calibrations/*")))


def schema_for(path: Path) -> Draft202012Validator:
    """Return the schema that a file names for editors."""
    first = path.read_text(encoding="utf-8").splitlines()[0]
    named = path.parent / first.removeprefix("# yaml-language-server: $schema=")
    return Draft202012Validator(json.loads(named.read_text(encoding="utf-8")))


@pytest.mark.parametrize("path", WRITTEN_BY_PEOPLE, ids=lambda path: path.name)
def test_an_editor_accepts_the_files_of_config_and_refuses_an_unknown_key(path):
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    schema_for(path).validate(content)
    assert not schema_for(path).is_valid({**content, "unknown": 1})


@pytest.mark.parametrize(
    ("angles", "accepted"), [("1.45:1.65:10", True), (0.1, True), ([0.1], True), ([], False), ("1", False)]
)
def test_an_editor_accepts_angles_as_the_program_does(angles, accepted):
    step = {"do": "twist", "angles_rad": angles}
    schema = schema_for(CONFIG / "experiments" / "tighten.yaml")
    assert schema.is_valid({"name": "twists", "steps": [step]}) == accepted


def test_the_calibration_of_config_is_of_this_version():
    assert load_calibration(CONFIG / "calibrations" / "skin_demo.yaml").rows


def test_schema_prints_every_kind(ran):
    for kind in MODELS:
        Draft202012Validator.check_schema(json.loads(ran("schema", kind).out))


def test_init_writes_files_that_load_and_changes_none(tmp_path, ran, mistake):
    folder = tmp_path / "my" / "rig"
    said = ran("init", folder).out
    # The order that works: `check` needs the bank.
    build = f"shearloop bank build --config {folder / 'banks' / 'paper.yaml'} --out {folder / 'paper.bank'}"
    assert 0 < said.index(f"`{build}`") < said.index(f"`shearloop check {folder / 'rig.yaml'}`")
    spaced = tmp_path / "my rig"
    assert f"`shearloop check '{spaced / 'rig.yaml'}'`" in ran("init", spaced).out
    said = mistake("check", spaced / "rig.yaml")
    assert f"bank build --config '{spaced / 'banks/paper.yaml'}' --out '{spaced / 'paper.bank'}'`" in said
    config = load_daemon_config(folder / "rig.yaml")
    assert config.robot == folder / "ur.yaml"
    assert not config.emulators
    assert load_yaml_model(folder / "experiments" / "tighten.yaml", ExperimentFile).steps
    assert f"build it with `{build}`" in mistake("check", folder / "rig.yaml")
    schema_for(folder / "banks" / "paper.yaml")
    (folder / "rig.yaml").write_text("mine")
    (folder / "ur.yaml").unlink()
    assert "nothing was written; choose another folder" in mistake("init", folder)
    assert (folder / "rig.yaml").read_text() == "mine"
    assert not (folder / "ur.yaml").exists()
    assert "cannot be written: Not a directory; choose another path" in mistake("init", folder / "rig.yaml")


@pytest.fixture
def untouched(tmp_path, ran, tiny_bank) -> Path:
    """The configuration of a fresh folder of `init`, with its bank, at addresses that no other daemon has."""
    ran("init", tmp_path / "rig")
    shutil.copy(tiny_bank, tmp_path / "rig" / "paper.bank")
    path = tmp_path / "rig" / "rig.yaml"
    text = path.read_text()
    for key, port in (("publish", 7761), ("commands", 7762)):
        text = text.replace(f"{key}: tcp://127.0.0.1:{port}", f"{key}: ipc://{tmp_path}/{key}")
    path.write_text(text)
    return path


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize("command", [("check",), ("run",), ("commission", "--out", "report.yaml")])
def test_a_real_robot_does_not_run_before_its_workspace_and_its_tool_are_filled_in(command, untouched, ran):
    name, *options = command
    robot = untouched.with_name("ur.yaml")
    # Nothing of it refuses a rehearsal, also in the configuration of an experiment.
    said = ran(name, untouched, *options, status=0 if name == "check" else 2)
    if name == "check":
        for part in ("\nload_cell: ", "\ngripper: 2F-140", "\ncommissioned: the robot is capped at 0.2 rad/s"):
            assert part in said.out, "what is not filled in hides nothing"
        *_, workspace, tool, verdict = said.out.splitlines()
        rehearsal = f"{untouched} is in order for a rehearsal (`shearloop run --emulate`)"
        assert verdict == f"{rehearsal}; the real devices need the changes above"
    else:
        assert said.out == ""
        workspace, tool = said.err.removeprefix(f"shearloop {name}: ").splitlines()
    assert workspace.startswith(f"{robot}: limits.workspace is not filled in: measure the free space of your cell")
    assert tool.startswith(f"{robot}: tool (payload_kg, payload_cog_m, tcp_offset) is not filled in: enter ")
    assert workspace.endswith(stakes := "; a real robot does not run before, a rehearsal (`--emulate`) does")
    assert tool.endswith(stakes)


@pytest.mark.usefixtures("ur_rtde")
def test_what_is_not_filled_in_hides_no_mistake_of_an_experiment(untouched, ran):
    fast = {"do": "turn_to", "angle_rad": 1, "speed_rad_per_s": 3}
    path = untouched.with_name("fast.yaml")
    path.write_text(yaml.safe_dump({"name": "fast", "torque_source": "load_cell", "steps": [fast]}))
    said = ran("check", path, "--config", untouched, status=2)
    assert "speed_rad_per_s 3 rad/s: write 0.2 or less" in said.err
    assert "limits.workspace is not filled in" in said.err
    assert "turn_to" in said.out


@pytest.mark.usefixtures("ur_rtde")
def test_an_experiment_is_judged_for_a_rehearsal_before_the_robot_is_filled_in(untouched, ran, result_of):
    path = untouched.parent / "experiments" / "loosen.yaml"
    said = ran("check", path, "--config", untouched).out
    assert f"{path} is in order for a rehearsal of {untouched}" in said
    assert "limits.workspace is not filled in" in said
    for names in ((path, "--config", untouched), (untouched,)):
        assert len(result_of("check", *names)["open"]) == 2
    fit("motion_regression", [replace(twisting(tips=(1,), peak_nm=0.25), emulated=True)], "rig").save(
        untouched.with_name("right.cal")
    )
    text = untouched.read_text()
    assert "    # calibration: right.cal\n" in text
    untouched.write_text(text.replace("    # calibration: right.cal\n", "    calibration: right.cal\n"))
    said = ran("check", path, "--config", untouched).out
    assert "right.cal was made from recordings of emulated devices" in said
    assert f"{path} is in order for a rehearsal of {untouched}" in said
    untouched.with_name("paper.bank").unlink()
    said = ran("check", path, "--config", untouched, status=2)
    assert f"{path} is in order, and {untouched} is not" in said.out
    assert "paper.bank" in said.err


@pytest.mark.usefixtures("ur_rtde")
def test_the_parts_of_the_robot_that_are_commented_out_count_only_with_ones_own_numbers(untouched, mistake):
    robot = untouched.with_name("ur.yaml")
    parts = re.compile(r"^( *)# (tool:|  (payload_|tcp_)|workspace:|  (lower|upper|margin)_m)", re.MULTILINE)
    robot.write_text(parts.sub(r"\1\2", robot.read_text()))
    said = mistake("check", untouched)
    for key in ("payload_kg", "payload_cog_m[2]", "tcp_offset[5]", "workspace.lower_m[0]", "workspace.upper_m[2]"):
        assert f"{key}: " in said
    assert said.count("is not a number") == 16


@pytest.mark.usefixtures("ur_rtde")
def test_a_robot_that_is_filled_in_is_in_order(untouched, ran):
    write_filled_in(untouched.parent)
    assert "is in order" in ran("check", untouched).out


@pytest.mark.usefixtures("ur_rtde")
def test_a_gripper_that_is_not_at_its_robots_address_is_refused_and_a_rehearsal_says_so(untouched, ran):
    robot = write_filled_in(untouched.parent, host="10.20.3.14")
    text = untouched.read_text()
    untouched.write_text(text.replace("{host: 192.168.1.10}", "{host: 10.20.3.41}"))
    why = f"{robot}: `host: 10.20.3.14` differs from the configuration's `gripper.socket.host: 10.20.3.41`; "
    assert ran("run", untouched, status=2).err.startswith(f"shearloop run: {why}")
    assert why in ran("commission", untouched, "--out", untouched.with_name("report.yaml"), status=2).err
    said = ran("check", untouched).out
    assert why in said
    assert "in order for a rehearsal (`shearloop run --emulate`); the real devices need the changes above" in said
    config = load_daemon_config(untouched)
    (finding,) = check_gripper_address(config)
    assert finding.state == "trouble"
    with rehearsal(config, untouched) as rehearsed:
        assert any(sentence.startswith(why) for sentence in rehearsed.sentences)
        assert open_settings(rehearsed.config) is not None
    # Another spelling of the same address, and what another process plays.
    untouched.write_text(text.replace("{host: 192.168.1.10}", '{host: "::ffff:10.20.3.14"}'))
    assert open_settings(load_daemon_config(untouched)) is not None
    robot_at("127.0.0.1", untouched.parent)
    emulated = {"emulated": True, "gripper": {"model": "2F-140", "socket": {"host": "127.0.0.2"}}, "robot": "ur.yaml"}
    untouched.write_text(yaml.safe_dump({**emulated, "load_cell": {"device": {"path": "load"}}}))
    assert open_settings(load_daemon_config(untouched)) is not None


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize(("tool", "status"), [(TOOL, 0), ({}, 2)])
def test_a_workspace_that_the_emulated_arm_does_not_reach_is_named_in_words(tool, status, untouched, ran):
    """Where the real robot may not run either, the configuration is refused."""
    robot = yaml.safe_load(write_filled_in(untouched.parent, tool=tool).read_text())
    robot["limits"]["workspace"] = {"lower_m": [1.3, 1.2, 0.1], "upper_m": [1.8, 1.7, 0.5], "margin_m": 0.02}
    untouched.with_name("ur.yaml").write_text(yaml.safe_dump(robot))
    out, err = ran("check", untouched, status=status)
    said = err if status else out
    box = "x from 1.3 to 1.8 m, y from 1.2 to 1.7 m, z from 0.1 to 0.5 m; check `limits.workspace`"
    assert "refused: the emulated arm, a UR5e, reaches no point" in said
    assert box in said
    assert ("tool (payload_kg, payload_cog_m, tcp_offset) is not filled in" in said) is (status == 2)
    assert "in order for a rehearsal" not in out
    assert box in ran("run", untouched, "--emulate", status=2).err


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize(("robot", "status"), [({}, 0), ({"robot": "ur.yaml"}, 2)])
def test_a_fingertip_without_a_bank_is_named_because_no_rehearsal_plays_it(robot, status, untouched, ran):
    fit("motion_regression", [twisting(tips=(1,), peak_nm=0.25)], "rig").save(untouched.with_name("right.cal"))
    fingertip = {"device": {"serial_number": "7"}, "calibration": "right.cal"}
    addresses = {key: f"ipc://{untouched.parent}/{key}" for key in ("publish", "commands")}
    untouched.write_text(yaml.safe_dump({"fingertips": {"right": fingertip}, **addresses, **robot}))
    why = f"{untouched}: `fingertips.right` has no `bank`, whose signals make the emulated frames; give one"
    out, err = ran("check", untouched, status=status)
    assert f"refused: {why}" in (err if status else out)
    assert "in order for a rehearsal" not in out
    assert why in ran("run", untouched, "--emulate", status=2).err


@pytest.mark.usefixtures("ur_rtde")
def test_an_untouched_folder_is_rehearsed_and_the_first_lines_say_what_is_not_filled_in(untouched):
    with rehearsal(load_daemon_config(untouched), untouched) as rehearsed:
        settings = open_settings(rehearsed.config)
        said = [one for one in rehearsed.sentences if "is not filled in" in one]
    assert is_loopback_host(settings.host)
    assert [one.partition(": ")[2].split()[0] for one in said] == ["limits.workspace", "tool"]


def test_init_leaves_nothing_behind_on_a_full_disc(tmp_path, mistake, monkeypatch):
    written, whole = [], Path.write_bytes

    def until_full(path: Path, content: bytes) -> int:
        written.append(path)
        # As a disc fills up within a file.
        size = whole(path, content[: None if len(written) < 8 else 3])
        if len(written) == 8:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return size

    monkeypatch.setattr(Path, "write_bytes", until_full)
    assert "cannot be written: No space left on device" in mistake("init", tmp_path / "rig")
    assert [path for path in (tmp_path / "rig").rglob("*") if path.is_file()] == []
    assert len(written) == 8


@pytest.mark.long
def test_the_demos_page_lasts_as_long_as_the_demo(tmp_path, monkeypatch, capsys):
    """The page's address is printed before the loop starts."""
    aiohttp = pytest.importorskip("aiohttp", reason="the live view needs the extra `view`")
    import asyncio

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    content = {"fingertips": {"right": {"device": {"path": "/dev/null"}}}}
    config = DaemonConfig(publish=f"ipc://{tmp_path}/publish", commands=f"ipc://{tmp_path}/commands", **content)

    async def status(url: str) -> int:
        async with aiohttp.ClientSession() as http, http.get(url) as page:
            return page.status

    with demo.page(config, 0):
        url = capsys.readouterr().out.rsplit(" ", 1)[1].strip()
        assert asyncio.run(status(url)) == 200
    with pytest.raises(aiohttp.ClientConnectorError):
        asyncio.run(status(url))


def test_ctrl_c_reaches_no_process_of_the_demo(capfd):
    with running([sys.executable, "-c", "import os; print(os.getpgrp())"]) as process:
        assert process.wait() == 0
    assert int(capfd.readouterr().out) != os.getpgrp()
    with running([sys.executable, "-c", "import time; time.sleep(60)"], stdout=subprocess.PIPE) as process:
        pass
    assert process.returncode == -signal.SIGTERM


@pytest.mark.parametrize("option", ["--play", "--recording"])
def test_the_demo_refuses_a_recording_that_is_not_there_at_once(option, tmp_path, mistake):
    said = mistake("demo", "--folder", tmp_path, option, tmp_path / "none.mat")
    assert "none.mat: the recording cannot be read: No such file" in said


def test_the_demo_without_aiohttp_says_what_the_page_needs(monkeypatch, capsys):
    monkeypatch.setattr(demo, "find_spec", lambda _: None)
    with demo.page(DaemonConfig(fingertips={"right": {"device": {"path": "/dev/null"}}}), 0):
        assert "pip install 'shearloop[view]'" in capsys.readouterr().out
