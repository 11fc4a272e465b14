"""The command line: every mistake is one sentence with its cure and status 2; help and `stop` import little."""

import argparse
import ctypes
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from io import StringIO
from pathlib import Path
from typing import Any, NoReturn
from unittest.mock import Mock

import numpy as np
import pytest
import zmq.asyncio

from shearloop.bank.models import MODELS
from shearloop.cli import main
from shearloop.cli.bank import MODEL_NAMES
from shearloop.cli.command import _lines
from shearloop.cli.completion import arguments_of, full_parser, parts_of
from shearloop.cli.options import path_of
from shearloop.cli.output_paths import output_path
from shearloop.cli.registry import COMMANDS, GROUPS, OTHER_SPELLINGS, command_module
from shearloop.cli.terminal import StatusLine, loop_line, message_json, message_line, table
from shearloop.daemon.app import Daemon
from shearloop.daemon.config import TAKEN_NAMES, load_daemon_config
from shearloop.daemon.messaging.deadlines import boot_ns
from shearloop.daemon.messaging.messages import TOPICS, EitEstimate, RobotStateMessage, decode, encode, wire_map
from shearloop.daemon.rig import LOOP_KEYS
from shearloop.daemon.run_summary import RunSummary
from shearloop.daemon.sensing.sessions import COMBINED
from shearloop.daemon.sensing.skin_task import SKIN
from shearloop.daemon.torques import WRENCH
from shearloop.errors import UserError
from shearloop.tools.recordings.time_formats import STREAM_VARIABLES
from shearloop.tools.task_row import task_row
from tests.fixtures.robots import write_filled_in
from tests.paper_curve import paper_curve
from tests.sample_messages import sample


@pytest.mark.parametrize("found", ["Unable to allocate 34 MiB", ""])
def test_a_lack_of_memory_is_one_sentence(found, monkeypatch, mistake, tiny_bank):
    monkeypatch.setattr("shearloop.bank.bank_file.Bank.open", Mock(side_effect=MemoryError(*filter(None, [found]))))
    said, cure = found or "none is left", "close other programs, or ask for less at a time"
    assert mistake("bank", "info", tiny_bank) == f"shearloop bank: not enough memory: {said}; {cure}\n"


def test_a_file_that_is_not_there_hides_no_other_mistake(config, tmp_path, mistake):
    steps = "[{do: wiat}, {do: turn_to, angle_rad: 90}, {do: hold_torque, torque_nm: 9}]"
    (tmp_path / "experiment.yaml").write_text(f"name: one\nsteps: {steps}\n")
    tips = {name: {"device": {"path": name}, "bank": f"{name}.bank"} for name in ("right", "left")}
    files = {"load_cell": {"device": {"path": "load"}, "calibration": "load.yaml"}, "robot": "ur.yaml"}
    parts = {"fingertips": tips, "experiment": "experiment.yaml", **files}
    said = mistake("check", str(config(**parts)))
    for part in ("right.bank: the bank", "left.bank: the bank", "load.yaml: the calibration", "ur.yaml: the robot"):
        assert f"{tmp_path}/{part}" in said
    assert "torque_source: `right` is a fingertip without a calibration" in said
    of_steps = (
        "steps[0].do: 'wiat' does not exist",
        "steps[1].angle_rad: 90 is too large",
        "steps[2].torque_nm: 9 is too large",
        "steps[2]: hold_torque needs an identified tool",
    )
    assert [said.count(one) for one in of_steps] == [1] * 4
    said = mistake("check", str(config(**parts, fingertip={})))
    assert [said.count(one) for one in ("fingertip: is not a known key", *of_steps)] == [1] * 5


def fingertip(**changes: Any) -> dict[str, Any]:
    return {"fingertips": {"right": {"device": {"path": "eit"}, "bank": "no.bank", **changes}}}


@pytest.mark.parametrize(
    "name", ["ur.yaml", "fingertips/paper.yaml", "banks/paper.yaml", "calibrations/skin_demo.yaml"]
)
def test_check_and_run_say_the_same_of_a_file_of_another_kind(name, mistake):
    path = Path(__file__).parents[2] / "config" / name
    said = mistake("run", str(path))
    assert said.startswith(f"shearloop run: {path}:1: this is ")
    assert mistake("check", str(path)).partition(": ")[2] == said.partition(": ")[2]


