"""A message of any topic with something in every key."""

import dataclasses
import functools
import time
from collections.abc import Mapping
from typing import Any, get_type_hints

import numpy as np

from shearloop.daemon.control.faults import FaultCode
from shearloop.daemon.messaging.messages import Message


@functools.cache
def hints_of(kind: type[Message]) -> Mapping[str, Any]:
    """Return the types of a message's keys; to read them takes long."""
    return get_type_hints(kind)


def sample(kind: type[Message], **changes: Any) -> Message:
    """Return a message of this moment with something in every key."""
    values: dict[str, Any] = {}
    for item in dataclasses.fields(kind):
        hint = str(hints_of(kind)[item.name])
        # Of NumPy's array types: numpy.ndarray[…], or from 2.5 on numpy.typing.NDArray[…].
        if "ndarray" in hint.lower():
            values[item.name] = np.arange(6.0).reshape(2, 3)
        elif "tuple" in hint:
            values[item.name] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
        elif "Mapping" in hint:
            values[item.name] = {"right": {"alive": True, "rate_hz": 1.85, "errors": {"nan": 2}, "last_error": ""}}
        elif "bool" in hint:
            values[item.name] = True
        elif "float" in hint:
            values[item.name] = 0.5
        elif "int" in hint:
            values[item.name] = 3
        elif item.name == "faults":
            # Faults are codes.
            values[item.name] = FaultCode.ESTIMATE_STALE.text
        else:
            values[item.name] = "text"
    return kind(**{**values, "t_mono_ns": time.monotonic_ns(), **changes})
