"""The report and stage 0 of a commissioning: each seeded fault fails its own line, and no other."""

import io
import json
import math
import re
import sys
from contextlib import ExitStack, closing
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from shearloop.cli import main, other_daemon
from shearloop.cli.commission import how_to_configure
from shearloop.daemon.commissioning_report import Line, Report, RigIdentity, StageResult
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.daemon.messaging.stop_socket import StopSocket
from shearloop.daemon.robot_files import RobotFiles, lock_robot
from shearloop.daemon.supplied_values import Supplied
from shearloop.drivers.ur.control_box import ControllerInfo
from shearloop.drivers.ur.limits import tool_difference
from shearloop.drivers.ur.messages import RtdeOutputs
from shearloop.drivers.ur.script import LOWER, UPPER
from shearloop.drivers.ur.settings import InstalledTool, read_settings
from shearloop.errors import UserError
from shearloop.tools.arm_models import UNKNOWN_ARM, Arm
from shearloop.tools.commission import identity
from shearloop.tools.commission.context import Context, Counts
from shearloop.tools.commission.identity import EMULATED_CHECKSUM, Identity, judge_identity
from shearloop.tools.commission.operator import DeclinedError, Operator
from shearloop.tools.commission.report import earlier_report, report_for, with_stage, write_page, write_report
from tests.emulator_process import EmulatorProcess
from tests.fixtures.robots import TOOL, write_filled_in

SIX = (0.0,) * 6
OUTPUTS = RtdeOutputs(0.0, SIX, SIX, SIX, SIX, SIX, 7, 1, 1, 1.0, 1.0, 0, 0, 0.0, 1.4, (0.0, 0.0, 0.06), SIX)
CONTROLLER = ControllerInfo("5.17.3.0", "20235500001", "RUNNING", "NORMAL", remote=True, registers=UPPER)
GOOD = Identity(CONTROLLER, OUTPUTS, "A1B2")
RIG = RigIdentity(
    emulated=False,
    configuration_sha256="a",
    robot_settings_sha256="b",
    script_sha256="c",
    ur_rtde="1.6.5",
    polyscope="5.17.3.0",
    robot_serial_number="20235500001",
)


def seen(**changed: object) -> Identity:
    return replace(GOOD, controller=replace(CONTROLLER, **changed))


def write_rig(folder: Path, host: str = "192.168.1.10") -> Path:
    write_filled_in(folder, host=host, tool={**TOOL, "payload_kg": 1.4, "tcp_offset": [0.0] * 6})
    path = folder / "rig.yaml"
    addresses = {key: f"ipc://{folder}/{key}" for key in ("publish", "commands")}
    cell = {"device": {"serial_number": "7583"}}
    path.write_text(yaml.safe_dump({"load_cell": cell, "robot": "ur.yaml", **addresses}))
    return path


@pytest.mark.parametrize(
    ("found", "failed"),
    [
        (GOOD, []),
        (seen(version="5.99.0.0"), []),
        (seen(version="3.15.8.0"), ["generation"]),
        (seen(robot_mode="IDLE"), ["robot mode"]),
        (seen(safety_mode="PROTECTIVE_STOP"), ["safety mode"]),
        (seen(registers=None), ["registers"]),
        (replace(GOOD, safety_checksum=""), ["safety checksum"]),
        (replace(GOOD, outputs=replace(OUTPUTS, speed_slider=0.5)), ["speed slider"]),
        (replace(GOOD, arm=Arm("UR5", (5.0,))), []),
        (replace(GOOD, arm=Arm("UR1", (1.0,))), ["rated payload"]),
        (replace(GOOD, arm=Arm("UR2", (1.0, 2.0))), []),
        (replace(GOOD, outputs=replace(OUTPUTS, payload_kg=1.409)), []),
        (replace(GOOD, outputs=replace(OUTPUTS, payload_kg=1.42)), ["payload"]),
        (replace(GOOD, outputs=replace(OUTPUTS, payload_kg=math.nan)), ["payload"]),
    ],
)
def test_a_fault_fails_exactly_its_own_line(tmp_path, found, failed):
    config = load_daemon_config(write_rig(tmp_path))
    lines = judge_identity(found, read_settings(config.robot), config)
    assert [line.what for line in lines if line.verdict == "failed"] == failed
    assert "7583" in [line.value for line in lines]


