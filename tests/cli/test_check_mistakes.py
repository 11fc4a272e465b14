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

    def said(*arguments: str, rig: str = RIG, robot: str = ROBOT, experiment: str | bytes = EXPERIMENT) -> str:
        for name, content in (("rig.yaml", rig), ("ur.yaml", robot), ("e.yaml", experiment)):
            Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
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


def test_the_files_of_an_invalid_rig_are_found_as_the_rig_names_them(said_of, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("BENCH", str(tmp_path))
    rig = replaced(f"{RIG}loop: {{kp: a}}\nexperiment: $BENCH/e.yaml\n", "robot: ur.yaml", "robot: ~/ur.yaml")
    assert said_of("rig.yaml", rig=rig).splitlines()[1:] == []
    wrong = replaced(EXPERIMENT, "wait_s: 3", "wait_s: x")
    assert f"{tmp_path}/e.yaml:10: steps[4].wait_s: " in said_of("rig.yaml", rig=rig, experiment=wrong)


@pytest.mark.parametrize("robot", ["~nobody-of-this-name/ur.yaml", "$NOT_SET_HERE/ur.yaml", '"a\\0b"', '"."', "5"])
def test_a_path_that_names_no_file_is_one_mistake(robot, said_of):
    said = said_of("rig.yaml", rig=replaced(RIG, "robot: ur.yaml", f"robot: {robot}"))
    assert "rig.yaml:3: robot: " in said
    assert said.splitlines()[1:] == []


NO_BREAK, IDEOGRAPHIC = "\N{NO-BREAK SPACE}", "\N{IDEOGRAPHIC SPACE}"
NO_WIDTH, BYTE_ORDER = "\N{ZERO WIDTH SPACE}", "\N{ZERO WIDTH NO-BREAK SPACE}"


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("name: one", "name one", "1:5: a `:` is missing behind the key"),
        ("torque_source: load_cell", "torque_source load_cell", "2:14: a `:` is missing behind the key"),
        ("- do: wait", "- do wait", "9:7: a `:` is missing behind the key"),
        ("wait_s: 3", "wait_s", "10:11: a `:` is missing behind the key"),
        ("wait_s: 3", "wait_s = 3", "10:11: a `:` is missing; write it instead of `=`"),
        ("name: one", "name:one", "1:5: a space is missing behind the `:`"),
        ("name: one", "name: one: two", "1:10: a second `:` stands in this line"),
        ("- do: wait", "-do: wait", "9:4: a space is missing behind the `-`"),
        ("- do: wait", "  do: wait", "9:5: a `-` is missing before this entry"),
        ("- {do: tare", "  {do: tare", "6:5: a `-` is missing before this entry"),
        ("    wait_s", "   wait_s", "10:4: this line is indented by 3 spaces, and a line above by 4"),
        ("    wait_s", "     wait_s", "10:6: this line is indented by 5 spaces, and a line above by 4"),
        ("    wait_s", "\twait_s", "10:1: a tab indents this line; use spaces"),
        ("name: one", "name:\tone", "1:6: a tab stands in this line; use spaces"),
        ("{do: tare, ", "{do: tare ", "6:14: a `,` is missing"),
        ("{do: tare, ", "{do: tare; ", "6:14: a `,` is missing; write it instead of `;`"),
        ("timeout_s: 30}", "timeout_s: 30", "a section is not closed: `,` or `}` is missing; it begins in line 6"),
        ("timeout_s: 30}", "timeout_s: 30}}", "6:30: a `}` too many"),
        ("name: one", 'name: "one" two', "1:13: something stands behind the value"),
        ("name: one", 'name: "one', "1:7: the quote that opens here is not closed"),
        ("name: one", 'name: "one”', "1:11: U+201D (right double quotation mark) stands here"),
        ("name: one", 'name: "C:\\users"', "a backslash in double quotes has a meaning of its own"),
        ("name: one", "name: %one", "1:7: no value begins with %; put it in quotes"),
        ("name: one", "```yaml\nname: one", "1:1: a fence of Markdown; take this line out"),
        ("name: one", "name: on\0e", "1:9: U+0000 is no character of a text; take it out"),
        ("    wait_s", f"{NO_BREAK}   wait_s", "10:1: U+00A0 (no-break space) stands here; write a space"),
        ("    wait_s", f"{IDEOGRAPHIC}  wait_s", "10:1: U+3000 (ideographic space) stands here; write a space"),
        ("- do: wait", f"-{NO_BREAK}do: wait", "9:4: U+00A0 (no-break space) stands here"),
        ("torque_source:", f"torque_source{NO_BREAK}:", "2:14: U+00A0 (no-break space) stands here"),
        ("torque_source:", f"{BYTE_ORDER}torque_source:", "2:1: U+FEFF (zero width no-break space) stands here; take"),
        (": load_cell", f": load_cell{NO_WIDTH}", "2:25: U+200B (zero width space) stands here; take it out"),
        ("name: one", f"name:{NO_BREAK}one", "1:6: U+00A0 (no-break space) stands here"),
        ("name: one", "name： one", "1:5: U+FF1A (fullwidth colon) stands here; write : instead"),
        ("name: one", "name: „one“", "1:7: U+201E (double low-9 quotation mark) stands here"),
        ("do: twist", "do: ‘twist’", "8:10: U+2018 (left single quotation mark) stands here"),
        ("- do: wait", "– do: wait", "9:3: U+2013 (en dash) stands here; write - instead"),
        ("- do: wait", "• do: wait", "9:3: U+2022 (bullet) stands here; write - instead"),
        ("- do: wait", "* do: wait", "9:3: an entry begins with `- `"),
        ("- do: wait", "-- do: wait", "9:3: an entry begins with `- `"),
        ("- do: wait", "1. do: wait", "9:3: an entry begins with `- `"),
        ("- {do: tare", "- do: tare", "6:5: a `{` is missing"),
        ("name: one", "<<<<<<< HEAD\nname: one", "1:1: a mark of a merge conflict; keep one side"),
        ("hold_s: 5", "hold_s: 5,0,0", "the key `0` is given twice; a `,` begins another key"),
        ("name: one", "name: 'Ada's tool'", "1:12: something stands behind the value; take it out, or put the whole"),
        ("    wait_s: 3", "    timeout_s: 9\n     wait_s: 3", "11:6: this line is indented by 5 spaces, and a"),
        ("hold_s: 5", "hold_s: 5, hold_s: 6", "8:69: the key `hold_s` is given twice"),
    ],
)
def test_a_slip_of_the_pen_is_named_where_it_stands(right, wrong, said, said_of):
    assert said in said_of("e.yaml", experiment=replaced(EXPERIMENT, right, wrong))


