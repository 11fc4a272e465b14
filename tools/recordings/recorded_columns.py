"""The columns of a recorded topic: the keys of the schema in its own file, next to the keys of this version.

A recording holds the schema that its writer used, so a message is read by the schema of its file. A key of this version
that the file's schema lacks has no value. A key that only the file's schema has keeps its name and its type.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple

from mcap.records import Schema
from pydantic_core import from_json

from shearloop.daemon.messaging.messages import units
from shearloop.daemon.recorder import schema

# The JSON types of the keys of a message.
KINDS = ("number", "integer", "boolean", "string", "object", "array")
_ENCODING = "jsonschema"
# The largest schema of this version has 8 kB.
_LARGEST_SCHEMA_BYTES = 256 << 10
_MOST_KEYS = 1000
# Keys become names of columns in files, also in MATLAB's.
_KEY = re.compile(r"[a-z][a-z0-9_]{0,58}", re.ASCII)
_LOG_TIME = "log_time_ns"
_LONGEST_UNIT = 20
_TIMES = dict.fromkeys((_LOG_TIME, "t_mono_ns", "offset_ns", schema.ARRIVAL, schema.SUSPENDED), "ns")


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

    # Those of this version, in the order of its schema.
    own: Mapping[str, Column]
    # Those of the file's schema, in its order.
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
    def usable(self) -> frozenset[str]:
        """The keys of this version that were recorded with its types."""
        shared = self.own.keys() & self.recorded.keys()
        return frozenset(key for key in shared if _is_of_kind(self.recorded[key].kind, self.own[key].kind))

    @cached_property
    def not_recorded(self) -> list[str]:
        """The keys of this version without a recorded value of its type."""
        return [key for key in self.own if key not in self.usable]

    @cached_property
    def unknown(self) -> list[str]:
        """The recorded keys that this version does not have."""
        return [key for key in self.recorded if key not in self.own]

    def known(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Return the part of a row that this version knows; None for a value that was not recorded with its type."""
        return {key: value if key in self.usable else None for key, value in row.items() if key in self.own}

    def need(self, topic: str, keys: Iterable[str], user: str) -> None:
        """Raise MissingKeyError if `user`, a command, needs a key that was not recorded."""
        for key in keys:
            if key not in self.usable:
                raise MissingKeyError(f"{user} needs the key {key!r} of {topic}")


class MissingKeyError(Exception):
    """A recording lacks a key that a command computes with."""


@cache
def own_columns(name: str) -> Mapping[str, Column]:
    """Return the columns of a schema of this version by their names, in its order."""
    optional = schema.optional_keys(name)
    described = schema.schemas()[name]["properties"].items()
    known = {**_TIMES, **units(name)}
    return {key: Column(key, definition["type"], key in optional, known.get(key, "")) for key, definition in described}


@cache
def own_topic(name: str) -> TopicColumns:
    """Return the columns of a topic whose file has the schema of this version, or none."""
    return TopicColumns(own_columns(name), own_columns(name))


def recorded_topic(name: str, written: Schema | None) -> TopicColumns:
    """Return the columns of a topic by the schema in its file, None for a file without schemas.

    Raises SchemaError for a schema that no version writes.
    """
    if written is None:
        return own_topic(name)
    own = own_columns(name)
    properties, required = _described(written)
    # The required keys of these topics are an import's, and a live message has others too.
    imported = name in schema.IMPORTED_KEYS
    recorded = {}
    for key, definition in properties.items():
        optional = (own[key].optional if key in own else True) if imported else key not in required
        recorded[key] = _column(key, definition, own.get(key), optional=optional)
    return TopicColumns(own, recorded)


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


def _column(key: str, definition: Any, own: Column | None, *, optional: bool) -> Column:
    """Return the column of one key of a schema in a file."""
    kind = definition.get("type") if isinstance(definition, dict) else None
    if not _KEY.fullmatch(key) or key == _LOG_TIME:
        raise SchemaError(f"its schema has the key {key[:40]!r}, which is no name of a column")
    if kind not in KINDS:
        raise SchemaError(f"its schema gives {key!r} no type of {', '.join(KINDS)}")
    unit = definition.get("unit", own.unit if own is not None else "")
    if not isinstance(unit, str) or not unit.isprintable() or len(unit) > _LONGEST_UNIT:
        raise SchemaError(f"its schema gives {key!r} a unit that is no short text")
    return Column(key, kind, optional, unit)


def _is_of_kind(recorded: str, own: str) -> bool:
    return recorded == own or (recorded, own) == ("integer", "number")
