"""The rehearsal: `check` prints an experiment's plan, and what the configured devices do not allow."""

import math
import re
from pathlib import Path

import pytest
import yaml

from shearloop.cli import main
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.control.plan import Plan, StepPlan, plan_of
from shearloop.daemon.experiment_files import ExperimentFiles, InvalidExperimentError
from shearloop.daemon.loaded_files import LoadedFiles
from shearloop.daemon.motion_cap import Commissioning
from shearloop.daemon.operator_questions import question_of
from shearloop.daemon.sensing.sessions import torque_sources
from shearloop.drivers.ur.settings import UrLimits, read_settings
from tests.daemon.control.loop_rig import CONFIG, TICK_S, Rig, new_loop, phase, started
from tests.fixtures.daemons import collector, running_daemon, shearloop
from tests.fixtures.robots import write_filled_in

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "config" / "ur.yaml"
GRIP = {"do": "grip", "width_mm": 5, "force_n": 60}
TIGHTEN = {"do": "tighten", "direction": "clockwise", "until_torque_nm": 0.08, "until_angle_rad": 2.0}


def written(folder: Path, *steps: dict[str, object], **keys: object) -> Path:
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump({"name": "one", "torque_source": "load_cell", **keys, "steps": list(steps)}))
    return path


def rig(folder: Path, model: str = "2F-140", **keys: object) -> Path:
    content = {
        "load_cell": {"device": {"path": "load"}},
        "robot": str(write_filled_in(folder)),
        "gripper": {"model": model, "socket": {"host": "192.168.1.10"}},
        **keys,
    }
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


WRIST_IS_ANYWHERE = "how long it takes depends on where wrist 3 stands, and is a guess here"
# The notes of the delivered experiments, by step.
NOTES = {
    "torque_sweep": {
        3: [WRIST_IS_ANYWHERE],
        # A straight line before it turns the wrist too, by what the plan does not know.
        7: [
            "a tool may be held, and turns too: which way, and how far, depends on where wrist 3 stands",
            WRIST_IS_ANYWHERE,
        ],
    },
    "skin_hold_shear": {
        # A tool that slipped under the torque may stand at the twist's angle already.
        4: [
            "may turn back: twist may turn clockwise, against the counterclockwise turn of step 3 (hold_torque)",
            "how long it takes depends on the tool's angle before it, and is a guess here",
        ]
    },
}


@pytest.mark.parametrize("path", sorted((ROOT / "config" / "experiments").glob("*.yaml")), ids=lambda path: path.stem)
def test_the_plan_of_every_delivered_experiment_is_in_words_and_in_numbers(path, ran, result_of):
    steps = yaml.safe_load(path.read_text(encoding="utf-8"))["steps"]
    said = ran("check", path).out.splitlines()
    planned = result_of("check", path)["plan"]
    assert [step["do"] for step in planned["steps"]] == [step["do"] for step in steps]
    assert all(any(line.split()[:2] == [str(n), step["do"]] for line in said) for n, step in enumerate(steps, 1))
    assert planned["force_n"] == max(step.get("force_n", 0) for step in steps)
    asked = max(step.get("torque_nm", step.get("until_torque_nm", 0)) for step in steps)
    by_angle = [step["do"] in ("twist", "identify") for step in steps]
    assert planned["torque_nm"] == (asked or (None if any(by_angle) else 0))
    assert planned["torque_is_known"] is not any(by_angle)
    assert [step["torque_nm"] is None for step in planned["steps"]] == by_angle
    for time in ("duration_s", "longest_s"):
        assert planned[time] == pytest.approx(sum(step[time] for step in planned["steps"]))
    assert not any(step["refused"] for step in planned["steps"])
    notes = {step["number"]: step["notes"] for step in planned["steps"] if step["notes"]}
    assert notes == NOTES.get(path.stem, {})


