"""The whole procedure in simulated time with scripted answers, and each seeded fault on its own line."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks.stop_times import write_random_bank
from shearloop.bank.bank_file import Bank
from shearloop.daemon.commissioning_report import Line
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.report_in_use import commissioning_of
from shearloop.daemon.report_validity import load_report
from shearloop.daemon.rig import open_settings
from shearloop.daemon.supplied_values import NOTHING_SUPPLIED
from shearloop.errors import UserError
from shearloop.tools.commission import stops, tool
from shearloop.tools.commission.bounds import LARGEST_RAD
from shearloop.tools.commission.context import Context, Counts
from shearloop.tools.commission.hand_stops import LAYERS, stops_of_layer
from shearloop.tools.commission.limits import REHEARSED
from shearloop.tools.commission.mover_process import CAUSES
from shearloop.tools.commission.operator import DeclinedError
from shearloop.tools.commission.procedure import STAGES, commission
from tests.paper_curve import paper_curve
from tests.tools.commission.scripted_operator import GAUGES_MM, ScriptedOperator
from tests.tools.commission.simulated_rig import SPEED, SimulatedRig

pytestmark = pytest.mark.usefixtures("ur_rtde")

COUNTS = Counts(
    listen_s=3.0,
    uploads_after_s=(0.0, 1.0),
    clock_s=2.0,
    rest_s=2.0,
    turns=4,
    stops=1,
    speeds_rad_per_s=(0.2,),
    exchanges=20,
    starts=2,
    frames=8,
    twists=4,
)


def write_rig(folder: Path, host: str, **content: object) -> Path:
    """Write a rig with one calibrated fingertip, as the emulated one is; boards are SPEED times as fast."""
    write_random_bank(folder / "rig.bank")
    sigma = np.linspace(1.0, 2.0, 40)
    curve = paper_curve(Bank.open(folder / "rig.bank").identity, torque=(sigma, (1.85 - sigma) * 0.14 / 0.6))
    curve.save(folder / "rig.cal")
    robot = yaml.safe_load(Path("config/demo_ur.yaml").read_text())
    (folder / "ur.yaml").write_text(yaml.safe_dump({**robot, "host": host}))
    right = {"device": {"path": "eit-right"}, "bank": "rig.bank", "calibration": "rig.cal"}
    content = {
        "load_cell": {"device": {"path": "load-cell"}, "rate_hz": 10.9 * SPEED},
        "fingertips": {"right": {**right, "frame_period_s": 0.5412 / SPEED}},
        "robot": "ur.yaml",
        "gripper": {"model": "2F-140", "socket": {"host": host}},
        **content,
    }
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


# At this radius the skin bears the press that is asked for, as the load cell and the fingertip do.
SKIN = {
    "source": {"serial": {"path": "skin-source"}},
    "daq": {"adc": {"device": {"path": "skin-daq"}}, "rate_hz": 10.0 * SPEED},
    "calibration": str(Path("config/calibrations/skin_demo.yaml").resolve()),
    "tool_radius_mm": 75.0,
}


class Lab:
    """A simulated rig and its operator."""

    def __init__(self, folder: Path, **content: object) -> None:
        self.path = write_rig(folder, "127.0.0.9", **{"skin": SKIN, **content})
        self.rig = SimulatedRig(load_daemon_config(self.path), folder)
        self.operator = ScriptedOperator(self.rig.order, self.rig.stop_program)

    def close(self) -> None:
        del self.rig, self.operator

    def move_by_hand(self, rad: float, before: str) -> None:
        """Have the wrist moved by hand before the rig gets this command."""

        def order(command: str) -> None:
            if command == before:
                self.rig.robot.arm.q_rad = self.rig.robot.arm.q_rad + np.array([0.0] * 5 + [rad])
            self.rig.order(command)

        self.operator = ScriptedOperator(order, self.rig.stop_program)

    def do_instead(self, of: str, others: list[list[str]]) -> None:
        """Have the operator do something else the first times: each time some commands, or nothing."""

        def order(command: str) -> None:
            for one in others.pop(0) if command == of and others else [command]:
                self.rig.order(one)

        self.operator = ScriptedOperator(order, self.rig.stop_program)

    def stopped_by_hand(self, what: str) -> Line:
        """Have the operator stop the wrist by one layer, once."""
        config = load_daemon_config(self.path)
        (layer,) = (one for one in LAYERS if one.what == what)
        with ExitStack() as opened:
            settings, controller, operator = open_settings(config), self.rig.controller(), self.operator.operator
            context = Context(config, settings, self.rig, controller, operator, None, COUNTS, opened)
            line, *_ = stops_of_layer(context, layer, (0.2,))
        return line

    def run(self, only: str = "", counts: Counts = COUNTS):
        config, out = load_daemon_config(self.path), self.path.with_name("report.yaml")
        return commission(config, self.path, out, self.operator.operator, counts, only, self.rig)


@pytest.fixture
def lab(tmp_path) -> Iterator[Lab]:
    lab = Lab(tmp_path)
    yield lab
    # The test's item keeps its fixtures longer, and the rig the bank's file.
    lab.close()


def failed(report) -> list[str]:
    return [line.what for stage in report.stages for line in stage.lines if line.verdict == "failed"]


@pytest.mark.long
def test_the_whole_procedure_runs_unattended_and_its_report_supplies_what_it_measured(lab):
    lab.operator.declined = "wrist 3 turns 4 times"
    with pytest.raises(DeclinedError, match="`no` was typed"):
        lab.run()
    lab.operator.declined = ""
    report, page = lab.run()
    assert failed(report) == []
    assert [stage.stage for stage in report.stages] == list(STAGES)
    assert sum("Listening" in line for line in lab.operator.said) == 1, "a stage that passed is not run again"
    assert "Ada" in page.read_text()
    for question, range_of_answers in (("known torque", "(0.02 to 1.75)"), ("known stiffness", "(0.05 to 21)")):
        asked = [one for one in lab.operator.asked if question in one]
        assert any(range_of_answers in one for one in asked), "nothing beyond the load cell's capacity is asked for"
    content = yaml.safe_load(lab.path.read_text())
    lab.path.write_text(yaml.safe_dump({**content, "commissioned": "report.yaml"}))
    config = load_daemon_config(lab.path)
    found = commissioning_of(config, open_settings(config))
    assert found.counts
    assert len(found.supplied.widths) == len(GAUGES_MM)
    assert 0 < found.supplied.actuation_s <= found.settings.reaction_s
    assert found.cap.wrist_speed_rad_per_s == 0.2, "one stop of each layer raises no speed"


@pytest.fixture
def emulated_lab(tmp_path) -> Iterator[Lab]:
    lab = Lab(tmp_path, emulated=True)
    yield lab
    lab.close()


@pytest.mark.long
def test_an_emulated_rig_with_its_long_deadlines_passes_and_says_so(emulated_lab):
    """The wrist turns on to the end of its range where a real one has stopped before."""
    report, page = emulated_lab.run("4")
    assert failed(report) == []
    assert report.rig.emulated
    assert "EMULATED" in page.read_text()
    assert "limits on times" in emulated_lab.operator.said[0]
    lines = {line.what: line for line in report.stages[0].lines}
    for what in ("time to rest at 0.2 rad/s", "worker killed at 0.2 rad/s", "watchdog alone, at rest"):
        assert (lines[what].verdict, lines[what].value) == ("noted", REHEARSED)
    assert report.supplied().stop_rad is None


FAULTS = [
    ("slider 0.5", "0", "speed slider"),
    ("registers-in-use", "0", "registers"),
    ("float-clock", "1", "script's clock"),
    ("block-scripts", "1", "uploads after 0, 1 s"),
    ("gripper slow 32", "2", "exchange with the gripper, p99"),
    ("velocity-noise 0.003", "3", "velocity noise at rest"),
    ("protect-ends", "4", "safety mode after stops at 0.2 rad/s"),
    ("slow-braking 0.5", "4", "time to rest at 0.2 rad/s"),
    ("slow-arm 0.3", "4", "time to rest on a line at 0.05 m/s"),
    ("watchdog-waits", "4", "watchdog alone, on a line"),
    ("bias 8", "5", "force at rest"),
    ("right zero-channel", "6", "dead channels of right"),
    ("right late 1", "6", "clock of right"),
    ("load late 8", "6", "lag of the load cell"),
    ("skin short 1", "6", "faults of the skin"),
    ("skin swapped", "6", "order of the skin's gauges"),
    ("skin daq late 4", "6", "clock of the skin"),
    ("flip load", "7", "sign of the load cell"),
    ("flip right", "7", "sign of the estimate of right"),
]


@pytest.mark.long
@pytest.mark.parametrize(("fault", "stage", "line"), FAULTS)
def test_each_seeded_fault_turns_its_own_line_red(lab, fault, stage, line):
    """The procedure runs as a whole up to the line; for those of late stages, which take long, its stage does."""
    lab.rig.order(fault)
    report, _ = lab.run("" if stage <= "4" else stage)
    assert failed(report) == [line]
    assert report.stages[-1].stage.startswith(stage)
    assert report.stages[-1].supplies == NOTHING_SUPPLIED, "what failed is no measurement"
    assert load_report(lab.path.with_name("report.yaml")) == report


@pytest.mark.long
def test_the_torque_of_a_gel_that_creeps_is_compared_without_its_creep(lab):
    """The emulated gel does not creep, so a configured creep takes half of its torque away."""

    def scale() -> str:
        report, _ = lab.run("7")
        return next(line for line in report.stages[0].lines if line.what == "scale of right").value

    without = scale()
    content = yaml.safe_load(lab.path.read_text())
    content["fingertips"]["right"]["creep"] = {"share": 0.5, "time_s": 0.001}
    lab.path.write_text(yaml.safe_dump(content))
    assert float(scale().split()[0]) == pytest.approx(0.5 * float(without.split()[0]), abs=0.02)


@pytest.fixture
def skin_lab(tmp_path) -> Iterator[Lab]:
    lab = Lab(tmp_path, fingertips={}, load_cell=None)
    yield lab
    lab.close()


@pytest.mark.long
def test_a_rig_with_a_skin_alone_runs_unattended(skin_lab):
    report, _ = skin_lab.run()
    assert failed(report) == []
    assert [stage.stage for stage in report.stages] == list(STAGES)
    lines = {line.what: line for line in report.stage("6").lines}
    assert [what for what, line in lines.items() if line.verdict == "passed"] == [
        "rate of the skin",
        "faults of the skin",
        "noise of the skin's gauge 1",
        "noise of the skin's gauge 2",
        "order of the skin's gauges",
        "clock of the skin",
        "skin's gauges under the press",
    ]
    assert report.stage("6").supplies == NOTHING_SUPPLIED
    (asked,) = (question for question in skin_lab.operator.asked if "Press the tool" in question)
    assert "by about 0.2 N·m, with at most 2.8 N on the skin" in asked


def test_a_press_that_spares_a_skin_near_the_axis_may_be_hidden_in_the_wrench(tmp_path):
    """A clock that is not known is not judged: the noise alone would turn its line red."""
    lab = Lab(tmp_path, fingertips={}, load_cell=None, skin={**SKIN, "tool_radius_mm": 30.0})
    asked = lab.operator.asked
    try:
        report, _ = lab.run("6")
    finally:
        lab.close()
    assert failed(report) == []
    (line,) = (line for line in report.stages[0].lines if line.what == "clock of the skin")
    assert line.verdict == "noted"
    assert "in the noise of the robot's wrench" in line.value
    assert any("by about 0.084 N·m" in question for question in asked)


def test_a_skin_is_the_reference_of_a_load_cell_beside_a_cb3(tmp_path):
    """The wrench of a CB3 is too noisy for a press."""
    lab = Lab(tmp_path, fingertips={}, skin={**SKIN, "tool_radius_mm": 30.0})
    settings = yaml.safe_load((tmp_path / "ur.yaml").read_text())
    limits = {**settings["limits"], "force_n": {"inner": 60, "hard": 90}, "torque_nm": {"inner": 12, "hard": 20}}
    (tmp_path / "ur.yaml").write_text(yaml.safe_dump({**settings, "generation": "cb3", "limits": limits}))
    try:
        report, _ = lab.run("6")
    finally:
        lab.close()
    assert failed(report) == []
    lines = {line.what: line for line in report.stages[0].lines}
    assert "clock of the skin" not in lines
    assert lines["lag of the load cell"].verdict == "passed"
    assert "behind the skin" in lines["lag of the load cell"].value


def test_a_skin_alone_with_a_dead_gauge_is_not_pressed(skin_lab):
    skin_lab.rig.order("skin open 2")
    report, _ = skin_lab.run("6")
    assert failed(report) == ["faults of the skin"]
    assert not any("Press the tool" in question for question in skin_lab.operator.asked)


def test_an_answer_of_12_ms_a_variable_is_fast_enough_for_the_daemon(lab):
    lab.rig.order("gripper slow 12")
    report, _ = lab.run("2")
    assert failed(report) == []


def test_an_active_gripper_is_activated_as_its_question_says_and_the_time_is_measured(lab):
    lab.run("2")
    lab.operator.asked.clear()
    report, _ = lab.run("2")
    assert "also where it is active already" in lab.operator.asked[1]
    (line,) = (line for line in report.stages[0].lines if line.what == "activation")
    assert float(line.value.split()[0]) > 0.1


@pytest.mark.long
def test_the_bounds_are_about_the_confirmed_pose_also_where_the_arm_was_moved_by_hand_before(lab):
    """The robot is driven from stage 1 on, and the pose is confirmed in stage 3."""
    lab.move_by_hand(0.08, before="object none")
    report, _ = lab.run("1234")
    assert failed(report) == []
    assert lab.rig.bounds_rad() == pytest.approx((0.08 - LARGEST_RAD, 0.08 + LARGEST_RAD))


@pytest.mark.long
def test_a_faster_stop_is_raised_by_five_of_each_layer(lab):
    report, _ = lab.run("4", replace(COUNTS, stops=5, speeds_rad_per_s=(0.05, 0.2)))
    assert failed(report) == []
    assert report.supplied().wrist_speed_rad_per_s == 0.2
    assert 0 < report.supplied().stop_rad < 0.05
    lines = {line.what: line for line in report.stages[0].lines}
    for what in ("emergency stop", "stop at the pendant", "cable pulled"):
        assert lines[what].count == 5
        assert "recovery 5 of 5" in lines[what].value
    assert "then robot emergency stop" in lines["emergency stop"].value
    for layer in CAUSES:
        assert lines[f"{layer} at 0.2 rad/s"].count == 5
    asked = [question for question in lab.operator.asked if "Now pull" in question]
    assert [
        f"stop {n} of 5, at {speed} rad/s" in question
        for n, speed, question in zip(range(1, 6), (0.05, 0.2, 0.2, 0.2, 0.2), asked, strict=True)
    ] == [True] * 5
    allowed = [question for question in lab.operator.asked if "pull" in question and "MOTION" in question]
    assert len(allowed) == 1
    assert "5 times" in allowed[0]
    assert "0.05, 0.2, 0.2, 0.2, 0.2 rad/s" in allowed[0]


@pytest.mark.long
def test_the_raised_speed_is_one_from_which_a_person_stopped_the_wrist(lab, monkeypatch):
    """Each press met a wrist that was slow, near the end of its way."""
    monkeypatch.setattr(stops, "stops_by_hand", lambda *_: ([], 0.01, 0.12))
    report, _ = lab.run("4", replace(COUNTS, stops=5, speeds_rad_per_s=(0.2,)))
    assert failed(report) == []
    assert report.supplied().wrist_speed_rad_per_s == 0.12
    (line,) = (line for line in report.stages[0].lines if line.what == "allowed speed")
    assert "0.12 rad/s" in line.value
    assert "`--stages 4` tries again up to 0.2 rad/s" in line.value


def test_a_cable_whose_samples_come_late_shows_the_whole_stop(lab):
    lab.do_instead("silence robot 1.2", [["robot hold-back 1.2"]])
    line = lab.stopped_by_hand("cable pulled")
    assert line.verdict == "passed"
    assert "s to rest" in line.value


@pytest.mark.long
@pytest.mark.parametrize(
    ("first", "verdict"), [([["robot silence 0.2"]], "passed"), ([[], []], "passed"), ([[], [], []], "failed")]
)
def test_a_cable_that_was_pulled_too_shortly_or_not_at_all_is_asked_for_again(lab, first, verdict):
    lab.do_instead("silence robot 1.2", list(first))
    line = lab.stopped_by_hand("cable pulled")
    assert line.verdict == verdict
    assert len([question for question in lab.operator.asked if "Now pull" in question]) == min(3, len(first) + 1)
    assert ("not interrupted" in line.value) == (verdict == "failed")


def test_a_program_that_replaced_the_commissionings_is_asked_about_before_the_next_stage(lab):
    """As a daemon of another computer uploads it: the clock of our script stands still while a program plays."""
    config = load_daemon_config(lab.path)
    with ExitStack() as opened:
        settings, controller, operator = open_settings(config), lab.rig.controller(), lab.operator.operator
        context = Context(config, settings, lab.rig, controller, operator, None, COUNTS, opened)
        context.ready()
        context.expect_no_other_program()
        assert lab.operator.asked == [], "our own program plays"
        outputs = lab.rig.outputs
        lab.rig.outputs = lambda registers: replace(outputs(registers), script_ticks=7)
        lab.operator.declined = "Another program plays"
        with pytest.raises(DeclinedError):
            context.expect_no_other_program()
        lab.operator.asked.clear()
        lab.rig.other_client = True
        with pytest.raises(UserError, match="end the other daemon, or stop the program at the teach pendant"):
            context.expect_no_other_program()
        assert lab.operator.asked == [], "the program may be another daemon's, and the worker refuses to end it"


@pytest.mark.long
def test_a_held_tool_is_twisted_by_the_announced_angle_wherever_the_stage_before_left_the_wrist(lab, monkeypatch):
    """The stage of motion ends beside the pose."""
    turned_rad = []

    def noted(before: tool.Held, after: tool.Held, *others: Any, **options: Any) -> list[Line]:
        turned_rad.append(after.wrist_rad - before.wrist_rad)
        return judge_signs(before, after, *others, **options)

    judge_signs = tool.judge_signs
    monkeypatch.setattr(tool, "judge_signs", noted)
    report, _ = lab.run("37")
    assert failed(report) == []
    assert turned_rad == [pytest.approx(tool.TURN_RAD, abs=0.015)]
    motions = [one for one in lab.operator.asked if "MOTION" in one]
    back = next(number for number, one in enumerate(motions) if "back to the confirmed pose, from -" in one)
    assert "close onto the tool" in motions[back + 1], "nothing is held yet"


@pytest.mark.long
def test_an_emergency_stop_of_a_wrist_that_stands_is_none(lab):
    """A swing ends by itself while nobody presses."""
    lab.do_instead("emergency-stop", [["object none"] * 80 + ["emergency-stop"]])
    line = lab.stopped_by_hand("emergency stop")
    assert (line.verdict, line.count) == ("passed", 1)
    assert "ended its turn before the stop" in " ".join(lab.operator.said)
