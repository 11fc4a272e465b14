"""Configuration files: every mistake is reported, at once, by file, key and allowed range."""

import importlib
import os
import re
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import MCAP0_MAGIC
from pydantic import BaseModel, Field, ValidationError, create_model, model_validator

from shearloop.bank.bank_file import BANK_MAGIC
from shearloop.binary_files import FIRST_BYTES
from shearloop.cli.config_schema import MODELS, schema_of
from shearloop.daemon.config import DaemonConfig, load_daemon_config
from shearloop.daemon.config_file import NAMED_FILES, ConfigModel, load_yaml_model
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.settings import UrSettings, read_settings
from shearloop.errors import UserError
from shearloop.estimation.archive import ARCHIVE_MAGIC
from shearloop.yaml_files import load_model, read_yaml
from tests.fixtures.robots import filled_in

CONFIG = Path(__file__).parents[2] / "config"


class Inner(ConfigModel):
    hold_s: Annotated[float, Field(gt=0, le=60)]


class Outer(ConfigModel):
    torque_limit_nm: Annotated[float, Field(ge=0.05, le=2)]
    mode: Literal["slow", "fast"] = "slow"
    steps: tuple[Inner, ...] = ()
    spare: Inner | None = None
    low: int = 0
    high: int = 1

    @model_validator(mode="after")
    def _ascends(self):
        if self.low >= self.high:
            raise ValueError(f"low must be below high, but low is {self.low} and high is {self.high}")
        return self


def refused(tmp_path, text, model=Outer):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        load_yaml_model(path, model)
    sentence = str(error.value)
    assert all(line.startswith(f"{path}:") for line in sentence.splitlines())
    return sentence