@pytest.mark.parametrize("command", ["run", "check"])
@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"fingertips": {}}, ["fingertips"]),
        ({"fingertip": {}}, ["fingertip: is not a known key; did you mean fingertips?"]),
        ({"host": "a"}, ["this is the robot's settings; name this file in a configuration as `robot`"]),
        ({"electrodes": []}, ["this is a fingertip's description; name it in a bank's as `fingertip`"]),
        ({"sigma": {}}, ["this is a bank's description; `shearloop bank build --config FILE` takes it"]),
        ({"publish": "tcp://lab-pc:7761"}, ["publish", "loopback"]),
        ({"publish": "tcp://127.0.0.1:70000"}, ["publish: must end in a port, a whole number from 1 to 65535, as in"]),
        ({"publish": "tcp://127.0.0.1:0"}, ["publish: must end in a port, a whole number from 1 to 65535"]),
        ({"commands": "tcp://127.0.0.1:7762a"}, ["commands: must end in a port, a whole number"]),
        ({"commands": "tcp://127.0.0.1"}, ["commands: must end in a port, a whole number"]),
        ({"publish": "ipc:///tmp/both", "commands": "ipc:///tmp/both"}, ["are both ipc:///tmp/both"]),
        (
            {"emulated": True, **fingertip(device={"serial_number": "1"})},
            ["`fingertips.right.device.serial_number: 1`"],
        ),
        (
            {"emulated": True, **fingertip(device={"path": "/dev/ttyACM0"})},
            ["device.path: /dev/ttyACM0`, a real device"],
        ),
        (
            {"emulated": True, "robot": "ur.yaml", "gripper": {"model": "2F-140", "socket": {"host": "192.168.1.10"}}},
            ["`gripper.socket.host"],
        ),
        (
            {"autostart": True, "experiment": "one.yaml", "robot": "ur.yaml"},
            ["`autostart` moves the robot without a command"],
        ),
        (
            {"emulators": [{"device": "hx711", "arguments": ["--link", "load"]}], "emulated": False},
            ["`emulators` play devices: add `emulated: true`"],
        ),
        ({"autostart": True, "emulated": True}, ["`autostart` starts no experiment"]),
        ({"experiment": "", "robot": "ur.yaml"}, ["experiment: must be the path of a file, not '.'"]),
        ({"robot": "a\0b"}, ["robot: must be the path of a file"]),
        ({"fingertips": {"Right Hand": {}}}, ["fingertips"]),
        (
            {"fingertips": {"load_cell": {"device": {"path": "eit"}}}},
            ["`fingertips.load_cell` has the name of another"],
        ),
        (fingertip(), ["no.bank", "shearloop bank build"]),
        (fingertip(device={}), ["device", "either serial_number or path"]),
        (fingertip(device={"path": "eit", "serial_number": "1"}), ["either serial_number or path"]),
        (fingertip(baseline_frames=1), ["fingertips.right.baseline_frames", "from 2 to 1000"]),
        (fingertip(matching="best"), ["matching", "all_lags"]),
        (
            fingertip(bank=None, estimator="motion_regression", calibration="no.cal"),
            ["no.cal does not exist; make one", "REC… --sides right --estimator motion_regression --out "],
        ),
        (fingertip(baseline_frames=0, average_frames=0), ["baseline_frames", "average_frames"]),
    ],
)
def test_a_configuration_mistake_names_file_key_and_cure(command, changes, parts, config, mistake):
    path = config(**changes)
    said = mistake(command, str(path))
    assert any(str(path.with_name(name)) in said for name in (path.name, "no.bank", "no.cal"))
    assert [part for part in parts if part not in said] == []


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize("command", ["run", "check"])
def test_a_real_robot_in_an_emulated_rig_is_refused(command, config, tmp_path, mistake):
    shutil.copy("config/ur.yaml", tmp_path / "ur.yaml")
    said = mistake(command, str(config(robot="ur.yaml", emulated=True)))
    assert re.search(rf"{tmp_path}/ur\.yaml:\d+: host: 192\.168\.1\.10 is not this computer", said)


@pytest.mark.usefixtures("ur_rtde")
async def test_fingertip_names_do_not_collide_with_task_names(config, tmp_path):
    write_filled_in(tmp_path)
    (tmp_path / "wait.yaml").write_text("{name: one, torque_source: right, steps: [{do: wait, wait_s: 1}]}")
    whole = config(
        robot="ur.yaml",
        gripper={"model": "2F-140", "socket": {"host": "192.168.1.10"}},
        load_cell={"device": {"path": "load"}},
        experiment="wait.yaml",
        recording={"folder": "recordings"},
    )
    with zmq.asyncio.Context() as context:
        daemon = Daemon(load_daemon_config(whole), context)
        names = {*daemon.health.tasks(), *daemon.tasks}
        daemon.stop()
        await daemon.run()
    assert {"right", "robot", "gripper", "loop", "load_cell", "recording", "health"} <= names
    assert (names | {COMBINED, SKIN, WRENCH}) - TAKEN_NAMES == {"right"}


def test_a_calibration_of_another_bank_is_refused(config, tiny_bank, tmp_path, mistake):
    foreign = tmp_path / "foreign.yaml"
    grid = np.linspace(1, 2, 9)
    paper_curve("cd" * 32, torque=(grid, grid)).save(foreign)
    said = mistake("check", str(config(**fingertip(bank=str(tiny_bank), calibration=str(foreign)))))
    for part in (str(foreign), "made with the bank cdcdcd", "calibrate again"):
        assert part in said


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["check", "no-such.yaml"], "no-such.yaml"),
        (["listen", "gel"], "there is no topic 'gel'. The topics are eit.frame, eit.estimate"),
        (["command", "pause", "--yes"], "--yes is for tare, start, unlock, release; leave it out of `pause`"),
        (["command", "pause", "--source", "left"], "--source is for tare; leave it out of `pause`"),
        (["command", "tare", "--experiment", "a.yaml"], "--experiment is for start; leave it out of `tare`"),
        (["listen", "skin.sheer"], "there is no topic 'skin.sheer'; did you mean skin.shear?"),
        (["listen", "eit.estimat"], "there is no topic 'eit.estimat'; did you mean eit.estimate? The topics are eit."),
        (["evaluate", "rec.mcap", "my.cal"], "rec.mcap is a recording, not a calibration; the calibration comes first"),
        (["adapt", "rec.mcap.partial", "my.cal", "--out", "new.cal"], "rec.mcap.partial is a recording, not a cal"),
        (["listen", "--count", "0"], "--count 0"),
        (["listen", "--timeout", "-1"], "--timeout -1"),
        (["listen", "--timeout", "inf"], "--timeout inf"),
        (["command", "status", "--timeout", "nan"], "--timeout nan"),
        (["command", "status", "--timeout", "-1"], "--timeout -1"),
        (["listen", "--connect", "here", "--timeout", "1"], "'here' is not an address"),
        (["listen", "eit.", "--connect", "ipc:///tmp/nobody-speaks-here", "--timeout", "0.05"], "no message came"),
        (["command", "start", "--connect", "ipc:///nobody", "--timeout", "2.5"], "at ipc:///nobody within 2.5 s"),
        (
            ["listen", "--connect", "tcp://127.0.0.1:70000", "--timeout", "0.05"],
            "tcp://127.0.0.1:70000 has no valid port",
        ),
        (
            ["command", "stop", "--connect", "tcp://127.0.0.1:7762a", "--timeout", "0.05"],
            "a whole number from 1 to 65535",
        ),
        (["listen", "--connect", "ipc:///tmp/nobody-speaks-here", "--timeout", "0.05"], "no message came"),
        (["command", "tare", "--connect", "ipc:///nobody", "--timeout", "0.05"], "no daemon answered at ipc:///nobody"),
    ],
)
def test_a_command_line_mistake_is_one_sentence(arguments, part, mistake):
    assert part in mistake(*arguments)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ("chart", "the following arguments are required: NAME, --out; NAME is one of speed-accuracy, stability, loop"),
        ("schema", "the following arguments are required: kind; kind is one of configuration, experiment, robot, bank"),
        ("recording import", "the following arguments are required: FORMAT; FORMAT is one of mat"),
        ("recording lsit", "there is no 'lsit'; did you mean list?"),
        ("recording info", "the following arguments are required: REC"),
        ("run x.yaml --log-level loud", "there is no 'loud' of --log-level; there are debug, info, warning, error"),
        ("run x.yaml --set loop.kp", "--set loop.kp is not of the form KEY=VALUE, such as loop.kp=0.5"),
        ("listen --timeout", "--timeout: expected one argument"),
        ("command strat", "there is no 'strat'; did you mean status?"),
        ("command relase", "there is no 'relase'; there are tare, status, experiments, start,"),
        ("bank info", "the following arguments are required: PATH"),
        ("chart scene --out DIR --bnak my.bank", "unrecognized arguments: --bnak my.bank; did you mean --bank?"),
        ("command stauts", "there is no 'stauts'; did you mean status?"),
        ("listen --cuont", "unrecognized arguments: --cuont; did you mean --count?"),
        ("evaluate a.cal --cluster README.md", "--cluster README.md is a file and no address; write `--cluster local`"),
    ],
)
def test_a_mistake_in_the_words_names_the_help(arguments, sentence, mistake):
    said = mistake(*arguments.split())
    assert f": {sentence}" in said
    nested = arguments in ("bank info", "recording import", "recording info")
    program = f"shearloop {arguments if nested else arguments.split()[0]}"
    assert said.endswith(f"; see `{program} --help`\n")


