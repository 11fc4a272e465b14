"""The order of the stages: what is measured is kept, a failed stage ends it, and a later run continues."""

import errno
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from shearloop.daemon.commissioning_report import Line, Verdict
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.report_validity import load_report
from shearloop.drivers.ur.control_box import ControllerInfo
from shearloop.drivers.ur.messages import RobotLostError
from shearloop.drivers.ur.script import LOWER, UPPER
from shearloop.errors import UserError
from shearloop.tools.commission import procedure
from shearloop.tools.commission.context import Context, Counts
from shearloop.tools.commission.operator import WORD, DeclinedError, Operator
from shearloop.tools.commission.report import Measured
from shearloop.tools.robot_use import SignKind, other_programs
from tests.tools.commission.test_commission import OUTPUTS, write_rig

CONTROLLER = ControllerInfo("5.17.3.0", "1", "RUNNING", "NORMAL", remote=True, registers=UPPER)


RIG = SimpleNamespace(controller=lambda: CONTROLLER, outputs=lambda _: OUTPUTS)
NO_CLOCK = SimpleNamespace(sleep=lambda _: None)


def play_stages(monkeypatch: pytest.MonkeyPatch, verdicts: Mapping[str, Verdict]) -> list[str]:
    """Put stages with these verdicts in the place of the real ones; return the names of those that ran."""
    ran: list[str] = []

    def stage(name: str) -> Callable[[Context], Measured]:
        def measure(context: Context) -> Measured:
            context.operator.allow(name)
            ran.append(name)
            return Measured([Line(what="w", value="v", verdict=verdicts[name])])

        return measure

    monkeypatch.setattr(procedure, "STAGES", {name: stage(name) for name in verdicts})
    return ran


@pytest.mark.usefixtures("ur_rtde")
def test_a_setting_that_one_stage_judges_makes_only_that_stage_run_again(tmp_path, monkeypatch):
    ran = play_stages(monkeypatch, dict.fromkeys(("0 a", "3 b", "4 c", "5 d", "6 e"), "passed"))
    path, out, said = write_rig(tmp_path, "127.0.0.9"), tmp_path / "report.yaml", []

    def run() -> list[str]:
        ran.clear()
        procedure.commission(
            load_daemon_config(path), path, out, Operator(lambda _: WORD, said.append, allows=True), Counts(), (), RIG
        )
        return list(ran)

    assert run() == ["0 a", "3 b", "4 c", "5 d", "6 e"]
    settings = yaml.safe_load((tmp_path / "ur.yaml").read_text())
    settings["limits"]["torque_nm"] = {"inner": 9.0, "hard": 10.0}
    (tmp_path / "ur.yaml").write_text(yaml.safe_dump(settings))
    assert run() == ["5 d"]
    assert "Stage 5 d is measured again, because `limits.torque_nm` changed." in said
    settings["rest_rad_per_s"] = 0.02
    (tmp_path / "ur.yaml").write_text(yaml.safe_dump(settings))
    assert run() == ["3 b", "4 c"]
    assert run() == []