@pytest.mark.parametrize("name", ["0.1\N{NO-BREAK SPACE}N·m", "a “slow” sweep", "one – two", "Prüfung 3 µm", "日本"])
def test_a_name_has_the_characters_of_its_language(name, ran, tmp_path):
    path = tmp_path / "e.yaml"
    path.write_text(replaced(EXPERIMENT, "name: one", f"name: {name}"), encoding="utf-8")
    assert f"plan of '{name}'".replace(NO_BREAK, "\\xa0") in ran("check", path).out


def test_a_path_with_typographic_quotes_or_an_invisible_end_is_refused(said_of):
    for port in ("“load”", f"load{NO_WIDTH}"):
        said = said_of("rig.yaml", rig=replaced(RIG, "path: load", f"path: {port}"))
        assert "rig.yaml:2:" in said
        assert "U+20" in said


@pytest.mark.parametrize(
    ("encoding", "said"),
    [
        ("utf-16", "e.yaml: the file is text in UTF-16, and not in UTF-8; save the file with the encoding UTF-8"),
        ("utf-16-le", "e.yaml: the file is text in UTF-16"),
        ("utf-16-be", "e.yaml: the file is text in UTF-16"),
        ("latin-1", "e.yaml:5:10: the byte 0xb7 is not UTF-8 text, and would be · in Windows-1252; save the file with"),
    ],
)
def test_a_file_in_another_encoding_is_named_with_its_place_and_the_cure(encoding, said, said_of):
    commented = replaced(EXPERIMENT, "steps:\n", "steps:\n  # 0.1 N·m\n")
    assert said in said_of("e.yaml", experiment=commented.encode(encoding))


