"""The bytes of the pipe between the daemon and the robot's own process: typed, length-prefixed, strictly decoded.

A message is a header (length of the body, number, kind) and its fields as JSON, written and checked by pydantic in one
pass; its strict mode for JSON takes neither a missing field nor an unknown one nor a value of another type. Of what
crosses up to 125 times a second while the wrist turns (states, wrist speeds and their replies) only the texts are JSON,
and those are nearly always the same as the time before.
"""

import struct
from functools import lru_cache
from math import isfinite
from typing import Final, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from shearloop.drivers.errors import ProtocolError
from shearloop.drivers.ur.messages import (
    CommandReply,
    Configure,
    Disconnect,
    Ease,
    Enable,
    Failed,
    Heartbeat,
    Message,
    MotionKind,
    MoveLinear,
    RobotPhase,
    RobotState,
    Stop,
    Unlock,
    WristSpeed,
    ZeroForceTorque,
)

T = TypeVar("T")

_STRICT = ConfigDict(strict=True)

_MOTIONS: Final[tuple[MotionKind, ...]] = ("idle", "wrist", "linear", "stopping")


# The numbers of a state, its four vectors as one: timestamp_s, vectors, modes, speed_scaling, t_mono_ns, age_ns,
# wrist_torque_nm, motion_id, cycle, stops_in_vain, motion, flags.
_NUMBERS = struct.Struct("<d24d3idqqdIQIB6?")
# What was last sent to the robot: its kind, and its numbers in the order of its fields.
_SENT = struct.Struct("<B8d")
_WRIST_SPEED = struct.Struct("<2d")
_NO_NUMBERS: Final = (0.0,) * 8

_KINDS: Final[tuple[type[Message], ...]] = (
    WristSpeed, MoveLinear, Stop, ZeroForceTorque, Enable, Unlock, Disconnect,
    CommandReply, RobotState, Configure, Heartbeat, Ease, RobotPhase, Failed,
)  # fmt: skip
_ADAPTERS: Final[tuple[TypeAdapter[Message], ...]] = tuple(TypeAdapter(kind) for kind in _KINDS)
_CODES: Final = {kind: code for code, kind in enumerate(_KINDS)}
_WORDS_OF_STATE: Final = TypeAdapter(tuple[str, str, tuple[str, ...]], config=_STRICT)
_WORDS_OF_REPLY: Final = TypeAdapter(tuple[str, tuple[str, ...]], config=_STRICT)
_HEADER = struct.Struct("<IIB")
# The largest message, a state with every reason for clipping, has some 2 kB; more is not ours.
LARGEST_BODY = 1 << 16


def encode(message: Message, number: int = 0) -> bytes:
    """Return a message with its header; `number` pairs a command with its reply."""
    code = _CODES[type(message)]
    match message:
        case RobotState():
            body = _state_body(message)
        case CommandReply():
            body = _sent_body(message.sent) + _words_of_reply_body(message.refused, message.clipped)
        case WristSpeed():
            body = _WRIST_SPEED.pack(message.rad_per_s, message.acceleration_rad_per_s2)
        case _:
            body = _ADAPTERS[code].dump_json(message)
    return _HEADER.pack(len(body), number, code) + body


class Decoder:
    """Cuts a byte stream into messages."""

    def __init__(self) -> None:
        """Start empty."""
        self._begun = b""

    def feed(self, data: bytes) -> list[tuple[int, Message]]:
        """Return the (number, message) pairs that are complete now.

        Raises:
            ProtocolError: the stream is not one of ours, or a message does not have its type's fields and values.
        """
        # Nearly always nothing had begun, and nothing is copied.
        data = self._begun + data
        messages: list[tuple[int, Message]] = []
        start, ready = 0, _HEADER.size
        while len(data) >= ready:
            length, number, code = _HEADER.unpack_from(data, start)
            if length > LARGEST_BODY or code >= len(_KINDS):
                raise ProtocolError(f"The robot's pipe carries no message of ours: kind {code}, {length} bytes.")
            body, end = ready, ready + length
            if len(data) < end:
                break
            messages.append((number, _decode(code, data[body:end])))
            start, ready = end, end + _HEADER.size
        self._begun = data[start:]
        return messages


def _decode(code: int, body: bytes) -> Message:
    kind = _KINDS[code]
    try:
        if kind is RobotState:
            return _state(body)
        if kind is CommandReply:
            sent = _sent(body[: _SENT.size])
            refused, clipped = _words_of_reply(body[_SENT.size :])
            return CommandReply(refused, sent, clipped)
        if kind is WristSpeed:
            return _wrist_speed(*_WRIST_SPEED.unpack(body))
    except struct.error as error:
        raise ProtocolError(f"The robot's pipe carries a bad {kind.__name__}: {len(body)} bytes.") from error
    except ValueError as error:
        raise ProtocolError(f"The robot's pipe carries a bad {kind.__name__}: {error}.") from error
    return _checked(_ADAPTERS[code], body, kind.__name__)