@pytest.mark.usefixtures("ur_rtde")
def test_stages_are_kept_blocked_and_continued(tmp_path, monkeypatch):
    verdicts: dict[str, Verdict] = {"0 a": "passed", "1 b": "failed", "2 c": "passed"}
    ran = play_stages(monkeypatch, verdicts)
    path, out, allowed = write_rig(tmp_path, "127.0.0.9"), tmp_path / "report.yaml", {"0 a"}

    def run(only: str = "") -> list[str]:
        ran.clear()
        operator = Operator(
            lambda question: WORD if any(one in question for one in allowed) else "no", lambda _: None, allows=True
        )
        procedure.commission(load_daemon_config(path), path, out, operator, Counts(), only, RIG)
        return list(ran)

    with pytest.raises(DeclinedError, match="not allowed: 1 b"):
        run()
    assert [one.stage for one in load_report(out).stages] == ["0 a"], "the stage before is kept"
    assert "1 b, 2 c" in out.with_suffix(".html").read_text()
    allowed |= set(verdicts)
    assert run() == ["1 b"], "a stage that passed is not repeated, and a failed one ends the commissioning"
    verdicts["1 b"] = "passed"
    assert run() == ["1 b", "2 c"]
    assert run() == []
    assert run("2") == ["2 c"], "a named stage is run again"


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize(
    ("registers", "runtime_state", "said", "kind", "times"),
    [
        (LOWER, 1, "those from 24 on are in use", SignKind.REGISTERS, 1),
        (UPPER, 2, "(playing)", SignKind.PROGRAM, 2),
        (UPPER, 4, "(paused)", SignKind.PROGRAM, 2),
    ],
)
def test_another_program_on_the_robot_is_named_before_each_stage_that_moves(
    tmp_path, monkeypatch, registers, runtime_state, said, kind, times
):
    """It may be a daemon's of another user or of another computer, which no lock of this one shows.

    A program is asked about each time, because it is replaced; registers are asked about once.
    """
    ran = play_stages(monkeypatch, dict.fromkeys(("0 identity", "1 b", "2 c"), "passed"))
    path, out, asked = write_rig(tmp_path, "127.0.0.9"), tmp_path / "report.yaml", []
    controller, outputs = replace(CONTROLLER, registers=registers), replace(OUTPUTS, runtime_state=runtime_state)
    rig = SimpleNamespace(controller=lambda: controller, outputs=lambda _: outputs, clock=NO_CLOCK)

    def run(word: str) -> None:
        def answer(question: str) -> str:
            asked.append(question)
            return word if "Type `continue`" in question else WORD

        operator = Operator(answer, lambda _: None, allows=True)
        procedure.commission(load_daemon_config(path), path, out, operator, Counts(), (), rig)

    with pytest.raises(DeclinedError, match="not accepted"):
        run("no")
    assert ran == ["0 identity"], "nothing moves before the word"
    (sign,) = other_programs(controller, outputs)
    assert sign.kind is kind
    assert said in sign.sentence
    asked.clear()
    run("continue")
    assert ran == ["0 identity", "1 b", "2 c"]
    assert sum(question.startswith(sign.sentence) for question in asked) == times


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize("runtime_state", [2, 4])
def test_another_daemons_program_is_not_offered_to_be_replaced(tmp_path, monkeypatch, runtime_state):
    """Its registers are in use, and the worker refuses to end it: a stop may wait there."""
    ran = play_stages(monkeypatch, dict.fromkeys(("0 identity", "1 b"), "passed"))
    path, asked = write_rig(tmp_path, "127.0.0.9"), []
    controller, outputs = replace(CONTROLLER, registers=LOWER), replace(OUTPUTS, runtime_state=runtime_state)
    rig = SimpleNamespace(controller=lambda: controller, outputs=lambda _: outputs, clock=NO_CLOCK)

    def answer(question: str) -> str:
        asked.append(question)
        return "continue" if "Type `continue`" in question else WORD

    operator = Operator(answer, lambda _: None, allows=True)
    with pytest.raises(UserError, match="end the other daemon, or stop the program at the teach pendant"):
        procedure.commission(load_daemon_config(path), path, tmp_path / "report.yaml", operator, Counts(), (), rig)
    assert ran == ["0 identity"]
    assert not any("Type `continue`" in question for question in asked)


@pytest.mark.usefixtures("ur_rtde")
def test_a_robot_whose_registers_are_all_taken_is_not_moved_by_a_later_run(tmp_path, monkeypatch):
    """Stage 0 passed earlier."""
    ran = play_stages(monkeypatch, {"0 identity": "passed", "3 b": "passed"})
    path, out = write_rig(tmp_path, "127.0.0.9"), tmp_path / "report.yaml"
    taken = replace(CONTROLLER, registers=None)

    def run(only: str, controller: ControllerInfo) -> None:
        rig = SimpleNamespace(controller=lambda: controller, outputs=lambda _: OUTPUTS)
        operator = Operator(lambda _: WORD, lambda _: None, allows=True)
        procedure.commission(load_daemon_config(path), path, out, operator, Counts(), only, rig)

    run("0", CONTROLLER)
    with pytest.raises(RobotLostError, match="already in use"):
        run("3", taken)
    assert ran == ["0 identity"]