@pytest.mark.parametrize(
    "arguments",
    [
        "chart scene --out DIR a.mcap b.mcap",
        "chart --out DIR scene a.mcap b.mcap",
        "chart scene a.mcap --out DIR b.mcap",
        "evaluate a.cal --json a.mcap --out DIR b.mcap",
        "calibrate a.mcap --out DIR b.mcap",
        "calibrate recording --out DIR a.mcap b.mcap",
        "recording info a.mcap --json b.mcap",
    ],
)
def test_options_may_stand_between_recordings(arguments, monkeypatch):
    name, *words = arguments.split()
    module = command_module(name)
    parsed = Mock(return_value=0)
    for where in ("shearloop.cli.calibrate.recording.run", "shearloop.cli.recording._info"):
        monkeypatch.setattr(where, parsed)
    if name in ("chart", "evaluate"):
        monkeypatch.setattr(module, "run", parsed)
    assert main([name, *words]) == 0
    [args] = parsed.call_args.args
    assert [str(path) for path in args.recordings] == ["a.mcap", "b.mcap"]
    assert getattr(args, "name", "scene") == "scene"


INTERRUPTED = "shearloop evaluate: interrupted before it was done\n"


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_an_interrupted_command_reports_it_unless_it_only_waits(number, status, monkeypatch, tmp_path, ran):
    def interrupted(*_: object) -> NoReturn:
        signal.raise_signal(number)
        raise AssertionError

    monkeypatch.setattr("shearloop.cli.evaluate.run", interrupted)
    assert ran("evaluate", "a.cal", "b.mcap", status=status) == ("", INTERRUPTED)
    monkeypatch.setattr("shearloop.daemon.messaging.client.receive_messages", interrupted)
    assert ran("listen", status=status) == ("", "")
    # What has started them says that it was interrupted.
    monkeypatch.setattr("shearloop.cli.view.load_fingertip", interrupted)
    assert ran("view", "--token-file", tmp_path / "token", status=status) == ("", "")
    monkeypatch.setattr("shearloop.cli.emulate.rig.robot_make", interrupted)
    assert ran("emulate", "rig", "--bank", "my.bank", "--run-dir", tmp_path, status=status) == ("", "")


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (KeyboardInterrupt(), 130, "interrupted before it was done"),
        (UserError("No robot answers."), 2, "No robot answers"),
    ],
)
def test_the_end_of_a_commissioning_says_what_is_kept(error, status, said, monkeypatch, ran, config, tmp_path):
    def ends(*_: object) -> NoReturn:
        error.add_note("Run it again to continue")
        raise error

    monkeypatch.setattr("shearloop.tools.commission.procedure.commission", ends)
    found = ran("commission", config(), "--out", tmp_path / "report.yaml", status=status).err
    assert found == f"shearloop commission: {said}. Run it again to continue\n"


def test_a_closed_terminal_causes_no_traceback(monkeypatch, ran):
    def interrupted(_: object) -> NoReturn:
        monkeypatch.setattr(sys.stderr, "write", Mock(side_effect=OSError(5, "Input/output error")))
        raise KeyboardInterrupt

    monkeypatch.setattr("shearloop.cli.evaluate.run", interrupted)
    assert ran("evaluate", "a.cal", "b.mcap", status=130) == ("", "")


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_during_a_callback_from_compiled_code_is_not_lost(number, status, monkeypatch, ran):

    def loads(_: object) -> int:
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()
        threading.Event().wait(10)
        return 0

    monkeypatch.setattr("shearloop.cli.evaluate.run", loads)
    assert ran("evaluate", "a.cal", "b.mcap", status=status) == ("", INTERRUPTED)


