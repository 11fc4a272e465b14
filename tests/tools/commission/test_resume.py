"""The order of the stages: what is measured is kept, a failed stage ends it, and a later run continues."""

from collections.abc import Callable, Mapping
from dataclasses import replace
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