def test_a_good_file_becomes_a_model_that_does_not_change(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text("torque_limit_nm: 1\nsteps: [{hold_s: 2.5}]\nspare: {hold_s: 1}\n")
    found = load_yaml_model(path, Outer)
    assert found == Outer(torque_limit_nm=1.0, steps=(Inner(hold_s=2.5),), spare=Inner(hold_s=1))
    with pytest.raises(ValidationError, match="frozen"):
        found.torque_limit_nm = 2.0


def path_keys(model, found):
    """Add every key of a model, and of those below it, whose type has a path in it: model and name."""
    for name, field in getattr(model, "model_fields", {}).items():
        for kind in parts_of(field.annotation):
            if kind is Path:
                found.add((model, name))
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                path_keys(kind, found)
    return found


def parts_of(kind):
    yield kind
    for part in get_args(kind):
        yield from parts_of(part)


def count_paths(schema):
    if isinstance(schema, list):
        return sum(map(count_paths, schema))
    if not isinstance(schema, dict):
        return 0
    return (schema.get("format") == "path") + sum(map(count_paths, schema.values()))


@pytest.mark.parametrize("kind", MODELS)
def test_every_path_in_a_file_is_expanded(tmp_path, monkeypatch, kind):
    monkeypatch.setenv("HOME", "/home/person")
    monkeypatch.setenv("DATA", "/data")
    module, name = MODELS[kind]
    keys = path_keys(getattr(importlib.import_module(module), name), set())
    # No path hides in another kind of class.
    assert len(keys) == count_paths(schema_of(kind))
    written = {
        "~/a": "/home/person/a",
        "$HOME/a": "/home/person/a",
        "${DATA}/a": "/data/a",
        "a~/b$1": tmp_path / "a~/b$1",
    }
    for model, key in keys:
        field = model.model_fields[key]
        assert issubclass(model, ConfigModel)
        # The key alone, with the checks that every model inherits.
        one = create_model("One", __base__=ConfigModel, **{key: (field.annotation, ...)})
        for text, expected in written.items():
            many = tuple in map(get_origin, parts_of(field.annotation))
            value = getattr(one.model_validate({key: [text] if many else text}, context={"folder": tmp_path}), key)
            assert value == ((Path(expected),) if many else Path(expected)), (model, key)


def test_a_path_that_cannot_be_expanded_is_refused(tmp_path, monkeypatch):
    monkeypatch.delenv("NOWHERE", raising=False)
    text = "fingertips: {right: {device: {serial_number: '1'}}}\nrecording: {folder: $NOWHERE/a}\n"
    said = refused(tmp_path, text, DaemonConfig)
    assert "a.yaml:2: recording.folder: has the variable $NOWHERE, which is not set here" in said
    said = refused(tmp_path, text.replace("$NOWHERE", "~no-such-user"), DaemonConfig)
    assert "recording.folder: begins with ~no-such-user, the home of an unknown user" in said


def test_the_daemon_gets_expanded_paths_and_addresses(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", "/home/person")
    path = tmp_path / "rig.yaml"
    path.write_text(
        "load_cell: {device: {path: ~/port}}\nexperiments: [~/experiments, .]\npublish: ipc://$HOME/run/p\n"
        "recording: {folder: ~/recordings}\n"
    )
    config = load_yaml_model(path, DaemonConfig)
    assert config.load_cell.device.path == Path("/home/person/port")
    assert config.experiments == (Path("/home/person/experiments"), tmp_path)
    assert config.recording.folder == Path("/home/person/recordings")
    assert config.publish == "ipc:///home/person/run/p"


def test_all_mistakes_are_reported_together_with_key_and_range(tmp_path):
    sentence = refused(
        tmp_path,
        "torque_limit_nm: 9\nmode: quick\nsteps: [{hold_s: 1}, {hold_s: -1}, {}]\nspare: {hold_s: x}\ntorqe_limit: 1\n",
    )
    for part in (
        "1: torque_limit_nm: 9 is too large; allowed: from 0.05 to 2",
        "2: mode: 'quick' does not exist; allowed: slow, fast",
        "3: steps[1].hold_s: -1 is too small; allowed: above 0 to 60",
        "3: steps[2].hold_s: is missing; allowed: above 0 to 60",
        "4: spare.hold_s: 'x' is not a number; allowed: above 0 to 60",
        "5: torqe_limit: is not a known key; did you mean torque_limit_nm?",
    ):
        assert f"a.yaml:{part}" in sentence.splitlines()[int(part[0]) - 1 + (part[0] > "3" or "[2]" in part)]


def test_a_value_in_another_unit_is_recognised_and_a_schema_mistake_hides_no_other(tmp_path):
    text = """\
name: one
drive: rigth
steps:
  - {do: grip, width_mm: 0.005}
  - {do: approach, along_tool_m: 30}
  - {do: twist, angles_rad: 90}
  - {do: twist, angles_rad: [0.1, 90], speed: 1}
"""
    lines = refused(tmp_path, text, ExperimentFile).splitlines()
    found = [line.removeprefix(f"{tmp_path}/a.yaml:").partition("; allowed")[::2] for line in lines]
    assert [begin for begin, _ in found] == [
        "2: drive: is not a known key",
        "4: steps[0].width_mm: 0.005 is too small for mm; did you mean 5, the thousandfold?",
        "5: steps[1].along_tool_m: 30 is too large",
        "6: steps[2].angles_rad: 90 is too large",
        "7: steps[3].angles_rad[1]: 90 is too large",
        "7: steps[3].speed: is not a known key; did you mean speed_rad_per_s?",
    ]
    assert found[2][1].endswith("did you mean 0.03, 30 mm in m?")
    assert found[3][1].endswith("did you mean 1.571, 90 degrees in rad?")


def test_a_file_of_another_kind_is_recognised(tmp_path):
    sentence = "1: this is an experiment; name it in a configuration"
    assert sentence in refused(tmp_path, "name: one\nsteps: [{do: tare}]\n", DaemonConfig)
    sentence = "1: this is a configuration; start it with `shearloop run FILE`"
    assert sentence in refused(tmp_path, "fingertips: {}\n", ExperimentFile)
    for kind in NAMED_FILES:
        for model in (DaemonConfig, ExperimentFile):
            # One mistake, and none of the keys that the other kind lacks.
            said = refused(tmp_path, f"name: one\n{kind.keys[0]}: 1\nlimits: {{force_n: 1}}\n", model)
            assert said.endswith(f"a.yaml:1: this is {kind.what}; {kind.cure}")
            assert len(said.splitlines()) == 1
    with pytest.raises(UserError, match=r"b\.yaml: the experiment cannot be read: No such file"):
        load_yaml_model(tmp_path / "b.yaml", ExperimentFile)


# Each list holds nine of the one before it: 3 GB, if all were written out.
ALIAS_BOMB = "a: &a [x]\n" + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefghij"))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "the configuration is empty"),
        ("# nothing\n", "the configuration is empty"),
        ("torque_limit_nm: 1\nmode\nlow: 2\n", ":2:5: a `:` is missing behind the key"),
        ("- 1\n- 2\n", "expected keys and values such as `torque_limit_nm: …`"),
        ("torque_limit_nm: 1\nmode: [slow\n", ":3:1: a list is not closed"),
        ("torque_limit_nm: 1\n\tmode: slow\n", ":2:1: a tab indents this line; use spaces"),
        ("torque_limit_nm: 1\nmode: slow\ntorque_limit_nm: 2\n", ":3:1: the key `torque_limit_nm` is given"),
        ("spare: {hold_s: 1, hold_s: 2}\n", ":1:20: the key `hold_s` is given twice"),
        ("mode: !!python/object/apply:os.system [ls]\n", ":1:7: the type tag tag:yaml.org,2002:python/"),
        ("torque_limit_nm: !!int 1:1\n", ":1:18: the type tag tag:yaml.org,2002:int is not supported"),
        ("torque_limit_nm: 2024-13-45\n", "torque_limit_nm: '2024-13-45' is not a number"),
        (f"torque_limit_nm: {'9' * 100_000}\n", "is not a finite number"),
        (f"torque_limit_nm: {':'.join(['59'] * 40_000)}\n", "is not a number"),
        ("mode: &a [*a]\n", ":1:11: an alias stands within its anchor"),
        (ALIAS_BOMB, ":4: more than 20000 values, with every alias written out"),
        ("#" * 131_073, "is larger than 128 kB"),
        ("? [1, 2]\n: 3\n", ":1:3: a key is a list or a section"),
        ("spare: {<<: {hold_s: 1}}\n", ":1:9: the keys `<<` and `=` are not supported"),
        ("low: 1\n---\nlow: 2\n", ":2:1: a second document begins here"),
        ("mode: *other\n", ":1:7: an alias `*name` without its anchor"),
        ("mode: \x00\n", ":1:7: U+0000 is no character of a text; take it out"),
        ("[" * 500, "nested too deeply"),
        ("torque_limit_nm: .nan\n", "nan is not a finite number; allowed: from 0.05 to 2"),
        ("torque_limit_nm: 1\nwhat: 1\n", "2: what: is not a known key; allowed: torque_limit_nm, mode, steps, spare"),
        ("torque_limit_nm: 1\nspare: {hold: 1}\n", "spare.hold: is not a known key; did you mean hold_s?"),
        ("torque_limit_nm: 1\nsteps: 3\n", "steps: 3 is not a list"),
        ("1: 2\n", "the key 1 is a number; a name is expected"),
        ("spare: {hold_s: 0,1}\n", "spare: the key 1 is a number; a name is expected; the decimal sign is a point"),
        ("spare: {hold_s: 0,08}\n", "spare: the key 08 is a number; a name is expected; the decimal sign is a point"),
        ("torque_limit_nm: 0,1\n", "'0,1' is not a number; the decimal sign is a point: 0.1, not 0,1; allowed"),
        ("".join(f"key{number}: 1\n" for number in range(8000)), ": 7901 more mistakes"),
        ("torque_limit_nm: 1\nlow: 3\n", ": low must be below high, but low is 3 and high is 1"),
    ],
)
def test_every_kind_of_mistake_is_one_sentence_with_the_files_name(tmp_path, text, part):
    assert part in refused(tmp_path, text)


