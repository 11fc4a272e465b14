"""The bytes of the pipe between the daemon and the robot's own process: typed, length-prefixed, strictly decoded.

A message is a header (length of the body, number, kind) and its fields as JSON, written and checked by pydantic in one
pass; its strict mode for JSON takes neither a missing field nor an unknown one nor a value of another type. Of a state,
which crosses up to 125 times a second, only what is no number is JSON, and that is nearly always the same as before.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Final, TypeVar

from pydantic import TypeAdapter, ValidationError

from drivers.errors import ProtocolError
from drivers.ur.messages import (
    STRICT,
    Configure,
    Disconnect,
    Ease,
    Enable,
    Failed,
    Heartbeat,
    Message,
    MotionKind,
    MoveLinear,
    Phase,
    Reply,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)

T = TypeVar("T")

_MOTIONS: Final[tuple[MotionKind, ...]] = ("idle", "wrist", "linear", "stopping")


@dataclass(frozen=True, slots=True)
class _Words:
    """What of a state is no number."""

    __pydantic_config__: ClassVar = STRICT

    blocked: str
    ended: str
    sent: WristSpeed | MoveLinear | Stop | None
    clipped: tuple[str, ...]


# The numbers of a state in the order of its fields, its four vectors as one: t_mono_ns, timestamp_s, age_ns, vectors,
# modes, speed_scaling, wrist_torque_nm, motion_id, cycle, motion, flags.
_NUMBERS = struct.Struct("<qdq24diiiddIQB5?")

_KINDS: Final[tuple[type[Message], ...]] = (
    WristSpeed, MoveLinear, Stop, ZeroForceTorque, Enable, Unlock, Disconnect,
    Reply, RobotState, Configure, Heartbeat, Ease, Phase, Failed,
)  # fmt: skip
_ADAPTERS: Final[tuple[TypeAdapter[Message], ...]] = tuple(TypeAdapter(kind) for kind in _KINDS)
_CODES: Final = {kind: code for code, kind in enumerate(_KINDS)}
_STATE: Final = _CODES[RobotState]
_WORDS: Final = TypeAdapter(_Words)
_HEADER = struct.Struct("<IIB")
# The largest message, a state with every reason for clipping, has some 2 kB; more is not ours.
LARGEST_BODY = 1 << 16


def encode(message: Message, number: int = 0) -> bytes:
    """Return a message with its header; `number` pairs a command with its reply."""
    code = _CODES[type(message)]
    body = _state_body(message) if isinstance(message, RobotState) else _ADAPTERS[code].dump_json(message)
    return _HEADER.pack(len(body), number, code) + body


class Decoder:
    """Cuts a byte stream into messages."""

    def __init__(self) -> None:
        """Start empty."""
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[tuple[int, Message]]:
        """Return the (number, message) pairs that are complete now.

        Raises:
            ProtocolError: the stream is not one of ours, or a message does not have its type's fields and values.
        """
        self._buffer += data
        messages = []
        while len(self._buffer) >= _HEADER.size:
            length, number, code = _HEADER.unpack_from(self._buffer)
            if length > LARGEST_BODY or code >= len(_KINDS):
                raise ProtocolError(f"The robot's pipe carries no message of ours: kind {code}, {length} bytes.")
            end = _HEADER.size + length
            if len(self._buffer) < end:
                break
            messages.append((number, _decode(code, bytes(self._buffer[_HEADER.size : end]))))
            del self._buffer[:end]
        return messages


def _decode(code: int, body: bytes) -> Message:
    if code == _STATE:
        return _state(body)
    return _checked(_ADAPTERS[code], body, _KINDS[code].__name__)


def _checked(adapter: TypeAdapter[T], body: bytes, name: str) -> T:
    try:
        return adapter.validate_json(body)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ProtocolError(f"The robot's pipe carries a bad {name}: {where} {first['msg']}.") from error


def _state_body(state: RobotState) -> bytes:
    return _NUMBERS.pack(
        state.t_mono_ns, state.timestamp_s, state.age_ns,
        *state.q_rad, *state.qd_rad_per_s, *state.tcp_pose, *state.wrench,
        state.robot_mode, state.safety_mode, state.runtime_state, state.speed_scaling, state.wrist_torque_nm,
        state.motion_id, state.cycle, _MOTIONS.index(state.motion),
        state.connected, state.moving_linearly, state.protective_stop, state.emergency_stop, state.recovering,
    ) + _words_body(state.blocked, state.ended, state.sent, state.clipped)  # fmt: skip


@lru_cache(maxsize=4)
def _words_body(
    blocked: str, ended: str, sent: WristSpeed | MoveLinear | Stop | None, clipped: tuple[str, ...]
) -> bytes:
    return _WORDS.dump_json(_Words(blocked, ended, sent, clipped))


@lru_cache(maxsize=4)
def _words(body: bytes) -> _Words:
    return _checked(_WORDS, body, RobotState.__name__)


def _state(body: bytes) -> RobotState:
    if len(body) < _NUMBERS.size:
        raise ProtocolError(f"The robot's pipe carries a bad RobotState: {len(body)} bytes.")
    (
        t_mono_ns, timestamp_s, age_ns, *v, robot_mode, safety_mode, runtime_state, speed_scaling, wrist_torque_nm,
        motion_id, cycle, motion, connected, moving_linearly, protective_stop, emergency_stop, recovering,
    ) = _NUMBERS.unpack_from(body)  # fmt: skip
    if motion >= len(_MOTIONS):
        raise ProtocolError(f"The robot's pipe carries a bad RobotState: there is no motion {motion}.")
    words = _words(body[_NUMBERS.size :])
    return RobotState(
        t_mono_ns, timestamp_s, age_ns, connected,
        (v[0], v[1], v[2], v[3], v[4], v[5]), (v[6], v[7], v[8], v[9], v[10], v[11]),
        (v[12], v[13], v[14], v[15], v[16], v[17]), (v[18], v[19], v[20], v[21], v[22], v[23]),
        robot_mode, safety_mode, runtime_state, speed_scaling, moving_linearly,
        wrist_torque_nm, protective_stop, emergency_stop, words.blocked, recovering,
        _MOTIONS[motion], motion_id, words.ended, words.sent, words.clipped, cycle,
    )  # fmt: skip