def test_a_long_file_is_refused_without_many_readings(said_of):
    long = EXPERIMENT + "  - {do: wait, wait_s: 3}\n" * 400 + "  - do wait\n    wait_s: 3\n"
    assert "e.yaml:413:11: this line is indented deeper" in said_of("e.yaml", experiment=long)


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("wait_s: 3", "wait_s: [yes]", "steps[4].wait_s: [yes] is not a number"),
        ("wait_s: 3", "wait_s: {a: no}", "steps[4].wait_s: {a: no} is not a number"),
        ("wait_s: 3", "wait_s:\n      - yes\n      - 3", "steps[4].wait_s: [yes, 3] is not a number"),
        ("wait_s: 3", "wait_s:", "steps[4].wait_s: has no value; allowed"),
        ("wait_s: 3", "wait_s: 3 s", "steps[4].wait_s: '3 s' is not a number; allowed: from 0 to 86400; write the "
         "number alone, in s"),
        ("[0.2]", "[20°]", "write the number alone, in rad"),
        ("[0.2]", "[−0.2]", "is not a number; allowed: from -6.2832 to 6.2832; at the beginning, U+2212 (minus sign)"),
        ("torque_source", "torque\N{NO-BREAK SPACE}source", "did you mean torque_source?; behind 'torque', U+00A0"),
        ("do: twist", "do:twist", "8: steps[3].do: is missing; a space is missing in `do:twist`"),
        ("- do: wait", "- wait:", "9: steps[4].do: is missing; write `do: wait`, and its keys beside it"),
        ("{do: tare, timeout_s: 30}", "tare", "steps[1]: 'tare' is not a section with keys; write `do: tare`"),
        (STEPS, "  do: wait\n", "steps: {do: wait} is not a list; each entry of a list begins with `- `"),
        ("limits: {torque_nm: 0.25, angle_rad: 1.5}", "angle_rad: 1.5", "angle_rad: is not a known key; it belongs in "
         "`limits`"),
        ("hold_s: 5", "hold_s: 5, tool_mm: 9", "steps[3].tool_mm: is not a known key; it belongs in no section"),
        ("{do: tare, timeout_s: 30}", "{do: approach, pose_m_rad: [0,4, 0,1, 0,3, 0, 3,14, 0]}", "[0,4, 0,1, 0,3, 0, "
         "3,14, 0] has too many entries; the decimal sign is a point: 0.1, not 0,1"),
        ("[0.2]", "[0,2]", "steps[3]: twist asks for 2 rad, and its limit is 1.5 rad; if these are decimals, the "
         "decimal sign is a point"),
        ("[0.2]", "[2]", "its limit is 1.5 rad; raise limits.angle_rad, or ask for less"),
    ],
)  # fmt: skip
def test_a_value_is_refused_as_it_is_written_and_with_the_cure(right, wrong, said, said_of):
    assert said in said_of("e.yaml", experiment=replaced(EXPERIMENT, right, wrong))


@pytest.mark.parametrize(
    ("angles", "noted"),
    [
        ("[0,2]", True),
        ("[0,2, 0,3]", True),
        ("[0, 1, 2]", False),
        ("[1, 2]", False),
        ("[2]", False),
        ("[0.0, 0.2]", False),
    ],
)
def test_a_large_turn_by_what_may_be_a_decimal_comma_is_pointed_out(angles, noted, ran, tmp_path):
    path = tmp_path / "e.yaml"
    content = replaced(replaced(EXPERIMENT, "angle_rad: 1.5", "angle_rad: 6"), "[0.2]", angles)
    path.write_text(content, encoding="utf-8")
    assert ("the decimal sign is a point" in ran("check", path).out) is noted


@pytest.mark.parametrize(
    ("named", "is_"),
    [
        ("robot: e.yaml", "e.yaml:1: this is an experiment; name another file here"),
        ("robot: rig.yaml", "rig.yaml:1: this is a configuration; name another file here"),
        ("robot: ur.yaml\nexperiment: rig.yaml", "rig.yaml:1: this is a configuration; name another file here"),
        ("robot: ur.yaml\nexperiment: ur.yaml", "ur.yaml:1: this is the robot's settings;"),
    ],
)
def test_a_file_of_another_kind_is_one_mistake(named, is_, said_of):
    said = said_of("rig.yaml", rig=replaced(RIG, "robot: ur.yaml", named))
    assert is_ in said
    assert len(said.splitlines()) == 1
