"""An experiment that can never be carried out is refused before anything is opened."""

import re
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.control.sensor_reach import tool_note
from shearloop.daemon.experiment_files import ExperimentFiles, check_experiment
from shearloop.daemon.loaded_files import LoadedFiles
from shearloop.daemon.motion_cap import Commissioning
from shearloop.daemon.sensing.sessions import torque_sources
from shearloop.daemon.torques import TorqueSource
from shearloop.drivers.ur.settings import ForceBound, TorqueBound, read_settings
from shearloop.errors import UserError
from tests.paper_curve import paper_curve

SERIAL = {"device": {"path": "port"}}
STEPS = [{"do": "tare"}, {"do": "wait", "wait_s": 1}]


def config(folder: Path, experiment: dict[str, Any], **more: Any) -> DaemonConfig:
    # Steps that stand twice in a test stand twice in the file: an alias would be refused.
    steps = [*map(deepcopy, experiment.get("steps", STEPS))]
    (folder / "experiment.yaml").write_text(yaml.safe_dump({"name": "one", **experiment, "steps": steps}))
    content = {
        "fingertips": {"right": {"device": {"path": "right"}, "calibration": "right.cal"}, "left": SERIAL},
        "robot": "ur.yaml",
        "experiment": "experiment.yaml",
        **more,
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(content))
    return load_daemon_config(folder / "config.yaml")


SOURCES = {
    name: TorqueSource(name=name, period_s=0.5, measures_torque=measures)
    for name, measures in (("right", True), ("left", False))
}
LOAD = {"load_cell": TorqueSource(name="load_cell", period_s=0.1)}


def refusal(folder: Path, experiment: dict[str, Any], **more: Any) -> str:
    with pytest.raises(UserError) as error:
        check_experiment(config(folder, experiment, **more), SOURCES)
    return str(error.value)


def test_a_torque_that_is_measured_may_drive(tmp_path):
    for drive in ("right", "load_cell", "wrench"):
        file = check_experiment(
            config(tmp_path, {"torque_source": drive}, load_cell={"device": {"path": "load"}}), {**SOURCES, **LOAD}
        )
        assert file.torque_source == drive


def test_a_torque_that_is_not_measured_may_not_drive(tmp_path):
    assert refusal(tmp_path, {"torque_source": "load_cell"}).endswith(
        "experiment.yaml:6: torque_source: `load_cell` is not a measured torque: choose another, or configure its "
        "device; there are right, wrench"
    )
    assert "torque_source: `left` is a fingertip without a calibration" in refusal(tmp_path, {"torque_source": "left"})


@pytest.mark.parametrize("step", [{"do": "grip"}, {"do": "release"}])
def test_a_gripper_that_is_not_there_is_missed_before_the_start(tmp_path, step):
    mistakes = refusal(tmp_path, {"steps": [*STEPS, step]})
    assert f"steps[2]: {step['do']} needs a gripper, and none is configured; add a `gripper` section" in mistakes


LIMITS = {"torque_nm": 0.2, "angle_rad": 1.0}


@pytest.mark.parametrize(
    ("step", "mistake"),
    [
        (
            {"do": "hold_torque", "torque_nm": -0.2},
            "asks for 0.2 N·m, and its limit is 0.2 N·m; raise limits.torque_nm",
        ),
        (
            {"do": "hold_torque", "torque_nm": 0.15, "limits": {"torque_nm": 0.1}},
            "asks for 0.15 N·m, and its limit is 0.1 N·m",
        ),
        (
            {"do": "hold_torque", "torque_nm": 0.25, "limits": {"torque_nm": 0.3}},
            "asks for 0.25 N·m, and its limit is 0.2 N·m",
        ),
        (
            {"do": "tighten", "direction": "clockwise", "until_torque_nm": 0.1, "until_angle_rad": 2},
            "asks for 2 rad, and its limit is 1 rad",
        ),
        (
            {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 20, "timeout_s": 20},
            "stands still for 20 s in all, and its timeout is 20 s; raise timeout_s",
        ),
        (
            {"do": "twist", "angles_rad": [0.1, 0.2], "hold_s": 5, "repeats": 3, "timeout_s": 25},
            "stands still for 30 s in all, and its timeout is 25 s",
        ),
        ({"do": "wait", "wait_s": 3, "timeout_s": 2}, "stands still for 3 s in all, and its timeout is 2 s"),
        (
            {"do": "twist", "angles_rad": "0.1:1.2:5"},
            "asks for 1.2 rad, and its limit is 1 rad; raise limits.angle_rad",
        ),
    ],
)
def test_a_step_that_asks_for_more_than_its_limit_is_refused_with_both_numbers(tmp_path, step, mistake):
    said = refusal(tmp_path, {"torque_source": "wrench", "limits": LIMITS, "steps": [*STEPS, step]})
    assert f"steps[2]: {step['do']} {mistake}" in said