def test_a_payload_that_only_newer_arms_of_the_model_carry_is_no_pass(tmp_path):
    """No controller says of which year its arm is."""
    config = load_daemon_config(write_rig(tmp_path))
    found = replace(GOOD, arm=Arm("UR2", (1.0, 2.0)))
    (line,) = (one for one in judge_identity(found, read_settings(config.robot), config) if one.what == "rated payload")
    assert (line.verdict, line.limit) == ("noted", "at most 1 or 2 kg, the rated payload of a UR2")
    assert "type plate" in line.value


@pytest.mark.parametrize(
    ("version", "registers", "verdict"),
    [("5.17.3.0", UPPER, "passed"), ("5.17.3.0", LOWER, "noted"), ("5.23.0.0", LOWER, "passed")],
)
def test_registers_that_another_client_has_are_not_free(tmp_path, version, registers, verdict):
    """A new controller has the lower half alone for us."""
    config = load_daemon_config(write_rig(tmp_path))
    found = seen(version=version, registers=registers)
    (line,) = (line for line in judge_identity(found, read_settings(config.robot), config) if line.what == "registers")
    assert line.verdict == verdict
    assert ("from 24 on are in use" in line.value) == (verdict == "noted")


def test_a_program_that_plays_before_the_commissioning_is_no_pass(tmp_path):
    config = load_daemon_config(write_rig(tmp_path))
    found = replace(GOOD, outputs=replace(OUTPUTS, runtime_state=2))
    (line,) = (line for line in judge_identity(found, read_settings(config.robot), config) if "program" in line.what)
    assert (line.verdict, "playing" in line.value) == ("noted", True)


def test_stage_0_and_the_daemon_refuse_the_same_tools(tmp_path):
    settings = read_settings(load_daemon_config(write_rig(tmp_path)).robot)
    settings = replace(settings, tool=InstalledTool(payload_kg=1.4, tcp_offset=SIX))
    config = load_daemon_config(tmp_path / "rig.yaml")
    for changed in ({}, {"payload_kg": 1.42}, {"payload_kg": 1.45}, {"tcp_offset": (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)}):
        outputs = replace(OUTPUTS, **changed)
        lines = judge_identity(replace(GOOD, outputs=outputs), settings, config)
        assert any(line.verdict == "failed" for line in lines) is bool(tool_difference(outputs, settings.tool))


def stage_0(tmp_path: Path, answers: list[str], version: str, tool: InstalledTool, **changed: object):
    """Run stage 0 with scripted answers; return its lines by name, and what was asked."""
    config = load_daemon_config(write_rig(tmp_path))
    asked: list[str] = []

    def answer(question: str) -> str:
        asked.append(question)
        return answers.pop(0)

    rig = SimpleNamespace(outputs=lambda _: replace(OUTPUTS, **changed), arm=lambda: UNKNOWN_ARM)
    settings, controller = replace(read_settings(config.robot), tool=tool), replace(CONTROLLER, version=version)
    operator = Operator(answer, lambda _: None, allows=True)
    measured = identity.measure(Context(config, settings, rig, controller, operator, None, Counts(), ExitStack()))
    assert answers == []
    return {line.what: line for line in measured.lines}, asked


def test_a_polyscope_above_the_tried_ones_is_noted_once_the_operator_goes_on(tmp_path):
    tool = InstalledTool(payload_kg=1.4)
    lines, asked = stage_0(tmp_path, ["continue", "A1B2"], "5.99.0.0", tool)
    assert lines["PolyScope"].verdict == "noted"
    for text in (asked[0], lines["PolyScope"].value):
        assert "5.99.0.0" in text
        assert "5.17.3" in text
    with pytest.raises(DeclinedError, match=r"5\.99\.0\.0"):
        stage_0(tmp_path, ["no"], "5.99.0.0", tool)


@pytest.mark.parametrize(("mounted_kg", "verdict"), [("1.3", "passed"), ("1.15", "failed")])
def test_a_payload_that_the_controller_does_not_report_is_typed(tmp_path, mounted_kg, verdict):
    unreported = {"payload_kg": math.nan, "tcp_offset": (math.nan,) * 6}
    lines, _ = stage_0(tmp_path, ["A1B2", "1.4", mounted_kg], "5.4.0.0", InstalledTool(), **unreported)
    assert lines["payload"].verdict == verdict
    assert "typed" in lines["payload"].limit


