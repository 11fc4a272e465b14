"""What stands in a recording as JSON reads as what it was."""

import json
import math
import struct
from types import MappingProxyType
from typing import Any, NoReturn

from hypothesis import example, given
from hypothesis import strategies as st

from shearloop.daemon.recording.schema import as_json, input_event, input_json
from shearloop.drivers.serial_sensor import InputKind, RawEvent

texts = st.text()
scalars = st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats() | texts
values = st.recursive(scalars, lambda inner: st.lists(inner) | st.dictionaries(texts, inner), max_leaves=20)


def not_json(name: str) -> NoReturn:
    raise AssertionError(f"{name} is not JSON, though Python reads it")


def read(value: Any) -> Any:
    """Return a value as JSON has it: null for what is no finite number."""
    if isinstance(value, dict):
        return {key: read(one) for key, one in value.items()}
    if isinstance(value, list):
        return [read(one) for one in value]
    if isinstance(value, float):
        # Of a float each bit counts: a replay is to be the same.
        return struct.pack("<d", value) if math.isfinite(value) else None
    return value


@given(st.dictionaries(texts, values))
@example({"torque_nm": math.nan})
@example({"whole": [math.inf, -0.0, 5e-324, 0.1 + 0.2, 1e22]})
def test_json_round_trips(content: dict[str, Any]) -> None:
    assert read(json.loads(as_json(content), parse_constant=not_json)) == read(content)


def test_other_mappings_are_written_like_a_dict() -> None:
    assert as_json(MappingProxyType({"tasks": MappingProxyType({"loop": (1, math.nan)})})) == (
        b'{"tasks":{"loop":[1,null]}}'
    )


def test_raw_input_round_trips() -> None:
    told = RawEvent(InputKind.DATA, 123456789012345678, bytes(range(256)))
    assert input_event(json.loads(input_json(told))) == told
