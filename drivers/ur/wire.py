"""The bytes of the pipe between the daemon and the robot's process, in msgpack.

Each message is `[number, message]`. A dataclass is an extension type with its fields in order.
"""

import math
from dataclasses import fields
from operator import attrgetter
from typing import Any, Final

import msgpack

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur.messages import (
    CommandReply,
    Configure,
    Disconnect,
    Enable,
    Failed,
    Heartbeat,
    Message,
    MoveLinear,
    RobotPhase,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)
from shearloop.drivers.ur.settings import Bound, JointRange, UrLimits, UrSettings, Workspace

# The largest message has some 2 kB.
LARGEST_MESSAGE: Final = 1 << 16

_MOTIONS: Final = (WristSpeed, MoveLinear, Stop)
_TYPES: Final[tuple[Any, ...]] = (
    *_MOTIONS, ZeroForceTorque, Enable, Unlock, Disconnect, CommandReply, RobotState, Configure, Heartbeat, RobotPhase,
    Failed, UrSettings, UrLimits, Bound, JointRange, Workspace,
)  # fmt: skip
_CODES: Final = {kind: code for code, kind in enumerate(_TYPES)}
_NAMES: Final = {kind: [field.name for field in fields(kind)] for kind in _TYPES}
# An attrgetter is ten times as fast as a loop, but returns no tuple of fewer than two.
_FIELDS: Final = {kind: attrgetter(*names) for kind, names in _NAMES.items() if len(names) > 1}


def encode(message: Message, number: int = 0) -> bytes:
    """Return the bytes of a message; `number` pairs a command with its reply."""
    packed: bytes = msgpack.packb((number, message), default=_packed, buf_size=4096)
    return packed


def _packed(value: Any) -> msgpack.ExtType:
    kind = type(value)
    content = _FIELDS[kind](value) if kind in _FIELDS else [getattr(value, name) for name in _NAMES[kind]]
    return msgpack.ExtType(_CODES[kind], msgpack.packb(content, default=_packed, buf_size=4096))


def _unpacked(code: int, data: bytes) -> Any:
    content = msgpack.unpackb(data, use_list=False, ext_hook=_unpacked)
    kind = _TYPES[code]
    if kind in _MOTIONS and not _is_finite(content):
        raise ValueError(f"{kind.__name__} {content} is not finite")
    return kind(*content)


def _is_finite(value: Any) -> bool:
    return all(map(_is_finite, value)) if isinstance(value, tuple) else math.isfinite(value)


class Decoder:
    """Cuts a byte stream into messages."""

    def __init__(self) -> None:
        """Start empty."""
        self._unpacker = msgpack.Unpacker(use_list=False, ext_hook=_unpacked, max_buffer_size=2 * LARGEST_MESSAGE)

    def feed(self, data: bytes) -> list[tuple[int, Message]]:
        """Return the (number, message) pairs that are complete now.

        Raises:
            ProtocolError: the stream holds something else, or a motion command that is not finite.
        """
        try:
            self._unpacker.feed(data)
            pairs = list(self._unpacker)
        except (ValueError, TypeError, IndexError, RecursionError, msgpack.UnpackException) as error:
            raise ProtocolError(f"The robot's pipe carries an invalid message: {error}.") from error
        for pair in pairs:
            match pair:
                case (int(), message) if isinstance(message, Message):
                    continue
            raise ProtocolError(f"The robot's pipe carries {pair!r}, which is no message.")
        return pairs