@pytest.mark.parametrize(("emulated", "verdict"), [(True, "noted"), (False, "failed")])
def test_a_rehearsal_goes_on_without_the_tool_that_a_real_robot_needs(tmp_path, emulated, verdict):
    config = load_daemon_config(write_rig(tmp_path))
    settings = replace(read_settings(config.robot), tool=InstalledTool())
    lines = judge_identity(GOOD, settings, config.model_copy(update={"emulated": emulated}))
    (payload,) = (line for line in lines if line.what == "payload")
    assert payload.verdict == verdict


def test_a_report_is_continued_and_a_repeated_stage_replaced(tmp_path):
    begun = Report(rig=RIG)
    assert not begun.passed, "nothing measured is nothing passed"
    bad, good = (
        StageResult(stage="0 identity", operator="O", date=date, lines=(Line(what="w", value="<v>", verdict=verdict),))
        for date, verdict in (("2026-01-01T00:00:00Z", "failed"), ("2026-01-02T00:00:00Z", "passed"))
    )
    path = tmp_path / "report.yaml"
    write_report(path, with_stage(begun, bad))
    found = report_for(RIG, earlier_report(path), path)
    assert (found.stages, found.passed) == ((bad,), False)
    repeated = with_stage(found, good)
    write_report(path, repeated)
    page = write_page(path, repeated, ["4 stops"])
    assert report_for(RIG, earlier_report(path), path).stages == (good,)
    text = page.read_text()
    HTMLParser().feed(text)
    assert "&lt;v&gt;" in text, "an operator's words are no markup"
    assert "Not measured" in text
    assert "4 stops" in text
    assert "emulated" not in text.lower()
    renamed = good.model_copy(update={"stage": "0 robot"})
    assert with_stage(found, renamed).stages == (renamed,), "the figure names the stage"