@pytest.mark.parametrize("between", [[], [{"do": "tare"}], [{"do": "release"}], [{"do": "grip"}]])
def test_hold_torque_is_refused_without_an_identification_of_the_present_tool(tmp_path, between):
    identify, hold = {"do": "identify"}, {"do": "hold_torque", "torque_nm": 0.1}
    gripper = {"model": "2F-140", "socket": {"host": "127.0.0.1"}}
    first = [identify] if between else []
    mistakes = refusal(tmp_path, {"steps": [*first, *between, hold, identify, hold]}, gripper=gripper)
    assert (
        f"steps[{len(first) + len(between)}]: hold_torque needs an identified tool; put an `identify` step" in mistakes
    )
    steps = [*between, identify, {"do": "wait", "wait_s": 1}, hold, hold]
    assert check_experiment(config(tmp_path, {"steps": steps}, gripper=gripper), SOURCES) is not None


ADAPT = {"do": "adapt", "fingertip": "right"}
IDENTIFY = {"do": "identify"}


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ([IDENTIFY, ADAPT], "steps[1]: adapt needs a load cell, and none is configured; add a `load_cell` section"),
        (
            [IDENTIFY, {**ADAPT, "fingertip": "left", "reference": "wrench"}],
            "steps[1]: adapt corrects `left`, which has no",
        ),
        ([IDENTIFY, {"do": "tare"}, {**ADAPT, "reference": "wrench"}], "steps[2]: adapt needs a twisted tool"),
        (
            [IDENTIFY, {**ADAPT, "reference": "wrench"}, {"do": "hold_torque", "torque_nm": 0.1}],
            "steps[2]: hold_torque needs an identified tool",
        ),
    ],
)
def test_an_adaptation_that_nothing_is_known_for_is_refused(tmp_path, steps, said):
    sources = {**SOURCES, "right": TorqueSource(name="right", period_s=0.5, has_gain=True)}
    with pytest.raises(UserError, match=re.escape(said)):
        check_experiment(config(tmp_path, {"steps": steps}), sources)
    cell = {"load_cell": {"device": {"path": "load"}}}
    fine = {"steps": [IDENTIFY, ADAPT, IDENTIFY, {"do": "hold_torque", "torque_nm": 0.1}]}
    assert check_experiment(config(tmp_path, fine, **cell), {**sources, **LOAD}) is not None


ONE_WAY = [
    {"do": "hold_torque", "torque_nm": -0.1},
    {"do": "hold_torque", "torque_nm": 0.1, "direction": "clockwise"},
    {"do": "tighten", "until_torque_nm": 0.1, "until_angle_rad": 0.3, "direction": "clockwise"},
    {"do": "twist", "angles_rad": [0.1, -0.1]},
]


@pytest.mark.parametrize("step", ONE_WAY)
async def test_a_torque_that_the_driving_calibration_reads_as_none_is_refused(tmp_path, step):
    steps, both_ways = [IDENTIFY, step], TorqueSource(name="right", period_s=0.5)
    experiment = config(tmp_path, {"torque_source": "right", "steps": steps})
    one_sided = replace(both_ways, only_sign=1)
    said = rf"steps\[1\]: {step['do']} turns clockwise, and right measures no torque of"
    with pytest.raises(UserError, match=said):
        check_experiment(experiment, {"right": one_sided})
    assert check_experiment(experiment, {"right": both_ways}) is not None
    # A running daemon reads it before each start.
    files = ExperimentFiles((tmp_path,), experiment, {"right": one_sided}, None, LoadedFiles(()))
    with pytest.raises(UserError, match=said):
        await files.read(experiment.experiment)