@pytest.mark.usefixtures("ur_rtde")
def test_a_stage_that_is_not_named_is_kept_and_said_to_be_old(tmp_path, monkeypatch):
    """Its torque would be lost without a word."""
    ran = play_stages(monkeypatch, dict.fromkeys(("0 identity", "3 b", "4 c"), "passed"))
    path, out, said = write_rig(tmp_path, "127.0.0.9"), tmp_path / "report.yaml", []

    def run(only: str = "") -> None:
        operator = Operator(lambda _: WORD, said.append, allows=True)
        procedure.commission(load_daemon_config(path), path, out, operator, Counts(), only, RIG)

    run()
    settings = yaml.safe_load((tmp_path / "ur.yaml").read_text())
    (tmp_path / "ur.yaml").write_text(yaml.safe_dump({**settings, "rest_rad_per_s": 0.02}))
    ran.clear()
    run("3")
    assert ran == ["3 b"]
    assert [one.stage for one in load_report(out).stages] == ["0 identity", "3 b", "4 c"]
    assert any("Stage 4 c judged another value of `rest_rad_per_s`" in line and "`--stages 4`" in line for line in said)


@pytest.mark.usefixtures("ur_rtde")
def test_a_stage_that_does_not_exist_and_an_empty_name_are_refused(tmp_path):
    path, out = write_rig(tmp_path, "127.0.0.9"), tmp_path / "report.yaml"

    def run(only: str, answer: str) -> None:
        operator = Operator(lambda _: answer, lambda _: None, allows=True)
        procedure.commission(load_daemon_config(path), path, out, operator, Counts(), only, RIG)

    with pytest.raises(UserError, match="there is no stage 9"):
        run("9", WORD)
    with pytest.raises(UserError, match="nothing was typed: Your name"):
        run("", "")
    assert not out.exists()


def declines(context: Context) -> Measured:
    context.operator.act("Look at the rig")
    raise AssertionError


def gives_no_number(context: Context) -> Measured:
    context.operator.number("Its width in mm", 0.5, 85.0)
    raise AssertionError


def is_interrupted(_: Context) -> Measured:
    raise KeyboardInterrupt


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize("ends", [declines, gives_no_number, is_interrupted])
def test_the_end_within_a_stage_says_what_is_in_the_report_and_what_is_measured_again(tmp_path, monkeypatch, ends):
    play_stages(monkeypatch, dict.fromkeys(("0 a", "3 b", "4 c", "6 d"), "passed"))
    path, out = write_rig(tmp_path, "127.0.0.9"), tmp_path / "report.yaml"

    def run(only: str, *, fails_in: str = "") -> str:
        with monkeypatch.context() as changed:
            if fails_in:
                changed.setitem(procedure.STAGES, fails_in, ends)
            answers = {"Your name:": "Ada"}
            operator = Operator(
                lambda question: WORD if "MOTION" in question else answers.get(question, "x"), [].append, allows=True
            )
            try:
                procedure.commission(load_daemon_config(path), path, out, operator, Counts(), only, RIG)
            except (UserError, KeyboardInterrupt) as error:
                return "".join(error.__notes__)
            return ""

    again = "is measured again from its beginning"
    said = run("", fails_in="0 a")
    assert said == f"Nothing is written: {out} does not exist. Run it again to continue: stage 0 a {again}"
    assert not out.exists()
    said = run("", fails_in="4 c")
    assert said == f"{out} has the stages 0 a, 3 b. Run it again to continue: stage 4 c {again}"
    assert [one.stage for one in load_report(out).stages] == ["0 a", "3 b"]
    assert run("") == ""
    said = run("346", fails_in="4 c")
    assert f"Run it again with `--stages 46` to continue: stage 4 c {again}, and has its earlier result" in said
    assert [one.stage for one in load_report(out).stages] == ["0 a", "3 b", "4 c", "6 d"]