def test_a_file_without_keys_is_refused_without_its_content(tmp_path):
    assert "pass" not in refused(tmp_path, "host:5432:lab:ada:pass\n")


@pytest.mark.parametrize(("given", "meant"), [("", "lab.yaml"), ("lab.yml", "lab.yaml"), ("ur.yam", "ur.yaml")])
def test_a_file_that_was_probably_meant_is_named(given, meant, tmp_path):
    for name in ("lab.yaml", "ur.yaml", "lab.cal"):
        (tmp_path / name).touch()
    with pytest.raises(UserError, match=rf"; did you mean {tmp_path / meant}\?$"):
        load_yaml_model(tmp_path / given, Outer)


def test_a_file_of_another_kind_is_not_named(tmp_path):
    (tmp_path / "mine.yaml").write_text("publish: tcp://127.0.0.1:1\nrobot: ur.yaml\n")
    with pytest.raises(DriverError) as failed:
        read_settings(tmp_path / "nothere.yaml")
    assert "did you mean" not in str(failed.value)
    (tmp_path / "nowhere.yaml").write_text("host: 192.0.2.1\n")
    with pytest.raises(DriverError, match=r"did you mean .*/nowhere\.yaml\?$"):
        read_settings(tmp_path / "nothere.yaml")
    with pytest.raises(UserError, match=r"did you mean .*/mine\.yaml\?$"):
        load_daemon_config(tmp_path / "nine.yaml")


