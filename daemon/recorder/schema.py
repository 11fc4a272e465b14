"""The format of a recording: topics, JSON schemas, metadata, and messages as JSON.

A recording is an MCAP file (mcap.dev) that any MCAP tool can show. Log times are Unix nanoseconds: for a message the
time of its measurement (for a frame the middle of its acquisition), for a raw input its arrival. All Unix times of a
file are the monotonic clock's plus one offset, CLOCK_OFFSET, so a wall clock that is set does not change their order.

Topics have the names of the live messages. A topic with several sources ends in the source: `eit.frame.right`.
`input.SOURCE` holds the raw input of a parser as Latin-1 text, so that each byte is one character. `input.clock` holds
each change of the offset between the monotonic clock and Unix time. Replay needs only these two.

The schemas use the part of JSON Schema that Foxglove supports: each key has one type, every object lists its
properties. A key without a value is therefore left out instead of null.
"""

import dataclasses
import hashlib
import math
import types
import typing
from collections.abc import Mapping
from functools import cache
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_json

from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.daemon.messaging.messages import TOPICS, EitFrame, EitHeatmap, LoadTorque
from shearloop.drivers.serial_sensor import InputKind, RawEvent

FORMAT_VERSION = "2"
FRAME_TOPIC = EitFrame.topic
LOAD_TOPIC = LoadTorque.topic
INPUT = "input"
CLOCK_TOPIC = f"{INPUT}.clock"
# MCAP metadata record of every recording: format, software, channel table.
METADATA = "shearloop"
# Its key for the offset: all Unix times of a daemon's recording minus CLOCK_MONOTONIC, in ns.
CLOCK_OFFSET = "clock_offset_ns"
# The first word of its keys for attached files; their paths follow.
FILE_HASH = "sha256"
# Its key in a recording of an emulated rig; other recordings do not have it.
EMULATED = "emulated"
# One metadata record for each experiment, and one at the end of a closed recording.
EXPERIMENT_METADATA = "shearloop.experiment"
END_METADATA = "shearloop.end"
# For a recording that begins in the middle of a run: the sources with a state that follows as an input.
CONTINUED_METADATA = "shearloop.continued"
CONFIGURATION = "configuration.json"
# The numbers of k and sigma of a heatmap; other arrays have one dimension.
SCORES_SHAPE = "scores_shape"
ARRIVAL = "arrival_unix_ns"
SUSPENDED = "suspended_ns"
# The name of a file, after the time (UTC) at which it was begun.
NAME_FORMAT = "%Y-%m-%dT%H-%M-%SZ"
# The keys of an imported message, which has no source.
IMPORTED_KEYS: Mapping[str, tuple[str, ...]] = {FRAME_TOPIC: (ARRIVAL, "line"), LOAD_TOPIC: ("torque_nm",)}
SIDES = ("right", "left")
# Metadata key of the tool's diameter in mm. The gripper opens no wider than the largest.
DIAMETER_NOTE = "diameter_mm"
LARGEST_DIAMETER_MM = 140.0

# Metadata key of a doubt about the load cell's times, and the doubt of an import.
LOAD_DOUBT_NOTE = "load_doubt"
# What an import corrected and left out, in sentences; and which load values it left out, in clauses.
REMARKS_NOTE, LEFT_OUT_NOTE = "remarks", "left_out"
LOAD_DOUBT = "the load's values waited in a buffer, and nothing shows for how long: its times may be seconds off"

# The rooms that a replay runs.
_REPLAYED_ROOMS = ("bank", "estimation", "drivers", "daemon", "tools")
_SCALARS = {float: "number", int: "integer", str: "string", bool: "boolean"}
_TIME = {"type": "integer", "description": "CLOCK_MONOTONIC in ns"}


class UnknownTopicError(Exception):
    """A recording has a topic that this version does not have."""


def basic_identity(source: str, table: ChannelTable = PAPER_TABLE) -> dict[str, str]:
    """Return the metadata of every recording; `source` describes the origin of the data."""
    return {
        "format_version": FORMAT_VERSION,
        "channel_table_hash": table.digest,
        "electrodes": str(table.n_electrodes),
        "injection": table.injection,
        "source": source,
        "software": software_version(),
        "code_sha256": code_digest(),
    }


def software_version() -> str:
    """Return the installed version of shearloop."""
    return version("shearloop")