def of_tool(tool_mm: float) -> TorqueSource:
    """Return a fingertip whose calibration is of a tool of this diameter."""
    sigma = np.linspace(0.9, 2.1, 30)
    calibration = replace(paper_curve("bank", torque=(sigma, 0.3 - 0.1 * sigma)), tool_mm=tool_mm)
    return TorqueSource(name="right", period_s=0.5, calibration=calibration)


CELL = {"load_cell": {"device": {"path": "load"}}}
CONFIGS = Path(__file__).parents[2] / "config"
SKIN = yaml.safe_load((CONFIGS / "skin_demo.yaml").read_text(encoding="utf-8"))["skin"]
SKIN = {**SKIN, "calibration": str(CONFIGS / SKIN["calibration"]), "tool_radius_mm": 15}


@pytest.mark.parametrize("driving", ["load_cell", "skin"])
@pytest.mark.parametrize(
    ("step", "refused"),
    [
        ({"do": "hold_torque", "torque_nm": 0.12}, "hold_torque asks for +0.12 N·m"),
        ({"do": "hold_torque", "torque_nm": 0.12, "direction": "clockwise"}, "hold_torque asks for -0.12 N·m"),
        ({"do": "hold_torque", "torque_nm": 0.07}, ""),
        (
            {"do": "tighten", "until_torque_nm": 0.12, "until_angle_rad": 0.3, "direction": "clockwise"},
            "tighten asks for -0.12 N·m",
        ),
        ({"do": "tighten", "until_torque_nm": 0.07, "until_angle_rad": 0.3, "direction": "clockwise"}, ""),
    ],
)
async def test_a_torque_beyond_what_the_skin_is_calibrated_for_is_refused(tmp_path, driving, step, refused):
    """Also where it only supervises: it holds the wrist as soon as it has no torque."""
    daemon = config(tmp_path, {"torque_source": driving, "steps": [IDENTIFY, step]}, skin=SKIN, **CELL)
    sources = torque_sources(daemon, {}, None)
    files = ExperimentFiles((tmp_path,), daemon, sources, None, LoadedFiles(()))
    if not refused:
        assert check_experiment(daemon, sources) is not None
        assert await files.read(daemon.experiment)
        return
    role = ", which supervises," if driving == "load_cell" else ""
    said = f"steps[1]: {refused}, and skin{role} measures -0.0782 to +0.0782 N·m: it is calibrated from -5.2 to"
    with pytest.raises(UserError, match=re.escape(said)):
        check_experiment(daemon, sources)
    with pytest.raises(UserError, match=re.escape(said)):
        await files.read(daemon.experiment)


@pytest.mark.parametrize("driving", ["load_cell", "right"])
def test_a_torque_beyond_a_fingertips_calibration_or_the_load_cells_capacity_is_refused(tmp_path, driving):
    def said(torque_nm: float) -> str:
        steps = [IDENTIFY, {"do": "hold_torque", "torque_nm": torque_nm}]
        content = {"torque_source": driving, "tool_mm": 20, "limits": {"torque_nm": 5}, "steps": steps}
        daemon = config(tmp_path, content, **CELL)
        sources = {"right": of_tool(20.0), **torque_sources(daemon, {}, None)}
        try:
            check_experiment(daemon, sources)
        except UserError as error:
            return str(error)
        return ""

    # It is calibrated from 0.09 to 0.21 N·m, and reads a third of this range beyond either end.
    assert said(0.2) == ""
    role = "" if driving == "right" else ", which supervises,"
    assert f"hold_torque asks for +0.3 N·m, and right{role} measures +0.048 to +0.252 N·m: ask for less" in said(0.3)
    assert "measures -1.75 to +1.75 N·m: this is its capacity" in said(2.0)