def test_the_configuration_of_a_folder_is_named_by_its_usual_name(tmp_path):
    for name in ("emulated.yaml", "rig.yaml"):
        (tmp_path / name).touch()
    with pytest.raises(UserError, match=r"did you mean .*rig\.yaml\?$"):
        load_yaml_model(tmp_path, Outer)


def test_files_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(UserError, match=r"none\.yaml: the configuration cannot be read: No such file"):
        load_yaml_model(tmp_path / "none.yaml", Outer)
    with pytest.raises(UserError, match="cannot be read: it is a folder; name a file in it"):
        load_yaml_model(tmp_path, Outer)
    with pytest.raises(UserError, match="null: the configuration cannot be read: it is a device or a pipe"):
        load_yaml_model(Path("/dev/null"), Outer)
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(UserError, match="cannot be read: it is a device or a pipe"):
        load_yaml_model(tmp_path / "pipe.yaml", Outer)
    # Read without a bound, it waits for the kernel's next message.
    for endless in ("/proc/kmsg", "/proc/self/status"):
        with pytest.raises(UserError, match=r"the configuration (is empty|cannot be read)"):
            load_yaml_model(Path(endless), Outer)
    for first, what in FIRST_BYTES.items():
        (tmp_path / "binary").write_bytes(first + b"\0\xff\xfe")
        with pytest.raises(UserError, match=re.escape(f"the configuration has to be YAML, and this file is {what}")):
            load_yaml_model(tmp_path / "binary", Outer)
    assert {ARCHIVE_MAGIC, BANK_MAGIC, MCAP0_MAGIC[:5]} < FIRST_BYTES.keys()
    (tmp_path / "latin.yaml").write_bytes(b"mode: sl\xf6w\n")
    with pytest.raises(UserError, match=r"latin\.yaml:1:9: the byte 0xf6 is not UTF-8 text, and would be ö in"):
        load_yaml_model(tmp_path / "latin.yaml", Outer)