class Cells(HTMLParser):
    """The rows of a page's tables."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.is_cell = False

    def handle_starttag(self, tag: str, _attributes: object) -> None:
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        self.is_cell = tag in ("td", "th")

    def handle_endtag(self, _tag: str) -> None:
        self.is_cell = False

    def handle_data(self, data: str) -> None:
        if self.is_cell:
            self.rows[-1][-1] += data


def test_file_and_page_have_each_value_of_a_stage_under_its_name(tmp_path):
    line = {"what": "w", "value": "v < 1", "limit": "l", "count": 7, "promise": "p", "verdict": "passed"}
    supplies = {
        "wrist_speed_rad_per_s": 0.45,
        "torque_nm": 0.35,
        "torque_sources": {"right": "a" * 64, "wrench": ""},
        "rest_rad_per_s": 0.006,
        "actuation_s": 0.03,
        "reaction_s": 0.04,
        "stop_rad": 0.15,
        "widths": [[70.0, 100.0], [198.0, 20.0]],
    }
    content = {
        "stage": "7 tool and spring",
        "operator": "Ada",
        "date": "2026-01-02T03:04:00Z",
        "lines": [line],
        "supplies": supplies,
        "judged_sha256s": {"load_cell": "b"},
    }
    result = StageResult.model_validate(content)
    report = with_stage(Report(rig=RIG), result)
    path = tmp_path / "report.yaml"
    page = Cells()
    write_report(path, report)
    page.feed(write_page(path, report).read_text())
    assert yaml.safe_load(path.read_text()) == {"version": 3, "rig": RIG.model_dump(), "stages": [content]}
    assert earlier_report(path) == report
    headings, values = page.rows
    assert dict(zip(headings, values, strict=True)) == {name: str(value) for name, value in line.items()}
    assert supplies.keys() == Supplied.model_fields.keys()


def stage(verdict: str) -> StageResult:
    line = Line(what="w", value="v", verdict=verdict)
    return StageResult(stage="0 identity", operator="O", date="2026-01-01T00:00:00Z", lines=(line,))


def test_a_report_in_which_nothing_passed_is_begun_anew_with_settings_that_were_mended(tmp_path):
    path = tmp_path / "report.yaml"
    mended = RIG.model_copy(update={"robot_settings_sha256": "other"})
    write_report(path, Report(rig=RIG, stages=(stage("failed"),)))
    assert report_for(mended, earlier_report(path), path) == Report(rig=mended)


@pytest.mark.parametrize("changed", list(RigIdentity.model_fields))
def test_a_report_of_another_rig_is_not_continued(tmp_path, changed):
    path = tmp_path / "report.yaml"
    write_report(path, Report(rig=RIG, stages=(stage("passed"),)))
    other = RIG.model_copy(update={changed: True if changed == "emulated" else "other"})
    why = (
        "is of real devices, and these are emulated" if changed == "emulated" else "changed since this report was begun"
    )
    with pytest.raises(UserError, match=why):
        report_for(other, earlier_report(path), path)


@pytest.mark.usefixtures("ur_rtde")
def test_a_robot_that_a_daemon_drives_is_not_commissioned(tmp_path, mistake):
    path = write_rig(tmp_path, "127.0.0.9")
    with lock_robot(RobotFiles("127.0.0.9")):
        assert "driven by another program" in mistake("commission", path, "--out", tmp_path / "report.yaml")


@pytest.mark.usefixtures("ur_rtde")
def test_a_robot_of_another_users_daemon_is_not_commissioned(tmp_path, mistake, monkeypatch):
    """Its lock is in another folder of states."""
    path = write_rig(tmp_path, "127.0.0.9")
    commands = load_daemon_config(path).commands
    monkeypatch.setattr(other_daemon, "STATUS_S", 0.01)
    with closing(StopSocket(commands, {}, Refusals())):
        assert "is taken" in mistake("commission", path, "--out", tmp_path / "report.yaml")
    reply = {"ok": True, "daemon": {"process": 4711, "rig": "lab", "folder": "/opt/lab"}}
    monkeypatch.setattr(other_daemon, "send_to_stop_socket", lambda *_: reply)
    said = mistake("commission", path, "--out", tmp_path / "report.yaml")
    assert "process 4711 (lab) in /opt/lab" in said
    assert "other addresses" not in said, "nothing may run beside it"


@pytest.mark.usefixtures("ur_rtde")
def test_stage_0_is_run_on_an_emulated_controller_with_scripted_answers(tmp_path, monkeypatch, capsys):
    robot = EmulatorProcess("ur", "--payload-kg", "1.4", module=7, ready="listening")
    try:
        path, out = write_rig(tmp_path, robot.host), tmp_path / "report.yaml"
        monkeypatch.setattr(sys, "stdin", io.StringIO("Ada\nA1B2\n"))
        assert main(["commission", str(path), "--out", str(out), "--stages", "0"]) == 0
        assert "passed payload: 1.400 kg" in capsys.readouterr().out
        monkeypatch.setattr(sys, "stdin", io.StringIO("Ada\nA1B2\n"))
        assert main(["commission", str(path), "--out", str(out), "--stages", "0", "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == yaml.safe_load(out.read_text())
        (stage,) = yaml.safe_load(out.read_text())["stages"]
        assert (stage["stage"], stage["operator"]) == ("0 identity", "Ada")
        assert "A1B2" in out.with_suffix(".html").read_text()
        robot.process.stdin.write(b"payload 2\n")
        robot.process.stdin.flush()
        monkeypatch.setattr(sys, "stdin", io.StringIO("Ada\nA1B2\n"))
        while main(["commission", str(path), "--out", str(out), "--stages", "0"]) == 0:
            monkeypatch.setattr(sys, "stdin", io.StringIO("Ada\nA1B2\n"))
        failed = [
            line["what"]
            for line in yaml.safe_load(out.read_text())["stages"][0]["lines"]
            if line["verdict"] == "failed"
        ]
        assert failed == ["payload"]
    finally:
        robot.close()


@pytest.mark.parametrize(
    ("out", "line"),
    [
        ("my-rig/report.yaml", "the line `commissioned: report.yaml` in my-rig/rig.yaml"),
        ("my-rig/reports/1: new.yaml", "the line `commissioned: 'reports/1: new.yaml'` in my-rig/rig.yaml"),
        ("report.yaml", "the line `commissioned: {}/report.yaml` in my-rig/rig.yaml"),
    ],
)
def test_the_line_that_names_the_report_is_as_the_configuration_needs_it(tmp_path, monkeypatch, out, line):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my-rig").mkdir()
    path = write_rig(tmp_path / "my-rig")
    named = how_to_configure(Path(out), path.relative_to(tmp_path), rehearsed=False)
    assert named == line.format(tmp_path)
    path.write_text(path.read_text() + named.split("`")[1] + "\n")
    assert load_daemon_config(path).commissioned == tmp_path / out


@pytest.mark.usefixtures("ur_rtde")
def test_a_commissioning_is_rehearsed_on_emulated_devices_and_every_line_says_so(tmp_path, monkeypatch, capsys):
    path, out = write_rig(tmp_path), tmp_path / "emulated.yaml"
    monkeypatch.setattr(sys, "stdin", io.StringIO(f"Ada\n{EMULATED_CHECKSUM}\n"))
    assert main(["commission", str(path), "--out", str(out), "--stages", "0", "--emulate"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "EMULATED: passed payload: 1.400 kg (limit: 1.4 ± 0.01 kg; else the daemon refuses motion)" in lines
    assert any(f"[emulated: the pendant shows {EMULATED_CHECKSUM}]:" in line for line in lines)
    assert [line for line in lines if not line.startswith("EMULATED: ")] == []
    # The real rig would refuse this report in its configuration.
    assert (
        "With `--set commissioned=emulated.yaml`, the robot is capped at 0.2 rad/s, 0.05 m/s and 0.3 N·m: its"
        in lines[-1]
    )
    rig = yaml.safe_load(out.read_text())["rig"]
    assert (rig["emulated"], rig["robot_serial_number"]) == (True, "EMULATED")
    page = out.with_suffix(".html").read_text()
    assert "EMULATED: commissioning" in page
    assert "raises no limit of a real robot" in page
    # The live page's colours, by day and by night.
    live = (Path(__file__).parents[3] / "daemon" / "web" / "assets" / "view.css").read_text()
    for colour in re.findall(r"--(?:ink|line|paper|alarm):#[0-9a-f]{6}", page):
        assert colour.replace(":", ": ") in live
    assert page.count("--paper:") == 2
    assert "prefers-color-scheme:dark" in page


ON_SOCKETS = {
    "source": {"socket": {"host": "10.0.0.7", "port": 5025}},
    "daq": {"scanner": {"socket": {"host": "10.0.0.8", "port": 5025}}},
}
ON_SERIAL_PORTS = {
    "source": {"serial": {"serial_number": "0042"}},
    "daq": {"adc": {"device": {"serial_number": "0043"}}},
}
GRIPPER = {"model": "2F-140", "socket": {"host": "192.168.1.10"}}


@pytest.mark.real_time
@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize(
    ("instruments", "gripper", "words"),
    [(ON_SOCKETS, {}, ["done"] * 3), (ON_SERIAL_PORTS, GRIPPER, ["done", "done", "move", "done"])],
    ids=["clamped to the wrist", "gripped"],
)
def test_a_press_shows_in_the_played_skin_through_its_driver(
    tmp_path, monkeypatch, capsys, instruments, gripper, words
):
    """Without fingertips and load cell, through every kind of instrument; the terminal shows its own lines alone."""
    path, out = write_rig(tmp_path), tmp_path / "emulated.yaml"
    calibration = Path("config/calibrations/skin_demo.yaml").resolve()
    content = {"skin": {**instruments, "calibration": str(calibration), "tool_radius_mm": 15}, "robot": "ur.yaml"}
    path.write_text(yaml.safe_dump({**content, **({"gripper": gripper} if gripper else {})}))
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join(["Ada", *words, ""])))
    assert main(["commission", str(path), "--out", str(out), "--stages", "6", "--emulate"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if not line.startswith("EMULATED: ")] == []
    (stage,) = yaml.safe_load(out.read_text())["stages"]
    passed = [line["what"] for line in stage["lines"] if line["verdict"] == "passed"]
    assert passed[-2:] == ["clock of the skin", "skin's gauges under the press"]
    assert len(passed) == 7
    assert "supplies" not in stage or not any(stage["supplies"].values())


def test_what_cannot_be_rehearsed_is_refused_before_anything_is_played(tmp_path, mistake):
    path = tmp_path / "rig.yaml"
    path.write_text("load_cell: {device: {path: cell}}\n")
    assert "no robot to commission" in mistake("commission", path, "--out", tmp_path / "r.yaml", "--emulate")
    write_rig(tmp_path)
    path.write_text("load_cell: {device: {path: cell}}\nrobot: ur.yaml\nemulated: true\n")
    assert "emulated already" in mistake("commission", path, "--out", tmp_path / "r.yaml", "--emulate")


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize(
    ("device", "cure"),
    [
        (
            {"fingertips": {"right": {"device": {"serial_number": "1"}, "bank": "absent.bank"}}},
            "build it with `shearloop bank build",
        ),
        ({"skin": {**ON_SERIAL_PORTS, "calibration": "absent.yaml"}}, "make it with `shearloop skin calibrate`"),
    ],
    ids=["bank", "skin"],
)
def test_a_file_that_a_late_stage_needs_is_missed_before_the_first(tmp_path, mistake, device, cure):
    path = write_rig(tmp_path, "127.0.0.9")
    content = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**content, **device}))
    assert cure in mistake("commission", path, "--out", tmp_path / "report.yaml")