TURN = [{"do": "turn_to", "angle_rad": 0.1}]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"tool_mm": 40}, "tool_mm: right has no torque on this tool: the tool has 40 mm, and"),
        ({"tool_mm": 40, "torque_source": "load_cell", "steps": TURN}, "tool_mm: right, which supervises, has no"),
        ({"tool_mm": 40, "torque_source": "load_cell"}, ""),
        ({"tool_mm": 22}, ""),
        ({}, ""),
    ],
)
async def test_an_experiment_on_another_tool_than_the_calibrated_one_is_refused(tmp_path, content, said):
    content = {"torque_source": "right", **content}
    daemon, sources = config(tmp_path, content, **CELL), {"right": of_tool(20.0), **LOAD}
    files = ExperimentFiles((tmp_path,), daemon, sources, None, LoadedFiles(()))
    if not said:
        assert check_experiment(daemon, sources) is not None
        assert (await files.read(daemon.experiment)).file.tool_mm == content.get("tool_mm")
        return
    with pytest.raises(UserError, match=re.escape(said)):
        check_experiment(daemon, sources)
    with pytest.raises(UserError, match=re.escape(said)):
        await files.read(daemon.experiment)


@pytest.mark.parametrize(
    ("content", "gripper", "said"),
    [
        ({}, {}, "the tool's diameter is not known, and the torque of right holds for a tool of 20 mm alone"),
        ({}, {"calibration": "gripper.yaml"}, ""),
        ({"tool_mm": 20}, {}, ""),
        ({"torque_source": "load_cell"}, {}, ""),
    ],
)
def test_a_plan_says_that_nothing_will_know_the_tool(tmp_path, content, gripper, said):
    gripper = {"gripper": {"model": "2F-140", "socket": {"host": "127.0.0.1"}, **gripper}}
    daemon = config(tmp_path, {"torque_source": "right", **content}, **CELL, **gripper)
    sources = {"right": of_tool(20.0), **LOAD}
    file = check_experiment(daemon, sources)
    note = tool_note(file, daemon, sources, None)
    assert said in note
    assert bool(note) is bool(said)


def test_every_mistake_of_an_experiment_has_a_line_of_its_own(tmp_path):
    hold = {"do": "hold_torque", "torque_nm": 0.1}
    mistakes = refusal(tmp_path, {"torque_source": "rigth", "steps": [{"do": "grip"}, hold, {"do": "release"}]})
    *others, last = mistakes.splitlines()
    assert last.endswith(
        "torque_source: `rigth` is not a measured torque: choose another, or configure its device; "
        "there are right, wrench; did you mean right?"
    )
    assert [f"steps[{number}]: " in line for number, line in zip((0, 1, 2), others, strict=True)] == [True] * 3
    schema, source = refusal(
        tmp_path, {"torque_source": "rigth", "steps": [*STEPS, {"do": "turn_to", "angle_rad": 90}]}
    ).splitlines()
    assert "steps[2].angle_rad: 90 is too large" in schema
    assert source.endswith("did you mean right?")
    wide = {**LIMITS, "angle_rad": 90}
    limit, source = refusal(tmp_path, {"torque_source": "rigth", "limits": wide, "steps": STEPS}).splitlines()
    assert "limits.angle_rad: 90 is too large" in limit
    assert source.endswith("did you mean right?")
    twist = {"do": "twist", "angles_rad": [2]}
    assert len(refusal(tmp_path, {"limits": LIMITS, "steps": [twist, twist]}).splitlines()) == 2


def test_a_missing_experiment_file_is_refused_by_name(tmp_path):
    daemon = config(tmp_path, {})
    (tmp_path / "experiment.yaml").unlink()
    with pytest.raises(UserError, match=r"experiment\.yaml: the experiment cannot be read: No such file"):
        check_experiment(daemon, SOURCES)


@pytest.mark.parametrize(("generation", "refused"), [("e-series", False), ("cb3", True)])
def test_a_wrench_that_a_controller_estimates_drives_nothing_gentle(generation, refused, tmp_path):
    robot = commissioned(generation)
    made = config(tmp_path, {"torque_source": "wrench", "limits": {"torque_nm": 0.1}})
    with pytest.raises(UserError, match="known to 5 N·m only") if refused else nullcontext():
        check_experiment(made, SOURCES, robot)