@given(content=st.binary(max_size=60))
def test_no_content_whatever_does_anything_but_load_or_be_refused(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(b"torque_limit_nm: 1\n" + content)
    with suppress(UserError):
        assert isinstance(load_yaml_model(path, Outer), Outer)


SHIPPED = [
    ("configuration", "rig.yaml"),
    ("configuration", "skin_demo.yaml"),
    ("robot", "ur.yaml"),
    ("experiment", "experiments/torque_sweep.yaml"),
    ("bank", "banks/paper.yaml"),
    ("fingertip", "fingertips/round.yaml"),
]
OTHERS = [None, True, -1, 1e9, float("nan"), "x", "", [], {}, [1], {"x": 1}, {1: "x"}, 10**23]


def places(content: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the path to each value of a document, its sections and lists included."""
    inside = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [path, *(place for key, value in inside for place in places(value, (*path, key)))]


def changed(content: Any, path: tuple[Any, ...], how: int) -> Any:
    """Return a document with the value at a path removed, shortened, lengthened, or replaced by another one."""
    if path:
        copy = content.copy()
        if len(path) == 1 and how == len(OTHERS):
            del copy[path[0]]
        else:
            copy[path[0]] = changed(content[path[0]], path[1:], how)
        return copy
    if isinstance(content, list):
        return (content[:-1], [*content, *content[-1:]], *OTHERS)[how % (len(OTHERS) + 2)]
    return OTHERS[how % len(OTHERS)]


@pytest.mark.parametrize(("kind", "name"), SHIPPED)
@given(drawn=st.data())
@settings(max_examples=25, deadline=None)
def test_a_shipped_file_with_any_value_changed_loads_or_is_refused_in_sentences(kind, name, drawn, tmp_path_factory):
    content = yaml.safe_load((CONFIG / name).read_text())
    place = drawn.draw(st.sampled_from(places(content)))
    path = tmp_path_factory.getbasetemp() / f"changed_{kind}.yaml"
    path.write_text(yaml.safe_dump(changed(content, place, drawn.draw(st.integers(0, len(OTHERS) + 1)))))
    module, model = MODELS[kind]
    with suppress(UserError):
        load_model(path, getattr(importlib.import_module(module), model), UserError)


def test_each_list_of_the_robots_file_may_lack_an_entry(tmp_path):
    content = filled_in()
    path = tmp_path / "ur.yaml"
    lists = [place for place in places(content) if place and place[-1] in ("lower_rad", "upper_rad", "lower_m")]
    assert len(lists) == 3
    for place in lists:
        path.write_text(yaml.safe_dump(changed(content, place, 0)))
        with pytest.raises(UserError, match=rf"{place[-1]}.*: is missing"):
            load_model(path, UrSettings, UserError)


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("{do: gripp}", "1: steps[0].do: 'gripp' does not exist; allowed: approach"),
        ("{do: 7}", "1: steps[0].do: '7' does not exist; allowed: approach, "),
        ("{width_mm: 5}", "1: steps[0].do: is missing"),
    ],
)
def test_a_step_of_an_unknown_kind_is_refused_in_one_sentence(step, said, tmp_path):
    assert said in refused(tmp_path, f"{{name: one, steps: [{step}]}}", ExperimentFile)


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "x/" * 5000])
def test_a_name_that_no_file_has_is_refused_in_short(name):
    with pytest.raises(UserError, match="no experiment has such a name") as refused:
        read_yaml(Path(name), UserError, "experiment")
    assert len(str(refused.value)) < 100


def test_a_wrong_length_names_the_limit(tmp_path):
    steps = "steps: [{do: tare}]\n"
    assert "is too long; allowed: up to 80 characters" in refused(
        tmp_path, f"name: {200 * 'ä'}\n{steps}", ExperimentFile
    )
    assert "is too long; allowed: up to 60 characters" in refused(tmp_path, f"name: {200 * 'ä'}\n", DaemonConfig)
    few = refused(tmp_path, "name: one\nsteps: []\n", ExperimentFile)
    assert "steps: [] has too few entries; allowed: 1 entry or more" in few


def test_an_empty_value_counts_as_none_of_two_keys(tmp_path):
    said = refused(tmp_path, "load_cell: {device: {serial_number: }}\n", DaemonConfig)
    assert "load_cell.device: give either serial_number or path, with a value, and not both" in said


@pytest.mark.parametrize(
    ("written", "line", "named"),
    [
        (
            "name: rig\nemulated: true\nload_cell:\n  device: {path: /dev/ttyACM0}\n",
            2,
            "`emulated: true` and `load_cell",
        ),
        (
            "load_cell: {device: {path: a}}\npublish: tcp://0.0.0.0:7761\n",
            2,
            "`publish: tcp://0.0.0.0:7761` would open",
        ),
        ("load_cell: {device: {path: a}}\nautostart: true\n", 2, "`autostart` moves the robot without a command"),
        (
            "fingertips:\n  left: {device: {path: a}}\n  load_cell: {device: {path: b}}\n",
            3,
            "`fingertips.load_cell` has",
        ),
        ("load_cell: {device: {path: a}}\n\nexperiment: a.yaml\n", 3, "an experiment needs a robot"),
        ("name: rig\n", 1, "nothing is measured"),
    ],
)
def test_a_rule_of_several_keys_is_shown_at_the_first_of_them(written, line, named, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(written)
    with pytest.raises(UserError, match=re.escape(f"{path}:{line}: {named}")):
        load_daemon_config(path)