def test_each_value_of_a_plan_is_in_its_json_under_its_name():
    values = {
        "number": 1,
        "do": "tighten",
        "text": "turns",
        "duration_s": 2.0,
        "longest_s": 3.0,
        "direction": "clockwise",
        "torque_nm": 0.04,
        "angle_rad": 0.05,
        "force_n": 6.0,
        "timeout_s": 7.0,
        "reverses": True,
        "may_reverse": False,
        "turns_back": True,
        "way_unknown": False,
        "moves": True,
        "notes": ("note",),
        "refused": ("reason",),
    }
    later = {"number": 2, "duration_s": 20.0, "longest_s": 30.0, "torque_nm": 0.4, "angle_rad": 0.5, "force_n": 60.0}
    own = {"name": "one", "torque_source": "skin", "limit_nm": 0.8, "limit_rad": 0.9, "unknown": "u", "assumed": "a"}
    plan = Plan(steps=(StepPlan(**values), StepPlan(**{**values, **later})), **own)
    assert plan.as_json() == {
        **own,
        "steps": (values, {**values, **later}),
        "duration_s": 22.0,
        "longest_s": 33.0,
        "torque_nm": 0.4,
        "torque_is_known": True,
        "angle_rad": 0.5,
        "force_n": 60.0,
    }


def test_a_reversal_is_pointed_out_at_its_step(tmp_path, result_of, ran):
    back = {"do": "hold_torque", "torque_nm": 0.05, "direction": "counterclockwise"}
    path = written(tmp_path, GRIP, {"do": "identify"}, TIGHTEN, back)
    planned = result_of("check", path)["plan"]["steps"]
    assert [step["reverses"] for step in planned] == [False, False, False, True]
    assert planned[3]["notes"] == [
        "reversal: hold_torque turns counterclockwise, against step 3 (tighten), which turned clockwise",
        "how long it takes depends on the torque before it, and is a guess here",
    ]
    assert "1 reversal of a held tool" in ran("check", path).out


def test_a_twist_to_the_other_side_of_a_held_torque_is_a_reversal(tmp_path, result_of):
    hold, twist = {"do": "hold_torque", "torque_nm": 0.1}, {"do": "twist", "angles_rad": [-0.05]}
    path = written(tmp_path, GRIP, {"do": "identify"}, hold, twist, hold)
    planned = result_of("check", path)["plan"]["steps"]
    assert [step["reverses"] for step in planned] == [False, False, False, True, False]
    same_side = written(tmp_path, GRIP, {"do": "identify"}, hold, {"do": "twist", "angles_rad": [0.05]})
    assert not any(step["reverses"] for step in result_of("check", same_side)["plan"]["steps"]), (
        "it may turn either way"
    )


@pytest.mark.parametrize(
    ("twist", "turns_back"),
    [
        ({"angles_rad": "-0.25:0.25:5"}, True),
        ({"angles_rad": [0.1, 0.2], "return_to_start": False}, False),
        ({"angles_rad": [0.2, 0.1, 0.3], "return_to_start": False}, True),
        ({"angles_rad": [0.3, 0.2, 0.1], "return_to_start": False}, True),
        ({"angles_rad": [-0.1, -0.2, -0.2], "return_to_start": False}, False),
        ({"angles_rad": [0.1, 0.2], "return_to_start": False, "repeats": 2}, True),
    ],
)
def test_a_twist_that_turns_both_ways_is_pointed_out(twist, turns_back, tmp_path, ran, result_of):
    path = written(tmp_path, GRIP, {"do": "twist", **twist}, limits={"angle_rad": 1.0})
    assert [step["turns_back"] for step in result_of("check", path)["plan"]["steps"]] == [False, turns_back]
    assert ("turning back within themselves: step 2 (twist)" in ran("check", path).out) is turns_back


@pytest.mark.parametrize(("before", "warned"), [((), True), (({"do": "release"},), False)])
def test_a_tare_before_any_release_is_pointed_out(before, warned, tmp_path, capsys):
    path = written(tmp_path, *before, {"do": "tare"}, GRIP)
    main(["check", str(path), "--config", str(rig(tmp_path))])
    assert ("put a `release` before it" in capsys.readouterr().out) is warned


@pytest.mark.parametrize(("tool_mm", "noted"), [(14.0, True), (16.0, False), (None, False)])
def test_a_grip_whose_target_is_nearly_the_tool_is_pointed_out(tool_mm, noted, tmp_path, result_of):
    keys = {} if tool_mm is None else {"tool_mm": tool_mm}
    path = written(tmp_path, {"do": "grip", "width_mm": 10.0}, **keys)
    notes = "".join(result_of("check", path)["plan"]["steps"][0]["notes"])
    assert ("may not feel the tool of 14 mm: make `width_mm` at most 9" in notes) is noted