def _checked(adapter: TypeAdapter[T], body: bytes, name: str) -> T:
    try:
        return adapter.validate_json(body)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ProtocolError(f"The robot's pipe carries a bad {name}: {where} {first['msg']}.") from error


def _state_body(state: RobotState) -> bytes:
    return _NUMBERS.pack(
        state.timestamp_s, *state.q_rad, *state.qd_rad_per_s, *state.tcp_pose, *state.wrench,
        state.robot_mode, state.safety_mode, state.runtime_state, state.speed_scaling,
        state.t_mono_ns, state.age_ns, state.wrist_torque_nm,
        state.motion_id, state.cycle, state.stops_in_vain, _MOTIONS.index(state.motion),
        state.connected, state.moving_linearly, state.protective_stop, state.emergency_stop, state.recovering,
        state.ours,
    ) + _sent_body(state.sent) + _words_of_state_body(state.blocked, state.ended, state.clipped)  # fmt: skip


def _sent_body(sent: WristSpeed | MoveLinear | Stop | None) -> bytes:
    match sent:
        case WristSpeed():
            return _SENT.pack(1, sent.rad_per_s, sent.acceleration_rad_per_s2, *_NO_NUMBERS[2:])
        case MoveLinear():
            return _SENT.pack(2, *sent.pose, sent.speed_m_per_s, sent.acceleration_m_per_s2)
        case Stop():
            return _SENT.pack(3, sent.deceleration_rad_per_s2, *_NO_NUMBERS[1:])
    return _SENT.pack(0, *_NO_NUMBERS)


# A reply and the state after it carry the same one, and at rest it does not change at all.
@lru_cache(maxsize=4)
def _sent(packed: bytes) -> WristSpeed | MoveLinear | Stop | None:
    kind, *numbers = _SENT.unpack(packed)
    a, b, c, d, e, f, speed, acceleration = _finite(tuple(numbers))
    match kind:
        case 0:
            return None
        case 1:
            return WristSpeed(a, b)
        case 2:
            return MoveLinear((a, b, c, d, e, f), speed, acceleration)
        case 3:
            return Stop(a)
    raise ValueError(f"there is no motion {kind} that could have been sent")


def _wrist_speed(*numbers: float) -> WristSpeed:
    return WristSpeed(*_finite(numbers))


def _finite(numbers: tuple[float, ...]) -> tuple[float, ...]:
    if not all(map(isfinite, numbers)):
        raise ValueError("it asks for what is no finite number")
    return numbers


@lru_cache(maxsize=4)
def _words_of_state_body(blocked: str, ended: str, clipped: tuple[str, ...]) -> bytes:
    return _WORDS_OF_STATE.dump_json((blocked, ended, clipped))


@lru_cache(maxsize=4)
def _words_of_state(body: bytes) -> tuple[str, str, tuple[str, ...]]:
    return _checked(_WORDS_OF_STATE, body, RobotState.__name__)


@lru_cache(maxsize=4)
def _words_of_reply_body(refused: str, clipped: tuple[str, ...]) -> bytes:
    return _WORDS_OF_REPLY.dump_json((refused, clipped))


@lru_cache(maxsize=4)
def _words_of_reply(body: bytes) -> tuple[str, tuple[str, ...]]:
    return _checked(_WORDS_OF_REPLY, body, CommandReply.__name__)


def _state(body: bytes) -> RobotState:
    numbers = _NUMBERS.unpack_from(body)
    (
        robot_mode, safety_mode, runtime_state, speed_scaling, t_mono_ns, age_ns,
        wrist_torque_nm, motion_id, cycle, stops_in_vain, motion,
        connected, moving_linearly, protective_stop, emergency_stop, recovering, ours,
    ) = numbers[25:]  # fmt: skip
    if motion >= len(_MOTIONS):
        raise ValueError(f"there is no motion {motion}")
    sent = _sent(body[_NUMBERS.size : _NUMBERS.size + _SENT.size])
    blocked, ended, clipped = _words_of_state(body[_NUMBERS.size + _SENT.size :])
    return RobotState(
        numbers[0], numbers[1:7], numbers[7:13], numbers[13:19], numbers[19:25],
        robot_mode, safety_mode, runtime_state, speed_scaling, t_mono_ns, age_ns, connected, moving_linearly,
        wrist_torque_nm, protective_stop, emergency_stop, blocked, recovering,
        _MOTIONS[motion], motion_id, ended, sent, clipped, cycle, ours, stops_in_vain,
    )  # fmt: skip
