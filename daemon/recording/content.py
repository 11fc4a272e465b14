"""Messages and raw inputs as the JSON that stands in a recording."""

import json
import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic_core import to_json

from shearloop.daemon.messaging.messages import EitFrame
from shearloop.drivers.serial_sensor import InputKind, RawEvent

# Of arrays, which are float32 on the wire: a microvolt, a microradian.
_DECIMALS = 6
# So few are quicker without numpy: a robot's state has three arrays of six.
_FEW_BYTES = 4 * 32
_SHAPE = "_shape"
# For what pydantic does not write; it takes a fifth to a tenth of the time.
_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


class NoJsonError(ValueError):
    """Something has no JSON form."""


def message_json(topic: str, content: Mapping[str, Any], offset_ns: int) -> bytes:
    """Return a message's map, as it goes on the wire, as JSON: arrays as flat lists, without what has no value."""
    plain: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, float):
            if math.isfinite(value):
                plain[key] = value
        elif isinstance(value, bytes):
            # Nothing else on the wire is bytes.
            plain[key] = _numbers(value)
        elif value is not None and not key.endswith(_SHAPE):
            plain[key] = value
    if topic == EitFrame.topic:
        plain["arrival_unix_ns"] = content["t_mono_ns"] + round(content["age_s"] * 1e9) + offset_ns
    return as_json(plain)


def input_json(told: RawEvent) -> bytes:
    """Return a raw input as JSON, each byte a character."""
    return as_json({"t_mono_ns": told.t_ns, "kind": told.kind.value, "data": told.data.decode("latin-1")})


def input_of(content: Mapping[str, Any]) -> RawEvent:
    """Return the raw input of a recorded message; raises KeyError, TypeError or ValueError for what is none."""
    return RawEvent(InputKind(content["kind"]), int(content["t_mono_ns"]), content["data"].encode("latin-1"))


def as_json(content: Mapping[str, Any]) -> bytes:
    """Return compact JSON, with null for the numbers that have none.

    Raises NoJsonError for what has no JSON form, or is nested deeper than Python goes: some hundreds of levels.
    """
    try:
        return to_json(content, inf_nan_mode="null")
    except ValueError:
        # A mapping that is no dict, or half of a surrogate pair, as in the name of a file that is no UTF-8.
        return _by_python(content)


def _by_python(content: Mapping[str, Any]) -> bytes:
    try:
        return _ENCODER.encode(_finite(content)).encode()
    except (RecursionError, TypeError, ValueError) as error:
        too_deep = isinstance(error, RecursionError)
        raise NoJsonError("it is nested too deep" if too_deep else str(error)) from error


def _numbers(data: bytes) -> list[float | None]:
    """Return the numbers of an array, None where one has no JSON form."""
    if len(data) <= _FEW_BYTES:
        few = struct.unpack(f"<{len(data) // 4}f", data)
        if all(map(math.isfinite, few)):
            return [round(value * 10**_DECIMALS) / 10**_DECIMALS for value in few]
    values = np.frombuffer(data, "<f4")
    rounded: list[float | None] = np.round(values.astype(np.float64), _DECIMALS).tolist()
    if np.isfinite(values).all():
        return rounded
    return [value if value is not None and math.isfinite(value) else None for value in rounded]


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