@pytest.mark.parametrize("option", ["--play", "--recording"])
def test_a_played_file_needs_an_emulator(option, config, mistake):
    said = mistake("run", str(config()), option, "some.mat")
    assert "has no eit-kit among its `emulators`" in said


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("replay no.mcap", "recording replay"),
        ("import mat no.mat --out a.mcap", "recording import"),
        ("export no.mcap", "recording export"),
        ("info no.mcap", "recording info"),
        ("repair no.mcap --out a.mcap", "recording repair"),
        ("stop --connect ipc://none --timeout 0.1", "command stop"),
        ("status --connect ipc://none --timeout 0.1", "command status"),
    ],
)
def test_other_spellings_work_and_answer_with_the_command(old, new, ran, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, rest = ran(*old.split(), status=2).err.split("\n", 1)
    assert first == f"`shearloop {old.split()[0]}` is `shearloop {new}`"
    assert rest == ran(*new.split(), *old.split()[1:], status=2).err
    assert set(OTHER_SPELLINGS).isdisjoint(COMMANDS)


def test_the_help_of_import_names_the_variables_of_each_stream(capsys):
    with pytest.raises(SystemExit):
        main(["recording", "import", "mat", "--help"])
    said = capsys.readouterr().out
    assert all(name in said for names in STREAM_VARIABLES.values() for name in names)


@pytest.mark.parametrize("one", [("--connect", "tcp://127.0.0.1:8791"), ("--commands", "tcp://127.0.0.1:8792")])
def test_a_page_of_one_daemon_does_not_command_another(one, mistake):
    assert "give both --connect and --commands of the same daemon" in mistake("view", *one)


@pytest.mark.parametrize("word", ["release", "resume", "start", "tare", "unlock"])
def test_what_may_move_the_rig_is_named_and_not_carried_out_without_the_word_command(word, ran, monkeypatch):
    monkeypatch.setattr("shearloop.cli.command.run", Mock(side_effect=AssertionError))
    assert f"there is no '{word}'; it is `shearloop command {word}`" in ran(word, status=2).err


def test_the_overview_has_every_command_in_one_group(capsys):
    with pytest.raises(SystemExit):
        main([])
    printed = capsys.readouterr().out
    for group, commands in GROUPS.items():
        section = printed.partition(f"\n{group}:\n")[2].partition("\n\n")[0]
        assert [line.split()[0] for line in section.splitlines()] == list(commands)


def test_set_replaces_values_of_the_configuration(config, tmp_path, mistake):
    path = config()
    found = load_daemon_config(path, {"loop.kp": "0.25", "recording.folder": "kept", "fingertips.right.bank": "b.bank"})
    assert (found.loop.kp, found.recording.folder) == (0.25, tmp_path / "kept")
    assert found.fingertips["right"].bank == tmp_path / "b.bank"
    assert found.publish == load_daemon_config(path).publish
    for assignment, sentence in (
        ("loop.kq=1", "loop.kq: is not a known key; allowed: "),
        ("loop.kp=[1", "loop.kp=[1: the value is not YAML"),
        ("publish.port=3", "publish is a value, so it has no port"),
        ("emulators.2.device=rig", "emulators is a list of 0, so 2 is not one of its numbers"),
    ):
        assert sentence in mistake("run", str(config(emulators=[])), "--set", assignment)


def test_set_takes_a_number_as_text_where_a_text_is_expected(config, tmp_path):
    device = "fingertips.right.device"
    given = {"name": "007", f"{device}.serial_number": "0070123", f"{device}.path": "", "loop.kp": "0.5"}
    found = load_daemon_config(config(), given)
    assert (found.name, found.fingertips["right"].device.serial_number, found.loop.kp) == ("007", "0070123", 0.5)
    assert load_daemon_config(config(), {"name": "on"}).name == "on"
    assert load_daemon_config(config(), {f"{device}.path": "0123"}).fingertips["right"].device.path == tmp_path / "0123"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(name, capsys):
    with pytest.raises(SystemExit) as ended:
        main([name, "--help"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert f"usage: shearloop {name}" in printed
    assert "%%" not in printed


@pytest.mark.parametrize("arguments", [[], ["help"], ["--help"], ["help", "run"]])
def test_help_comes_without_a_command_too(arguments, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(arguments)
    out, err = capsys.readouterr()
    assert (out.startswith("usage: shearloop run") if "run" in arguments else "\n  run " in out, err) == (True, "")


def test_an_unknown_command_lists_the_known_ones(capsys):
    for name, said in (("fly", " run, "), ("rnu", "; did you mean run?; see `shearloop --help`")):
        assert main([name]) == 2
        assert said in capsys.readouterr().err


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield the parsers of a command's parts, or its own where it has none."""
    for below in parts_of(parser).values():
        yield from parsers(below)
    if not parts_of(parser):
        yield parser


def test_every_argument_has_a_help_text():
    for parser in parsers(full_parser()):
        for argument in arguments_of(parser):
            assert argument.help, f"{parser.prog} {argument.dest}"
            assert not argument.help.startswith(("default", "(default")), f"{parser.prog} {argument.dest}"


def options_of(parser: argparse.ArgumentParser) -> set[str]:
    return {option for action in arguments_of(parser) for option in action.option_strings}


def path_actions() -> list[tuple[str, argparse.Action]]:
    """Every argument that takes a path, by its name or by its type, with its command."""
    named = re.compile(r"(FILE|DIR|PATH|REC|CAL|SRC|CONFIG|TABLE|RIG|YAML|RECORDINGS?)(\.\w+)?")
    return [
        (f"{parser.prog} {action.dest}", action)
        for parser in parsers(full_parser())
        for action in arguments_of(parser)
        if action.type in (Path, path_of, output_path)
        or (isinstance(action.metavar, str) and named.fullmatch(action.metavar))
    ]


def test_every_path_of_a_command_is_expanded(monkeypatch):
    monkeypatch.setenv("HOME", "/home/person")
    monkeypatch.setenv("DATA", "/data")
    found = path_actions()
    assert len(found) > len(COMMANDS)
    written = {
        "~/a.mcap": "/home/person/a.mcap",
        "$HOME/a": "/home/person/a",
        "${DATA}/a": "/data/a",
        "a~/b$1": "a~/b$1",
    }
    for name, action in found:
        assert {text: str(action.type(text)) for text in written} == written, name


@pytest.mark.parametrize("option", ["--config", "--config="])
def test_a_path_that_cannot_be_expanded_is_refused(mistake, monkeypatch, option):
    monkeypatch.delenv("NOWHERE", raising=False)
    options = [f"{option}$NOWHERE/a"] if option.endswith("=") else [option, "$NOWHERE/a"]
    assert "$NOWHERE/a has the variable $NOWHERE, which is not set here" in mistake("check", "a.yaml", *options)
    assert "begins with ~no-such-user, the home of an unknown user" in mistake("check", "~no-such-user/a.yaml")


def test_an_address_with_a_home_is_expanded(monkeypatch):
    monkeypatch.setenv("HOME", "/home/person")
    parser = _command("command")
    assert parser.parse_args(["status", "--connect=ipc://~/run/commands"]).connect == "ipc:///home/person/run/commands"
    assert parser.parse_args(["status", "--connect", "tcp://~:1"]).connect == "tcp://~:1"


# What a script needs no `--json` of, and why.
WITHOUT_JSON = {
    "run": "it logs JSON lines with --json-log, and publishes",
    "emulate": "its events are JSON lines as they are",
    "completion": "it prints what a shell reads",
    "demo": "it prints what `run` prints",
    "init": "it prints the next steps",
    "schema": "it prints JSON as it is",
    "bank design": "it prints the YAML that `bank build` takes",
    "chart": "it prints the files drawn, one a line; its numbers are a JSON file among them",
}


def test_every_command_has_a_json_option_or_a_reason_for_none():
    every = {parser.prog.removeprefix("shearloop "): parser for parser in parsers(full_parser())}
    lacking = {name for name, parser in every.items() if "--json" not in options_of(parser)}
    assert {next((known for known in WITHOUT_JSON if name.startswith(known)), name) for name in lacking} == set(
        WITHOUT_JSON
    )


def test_help_names_all_basis_models():
    assert MODEL_NAMES.replace(" or ", ", ").split(", ") == list(MODELS)


def test_help_loads_no_heavy_modules():
    heavy = ("numpy", "scipy", "pydantic", "zmq", "matplotlib", "skfem", "serial", "yaml", "tqdm")
    program = (
        "import sys\nfrom shearloop.cli import main\nfrom shearloop.cli.registry import COMMANDS\n"
        "for arguments in [[], *([name] for name in COMMANDS)]:\n"
        "    try: main([*arguments, '--help'])\n    except SystemExit: pass\n"
        f"    loaded = [name for name in {heavy!r} if name in sys.modules]\n"
        "    if loaded: print(arguments, loaded, file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == ""


def test_messages_are_readable():
    values = {"diameter_mm": 31.0, "k": 3.5, "sigma": 1.5, "score": 0.75, "reason": ""}
    message = sample(EitEstimate, torque_nm=0.05, torque_low_nm=0.02, torque_high_nm=0.08, **values)
    content = decode(encode(wire_map(message, timestamp=0.0, seq=1)))
    line = message_line("eit.estimate", content)
    assert "torque +0.0500 N·m [+0.0200, +0.0800]   diameter  31.0 mm   k 3.500   " in line
    assert line.endswith("sigma 1.500 cm   score 0.750")
    assert message_json("eit.estimate", content).startswith('{"topic": "eit.estimate", "timestamp": 0.0')
    robot = decode(encode(wire_map(sample(RobotStateMessage, blocked=""), timestamp=0.0, seq=1)))
    shown = message_line("robot.state", {**robot, "safety_mode": None})
    assert "joints_rad (" in shown
    assert not any(word in shown for word in ("blocked", "safety_mode", "None"))
    invalid = {**content, "valid": False, "reason": "no signal"}
    assert message_line("eit.estimate", invalid).endswith("no estimate: no signal")


def test_a_task_row_shows_state_rate_and_errors_and_leaves_unknown_facts_empty():
    facts = {"alive": True, "done": False, "restarts": 0, "last_error": "", "rate_hz": None, "errors": {}}
    for changes, row in (
        ({}, ("alive", "", "")),
        ({"rate_hz": 1.85, "expected_hz": 1.849}, ("alive", "1.85 of 1.85 Hz", "")),
        ({"connected": True, "errors": {"unreachable": 1}}, ("alive", "", "reconnected once")),
        ({"connected": True, "connections": 3}, ("alive", "", "reconnected twice")),
        ({"connected": False, "error": "No board."}, ("not connected", "", "No board.")),
        ({"errors": {"nan": 3}, "restarts": 1}, ("alive", "", "restarted once, nan 3 times")),
        ({"alive": False, "last_error": "ValueError"}, ("DEAD", "", "ValueError")),
        ({"alive": False, "done": True}, ("done", "", "")),
    ):
        assert task_row("right", {**facts, **changes})[1:] == row
    assert table(("a", "b"), [("longer", "x")]) == ["a       b", "longer  x"]


def test_the_status_line_is_redrawn_in_place(monkeypatch):
    out = StringIO()
    state = {"experiment": "one", "step": 2, "steps": 3, "step_name": "grip", "progress": 0.5, "reasons": ""}
    with StatusLine(out) as line:
        line("loop.state", {**state, "phase": "running", "activity": "closing", "torque_source": "right"})
        for source, valid in (("right", True), ("left", True), ("right", False)):
            line("eit.estimate", {"source": source, "valid": valid, "torque_nm": 0.1})
    _, starting, *shown, end = out.getvalue().split("\r\x1b[K")
    running = "running 50 %  step 2 of 3 grip  closing"
    assert (starting, shown, end) == ("starting", [running, f"{running}   right +0.100 N·m", running], "")
    narrow = StringIO()
    monkeypatch.setattr("shutil.get_terminal_size", lambda **_: os.terminal_size((50, 24)))
    line = StatusLine(narrow)
    line("loop.state", {**state, "phase": "running", "activity": "closing on a tool", "torque_source": "right"})
    line("eit.estimate", {"source": "right", "valid": True, "torque_nm": 0.1})
    assert narrow.getvalue().split("\r\x1b[K")[-1] == "running 50 %  step 2 of 3 gri…   right +0.100 N·m"
    line = StatusLine(narrow)
    line("eit.estimate", {"source": "right", "timestamp": 0.0, "valid": False, "reason": "no grip"})
    assert "eit.estimate  right     no estimat…" in narrow.getvalue(), "without a robot there is no state of the loop"
    line = StatusLine(narrow, topics=("load.torque",))
    line("load.torque", {"source": "load_cell", "timestamp": 0.0, "valid": False, "reason": "spike", "raw": 1.0})
    assert "load.torque   load_cell no torque:" in narrow.getvalue(), "a load cell alone is shown as well"
    stopped = {**state, "phase": "stopped", "activity": "the operator stopped it"}
    assert loop_line(stopped) == "stopped: the operator stopped it  step 2 of 3 grip"
    held = {**state, "phase": "held", "activity": "closing", "reasons": "no estimate"}
    assert loop_line(held) == "held 50 %: no estimate  step 2 of 3 grip  closing", "what is cut matters less"


def test_the_status_gives_the_cause_then_the_step():
    assert {"cause", "faults"} <= set(LOOP_KEYS)
    step = {"experiment": "one", "step": 2, "steps": 3, "step_name": "grip", "progress": 0.5, "activity": ""}
    loop = {
        **step,
        "phase": "stopped",
        "cause": "it slipped.",
        "faults": "grip lost",
        "reasons": "it slipped. And more.",
    }
    lines = _lines("status", {"tasks": {}, "loop": loop})
    assert lines[:2] == ["stopped: it slipped.", "step 2 of 3 grip"]


def test_the_summary_of_a_run_that_ends_with_its_experiment_comes_last(config, monkeypatch, capsys):
    at_once: list[bool] = []

    async def run_daemon(_config: object, _listeners: object, _on_ready: object, summary: RunSummary) -> bool:
        summary.add("What happened: nothing.")
        at_once.append(summary.out is not None)
        return True

    monkeypatch.setattr("shearloop.daemon.app.run_daemon", run_daemon)
    path = config()
    for ends in (False, True):
        loaded = load_daemon_config(path).model_copy(update={"stop_when_done": ends})
        monkeypatch.setattr("shearloop.cli.run._config", lambda _, loaded=loaded: loaded)
        assert main(["run", str(path), "--show"]) == 0
        assert capsys.readouterr().out == "\nWhat happened: nothing.\n\n"
    assert at_once == [True, False]


def test_invalid_emulators_and_recordings_are_refused_before_the_start(config, tmp_path, mistake):
    unknown = str(config(emulators=[{"device": "eit-kitt"}]))
    for command in ("check", "run"):
        assert "`emulators[0].device` is 'eit-kitt'; there are eit-kit" in mistake(command, unknown)
    for arguments, part in (
        (["--bank", "b"], "--bank b: there is no such file; build it with `shearloop bank build --config FILE --out "),
        (["--speed", "fast"], "--speed fast is not a number above 0; see `shearloop emulate eit-kit --help`"),
        (["--sped", "2"], "unrecognized arguments: --sped 2"),
        (["--help"], "unrecognized arguments: --help"),
    ):
        wrong = str(config(emulators=[{"device": "eit-kit", "arguments": arguments}]))
        for command in ("check", "run"):
            said = mistake(command, wrong)
            assert "`emulators[0].arguments`: eit-kit: " in said
            assert part in said
    known = str(config(emulators=[{"device": "eit-kit"}]))
    assert "the recording cannot be read" in mistake("run", known, "--play", str(tmp_path / "none.mat"))


def test_what_takes_long_waits_and_a_missing_daemon_is_reported_at_once(monkeypatch, capsys, tmp_path):
    asked: list[tuple[str, float]] = []

    def answers(_address: str, content: dict[str, Any], timeout_s: float, _keys: object) -> dict[str, Any]:
        asked.append((content["command"], timeout_s))
        return {"ok": True}

    monkeypatch.setattr("shearloop.daemon.messaging.client.send_command", answers)
    assert main(["command", "unlock"]) == 0
    assert main(["command", "start"]) == 0
    assert main(["command", "unlock", "--timeout", "5"]) == 0
    assert main(["command", "pause", "--timeout", "0.5"]) == 0
    assert main(["command", "stop", "--connect", f"ipc://{tmp_path}/commands"]) == 0
    long = [("status", 2.0), ("unlock", 150.0), ("status", 2.0), ("start", 150.0)]
    # A given timeout holds for all that the command waits for.
    given = [("status", 5.0), ("unlock", 5.0), ("status", 0.5), ("pause", 0.5)]
    assert asked == [*long, *given, ("stop", 2.0)]
    assert "unlock: done" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["tare", "start", "pause", "resume", "release", "unlock"])
def test_a_command_names_the_running_daemon_and_unlock_names_the_waiting_stop(name, monkeypatch, capsys):
    asked: list[dict[str, Any]] = []
    loop = {"stop": 3, "stop_causes": "the operator stopped it: nothing was under way"}

    def answers(_address: str, content: dict[str, Any], *_: object) -> dict[str, Any]:
        asked.append(content)
        status = {"daemon": {"instance": "a1"}, "loop": loop} if content["command"] == "status" else {}
        return {"ok": True, "taring": [], **status}

    monkeypatch.setattr("shearloop.daemon.messaging.client.send_command", answers)
    assert main(["command", name, "--timeout", "60"]) == 0
    assert [one["command"] for one in asked] == ["status", name]
    assert (asked[1]["instance"], asked[1].get("stop")) == ("a1", 3 if name == "unlock" else None)
    said = "unlock acknowledged the stop: the operator stopped it: nothing was under way.\n"
    assert capsys.readouterr().err == (said if name == "unlock" else "")


def test_an_unlock_that_is_refused_acknowledges_nothing(monkeypatch, capsys):
    loop = {"stop": 3, "stop_causes": "the operator stopped it: nothing was under way"}

    def answers(_address: str, content: dict[str, Any], *_: object) -> dict[str, Any]:
        is_asked = content["command"] == "status"
        return {"ok": is_asked, "reason": "it is pressed", "daemon": {"instance": "a1"}, "loop": loop}

    monkeypatch.setattr("shearloop.daemon.messaging.client.send_command", answers)
    assert main(["command", "unlock"]) == 1
    assert capsys.readouterr().err == "shearloop command: unlock was refused: it is pressed\n"


@pytest.mark.parametrize("name", ["status", "start", "pause", "tare", "experiments"])
@pytest.mark.parametrize("ok", [True, False])
def test_a_command_to_an_emulated_rig_says_so(name, ok, monkeypatch, tmp_path, capsys):
    reply = {"ok": ok, "reason": "not now", "taring": [], "tasks": {}, "experiments": [], "configured": ""}
    replies = {"status": {**reply, "ok": ok or name != "status"}}
    address = f"ipc://{tmp_path}/commands"
    monkeypatch.setattr(
        "shearloop.daemon.messaging.client.send_command",
        lambda _address, asked, *_: {**replies.get(asked["command"], reply), "emulated": True},
    )
    assert main(["command", name, "--connect", address]) == (0 if ok else 1)
    said = capsys.readouterr()
    assert "EMULATED: " in (said.out if ok else said.err)
    assert main(["command", name, "--connect", address, "--json"]) == (0 if ok else 1)
    assert json.loads(capsys.readouterr().out)["emulated"] is True


@pytest.mark.parametrize("emulated", [False, True])
@pytest.mark.parametrize("as_json", [False, True])
def test_listen_says_first_that_the_rig_is_emulated(emulated, as_json, tmp_path, capsys):
    address = f"ipc://{tmp_path}/publish"
    with zmq.Context() as context, closing(context.socket(zmq.XPUB)) as daemon:
        daemon.bind(address)

        def publish() -> None:
            # Each subscription is announced once, and `listen` has two.
            topics = {daemon.recv(), daemon.recv()}
            assert topics == {b"\x01loop.state", b"\x01health"}
            for topic in ("loop.state", "health"):
                content = wire_map(
                    sample(TOPICS[topic], **({"emulated": emulated} if topic == "health" else {})), 1.5, 0
                )
                daemon.send_multipart([topic.encode(), encode(content)])

        sending = threading.Thread(target=publish)
        sending.start()
        options = ["--json"] if as_json else []
        assert main(["listen", "loop.state", "--count", "1", "--connect", address, *options]) == 0
        sending.join()
    out, err = capsys.readouterr()
    assert ("EMULATED" in (err if as_json else out.splitlines()[0])) is emulated
    assert len(out.splitlines()) == (1 if as_json or not emulated else 2)


@pytest.mark.parametrize(("name", "sent"), [("start", False), ("unlock", False), ("pause", True)])
def test_a_command_that_was_held_up_is_not_sent_unless_it_lets_nothing_move(name, sent, monkeypatch, capsys):
    """Ctrl-Z, or a suspended computer, between the person's word and the daemon."""
    asked: list[str] = []

    def answers(_address: str, content: dict[str, Any], *_: object) -> dict[str, Any]:
        asked.append(content["command"])
        return {"ok": True, "daemon": {"instance": "a1", "now_ns": 1}}

    monkeypatch.setattr("shearloop.daemon.messaging.client.send_command", answers)
    monkeypatch.setattr("shearloop.cli.command.boot_ns", lambda: boot_ns() + 6_000_000_000)
    assert main(["command", name]) == (0 if sent else 2)
    assert asked == ["status", name][: 1 + sent]
    assert ("and nothing begins later than 5 s after that" in capsys.readouterr().err) is not sent


def test_a_command_is_as_old_as_its_program():
    """And not as a shell that has become it (`exec`)."""
    before_ns = boot_ns()
    program = "import os, sys; os.execv(sys.executable, [sys.executable, '-c', sys.argv[1]])"
    shown = "from shearloop import cli; print(cli._LOADED_NS)"
    began_ns = int(subprocess.run([sys.executable, "-c", program, shown], capture_output=True, check=True).stdout)
    assert before_ns <= began_ns <= boot_ns()


@pytest.mark.parametrize("given", [(), ("--connect", "tcp://127.0.0.1:9762")])
def test_a_hint_reaches_the_daemon_that_the_command_reached(given, monkeypatch, capsys):
    reason = "a stop waits; `shearloop command unlock` ends it, and `shearloop listen health` tells more"
    reply = {"ok": False, "reason": reason}
    monkeypatch.setattr("shearloop.daemon.messaging.client.send_command", lambda *_: dict(reply))
    assert main(["command", "start", *given]) == 1
    hinted = " ".join(("shearloop command unlock", *given))
    assert f"`{hinted}` ends it, and `shearloop listen health`" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["check", "run", "demo"])
def test_a_broken_robot_library_is_one_sentence(config, command, monkeypatch, tmp_path, mistake):
    (tmp_path / "rtde_control.py").write_text("raise ImportError('librtde.so.1.6: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "rtde_control", raising=False)
    robot = str(config(robot=str(Path("config/ur.yaml").resolve())))
    arguments = ["--folder", str(tmp_path / "demo")] if command == "demo" else [robot]
    said = mistake(command, *arguments)
    assert "the package ur-rtde, which drives the robot, cannot be loaded: install it again with" in said
    assert said.endswith("--no-deps ur-rtde==1.6.5` (librtde.so.1.6: cannot open shared object file)\n")


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize("command", ["check", "run"])
def test_another_version_of_the_robot_library_is_one_sentence(config, command, monkeypatch, mistake):
    """The script on the robot speaks the protocol of one version."""
    monkeypatch.setattr("shearloop.drivers.ur.library.version", lambda _name: "1.7.0")
    said = mistake(command, str(config(robot=str(Path("config/ur.yaml").resolve()))))
    assert "the installed ur-rtde is of version 1.7.0" in said
    assert said.endswith("-m pip install ur-rtde==1.6.5`\n")


@pytest.mark.parametrize("command", ["check", "run"])
def test_a_missing_robot_library_is_one_sentence(config, command, monkeypatch, mistake):
    monkeypatch.setattr("shearloop.drivers.ur.library.find_spec", lambda _name: None)
    said = mistake(command, str(config(robot=str(Path("config/ur.yaml").resolve()))))
    assert "the robot needs the package ur-rtde, which is not installed for Python 3." in said
    assert "-m pip install ur-rtde" in said


def completed(script: Path, *words: str) -> set[str]:
    """Return what bash would offer at the end of a command line."""
    line = " ".join(f"'{word}'" for word in words)
    program = (
        f'source "{script}"; COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; '
        'complete -p shearloop >/dev/null || exit 9; _shtab_shearloop "$1"; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return set(done.stdout.split())


def test_bash_completes_commands_and_options(tmp_path, ran):
    script = tmp_path / "shearloop"
    script.write_text(ran("completion", "bash").out)
    assert set(COMMANDS) <= completed(script, "shearloop", "")
    assert completed(script, "shearloop", "do") == {"doctor"}
    assert "--geometry" in completed(script, "shearloop", "doctor", "--")
    assert {"server", "client", "allow", "revoke", "list"} <= completed(script, "shearloop", "keys", "")


def test_every_shell_has_its_script(ran):
    for shell in ("zsh", "tcsh"):
        assert "doctor" in ran("completion", shell).out


def test_file_arguments_complete_file_names():
    config = next(action for action in arguments_of(_command("check")) if action.dest == "config")
    assert getattr(config, "complete", None)


def _command(name: str):
    return parts_of(full_parser())[name]


# Each costs tens of megabytes and tenths of a second. Without a bank and a shear skin none is needed to run.
HEAVY = ("scipy", "skfem", "numba", "matplotlib")
# What `shearloop run` loads for a rig with a robot and a calibration of the default estimator.
RUN = ("cli.run", "daemon.app", "daemon.rig", "daemon.configured_experiment", "estimation.motion_regression")


@pytest.mark.parametrize("modules", [RUN, ("emulators.emulated_rig",)])
def test_what_starts_often_imports_no_heavy_modules(modules):
    imported = ", ".join(f"shearloop.{name}" for name in modules)
    says = f"import sys, {imported}; print([name for name in {HEAVY} if name in sys.modules])"
    found = subprocess.run([sys.executable, "-c", says], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.parametrize("in_time", [True, False])
def test_a_stop_ends_an_idle_daemon_by_a_second_request_that_names_its_age(in_time, monkeypatch):
    asked: list[dict[str, Any]] = []

    def answers(_address: str, content: dict[str, Any], _timeout_s: float) -> dict[str, Any]:
        asked.append(content)
        if "until_ns" in content:
            return {"ok": True, "ended": True}
        if not in_time:
            # The program was stopped by Ctrl-Z.
            monkeypatch.setattr("shearloop.cli.command.boot_ns", lambda: boot_ns() + 6 * 10**9)
        return {"ok": True, "stopped": "", "idle": True, "daemon": {"instance": "a1", "now_ns": 0}}

    monkeypatch.setattr("shearloop.daemon.messaging.stop_client.send_to_stop_socket", answers)
    assert main(["command", "stop", "--connect", "ipc:///idle"]) == 0
    assert "until_ns" not in asked[0], "a stop does not wait for the daemon's clock"
    assert "spare_daemon" not in asked[0]
    if in_time:
        assert asked[1]["instance"] == "a1"
        assert 0 < asked[1]["until_ns"] <= 5 * 10**9
    assert len(asked) == 1 + in_time


@pytest.mark.parametrize(
    ("reply", "happens"),
    [
        ({"ended": True}, "this stop ends the daemon"),
        (
            {"idle": True},
            "the daemon continues, because the stop came too late to end it. Send it again to end the daemon",
        ),
    ],
)
def test_a_second_stop_says_what_the_first_one_stopped(reply, happens):
    stopped = "nothing moves any more: 'hold' had just been stopped by an earlier stop"
    assert _lines("stop", {**reply, "stopped_before": "hold"}) == [f"stop: {stopped}; {happens}"]
    assert _lines("stop", reply) == [f"stop: nothing was moving; {happens}"]


@pytest.mark.parametrize(
    ("lost", "without"),
    [
        ([], ""),
        (["left"], "; NOT of left, which is not connected"),
        (["left", "combined"], "; NOT of left, combined, which are not connected"),
    ],
)
def test_an_accepted_tare_names_the_sensors_without_one(lost, without):
    (line,) = _lines("tare", {"taring": ["right"], "not_connected": lost})
    assert line.startswith(f"tare: the zero of right is being taken{without}; `shearloop command status`")


def test_a_stop_imports_little():
    """On a busy computer, imports are most of the time that `shearloop command stop` takes."""
    says = """if True:
        import os, socket, sys, threading
        import msgpack
        from shearloop.cli import main
        from shearloop.daemon.messaging.addresses import stop_name

        address = f"ipc:///lean-{os.getpid()}"
        daemon = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        daemon.bind(stop_name(address))

        def reply():
            request, client = daemon.recvfrom(1024)
            assert msgpack.unpackb(request)["command"] == "stop"
            daemon.sendto(msgpack.packb({"ok": True, "stopped": "one"}), client)

        threading.Thread(target=reply, daemon=True).start()
        main(["command", "stop", "--connect", address])
        print([name for name in ("numpy", "zmq", "asyncio", "structlog", "tqdm") if name in sys.modules])
    """
    found = subprocess.run([sys.executable, "-c", says], capture_output=True, text=True, check=True)
    assert found.stdout == "stop: stopped one\n[]\n"