def test_turns_that_add_up_to_more_than_the_limit_are_pointed_out(tmp_path, result_of):
    path = written(tmp_path, GRIP, TIGHTEN, TIGHTEN, limits={"angle_rad": 3.0})
    assert "4 rad (229°) from the grip: the limit stops it at 3 rad" in "".join(
        result_of("check", path)["plan"]["steps"][2]["notes"]
    )


def test_the_torque_of_a_twist_is_said_to_be_unknown(tmp_path, ran):
    twist = {"do": "twist", "angles_rad": "-0.25:0.25:5"}
    said = ran("check", written(tmp_path, GRIP, twist, limits={"torque_nm": 0.4})).out
    assert "a torque not known before where the tool turns by an angle" in said
    assert "its limits stop it at 0.4 N·m" in said
    assert "not known before" not in ran("check", written(tmp_path, GRIP, TIGHTEN)).out


OUTSIDE = [
    ({"do": "approach", "pose_m_rad": [0.4, 0.1, 1.2, 0, 3.1, 0]}, "approach ends at z = 1.2 m, outside the robot's"),
    ({"do": "retreat", "pose_m_rad": [0.4, -0.79, 0.2, 0, 3.1, 0]}, "retreat ends at y = -0.79 m, outside the robot's"),
    ({"do": "turn_to", "angle_rad": 6.15}, "turn_to turns to 6.15 rad, and the robot's wrist has -6.1 to 6.1 rad"),
    ({"do": "twist", "absolute": True, "angles_rad": [0.1, -6.2]}, "twist turns to -6.2 rad, and the robot's wrist"),
    ({**GRIP, "force_n": 230}, "grip asks for a force of 230 N, and a 2F-140 has 10 to 125 N"),
    ({**GRIP, "speed_mm_per_s": 25}, "grip asks for a speed of 25 mm/s, and a 2F-140 has 30 to 250 mm/s"),
]


@pytest.mark.parametrize(("step", "said"), OUTSIDE)
async def test_what_lies_outside_the_devices_is_refused_by_check_and_by_start(step, said, tmp_path, capsys):
    path = written(tmp_path, {"do": "release"}, step)
    assert main(["check", str(path), "--config", str(rig(tmp_path))]) == 2
    out, err = capsys.readouterr()
    assert f"REFUSED: {said}" in out, "the plan shows where"
    assert f"steps[1]: {said}" in err
    # As `command start` does, before the experiment begins.
    config, robot = load_daemon_config(rig(tmp_path)), Commissioning(read_settings(ROBOT), None, emulated=True)
    with pytest.raises(InvalidExperimentError, match=rf"experiment\.yaml:\d+: steps\[1\]: {re.escape(said)}"):
        await ExperimentFiles((tmp_path,), config, torque_sources(config, {}, None), robot, LoadedFiles(())).read(path)


@pytest.mark.parametrize(
    ("model", "step", "said"),
    [
        ("2F-85", {**GRIP, "width_mm": 100}, "a width of 100 mm, and a 2F-85 has 0 to 85 mm"),
        ("Hand-E", {"do": "release", "width_mm": 60}, "a width of 60 mm, and a Hand-E has 0 to 50 mm"),
        ("2F-85", {"do": "release"}, ""),
    ],
)
def test_a_smaller_gripper_has_its_own_ranges(model, step, said, tmp_path, capsys):
    path = written(tmp_path, step)
    assert main(["check", str(path), "--config", str(rig(tmp_path, model))]) == (2 if said else 0)
    out, err = capsys.readouterr()
    assert said in err
    assert said or "opens the fingers to 85 mm" in out


def test_what_the_robot_slows_down_is_said(tmp_path, ran):
    steps = ({"do": "turn_to", "angle_rad": 1, "speed_rad_per_s": 3}, {"do": "approach", "along_tool_m": 0.1,
             "speed_m_per_s": 0.5})  # fmt: skip
    # No report caps an emulated robot.
    emulated = {"emulated": True, "robot": str(ROBOT.with_name("demo_ur.yaml")), "gripper": None}
    said = ran("check", written(tmp_path, *steps), "--config", rig(tmp_path, **emulated)).out
    assert "the robot's limit allows 0.5 rad/s" in said
    assert "the robot's limit allows 0.1 m/s" in said


def test_an_option_for_experiments_is_refused_for_a_configuration(tmp_path, mistake):
    assert "--config goes with an experiment" in mistake("check", rig(tmp_path), "--config", "a.yaml")


SKIN = yaml.safe_load((ROOT / "config" / "skin_demo.yaml").read_text(encoding="utf-8"))["skin"]
SKIN["calibration"] = str(ROOT / "config" / SKIN["calibration"])


