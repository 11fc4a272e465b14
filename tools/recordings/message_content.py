"""The keys of a recorded message in the order of its topic's schema, each checked for its type.

Exports, replay and `shearloop.read` take messages from here, so a value is always under its own name. Content that does
not fit the schema of its own file is refused: an unknown or missing key, another type. So are integers beyond 64 bits,
nested lists, and a heatmap that is no rectangle.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from pydantic_core import from_json

from shearloop.daemon.messaging.messages import EitHeatmap
from shearloop.daemon.recorder import schema
from shearloop.drivers.serial_sensor import InputKind
from shearloop.tools.recordings.recorded_columns import Column, ContentError, TopicColumns, own_topic

# Unix time and CLOCK_MONOTONIC in ns: the year 2116, and 146 years after the start of a computer.
_LATEST_NS = 2**62
# Frames and heatmaps have less than 1 MB, and states a few. JSON of this size is parsed within three seconds.
_LARGEST_MESSAGE_BYTES = 16 << 20
_LONGEST_QUOTE = 40
# A message of a daemon has these, and an imported one has none of them.
_LIVE_KEYS = frozenset({"source", "t_mono_ns"})


def read_content(topic: str, data: bytes, columns: TopicColumns | None = None) -> dict[str, Any]:
    """Return a message of a recorded topic: this version's keys in the order of its schema, then others of the file's.

    `columns` describe the topic in its file; the default is this version's. A value that is missing, or whose key the
    file's schema lacks, is None. Numbers are floats, arrays are lists of floats, integers or None. An imported message
    has only the keys that its import writes. Raises ContentError for what does not fit the topic, and without columns
    UnknownTopicError for one that this version does not have.
    """
    columns = columns or own_topic(schema.schema_name(topic))
    name = columns.name
    if len(data) > _LARGEST_MESSAGE_BYTES:
        raise ContentError(f"it has {len(data) >> 20} MB, and at most {_LARGEST_MESSAGE_BYTES >> 20} are read")
    try:
        # Its nesting is bounded there.
        content = from_json(data)
    except ValueError as error:
        raise ContentError(f"it is not JSON ({error})") from error
    if not isinstance(content, dict):
        raise ContentError(f"it is {_quoted(content)}, not a map")
    imported = name in schema.IMPORTED_KEYS and not content.keys() & _LIVE_KEYS
    if name is not None and imported:
        expected = [*schema.IMPORTED_KEYS[name], *columns.unknown]
    else:
        expected = list(columns.all)
    allowed = columns.recorded.keys() & {*expected}
    if other := [key for key in content if key not in allowed]:
        raise ContentError(f"it has the unknown key {_quoted(other[0])}")
    lacking = (key for key in expected if key in allowed and key not in content)
    if missing := [key for key in lacking if not columns.recorded[key].optional]:
        raise ContentError(f"it lacks the key {missing[0]!r}")
    row = {
        key: _checked(columns.recorded[key], content.get(key), imported=imported) if key in allowed else None
        for key in expected
    }
    _check_known(name, columns.known(row))
    return row


def _check_known(name: str | None, row: Mapping[str, Any]) -> None:
    """Raise ContentError for values that no daemon writes, among those that this version knows."""
    for key in ("t_mono_ns", "offset_ns", schema.ARRIVAL):
        check_time(key, row.get(key) or 0)
    if name == EitHeatmap.topic and row["scores"] is not None and row[schema.SCORES_SHAPE] is not None:
        _check_rectangle(row["scores"], row[schema.SCORES_SHAPE])
    elif name == schema.INPUT:
        _check_input(row)


def check_time(key: str, t_ns: int) -> None:
    """Raise ContentError for a time in ns that no clock shows."""
    if abs(t_ns) >= _LATEST_NS:
        raise ContentError(f"{key} is {t_ns} ns, which no clock shows")


def check_length(key: str, found: int, expected: int) -> None:
    """Raise ContentError for an array of another length."""
    if found != expected:
        raise ContentError(f"{key} has {found} values, not {expected}")


def _checked(column: Column, value: Any, *, imported: bool) -> Any:
    """Return a value in the type of its column; raises ContentError for another type."""
    if value is None and (column.optional or imported):
        return None
    expected, fits, convert = _TYPES[column.kind]
    if not fits(value):
        raise ContentError(f"{column.name} is {_quoted(value)}, not {expected}")
    return convert(value)


def _is_number(value: Any) -> bool:
    if type(value) is int:
        return -(2**63) <= value < 2**63
    return type(value) is float and math.isfinite(value)


def _is_integer(value: Any) -> bool:
    return type(value) is int and -(2**63) <= value < 2**63


def _is_array(value: Any) -> bool:
    if type(value) is not list:
        return False
    kinds = set(map(type, value))
    if not kinds <= {float, int, type(None)}:
        return False
    return all(map(_is_number, value)) if int in kinds else _is_finite_array(value)


def _is_finite_array(value: list[Any]) -> bool:
    # A frame has 896 elements, and mostly all of them.
    if None in value:
        return all(element is None or math.isfinite(element) for element in value)
    return all(map(math.isfinite, value))


class _Type(NamedTuple):
    expected: str
    fits: Callable[[Any], bool]
    convert: Callable[[Any], Any]


_TYPES: Mapping[str, _Type] = {
    "number": _Type("a number", _is_number, float),
    "integer": _Type("an integer of 64 bits", _is_integer, int),
    "boolean": _Type("true or false", lambda value: type(value) is bool, bool),
    "string": _Type("a text", lambda value: type(value) is str, str),
    "object": _Type("a map", lambda value: type(value) is dict, dict),
    "array": _Type("a list of numbers", _is_array, list),
}


def _check_rectangle(scores: list[float], shape: list[float]) -> None:
    sides = [int(side) for side in shape if side is not None and side >= 1]
    if len(shape) != 2 or sides != shape or math.prod(sides) != len(scores):
        raise ContentError(f"its {len(scores)} scores are no rectangle of {_quoted(shape)}")


def _check_input(row: Mapping[str, Any]) -> None:
    if row["kind"] is not None and row["kind"] not in (kind.value for kind in InputKind):
        raise ContentError(f"kind is {_quoted(row['kind'])}, not one of {', '.join(kind.value for kind in InputKind)}")
    try:
        (row["data"] or "").encode("latin-1")
    except UnicodeEncodeError:
        raise ContentError(f"data is {_quoted(row['data'])}, not bytes as Latin-1 text") from None


def _quoted(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:
        # Python refuses to print integers of thousands of digits.
        text = "a huge integer"
    return text if len(text) <= _LONGEST_QUOTE else f"{text[:_LONGEST_QUOTE]}…"
