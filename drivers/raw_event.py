"""What a parser was told, so that it can be recorded and told again."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias


class InputKind(Enum):
    """What happened; the value is its name in recordings."""

    OPENED = "opened"  # the port was opened: what was half received before stays so
    STARTED = "started"  # a silent board was told to start again
    ASKED = "asked"  # an instrument was sent the question in `data`; what arrives next is its answer
    DATA = "data"  # bytes arrived
    TARE = "tare"  # a new zero was asked for, or found
    TOOL = "tool"  # another tool is held, or none


@dataclass(frozen=True, slots=True)
class RawEvent:
    """One thing that a parser was told at t_ns (monotonic clock); `data` are the bytes, or what belongs to its kind."""

    kind: InputKind
    t_ns: int
    data: bytes = b""


Tap: TypeAlias = Callable[[RawEvent], None]


def no_tap(_told: RawEvent) -> None:
    """Hear of an input and let it go."""