@pytest.mark.parametrize("name", ["load_cell", "fingertips", "skin"])
def test_a_sensor_alone_is_a_configuration(name, config, ran):
    alone = {"load_cell": {"device": {"path": "load"}}, "skin": SKIN}.get(name)
    path = config() if alone is None else config(**{name: alone}, fingertips={})
    said = ran("check", path).out
    assert said.endswith(f"{path} is in order\n")
    assert "plan of" not in said


async def test_a_load_cell_alone_runs_and_publishes(config, tmp_path):
    path = config(load_cell={"device": {"path": str(tmp_path / "load")}}, fingertips={})
    board = shearloop("emulate", "hx711", "--link", str(tmp_path / "load"), "--speed", "20")
    async with board, running_daemon(path) as daemon:
        message = await collector(daemon, "load.torque").get()
    assert message["source"] == "load_cell"


def test_the_duration_knows_of_the_robots_speed_and_of_the_approach_to_each_angle():
    robot = read_settings(ROBOT).limits
    fastest_rad_per_s = robot.wrist_speed_rad_per_s.inner
    twist = {"do": "twist", "angles_rad": [0.2, -0.2], "hold_s": 0, "repeats": 10, "speed_rad_per_s": 3}

    def duration_s(step: dict[str, object], limits: UrLimits | None) -> float:
        return plan_of(ExperimentFile.model_validate({"name": "fast", "steps": [step]}), limits).duration_s

    # 8 rad, and 40 angles or 20 that are come near to.
    assert duration_s(twist, None) == pytest.approx(8 / 3 + 20.0)
    assert duration_s(twist, robot) == pytest.approx(8 / fastest_rad_per_s + 20.0)
    # From the grip to the first angle it is half as far as between the others.
    assert duration_s({**twist, "return_to_start": False}, robot) == pytest.approx(7.8 / fastest_rad_per_s + 10.0)
    once = {**twist, "angles_rad": [0.4], "speed_rad_per_s": 0.02, "repeats": 1, "return_to_start": False}
    assert duration_s(once, robot) == pytest.approx(20.0 + 0.5)


def test_the_duration_knows_what_the_steps_before_have_left():
    hold = {"do": "hold_torque", "torque_nm": 0.08, "ramp_nm_per_s": 0.04, "hold_s": 12}
    back = {**hold, "torque_nm": -0.05}
    turn = {"do": "turn_to", "angle_rad": 1.4}
    twist = {"do": "twist", "angles_rad": [1.45, 1.65], "absolute": True, "hold_s": 0, "speed_rad_per_s": 0.1}
    file = ExperimentFile.model_validate({"name": "one", "steps": [turn, GRIP, twist, hold, back, GRIP, hold]})
    durations_s = [step.duration_s for step in plan_of(file).steps]
    assert durations_s[2] == pytest.approx(2 * (0.05 + 0.25) / 0.1 + 4 * 0.5)
    # Each torque is come near to.
    assert durations_s[3:5] == pytest.approx([12 + 0.08 / 0.04 + 0.5, 12 + 0.13 / 0.04 + 0.5])
    # A second grip closes tighter on the tool, which stays loaded.
    assert durations_s[6] == pytest.approx(12 + 0.13 / 0.04 + 0.5)


def test_a_step_that_takes_less_than_a_second_does_not_take_none():
    ramp = {"do": "hold_torque", "torque_nm": 0.1, "ramp_nm_per_s": 1, "hold_s": 0}
    (step,) = plan_of(ExperimentFile.model_validate({"name": "quick", "steps": [ramp]})).steps
    assert "about 0.6 s" in next(iter(step.sentences()))


GRIP = {"do": "grip", "width_mm": 5, "force_n": 60}
TURN = {"do": "turn_to", "angle_rad": 0.25}


