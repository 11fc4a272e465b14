"""Files written in a hurry: `check` names each mistake of rig, robot and experiment, its line, and the cure."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RIG = """load_cell:
  device: {path: load}
robot: ur.yaml
gripper:
  model: 2F-140
  socket: {host: 127.0.0.1}
emulated: true
"""
EXPERIMENT = """name: one
torque_source: load_cell
limits: {torque_nm: 0.25, angle_rad: 1.5}
steps:
  - {do: release, timeout_s: 15}
  - {do: tare, timeout_s: 30}
  - {do: grip, width_mm: 5, force_n: 60}
  - {do: twist, angles_rad: [0.2], speed_rad_per_s: 0.1, hold_s: 5}
  - do: wait
    wait_s: 3
  - {do: release, timeout_s: 15}
"""
ROBOT = (ROOT / "config" / "ur.yaml").read_text(encoding="utf-8").replace("192.168.1.10", "127.0.0.1")
STEPS = EXPERIMENT.partition("steps:\n")[2]


def replaced(text: str, old: str, new: str) -> str:
    """Return a text with one mistake: a part of it that stands there once is replaced."""
    assert text.count(old) == 1, old
    return text.replace(old, new)


@pytest.fixture
def said_of(tmp_path, ran, monkeypatch):
    """Return what `check` says of three files, any of them with other content; it refuses them."""
    monkeypatch.chdir(tmp_path)

    def said(*arguments: str, rig: str = RIG, robot: str = ROBOT, experiment: str = EXPERIMENT) -> str:
        for name, content in (("rig.yaml", rig), ("ur.yaml", robot), ("e.yaml", experiment)):
            Path(name).write_text(content, encoding="utf-8")
        return ran("check", *(arguments or ("e.yaml", "--config", "rig.yaml")), status=2).err

    return said


@pytest.mark.usefixtures("said_of")
def test_the_files_of_these_tests_are_in_order(ran):
    for name, content in (("rig.yaml", RIG), ("ur.yaml", ROBOT), ("e.yaml", EXPERIMENT)):
        Path(name).write_text(content, encoding="utf-8")
    assert "e.yaml is in order" in ran("check", "e.yaml", "--config", "rig.yaml").out


@pytest.mark.parametrize(
    ("folder", "said"),
    [
        ("missing", "missing does not exist: make this folder"),
        ("mine", "mine does not exist; did you mean {root}/mines?"),
        ("e.yaml", "e.yaml is a file: name its folder"),
    ],
)
def test_a_folder_of_experiments_that_is_none_is_named(folder, said, said_of, tmp_path):
    (tmp_path / "mines").mkdir()
    refusal = said_of("rig.yaml", rig=f"{RIG}experiments: [., {folder}]\n")
    assert f"`experiments`: {tmp_path}/{said.format(root=tmp_path)}" in refusal


@pytest.mark.parametrize("arguments", [("e.yaml",), ("e.yaml", "--config", "rig.yaml")])
@pytest.mark.parametrize(("key", "own", "whole"), [("torque_nm", "0.5 N·m", "0.25 N·m"), ("angle_rad", "2 rad", "1.5")])
def test_a_limit_of_a_step_above_the_experiments_is_refused(arguments, key, own, whole, said_of):
    looser = f"hold_s: 5, limits: {{{key}: {own.split()[0]}}}"
    said = said_of(*arguments, experiment=replaced(EXPERIMENT, "hold_s: 5", looser))
    assert f"e.yaml:8: steps[3].limits.{key}: the limit of twist is {own}, and the experiment's is {whole}" in said


def test_a_limit_of_a_step_that_is_the_experiments_is_in_order(ran, tmp_path):
    path = tmp_path / "e.yaml"
    path.write_text(replaced(EXPERIMENT, "hold_s: 5", "hold_s: 5, limits: {torque_nm: 0.25}"), encoding="utf-8")
    assert "is in order" in ran("check", path).out


@pytest.mark.parametrize(
    ("content", "is_"),
    [
        (STEPS, "a list of steps, and no whole experiment; write `name: …` and `steps:` above it"),
        ("- robot: ur.yaml\n- emulated: true\n", "a list, and no section with keys; take out the `-` before each key"),
        ("a sentence\n", "a text or a number, and no section with keys; write keys and values such as"),
    ],
)
@pytest.mark.parametrize("arguments", [("e.yaml",), ("e.yaml", "--config", "rig.yaml")])
def test_a_file_without_keys_is_called_what_it_is(content, is_, arguments, said_of):
    assert f"e.yaml: this file is {is_}" in said_of(*arguments, experiment=content)


def test_two_files_the_wrong_way_round_are_named(said_of):
    assert "write `shearloop check e.yaml --config rig.yaml`" in said_of("rig.yaml", "--config", "e.yaml")


@pytest.mark.parametrize("arguments", [("rig.yaml",), ("e.yaml", "--config", "rig.yaml")])
def test_mistakes_in_three_files_are_shown_together(arguments, said_of):
    said = said_of(
        *arguments,
        rig=f"{RIG}loop: {{kp: a}}\nexperiment: e.yaml\n",
        robot=replaced(ROBOT, "margin_rad: 0.1", "margin_rad: x"),
        experiment=replaced(EXPERIMENT, "wait_s: 3", "wait_s: x"),
    )
    places = re.findall(r"(\w+\.yaml):\d+: ([\w.\[\]]+): ", said)
    assert places == [("rig.yaml", "loop.kp"), ("ur.yaml", "limits.joints.margin_rad"), ("e.yaml", "steps[4].wait_s")]