def no_space_for(ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the disk be full for files of this ending."""

    def fsync(handle: int) -> None:
        if os.readlink(f"/proc/self/fd/{handle}").endswith(ending):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.fsync", fsync)


@pytest.mark.usefixtures("ur_rtde")
@pytest.mark.parametrize(
    ("full", "kept", "cause"),
    [
        (".yaml.tmp", ["0 a"], "report.yaml: the report cannot be written: No space left on device"),
        (".html.tmp", ["0 a", "1 b"], "report.html: the page of the report cannot be written: No space left on device"),
    ],
)
@pytest.mark.parametrize("has_page", [True, False])
def test_a_full_disk_after_a_stage_loses_no_line_and_names_its_file(tmp_path, monkeypatch, full, kept, cause, has_page):
    play_stages(monkeypatch, {"0 a": "passed", "1 b": "passed"})
    path, out, said = write_rig(tmp_path, "127.0.0.9"), tmp_path / "report.yaml", []
    page = out.with_suffix(".html")

    def run(only: str) -> None:
        operator = Operator(lambda _: WORD, said.append, allows=True)
        procedure.commission(load_daemon_config(path), path, out, operator, Counts(), only, RIG)

    run("0")
    earlier = page.read_text()
    if not has_page:
        page.unlink()
    said.clear()
    with monkeypatch.context() as disk:
        no_space_for(full, disk)
        with pytest.raises(UserError, match=cause) as refused:
            run("1")
    assert "choose another" not in str(refused.value)
    assert "passed w: v" in said
    assert [one.stage for one in load_report(out).stages] == kept
    assert f"{', '.join(kept)}. Run it again" in refused.value.__notes__[0]
    assert ("stage 1 b is measured again" in refused.value.__notes__[0]) == (kept == ["0 a"])
    assert (page.read_text() if page.exists() else None) == (earlier if has_page else None)


@pytest.mark.usefixtures("ur_rtde")
def test_a_report_that_cannot_be_written_is_refused_before_the_first_question(tmp_path):
    path, asked = write_rig(tmp_path, "127.0.0.9"), []
    page = tmp_path / "mine.html"
    page.write_text("<html>my own page")
    (tmp_path / "folder").mkdir()

    def refusal(out: Path) -> str:
        operator = Operator(asked.append, asked.append, allows=True)
        with pytest.raises(UserError) as refused:
            procedure.commission(load_daemon_config(path), path, out, operator, Counts(), (), RIG)
        return str(refused.value)

    assert "there is no folder" in refusal(tmp_path / "none" / "report.yaml")
    assert "is a folder" in refusal(tmp_path / "folder")
    assert "mine.html exists and is not the page of a report" in refusal(page.with_suffix(".yaml"))
    # No file with the ending of a lock fits there.
    assert "the report cannot be written: File name too long" in refusal(tmp_path / f"{'r' * 250}.yaml")
    assert asked == []
    assert page.read_text() == "<html>my own page"


@pytest.mark.usefixtures("ur_rtde")
def test_a_second_commissioning_into_the_same_report_is_refused(tmp_path, monkeypatch):
    """Otherwise the one that ends last replaces the other's stages."""
    first, second, out = tmp_path / "first", tmp_path / "second", tmp_path / "report.yaml"
    link = tmp_path / "link.yaml"
    link.symlink_to(out)
    refused: list[str] = []

    def commission(folder: Path, host: str, out: Path, answer: Callable[[str], str]) -> None:
        folder.mkdir(exist_ok=True)
        path = write_rig(folder, host)
        operator = Operator(answer, lambda _: None, allows=True)
        procedure.commission(load_daemon_config(path), path, out, operator, Counts(), (), RIG)

    def answer(_: str) -> str:
        for name in (out, link):
            with pytest.raises(UserError) as error:
                commission(second, "127.0.0.8", name, lambda _: WORD)
            refused.append(str(error.value))
        return WORD

    play_stages(monkeypatch, {"0 a": "passed"})
    commission(first, "127.0.0.9", out, answer)
    assert all(said.startswith("another `shearloop commission` writes the report") for said in refused)
    assert len(refused) == 4
    assert [one.stage for one in load_report(out).stages] == ["0 a"]
    assert not list(tmp_path.glob("*.lock"))
