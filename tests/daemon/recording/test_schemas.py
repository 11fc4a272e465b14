"""A recording's schemas: valid, true of every message, and within what Foxglove takes of JSON Schema."""

import dataclasses
import json
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from shearloop.daemon.messaging.messages import TOPICS, EitFrame, Message, wire_map
from shearloop.daemon.recording.schema import INPUT, input_json, message_json, schemas, with_missing_keys
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from tests.daemon.sample_messages import sample

PLAIN = {"boolean", "string", "number", "integer"}


def refused(schema: dict[str, Any], path: str = "") -> list[str]:
    """Return what Foxglove would refuse a topic for, by its packages/mcap-support/src/parseJsonSchema.ts (v1.87)."""
    found = [] if schema.get("type") == "object" and "properties" in schema else [f"{path}: no object with properties"]
    for name, given in schema.get("properties", {}).items():
        inner = given["items"] if given.get("type") == "array" else given
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
def test_every_schema_is_valid_and_within_what_foxglove_takes(name: str) -> None:
    Draft202012Validator.check_schema(schemas()[name])
    assert refused(schemas()[name]) == []


def test_foxglove_would_refuse_what_it_is_said_to() -> None:
    several = {"type": "object", "properties": {"torque_nm": {"type": ["number", "null"]}}}
    assert refused(several) == [".torque_nm: ['number', 'null']"]
    assert refused({"type": "object", "properties": {"tasks": {"type": "object"}}}) == [
        ".tasks: no object with properties"
    ]


@pytest.mark.parametrize("topic", TOPICS)
def test_every_message_is_what_its_schema_says_with_and_without_values(topic: str) -> None:
    full = sample(TOPICS[topic])
    # A frame's age makes its time of arrival: there is always one.
    for message in (full,) if topic == EitFrame.topic else (full, without_values(full)):
        on_wire = wire_map(message, 1.5, 3)
        written = json.loads(message_json(topic, on_wire, 0))
        Draft202012Validator(schemas()[topic]).validate(written)
        assert None not in written.values()
        restored = with_missing_keys(topic, written)
        for item in dataclasses.fields(message):
            value = getattr(message, item.name)
            if isinstance(value, tuple):
                assert restored[item.name] == list(value), item.name
            elif not isinstance(value, np.ndarray):
                missing = value is None or value != value  # noqa: PLR0124 - NaN alone is unlike itself
                assert restored[item.name] == (None if missing else value), item.name


def test_raw_inputs_are_what_their_schema_says() -> None:
    written = json.loads(input_json(RawEvent(InputKind.DATA, 7, bytes(range(256)))))
    Draft202012Validator(schemas()[INPUT]).validate(written)


@pytest.mark.parametrize("lost", [[], [float("nan")], [float("inf"), float("-inf")]])
def test_few_numbers_are_written_as_they_are_among_many(lost: list[float]) -> None:
    random = np.random.default_rng(0)
    many = np.concatenate([random.normal(size=57), random.normal(size=4) * 1e6, [1e30], lost]).astype("<f4")
    message = {"t_mono_ns": 0, "source": "right"}
    written = json.loads(message_json("robot.state", {**message, "q": many.tobytes()}, 0))["q"]
    assert any(one is None for one in written) == bool(lost)
    for start in range(0, len(many), 6):
        few = json.loads(message_json("robot.state", {**message, "q": many[start : start + 6].tobytes()}, 0))["q"]
        assert few == written[start : start + 6]
