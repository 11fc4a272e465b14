"""What stands in a recording: topics, their JSON schemas, and the metadata that says what it was made with.

A recording is an MCAP file (mcap.dev). Log times are Unix nanoseconds: of a message the time that it speaks of (of a
frame the middle of its acquisition), of a raw input when it arrived. Any MCAP tool can show and plot one; the schemas
describe every key.

The schemas keep to what Foxglove takes of JSON Schema, which refuses a topic for anything more: each key has one type,
every object names its properties. So a value that there is none of is not null; its key is left out.

Topics are those of the wire; where several fingertips send one, its source follows: `eit.frame.right`. `input.SOURCE`
holds all that a parser was told, bytes as text (Latin-1, so that each byte is one character), and `input.clock` how the
monotonic clock was translated into Unix time: from these two a recording can be replayed.
"""

import dataclasses
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from shearloop.daemon.messaging.messages import TOPICS, EitEstimate, EitFrame, EitHeatmap, LoadTorque

FRAME_TOPIC = EitFrame.topic
LOAD_TOPIC = LoadTorque.topic
INPUT = "input"
CLOCK_TOPIC = f"{INPUT}.clock"
# MCAP metadata record with the identities; a reader refuses a file without it.
METADATA = "shearloop"
# One more for each experiment that was started.
EXPERIMENT_METADATA = "shearloop.experiment"
# And one at the end of a recording that was closed.
END_METADATA = "shearloop.end"
CONFIGURATION = "configuration.json"
FORMAT_VERSION = "1"
PROFILE = "shearloop"
SIDES = ("right", "left")
# The note that tells the tool's diameter in mm, where it was known: of an imported recording, or of the experiment in
# one of a daemon. The gripper opens no wider.
DIAMETER_NOTE = "diameter_mm"
LARGEST_DIAMETER_MM = 140.0

_OF_FINGERTIPS = (EitFrame.topic, EitEstimate.topic, EitHeatmap.topic)
_NAMES = {float: "number", int: "integer", str: "string", bool: "boolean"}
_TIME = {"type": "integer", "description": "CLOCK_MONOTONIC in ns"}


def recorded_topic(topic: str, source: str) -> str:
    """Return the topic under which a message is recorded."""
    return f"{topic}.{source}" if topic in _OF_FINGERTIPS else topic


def frame_topic(side: str) -> str:
    """Return the topic of a side's frames."""
    return recorded_topic(FRAME_TOPIC, side)


def input_topic(source: str) -> str:
    """Return the topic of what a source's parser was told."""
    return f"{INPUT}.{source}"


def schema_of(topic: str) -> str:
    """Return the name of a recorded topic's schema; raises KeyError for a topic that is never recorded."""
    if topic == CLOCK_TOPIC or topic in TOPICS:
        return topic
    if topic.startswith(f"{INPUT}."):
        return INPUT
    for wire in _OF_FINGERTIPS:
        if topic.startswith(f"{wire}."):
            return wire
    raise KeyError(topic)


@cache
def schemas() -> Mapping[str, dict[str, Any]]:
    """Return the JSON schema of each name that `schema_of` gives."""
    raw = {
        INPUT: {
            "t_mono_ns": _TIME,
            "kind": {"type": "string", "description": "opened or started (the board), asked, data, tare, or tool"},
            "data": {"type": "string", "description": "the bytes as Latin-1 text, or what belongs to a tare or a tool"},
        },
        CLOCK_TOPIC: {
            "t_mono_ns": _TIME,
            "offset_ns": {"type": "integer", "description": "Unix time less CLOCK_MONOTONIC in ns, from now on"},
        },
    }
    return {
        **{name: _object(name, properties, list(properties)) for name, properties in raw.items()},
        **{topic: _of_message(topic) for topic in TOPICS},
    }


def completed(topic: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a recorded message of a wire topic with None for each value that there was none of."""
    # A recording that was brought in from elsewhere has no source, and never had more keys than are there.
    absent = _optional_keys(topic) if topic in TOPICS and "source" in content else ()
    return {**content, **{key: None for key in absent if key not in content}}


@cache
def _optional_keys(topic: str) -> tuple[str, ...]:
    """Return the keys of a wire topic that a message is without where there is no value, or none that is finite."""
    hints = typing.get_type_hints(TOPICS[topic])
    fields = [item.name for item in dataclasses.fields(TOPICS[topic])]
    return tuple(name for name in fields if hints[name] is float or type(None) in typing.get_args(hints[name]))


def _of_message(topic: str) -> dict[str, Any]:
    properties: dict[str, Any] = {
        "timestamp": {"type": "number", "description": "Unix time in s that the message speaks of"},
        "seq": {"type": "integer", "description": "number of the message, without gaps, per topic and source"},
    }
    hints = typing.get_type_hints(TOPICS[topic])
    for item in dataclasses.fields(TOPICS[topic]):
        unit, meaning = item.metadata.get("unit", ""), item.metadata.get("meaning", "")
        properties[item.name] = {**_type(hints[item.name]), "description": f"{meaning} ({unit})" if unit else meaning}
    required = [name for name in properties if name not in _optional_keys(topic)]
    if topic == FRAME_TOPIC:
        properties["arrival_unix_ns"] = {"type": "integer", "description": "when the last byte of the line was read"}
        # A recording that was brought in from elsewhere has no more of a frame.
        required = ["arrival_unix_ns", "line"]
    elif topic == LOAD_TOPIC:
        required = []
    return _object(topic, properties, required)


def _type(hint: Any) -> dict[str, Any]:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(part for part in typing.get_args(hint) if part is not type(None))
    if hint in _NAMES:
        return {"type": _NAMES[hint]}
    if typing.get_origin(hint) in (np.ndarray, tuple):
        # An element that is NaN has no JSON form and is null, for which there is no word that Foxglove takes.
        return {"type": "array", "items": {"type": "number"}}
    return {"type": "object", "properties": {}}


def _object(title: str, properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": required}