@pytest.mark.parametrize(
    ("steps", "by_angle", "unknown", "direction"),
    [
        ([TURN], True, True, ""),
        ([{"do": "release"}, TURN], False, False, ""),
        ([GRIP, TURN], True, True, ""),
        ([GRIP, {"do": "release"}, TURN], False, False, ""),
        ([{"do": "release"}, {**TURN, "angle_rad": 0.1}, GRIP, TURN], True, False, "counterclockwise"),
        ([GRIP, {"do": "twist", "angles_rad": [0.1]}, TURN], True, True, ""),
        ([{"do": "release"}, {**TURN, "angle_rad": 0.4}, GRIP, TURN], True, False, "clockwise"),
        ([{"do": "release"}, TURN, GRIP, {"do": "approach", "along_tool_m": 0.1}, TURN], True, True, ""),
    ],
)
def test_a_turn_of_the_wrist_with_a_held_tool_twists_it(steps, by_angle, unknown, direction):
    """By a torque that is not known before. Which way depends on where the wrist stands."""
    plan = plan_of(ExperimentFile.model_validate({"name": "one", "steps": steps}))
    last = plan.steps[-1]
    assert (last.torque_nm is None, last.way_unknown, last.direction) == (by_angle, unknown, direction)
    told = [line for line in plan.sentences() if "and turns too" in line or "not known before: step" in line]
    assert len(told) == (2 if unknown else 0)


def test_a_turn_of_the_wrist_against_the_last_one_is_a_reversal():
    steps = [{**TURN, "angle_rad": 0.1}, GRIP, TURN, {**TURN, "angle_rad": 0.2}]
    plan = plan_of(ExperimentFile.model_validate({"name": "one", "steps": steps}))
    assert [step.reverses for step in plan.steps] == [False, False, False, True]


def test_an_identification_reaches_further_than_the_twist_before_it():
    """It turns to both sides of the angle at which it begins."""
    twist = {"do": "twist", "angles_rad": [0.18], "return_to_start": False}
    steps = [{"do": "grip", "width_mm": 5, "force_n": 60}, twist, {"do": "identify", "amplitude_rad": 0.1}]
    content = {"name": "one", "steps": steps, "limits": {"torque_nm": 0.3, "angle_rad": 0.22}}
    notes = [note for step in plan_of(ExperimentFile.model_validate(content)).steps for note in step.notes]
    assert any("0.28 rad (16°) from the grip: the limit stops it at 0.22 rad" in note for note in notes)


def test_the_duration_of_a_move_between_two_poses_counts_the_tools_turn():
    """A tool that turns by 90 degrees on 5 mm is slowed to the wrist's speed. The first move begins anywhere."""
    poses = [
        (0.3, -0.4, 0.3, 3.14159, 0.0, 0.0),
        (0.3, -0.4, 0.305, 2.22144, 2.22144, 0.0),
        (0.3, -0.4, 0.405, 2.22144, 2.22144, 0.0),
    ]
    steps = [{"do": "approach", "pose_m_rad": pose, "speed_m_per_s": 0.05, "timeout_s": 4} for pose in poses]
    robot = read_settings(ROBOT).limits
    guessed, turned, straight = plan_of(ExperimentFile.model_validate({"name": "one", "steps": steps}), robot).steps
    assert "is a guess here" in " ".join(guessed.notes)
    assert turned.duration_s == pytest.approx(1.0 + math.pi / 2 / robot.wrist_speed_rad_per_s.inner, rel=1e-3)
    assert turned.notes == ("its timeout_s of 4 s may stop it before its end",)
    assert straight.duration_s == pytest.approx(1.0 + 0.1 / 0.05, rel=1e-3)


@pytest.mark.parametrize(
    ("between", "guessed"),
    [
        ([GRIP, {"do": "wait", "wait_s": 1}, {"do": "tare"}], False),
        ([{"do": "release"}, {"do": "retreat", "along_tool_m": -0.1}], False),
        ([GRIP, {"do": "twist", "angles_rad": [0.1]}], False),
        ([GRIP, {"do": "twist", "angles_rad": [0.1], "return_to_start": False}], True),
        ([TURN], True),
    ],
)
def test_a_pose_stays_known_until_the_wrist_turns(between, guessed):
    approach = {"do": "approach", "pose_m_rad": (0.3, -0.4, 0.3, 3.14159, 0.0, 0.0), "speed_m_per_s": 0.05}
    back = {**approach, "pose_m_rad": (0.3, -0.4, 0.2, 3.14159, 0.0, 0.0)}
    *_, last = plan_of(ExperimentFile.model_validate({"name": "one", "steps": [approach, *between, back]})).steps
    assert ("is a guess here" in " ".join(last.notes)) is guessed
    # A retreat by -0.1 m moves away from the table: the tool points down.
    way_m = 0.2 if between[-1]["do"] == "retreat" else 0.1
    assert last.duration_s == pytest.approx(3.0 if guessed else 1.0 + way_m / 0.05, rel=1e-3)


