"""Configuration files: every mistake is reported, at once, by file, key and allowed range."""

from contextlib import suppress
from itertools import pairwise
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, ValidationError, model_validator

from shearloop.daemon.config_file import ConfigModel, load_yaml_model
from shearloop.daemon.control.experiment_schema import ExperimentFile
from shearloop.daemon.errors import UserError


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


def refused(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as error:
        load_yaml_model(path, Outer)
    sentence = str(error.value)
    assert sentence.startswith(f"{path}: ")
    assert "\n" not in sentence
    return sentence


def test_a_good_file_becomes_a_model_that_does_not_change(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text("torque_limit_nm: 1\nsteps: [{hold_s: 2.5}]\nspare: {hold_s: 1}\n")
    found = load_yaml_model(path, Outer)
    assert found == Outer(torque_limit_nm=1.0, steps=(Inner(hold_s=2.5),), spare=Inner(hold_s=1))
    with pytest.raises(ValidationError, match="frozen"):
        found.torque_limit_nm = 2.0


def test_all_mistakes_are_reported_together_with_key_and_range(tmp_path):
    sentence = refused(
        tmp_path,
        "torque_limit_nm: 9\nmode: quick\nsteps: [{hold_s: 1}, {hold_s: -1}, {}]\nspare: {hold_s: x}\ntorqe_limit: 1\n",
    )
    for part in (
        "`torque_limit_nm` should be less than or equal to 2 (found 9, allowed: from 0.05 to 2)",
        "`mode` should be 'slow' or 'fast' (found 'quick', allowed: slow, fast)",
        "`steps[1].hold_s` should be greater than 0 (found -1, allowed: above 0 to 60)",
        "`steps[2].hold_s` is missing (allowed: above 0 to 60)",
        "`spare.hold_s` should be a valid number, unable to parse string as a number (found 'x', allowed: above 0",
        "`torqe_limit` is not a known key, did you mean `torque_limit_nm`?",
    ):
        assert part in sentence


# Each list holds nine of the one before it: 3 GB, if all were written out.
ALIAS_BOMB = "a: &a [x]\n" + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefghij"))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "the configuration is empty"),
        ("# nothing\n", "the configuration is empty"),
        ("- 1\n- 2\n", "expected keys and values such as `torque_limit_nm: …`, found [1, 2]"),
        ("torque_limit_nm: 1\nmode: [slow\n", "line 3, column 1: "),
        ("torque_limit_nm: 1\n\tmode: slow\n", "line 2, column 1: found character '\\t'"),
        (
            "torque_limit_nm: 1\nmode: slow\ntorque_limit_nm: 2\n",
            "line 3, column 1: the key `torque_limit_nm` is given",
        ),
        ("spare: {hold_s: 1, hold_s: 2}\n", "line 1, column 20: the key `hold_s` is given twice"),
        ("mode: !!python/object/apply:os.system [ls]\n", "line 1, column 7: the type tag tag:yaml.org,2002:python/"),
        ("torque_limit_nm: !!int 1:1\n", "line 1, column 18: the type tag tag:yaml.org,2002:int is not supported"),
        ("torque_limit_nm: 2024-13-45\n", "should be a valid number, unable to parse string as a number"),
        (f"torque_limit_nm: {'9' * 100_000}\n", "should be"),
        (f"torque_limit_nm: {':'.join(['59'] * 40_000)}\n", "should be a valid number"),
        ("mode: &a [*a]\n", "line 1, column 11: an alias stands within its anchor"),
        (ALIAS_BOMB, "column 4: more than 20000 values, with every alias written out"),
        ("#" * 131_073, "is larger than 128 kB"),
        ("? [1, 2]\n: 3\n", "line 1, column 3: found unhashable key"),
        ("mode: *other\n", "line 1, column 7: found undefined alias 'other'"),
        ("mode: \x00\n", "not a YAML file: unacceptable character"),
        ("[" * 500, "nested too deeply"),
        ("torque_limit_nm: .nan\n", "should be a finite number (found nan, allowed: from 0.05 to 2)"),
        ("torque_limit_nm: 1\nwhat: 1\n", "`what` is not a known key, known are torque_limit_nm, mode, steps, spare"),
        ("torque_limit_nm: 1\nspare: {hold: 1}\n", "`spare.hold` is not a known key, did you mean `hold_s`?"),
        ("torque_limit_nm: 1\nsteps: 3\n", "`steps` should be a valid tuple (found 3)"),
        ("1: 2\n", "the key 1 is a number; a name is expected"),
        ("torque_limit_nm: 1\nlow: 3\n", ": low must be below high, but low is 3 and high is 1"),
    ],
)
def test_every_kind_of_mistake_is_one_sentence_with_the_files_name(tmp_path, text, part):
    assert part in refused(tmp_path, text)


def test_files_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(UserError, match=r"none\.yaml: the configuration cannot be read: No such file"):
        load_yaml_model(tmp_path / "none.yaml", Outer)
    with pytest.raises(UserError, match="cannot be read: Is a directory"):
        load_yaml_model(tmp_path, Outer)
    (tmp_path / "latin.yaml").write_bytes(b"mode: sl\xf6w\n")
    with pytest.raises(UserError, match=r"latin\.yaml: the configuration is not UTF-8 text \(byte 8\)"):
        load_yaml_model(tmp_path / "latin.yaml", Outer)


@given(content=st.binary(max_size=60))
def test_no_content_whatever_does_anything_but_load_or_be_refused(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(b"torque_limit_nm: 1\n" + content)
    with suppress(UserError):
        assert isinstance(load_yaml_model(path, Outer), Outer)


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("{do: gripp}", "`steps[0]` has the do 'gripp', which does not exist, did you mean 'grip'? (allowed: approach"),
        ("{do: 7}", "`steps[0]` has the do '7', which does not exist (allowed: approach, "),
        ("{width_mm: 5}", "`steps[0]` lacks `do`, its kind"),
    ],
)
def test_a_step_of_no_kind_is_told_in_a_sentence(step, said, tmp_path):
    path = tmp_path / "steps.yaml"
    path.write_text(f"{{name: one, steps: [{step}]}}")
    with pytest.raises(UserError) as caught:
        load_yaml_model(path, ExperimentFile)
    assert said in str(caught.value)