RELEASE, CLOSE, WAIT = {"do": "release"}, {"do": "grip"}, {"do": "wait", "wait_s": 1}
RETREAT = {"do": "retreat", "along_tool_m": -0.05}
BARE = {name: TorqueSource(name=name, period_s=0.5, measures_torque=False) for name in ("right", "left")}
BARE_RIG = {"fingertips": {"right": SERIAL}, "gripper": {"model": "2F-140", "socket": {"host": "127.0.0.1"}}}


def commissioned(generation: str = "cb3") -> Commissioning:
    settings = read_settings(Path(__file__).parents[2] / "config" / "ur.yaml")
    limits = replace(settings.limits, torque_nm=TorqueBound(8.0, 12.0), force_n=ForceBound(45.0, 60.0))
    return Commissioning(replace(settings, generation=generation, limits=limits), None, emulated=True)


@pytest.mark.parametrize("keys", [{}, {"torque_source": "wrench"}, {"torque_source": "right", "tool_mm": 20}])
@pytest.mark.parametrize(
    ("steps", "needs"),
    [
        ([RELEASE, CLOSE, WAIT, RELEASE], False),
        ([RETREAT, RELEASE, *TURN, CLOSE], False),
        ([CLOSE, RELEASE, RETREAT, *TURN], False),
        # The tool is held, or may be held, while the arm moves or the wrist turns.
        ([CLOSE, RETREAT, RELEASE], True),
        ([CLOSE, *TURN], True),
        ([*TURN, RELEASE], True),
        ([{"do": "grip", "expect_object": False}, *TURN], True),
        ([RELEASE, {"do": "tare"}, CLOSE], True),
    ],
)
def test_only_a_step_that_needs_a_torque_asks_for_a_source_that_can_drive(tmp_path, keys, steps, needs):
    made = config(tmp_path, {**keys, "steps": steps}, **BARE_RIG)
    with pytest.raises(UserError, match="torque_source: `") if needs else nullcontext():
        check_experiment(made, BARE, commissioned())


@pytest.mark.parametrize("misspelt", ["rihgt", "load_cell"])
def test_a_source_that_the_rig_does_not_have_is_refused_also_where_no_step_needs_one(tmp_path, misspelt):
    made = config(tmp_path, {"torque_source": misspelt, "steps": [RELEASE, CLOSE, WAIT]}, **BARE_RIG)
    with pytest.raises(UserError, match=f"torque_source: `{misspelt}` is not a measured torque"):
        check_experiment(made, BARE, commissioned("e-series"))


def test_a_straight_move_of_a_clamped_tool_asks_for_a_source_that_can_drive(tmp_path):
    made = config(tmp_path, {"steps": [RETREAT]}, fingertips={"right": SERIAL})
    with pytest.raises(UserError, match="torque_source: `right` is a fingertip without"):
        check_experiment(made, BARE, commissioned())


def test_no_source_is_offered_that_is_refused_next(tmp_path):
    def said(robot: Commissioning | None, sources: dict[str, TorqueSource] = BARE, **keys: Any) -> str:
        with pytest.raises(UserError) as error:
            check_experiment(config(tmp_path, {"limits": {"torque_nm": 5}, **keys}, **BARE_RIG), sources, robot)
        return str(error.value).partition("torque_source: ")[2]

    bare = "`right` is a fingertip without a calibration, which has no torque: "
    noisy = "is known to 5 N·m only, and the smallest limit is 5 N·m"
    default = "; the file names no `torque_source`, and right is the default"
    assert said(commissioned()) == f"{bare}add `calibration`; no other can drive, because the wrench {noisy}{default}"
    named = {"torque_source": "right"}
    assert said(None, **named) == f"{bare}choose another, or add `calibration`; there is only wrench"
    cell = {**BARE, **LOAD}
    assert said(commissioned(), cell, **named) == f"{bare}choose another, or add `calibration`; there is only load_cell"
    wrench = {"torque_source": "wrench"}
    passed = f"`wrench` {noisy}, which its noise alone may pass: "
    assert said(commissioned(), **wrench) == f"{passed}calibrate a fingertip, or add a load cell"
    assert said(commissioned(), cell, **wrench).endswith("or add a load cell; there is only load_cell")
