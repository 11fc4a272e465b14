"""Messages and raw inputs as the JSON that stands in a recording."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic_core import to_json

from shearloop.daemon.messaging.messages import EitFrame
from shearloop.drivers.raw_event import InputKind, RawEvent

# Of arrays, which are float32 on the wire: a microvolt, a microradian.
_DECIMALS = 6
_SHAPE = "_shape"


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

    Raises NoJsonError for what has no JSON form: no text in UTF-8, another kind of object, more than 250 levels.
    """
    try:
        return to_json(content, inf_nan_mode="null", fallback=_plain)
    except (ValueError, TypeError) as error:
        raise NoJsonError(str(error)) from error


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} is no JSON type")


def _numbers(data: bytes) -> list[float | None]:
    """Return the numbers of an array, None where one has no JSON form."""
    values = np.frombuffer(data, "<f4")
    rounded: list[float | None] = np.round(values.astype(np.float64), _DECIMALS).tolist()
    if np.isfinite(values).all():
        return rounded
    return [value if value is not None and math.isfinite(value) else None for value in rounded]