@pytest.mark.parametrize(
    ("steps", "waits"),
    [
        ([{"do": "tare"}, TURN], "step 1 (tare)"),
        ([GRIP, {"do": "wait", "wait_s": 1}, TURN], "step 1 (grip)"),
        ([GRIP, TIGHTEN], "step 1 (grip)"),
        ([{"do": "tare"}, GRIP, TIGHTEN], "step 2 (grip)"),
        ([GRIP, TURN, TIGHTEN], ""),
        ([{"do": "release"}, {"do": "tare"}, TURN], ""),
    ],
)
def test_the_first_turn_of_a_held_tool_waits_for_the_first_torques(steps, waits):
    file = ExperimentFile.model_validate({"name": "one", "steps": steps})
    last, at_once = plan_of(file, warm_up_s=7.0).steps[-1], plan_of(file).steps[-1]
    noted = [note for note in last.notes if "first torques" in note]
    assert noted == ([f"before it, up to 7 s for the first torques after {waits}"] if waits else [])
    assert last.duration_s - at_once.duration_s == (pytest.approx(7.0) if waits else 0.0)


def test_an_experiment_without_its_steps_is_still_one(tmp_path, capsys):
    path = tmp_path / "experiment.yaml"
    path.write_text("{name: one, torque_source: load_cell, step: [{do: release}]}")
    for options in ((), ("--config", str(rig(tmp_path)))):
        assert main(["check", str(path), *options]) == 2
        assert f"{path}:1: step: is not a known key; did you mean steps?" in capsys.readouterr().err


def test_a_turn_without_a_zero_is_named():
    steps = [GRIP, TIGHTEN]
    for source, before, named in (
        ("load_cell", [], True),
        ("right", [], False),
        ("load_cell", [{"do": "tare"}], False),
    ):
        content = {"name": "one", "torque_source": source, "steps": [*before, *steps]}
        notes = plan_of(ExperimentFile.model_validate(content)).steps[-1].notes
        assert any("no `tare` comes before it" in note for note in notes) is named


def test_a_timeout_that_may_end_a_step_early_is_named():
    file = ExperimentFile.model_validate({"name": "one", "steps": [{"do": "release", "timeout_s": 1}, GRIP]})
    first, second = plan_of(file).steps
    assert first.notes == ("its timeout_s of 1 s may stop it before its end",)
    assert second.notes == ()


SLOW_RAD_PER_S = 0.05


def test_the_plan_has_the_speeds_of_the_loop_where_they_are_below_the_robots(tmp_path, result_of):
    turn = {"do": "turn_to", "angle_rad": 0.0, "speed_rad_per_s": 0.2}
    steps = ({"do": "release"}, turn, {**turn, "angle_rad": 1.0}, GRIP, {"do": "identify"})
    path = written(tmp_path, *steps, limits={"torque_nm": 0.3, "angle_rad": 1.0})
    config = rig(tmp_path, loop={"wrist_speed_rad_per_s": SLOW_RAD_PER_S})
    planned = result_of("check", path, "--config", config)["plan"]["steps"]
    assert planned[2]["text"].endswith("at 0.05 rad/s")
    assert planned[2]["duration_s"] == pytest.approx(1.0 / SLOW_RAD_PER_S + 0.5)
    assert planned[2]["notes"] == ["it asks for 0.2 rad/s, and `loop.wrist_speed_rad_per_s` allows 0.05 rad/s"]
    # To half of 0.2 rad and to 0.2 rad, and back: 0.6 rad in all.
    assert planned[4]["duration_s"] == pytest.approx(6 * 2.5 + 0.6 / SLOW_RAD_PER_S + 2.5)


async def test_the_question_before_a_start_has_the_speeds_of_the_loop(tmp_path):
    config = load_daemon_config(rig(tmp_path, loop={"wrist_speed_rad_per_s": SLOW_RAD_PER_S}))
    path = written(tmp_path, {"do": "release"}, {"do": "turn_to", "angle_rad": 0.0, "speed_rad_per_s": 0.2})
    robot = Commissioning(read_settings(ROBOT), None, emulated=True)
    files = ExperimentFiles((tmp_path,), config, torque_sources(config, {}, None), robot, LoadedFiles(()))
    question = question_of(await files.read(path), files, Rig(new_loop()).control_loop)
    assert "turns wrist 3 to 0 rad (0°) at 0.05 rad/s" in "".join(question.plan)


