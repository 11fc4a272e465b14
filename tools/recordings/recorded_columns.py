"""The columns of a recorded topic: the keys of the schema in its own file, next to the keys of this version.

A recording holds the schema that its writer used, so a message is read by the schema of its file. A key of this version
that the file's schema lacks has no value. A key that only the file's schema has keeps its name, its type and its unit.
So does each key of a topic that this version does not have. A key with another type or unit than this version's is
exported as it was recorded, and no command computes with it.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

from mcap.records import Schema
from pydantic_core import from_json

from shearloop.daemon.messaging.messages import ENVELOPE, units
from shearloop.daemon.recorder import schema

# The JSON types of the keys of a message.
KINDS = ("number", "integer", "boolean", "string", "object", "array")
_ENCODING = "jsonschema"
# The largest schema of this version has 8 kB.
_LARGEST_SCHEMA_BYTES = 256 << 10
_MOST_KEYS = 1000
# Keys become names of columns in files, also in MATLAB's.
_KEY = re.compile(r"[a-z][a-z0-9_]{0,58}", re.ASCII)
# Topics that this version does not have become names of files and of MATLAB's variables.
_TOPIC = re.compile(r"[a-z][a-z0-9_]{0,30}(\.[A-Za-z0-9_-]{1,60}){0,3}", re.ASCII)
# The table of an export's units, which no topic is named like.
UNITS_TABLE = "units"
_LOG_TIME = "log_time_ns"
_LONGEST_UNIT = 20
# Earlier versions wrote the unit only at the end of the description.
_UNIT_IN_DESCRIPTION = re.compile(rf"\(([^()]{{1,{_LONGEST_UNIT}}})\)$")
# No schema declares the units of these times.
_TIMES = {
    **dict.fromkeys((_LOG_TIME, "t_mono_ns", "offset_ns", schema.ARRIVAL, schema.SUSPENDED), "ns"),
    "timestamp": "s",
}
# The unit of these keys depends on the bank's model. Earlier versions declared one unit, or both.
_UNITS_OF_K = frozenset({"", "cm", "cm or rad/cm"})
_KEYS_OF_K = frozenset({"k", "k_low", "k_high"})


class ContentError(ValueError):
    """A recorded message that does not fit the schema of its file."""


class SchemaError(ContentError):
    """A schema in a file that no version writes."""


class Column(NamedTuple):
    """One key of a topic: its JSON type, its unit or "", and whether a message may leave it out."""

    name: str
    kind: str
    optional: bool
    unit: str = ""


@dataclass(frozen=True)
class TopicColumns:
    """The columns of one topic of a recording, by their names."""

    # The name of its schema in this version, None for a topic that this version does not have.
    name: str | None
    # This version's columns, in the order of its schema. A topic that it does not have has only the envelope's columns.
    own: Mapping[str, Column]
    # The columns of the file's schema, in its order.
    recorded: Mapping[str, Column]

    @cached_property
    def all(self) -> Mapping[str, Column]:
        """All columns of a table: this version's first, each with the type that was recorded."""
        return {**self.own, **self.recorded}

    @cached_property
    def units(self) -> Mapping[str, str]:
        """The unit of each column of a table that has one, the log time first."""
        return {_LOG_TIME: _TIMES[_LOG_TIME], **{key: one.unit for key, one in self.all.items() if one.unit}}

    @cached_property
    def differing(self) -> Mapping[str, str]:
        """The keys that were recorded with another type or unit than this version's, and how: `in mN·m, not in N·m`."""
        shared = (key for key in self.own if key in self.recorded)
        found = {key: _difference(self.recorded[key], self.own[key]) for key in shared}
        return {key: difference for key, difference in found.items() if difference}

    @cached_property
    def usable(self) -> frozenset[str]:
        """The keys of this version that were recorded with its types and units."""
        return frozenset((self.own.keys() & self.recorded.keys()) - self.differing.keys())

    @cached_property
    def unusable(self) -> list[str]:
        """The keys of this version without a recorded value of its type and unit."""
        return [key for key in self.own if key not in self.usable]

    @cached_property
    def not_recorded(self) -> list[str]:
        """The keys of this version that were not recorded, with any type or unit."""
        return [key for key in self.own if key not in self.recorded]

    @cached_property
    def unknown(self) -> list[str]:
        """The recorded keys that this version does not have."""
        return [key for key in self.recorded if key not in self.own]

    def known(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Return the part of a row that this version knows; None for a value without its type and unit."""
        return {key: value if key in self.usable else None for key, value in row.items() if key in self.own}

    def need(self, topic: str, keys: Iterable[str], user: str) -> None:
        """Raise MissingKeyError if `user`, a command, needs a key that was not recorded with its type and unit."""
        for key in keys:
            if key not in self.usable:
                how = f"was recorded {self.differing[key]}" if key in self.differing else "the recording does not have"
                raise MissingKeyError(f"{user} needs the key {key!r} of {topic}, which {how}")


class MissingKeyError(Exception):
    """A recording lacks a key that a command computes with, or has it with another type or unit."""


@cache
def own_columns(name: str) -> Mapping[str, Column]:
    """Return the columns of a schema of this version by their names, in its order."""
    optional = schema.optional_keys(name)
    described = schema.schemas()[name]["properties"].items()
    known = {**_TIMES, **units(name)}
    return {key: Column(key, definition["type"], key in optional, known.get(key, "")) for key, definition in described}


def own_name(topic: str) -> str | None:
    """Return the name of a recorded topic's schema, None for a topic that this version does not have."""
    try:
        return schema.schema_name(topic)
    except schema.UnknownTopicError:
        return None


@cache
def own_topic(name: str) -> TopicColumns:
    """Return the columns of a topic, for a file with this version's schema or without a schema."""
    return TopicColumns(name, own_columns(name), own_columns(name))


def recorded_topic(topic: str, written: Schema | None) -> TopicColumns:
    """Return the columns of a recorded topic by the schema in its file, None for a topic without one.

    Raises SchemaError for a schema that no version writes, and for a topic that only a schema would describe.
    """
    name = own_name(topic)
    if name is None and (not _TOPIC.fullmatch(topic) or topic == UNITS_TABLE):
        raise SchemaError(f"no version has a topic {topic[:40]!r}")
    if written is None:
        if name is None:
            raise SchemaError("this version does not have this topic, and the recording has no schema of it")
        return own_topic(name)
    properties, required = _described(written)
    own = _envelope(properties) if name is None else own_columns(name)
    # The required keys of these topics are an import's, and a live message has others too.
    imported = name in schema.IMPORTED_KEYS
    recorded = {}
    for key, definition in properties.items():
        if not imported:
            optional = key not in required
        elif key in own:
            optional = own[key].optional
        else:
            optional = True
        recorded[key] = _column(key, definition, optional=optional)
    return TopicColumns(name, own, recorded)


def _envelope(properties: Iterable[str]) -> Mapping[str, Column]:
    """Return the columns of the keys that every message has, as far as a schema has them."""
    every = own_columns(schema.LOAD_TOPIC)
    return {key: every[key] for key in properties if key in ENVELOPE}


def _described(written: Schema) -> tuple[dict[str, Any], list[Any]]:
    """Return the properties and the required keys of a schema in a file."""
    if written.encoding != _ENCODING:
        raise SchemaError(f"its schema is {written.encoding[:20]!r}, not {_ENCODING}")
    if len(written.data) > _LARGEST_SCHEMA_BYTES:
        raise SchemaError(
            f"its schema has {len(written.data) >> 10} kB, and at most {_LARGEST_SCHEMA_BYTES >> 10} are read"
        )
    try:
        # Its nesting is bounded there.
        content = from_json(written.data)
    except ValueError as error:
        raise SchemaError(f"its schema is not JSON ({error})") from error
    found = content if isinstance(content, dict) else {}
    properties, required = found.get("properties"), found.get("required", [])
    if not isinstance(properties, dict) or not isinstance(required, list):
        raise SchemaError("its schema lists no properties of an object")
    if len(properties) > _MOST_KEYS:
        raise SchemaError(f"its schema has {len(properties)} keys, and at most {_MOST_KEYS} are read")
    if missing := [key for key in required if not isinstance(key, str) or key not in properties]:
        raise SchemaError(f"its schema requires {repr(missing[0])[:40]}, and does not describe it")
    return properties, required


def _column(key: str, definition: Any, *, optional: bool) -> Column:
    """Return the column of one key of a schema in a file."""
    kind = definition.get("type") if isinstance(definition, dict) else None
    if not _KEY.fullmatch(key) or key == _LOG_TIME:
        raise SchemaError(f"its schema has the key {key[:40]!r}, which is no name of a column")
    if kind not in KINDS:
        raise SchemaError(f"its schema gives {key!r} no type of {', '.join(KINDS)}")
    unit = _unit(key, definition)
    if not isinstance(unit, str) or not unit.isprintable() or len(unit) > _LONGEST_UNIT:
        raise SchemaError(f"its schema gives {key!r} a unit that is no short text")
    return Column(key, kind, optional, unit)


def _unit(key: str, definition: Mapping[str, Any]) -> Any:
    """Return what a schema in a file gives as the unit of a key, "" for none."""
    if "unit" in definition:
        return definition["unit"]
    in_description = _UNIT_IN_DESCRIPTION.search(str(definition.get("description", "")))
    return in_description[1] if in_description else _TIMES.get(key, "")


def _difference(recorded: Column, own: Column) -> str:
    """Return how the type or unit of a recorded key differs from this version's, or "" if neither differs."""
    if recorded.kind != own.kind and (recorded.kind, own.kind) != ("integer", "number"):
        return f"as {recorded.kind}, not {own.kind}"
    if recorded.unit == own.unit or (own.name in _KEYS_OF_K and recorded.unit in _UNITS_OF_K):
        return ""
    return f"{_in_unit(recorded)}, not {_in_unit(own)}"


def _in_unit(column: Column) -> str:
    return f"in {column.unit}" if column.unit else "without a unit"
