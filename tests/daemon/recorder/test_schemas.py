"""A recording's schemas: valid, true of every message, and within what Foxglove takes of JSON Schema."""

import dataclasses
import json
import math
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from numpy.typing import NDArray
from typing_extensions import TypeAliasType

import shearloop
from shearloop.daemon.messaging import messages
from shearloop.daemon.messaging.messages import TOPICS, EitFrame, Message, column, wire_map
from shearloop.daemon.recorder.schema import (
    INPUT,
    as_json,
    input_event,
    input_json,
    json_type,
    message_json,
    recorded_topic,
    replayed_files,
    schema_name,
    schemas,
)
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.tools.recordings.message_content import read_content
from tests.sample_messages import sample

PLAIN = {"boolean", "string", "number", "integer"}


def refused(schema: dict[str, Any], path: str = "") -> list[str]:
    """Return what Foxglove would refuse a topic for, by its packages/mcap-support/src/parseJsonSchema.ts (v1.87)."""
    found = [] if schema.get("type") == "object" and "properties" in schema else [f"{path}: no object with properties"]
    for name, declared in schema.get("properties", {}).items():
        inner = declared["items"] if declared.get("type") == "array" else declared
        kind = inner.get("type")
        if kind == "object":
            found += refused(inner, f"{path}.{name}")
        # A list of types is none of them.
        elif not isinstance(kind, str) or kind not in PLAIN:
            found.append(f"{path}.{name}: {kind}")
    return found


def without_values(message: Message) -> Message:
    """Return a message in which everything that may be nil is, and every number is none."""
    hints = get_type_hints(type(message))
    nothing: dict[str, Any] = {}
    for item in dataclasses.fields(message):
        if type(None) in get_args(hints[item.name]):
            nothing[item.name] = None
        elif hints[item.name] is float:
            nothing[item.name] = float("nan")
    return dataclasses.replace(message, **nothing)


@pytest.mark.parametrize("name", schemas())
def test_each_schema_is_valid_for_foxglove(name):
    Draft202012Validator.check_schema(schemas()[name])
    assert refused(schemas()[name]) == []


@pytest.mark.parametrize("topic", TOPICS)
def test_each_message_matches_its_schema(topic):
    full = sample(TOPICS[topic])
    # A frame's age makes its time of arrival: there is always one.
    for message in (full,) if topic == EitFrame.topic else (full, without_values(full)):
        on_wire = wire_map(message, 1.5, 3)
        written = json.loads(message_json(topic, on_wire, 0))
        Draft202012Validator(schemas()[topic]).validate(written)
        assert None not in written.values()
        restored = read_content(recorded_topic(topic, message.source), as_json(written))
        for item in dataclasses.fields(message):
            value = getattr(message, item.name)
            if isinstance(value, tuple):
                assert restored[item.name] == list(value), item.name
            elif not isinstance(value, np.ndarray):
                missing = value is None or value != value  # noqa: PLR0124 - NaN alone is unlike itself
                assert restored[item.name] == (None if missing else value), item.name


def test_a_new_topic_of_each_fingertip_is_recorded_for_each_of_them(monkeypatch):
    # So that the topic goes away with this test.
    monkeypatch.setitem(TOPICS, "eit.temperature", EitFrame)

    @messages.message("eit.temperature", rate_hz=1.0, per_source=True)
    class EitTemperature(Message):
        """The temperature of a fingertip."""

        temperature_c: float = column("°C", "temperature of the gel")

    right, left = (recorded_topic(EitTemperature.topic, side) for side in ("right", "left"))
    assert (right, left) == ("eit.temperature.right", "eit.temperature.left")
    assert schema_name(right) == schema_name(left) == "eit.temperature"


def test_each_message_of_a_fingertip_has_a_recorded_topic_for_each_source():
    assert [topic for topic, kind in TOPICS.items() if topic.startswith("eit.") and not kind.per_source] == []


def test_the_code_s_hash_covers_every_module_that_a_replay_loads():
    code = (
        "import sys, shearloop.cli.replay, shearloop.tools.recordings.replay; "
        "print(*(one.__file__ for name, one in sys.modules.items() if name.startswith('shearloop')), sep='\\n')"
    )
    printed = subprocess.check_output([sys.executable, "-c", code], text=True)
    loaded = {Path(line) for line in printed.splitlines()}
    root = Path(shearloop.__file__).parent
    # The command line only parses and prints.
    computing = {path for path in loaded if path.parent != root / "cli"}
    assert root / "words.py" in computing
    assert computing - set(replayed_files(root)) == set()


def test_raw_input_matches_its_schema_and_round_trips():
    event = RawEvent(InputKind.DATA, 123456789012345678, bytes(range(256)))
    written = json.loads(input_json(event))
    Draft202012Validator(schemas()[INPUT]).validate(written)
    assert input_event(written) == event


def test_array_elements_are_rounded_to_a_millionth_and_null_if_not_finite():
    values = np.array([0.1234567, -1e6, 1e30, np.nan, np.inf, -np.inf], "<f4")
    message = {"t_mono_ns": 0, "source": "right", "wrench": values.tobytes(), "wrench_shape": [6]}
    written = json.loads(message_json("robot.state", message, 0))["wrench"]
    assert written == [0.123457, -1e6, float(np.float32(1e30)), None, None, None]


def test_an_alias_of_an_array_type_is_an_array():
    """NumPy 2.5 on Python 3.12 makes NDArray a TypeAliasType, whose origin is the alias itself."""
    element = TypeVar("element", bound=np.generic)
    alias = TypeAliasType("alias", np.ndarray[Any, np.dtype[element]], type_params=(element,))
    array = {"type": "array", "items": {"type": "number"}}
    assert json_type(alias[np.float64]) == json_type(NDArray[np.float64]) == json_type(tuple[float, ...]) == array
    assert json_type(float | None) == {"type": "number"}
    assert json_type(Mapping[str, int]) == {"type": "object", "properties": {}}


def test_each_bit_of_a_number_is_kept_and_what_is_not_finite_is_null():
    # A replay must be equal.
    numbers = [-0.0, 5e-324, 0.1 + 0.2, 1e22, -(2**63)]
    assert repr(json.loads(as_json({"kept": numbers}))["kept"]) == repr(numbers)
    assert as_json({"lost": [math.nan, math.inf]}) == b'{"lost":[null,null]}'


def test_other_mappings_are_written_like_a_dict():
    assert as_json(MappingProxyType({"tasks": MappingProxyType({"loop": (1, math.nan)})})) == (
        b'{"tasks":{"loop":[1,null]}}'
    )
