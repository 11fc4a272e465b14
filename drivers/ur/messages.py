"""What crosses the pipe between the daemon and the robot's own process: typed, length-prefixed, strictly decoded.

A message is a header (length of the body, number, kind) and its fields as JSON, written and checked by pydantic in one
pass; its strict mode for JSON takes neither a missing field nor an unknown one nor a value of another type. Of a state,
which crosses 125 times a second, only what is no number is JSON, and that is the same as the time before nearly always.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Final, Literal, TypeVar

from pydantic import TypeAdapter, ValidationError

from drivers.errors import ProtocolError
from drivers.ur.settings import Six, UrSettings

T = TypeVar("T")

MotionKind = Literal["idle", "wrist", "linear", "stopping"]
FailureKind = Literal["not-installed", "unreachable", "silent", "version", "registers-in-use", "local-control", "lost"]

_FINITE: dict[str, object] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}
# What the controller reports is passed on even where it is no number; `limits.violation` then says so.
_STRICT: dict[str, object] = {"extra": "forbid", "strict": True, "ser_json_inf_nan": "constants"}


@dataclass(frozen=True, slots=True)
class WristSpeed:
    """Turn the tool about its axis; holds for `command_timeout_s`, then has to be commanded again."""

    __pydantic_config__: ClassVar = _FINITE

    rad_per_s: float
    acceleration_rad_per_s2: float


@dataclass(frozen=True, slots=True)
class MoveLinear:
    """Move the tool on a straight line to a pose: x, y, z in m and the rotation vector in rad, in the base frame."""

    __pydantic_config__: ClassVar = _FINITE

    pose: Six
    speed_m_per_s: float
    acceleration_m_per_s2: float


@dataclass(frozen=True, slots=True)
class Stop:
    """Slow every joint down to rest, whatever moves."""

    __pydantic_config__: ClassVar = _FINITE

    deceleration_rad_per_s2: float


@dataclass(frozen=True, slots=True)
class ZeroForceTorque:
    """Take the present wrench as zero; only at rest."""

    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class Enable:
    """Allow motion: after every start of the robot's process, and after everything that stopped the arm."""

    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class Unlock:
    """The operator's word after a protective or emergency stop: unlock, power, start the control program, enable."""

    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Stop, end the control program, go."""

    __pydantic_config__: ClassVar = _STRICT


Command = WristSpeed | MoveLinear | Stop | ZeroForceTorque | Enable | Unlock | Disconnect


@dataclass(frozen=True, slots=True)
class Reply:
    """The one answer to a command: what is sent to the robot after clipping, or why nothing is."""

    __pydantic_config__: ClassVar = _STRICT

    refused: str = ""
    sent: WristSpeed | MoveLinear | Stop | None = None
    clipped: tuple[str, ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether the command is carried out."""
        return not self.refused


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of the controller: SI units, base frame, joints from base to wrist 3."""

    __pydantic_config__: ClassVar = _STRICT

    t_mono_ns: int
    timestamp_s: float
    # How long ago the controller's timestamp last changed; a connection can be open and the data old.
    age_ns: int
    connected: bool
    q_rad: Six
    qd_rad_per_s: Six
    tcp_pose: Six
    wrench: Six
    robot_mode: int
    safety_mode: int
    runtime_state: int
    speed_scaling: float
    moving_linearly: bool

    @property
    def program_running(self) -> bool:
        """Whether the control program plays."""
        return self.runtime_state == RUNTIME_PLAYING

    @property
    def rests(self) -> bool:
        """Whether every joint rests."""
        return all(abs(speed) < REST_RAD_PER_S for speed in self.qd_rad_per_s)

    @property
    def fastest_rad_per_s(self) -> float:
        """The speed of the fastest joint."""
        return max(map(abs, self.qd_rad_per_s))

    @property
    def wrist_rad(self) -> float:
        """The angle of wrist 3, about which the tool twists."""
        return self.q_rad[5]


@dataclass(frozen=True, slots=True)
class RobotState(Reading):
    """A reading and what the driver makes of it; published as `robot.state`."""

    # Torque about the tool's own axis, from wrench and pose.
    wrist_torque_nm: float
    protective_stop: bool
    emergency_stop: bool
    # Why motion is refused at present; empty when it is enabled.
    blocked: str
    # Whether the robot is being unlocked, powered or started.
    recovering: bool
    motion: MotionKind
    # Number of the command that the motion belongs to, and why its motion ended ("arrived" when as asked).
    motion_id: int
    ended: str
    # What was last sent to the robot, after clipping, and every reason for clipping it.
    sent: WristSpeed | MoveLinear | Stop | None
    clipped: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Configure:
    """The first message to the process."""

    __pydantic_config__: ClassVar = _STRICT

    settings: UrSettings
    # Whether a program that runs on the robot is one that a process before this one has just left behind.
    takes_over: bool = False


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The daemon is alive."""

    __pydantic_config__: ClassVar = _STRICT


@dataclass(frozen=True, slots=True)
class Phase:
    """What the process is about to do, said before doing it: it may hang or crash there."""

    __pydantic_config__: ClassVar = _STRICT

    doing: str


@dataclass(frozen=True, slots=True)
class Failed:
    """Why the process ends."""

    __pydantic_config__: ClassVar = _STRICT

    kind: FailureKind
    sentence: str


Message = Command | Reply | RobotState | Configure | Heartbeat | Phase | Failed

# Why a motion ended that did as it was asked, or was told to stop; any other reason is a sentence of its own.
ARRIVED: Final = "arrived"
STOPPED_ON_COMMAND: Final = "stopped on command"

# Slower than this, a joint rests: below it lies the noise of a real arm's speed signal.
REST_RAD_PER_S: Final = 2e-3

# How long a cycle may take while recovering: the dashboard's client waits 2.5 s for an answer, the control client 3 s
# for a ready program.
RECOVERY_HANG_S: Final = 6.0

ROBOT_MODE_POWER_OFF: Final = 3
ROBOT_MODE_IDLE: Final = 5
ROBOT_MODE_RUNNING: Final = 7
RUNTIME_STOPPED: Final = 1
RUNTIME_PLAYING: Final = 2
SAFETY_NORMAL: Final = 1
SAFETY_REDUCED: Final = 2
SAFETY_PROTECTIVE_STOP: Final = 3
SAFETY_EMERGENCY_STOPS: Final = (6, 7)

_MOTIONS: Final[tuple[MotionKind, ...]] = ("idle", "wrist", "linear", "stopping")


@dataclass(frozen=True, slots=True)
class _Words:
    """What of a state is no number."""

    __pydantic_config__: ClassVar = _STRICT

    blocked: str
    ended: str
    sent: WristSpeed | MoveLinear | Stop | None
    clipped: tuple[str, ...]


# The numbers of a state in the order of its fields, its four vectors as one: t_mono_ns, timestamp_s, age_ns, vectors,
# modes, speed_scaling, wrist_torque_nm, motion_id, motion, flags.
_NUMBERS = struct.Struct("<qdq24diiiddIB5?")

_KINDS: Final[tuple[type[Message], ...]] = (
    WristSpeed, MoveLinear, Stop, ZeroForceTorque, Enable, Unlock, Disconnect,
    Reply, RobotState, Configure, Heartbeat, Phase, Failed,
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
        state.motion_id, _MOTIONS.index(state.motion),
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
        motion_id, motion, connected, moving_linearly, protective_stop, emergency_stop, recovering,
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
        _MOTIONS[motion], motion_id, words.ended, words.sent, words.clipped,
    )  # fmt: skip