@cache
def code_digest() -> str:
    """Return a hash of shearloop's own sources; equal code must give equal replays."""
    root = Path(str(resources.files("shearloop")))
    digest = hashlib.sha256()
    for path in replayed_files(root):
        digest.update(f"{path.relative_to(root)}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def replayed_files(root: Path) -> list[Path]:
    """Return the Python files of the package at `root` that a replay may run: modules, then rooms."""
    found = sorted(root.glob("*.py"))
    for room in _REPLAYED_ROOMS:
        found += sorted((root / room).rglob("*.py"))
    return found


def recorded_topic(topic: str, source: str) -> str:
    """Return the topic under which a message is recorded."""
    return f"{topic}.{source}" if TOPICS[topic].per_source else topic


def input_topic(source: str) -> str:
    """Return the topic of a source's raw input."""
    return f"{INPUT}.{source}"


def schema_name(topic: str) -> str:
    """Return the name of a recorded topic's schema; raises UnknownTopicError for another."""
    if topic == CLOCK_TOPIC or topic in TOPICS:
        return topic
    if topic.startswith(f"{INPUT}."):
        return INPUT
    for live, kind in TOPICS.items():
        if kind.per_source and topic.startswith(f"{live}."):
            return live
    raise UnknownTopicError(topic)


@cache
def schemas() -> Mapping[str, dict[str, Any]]:
    """Return the JSON schemas by name."""
    raw = {
        INPUT: {
            "t_mono_ns": _TIME,
            "kind": {"type": "string", "description": ", ".join(kind.value for kind in InputKind)},
            "data": {"type": "string", "description": "the bytes as Latin-1 text, or the argument of another input"},
        },
        CLOCK_TOPIC: {
            "t_mono_ns": _TIME,
            "offset_ns": {"type": "integer", "description": "Unix time minus CLOCK_MONOTONIC in ns, from now on"},
            SUSPENDED: {"type": "integer", "description": "CLOCK_BOOTTIME minus CLOCK_MONOTONIC in ns"},
        },
    }
    return {
        **{
            name: _object(name, properties, [key for key in properties if key not in optional_keys(name)])
            for name, properties in raw.items()
        },
        **{topic: _message_schema(topic) for topic in TOPICS},
    }


def message_json(topic: str, content: Mapping[str, Any], offset_ns: int) -> bytes:
    """Return a message's map as JSON: float32 arrays or their bytes as flat lists, without keys that have no value.

    Its Unix times are its monotonic stamps plus offset_ns.
    """
    plain: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, float):
            if math.isfinite(value):
                plain[key] = value
        elif isinstance(value, bytes | np.ndarray):
            # To a microvolt or microradian. Elements that are not finite become null.
            plain[key] = np.round(np.frombuffer(value, "<f4").astype(np.float64), 6).tolist()
        elif value is not None and (not key.endswith("_shape") or key == SCORES_SHAPE):
            plain[key] = value
    return as_json({**plain, **unix_times(topic, content, content["t_mono_ns"] + offset_ns)})


def unix_times(topic: str, content: Mapping[str, Any], t_unix_ns: int) -> dict[str, Any]:
    """Return the keys of a live message that are Unix times, for one that was measured at t_unix_ns."""
    times: dict[str, Any] = {"timestamp": t_unix_ns / 1e9}
    if topic == EitFrame.topic and content["age_s"] is not None:
        times[ARRIVAL] = t_unix_ns + round(content["age_s"] * 1e9)
    return times


def input_json(event: RawEvent) -> bytes:
    """Return a raw input as JSON, each byte as one character."""
    return as_json({"t_mono_ns": event.t_ns, "kind": event.kind.value, "data": event.data.decode("latin-1")})


def input_event(content: Mapping[str, Any]) -> RawEvent:
    """Return the raw input of a recorded message; raises KeyError, TypeError or ValueError for other content."""
    return RawEvent(InputKind(content["kind"]), int(content["t_mono_ns"]), content["data"].encode("latin-1"))


def as_json(content: Mapping[str, Any]) -> bytes:
    """Return compact JSON, with null for numbers that are not finite.

    Raises ValueError for text that is not UTF-8, for other objects, and for more than 250 levels.
    """
    return to_json(content, inf_nan_mode="null", fallback=_mapping_as_dict)


def _mapping_as_dict(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is no JSON type")


@cache
def optional_keys(topic: str) -> tuple[str, ...]:
    """Return the keys that a message, or an entry of `input.clock`, may leave out, as if they had no finite value."""
    if topic not in TOPICS:
        return (SUSPENDED,) if topic == CLOCK_TOPIC else ()
    hints = typing.get_type_hints(TOPICS[topic])
    names = (item.name for item in dataclasses.fields(TOPICS[topic]))
    return tuple(name for name in names if hints[name] is float or type(None) in typing.get_args(hints[name]))


def _message_schema(topic: str) -> dict[str, Any]:
    properties: dict[str, Any] = {
        "timestamp": {"type": "number", "description": "Unix time in s of the measurement"},
        "seq": {"type": "integer", "description": "number of the message, without gaps, per topic and source"},
    }
    hints = typing.get_type_hints(TOPICS[topic])
    for item in dataclasses.fields(TOPICS[topic]):
        unit, meaning = item.metadata.get("unit", ""), item.metadata.get("meaning", "")
        described = {"description": f"{meaning} ({unit})", "unit": unit} if unit else {"description": meaning}
        properties[item.name] = {**json_type(hints[item.name]), **described}
    required = [name for name in properties if name not in optional_keys(topic)]
    if topic == FRAME_TOPIC:
        properties[ARRIVAL] = {"type": "integer", "description": "arrival of the line's last byte"}
    elif topic == EitHeatmap.topic:
        numbers = {"type": "array", "items": {"type": "integer"}}
        properties[SCORES_SHAPE] = {**numbers, "description": "numbers of k and of sigma"}
    if topic in IMPORTED_KEYS:
        required = [key for key in IMPORTED_KEYS[topic] if key not in optional_keys(topic)]
    return _object(topic, properties, required)


def json_type(hint: Any) -> dict[str, Any]:
    """Return the JSON schema of a message field's type: a scalar, a mapping or an array, each maybe optional."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        hint = next(part for part in typing.get_args(hint) if part is not type(None))
    if hint in _SCALARS:
        return {"type": _SCALARS[hint]}
    if typing.get_origin(hint) is Mapping:
        return {"type": "object", "properties": {}}
    # A NaN element becomes null, which a schema for Foxglove cannot express.
    return {"type": "array", "items": {"type": "number"}}


def _object(title: str, properties: dict[str, Any], required: list[str]) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties, "required": required}