async def test_the_question_before_a_start_knows_where_the_wrist_is_and_does_not_change_with_it(tmp_path):
    config = load_daemon_config(rig(tmp_path))
    path = written(tmp_path, {"do": "release"}, {"do": "turn_to", "angle_rad": 1.3, "speed_rad_per_s": 0.1})
    robot = Commissioning(read_settings(ROBOT), None, emulated=True)
    files = ExperimentFiles((tmp_path,), config, torque_sources(config, {}, None), robot, LoadedFiles(()))
    experiment, digests = await files.read(path), set()
    for wrist_rad, said in ((0.25, "about 11 s"), (0.35, "about 10 s")):
        ready = Rig(new_loop())
        ready.wrist_rad = wrist_rad
        ready.step()
        question = question_of(experiment, files, ready.control_loop)
        assert said in question.plan[2]
        assert WRIST_IS_ANYWHERE not in "".join(question.plan)
        digests.add(question.digest)
    assert len(digests) == 1


async def test_a_wrist_near_the_end_of_its_range_is_named_before_a_start(tmp_path):
    """The robot slows it there to a stand, and the step would wait for its end for ever."""
    config = load_daemon_config(rig(tmp_path))
    tighten = {"do": "tighten", "until_torque_nm": 0.1, "until_angle_rad": 0.3}
    robot = Commissioning(read_settings(ROBOT), None, emulated=True)
    files = ExperimentFiles((tmp_path,), config, torque_sources(config, {}, None), robot, LoadedFiles(()))
    joints = robot.settings.limits.joints
    high_rad, low_rad = joints.upper_rad[-1] - joints.margin_rad, joints.lower_rad[-1] + joints.margin_rad
    for way, wrist_rad, is_named in (
        ("counterclockwise", high_rad - 0.05, True),
        ("counterclockwise", low_rad + 0.05, False),
        ("counterclockwise", 0.0, False),
        ("clockwise", low_rad + 0.05, True),
        ("clockwise", high_rad - 0.05, False),
    ):
        path = written(tmp_path, {"do": "release"}, GRIP, {**tighten, "direction": way})
        experiment = await files.read(path)
        ready = Rig(new_loop())
        ready.wrist_rad = wrist_rad
        ready.step()
        plan = "".join(question_of(experiment, files, ready.control_loop).plan)
        named = re.findall(r"near the (\w+) end of its range", plan)
        assert named == [way] * is_named, wrist_rad


@pytest.mark.parametrize(("speed_rad_per_s", "amplitude_rad"), [(0.05, 0.2), (0.2, 0.2), (0.5, 0.1)])
def test_the_planned_duration_of_an_identification_is_about_the_real_one(speed_rad_per_s, amplitude_rad):
    config = CONFIG.model_copy(update={"wrist_speed_rad_per_s": speed_rad_per_s})
    step = {"do": "identify", "amplitude_rad": amplitude_rad, "hold_s": 0.8}
    rig = started(Rig(new_loop(config)), GRIP, step, torque_source="load_cell", limits={"torque_nm": 1, "angle_rad": 1})
    while rig.control_loop.experiment.step_number == 1:
        rig.step()
    begun = rig.tick
    rig.run(120)
    assert phase(rig) is ExperimentPhase.DONE
    robot = read_settings(ROBOT).limits
    planned_s = plan_of(rig.control_loop.experiment.file, robot, loop=config).steps[1].duration_s
    assert (rig.tick - begun) * TICK_S == pytest.approx(planned_s, rel=0.2)


@pytest.mark.parametrize("speed_rad_per_s", [0.1, 0.2, 0.5])
def test_the_planned_duration_of_a_twist_is_the_real_one(speed_rad_per_s):
    step = {"do": "twist", "angles_rad": [0.05, 0.3], "hold_s": 2, "speed_rad_per_s": speed_rad_per_s, "repeats": 3}
    rig = started(Rig(new_loop()), GRIP, step, torque_source="load_cell", limits={"torque_nm": 1, "angle_rad": 1})
    while not rig.speed:
        rig.step()
    begun = rig.tick
    rig.run(120)
    assert phase(rig) is ExperimentPhase.DONE
    planned_s = plan_of(rig.control_loop.experiment.file).steps[1].duration_s
    assert (rig.tick - begun) * TICK_S == pytest.approx(planned_s, rel=0.1)
