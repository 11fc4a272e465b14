"""The messages between the daemon and the worker, and their bytes.

On the pipe each message is a line: its number, its type's name, and its fields in JSON, which pydantic checks.
"""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Final, Literal, get_args

from pydantic import TypeAdapter

from shearloop.drivers.errors import DeviceLostError, ProtocolError
from shearloop.drivers.ur.poses import tool_axis
from shearloop.drivers.ur.settings import REST_RAD_PER_S, Six, Three, UrSettings

MotionKind = Literal["idle", "wrist", "linear", "stopping"]
FailureKind = Literal[
    "unreachable", "silent", "protocol", "version", "registers-in-use", "local-control", "script", "lost", "crashed",
    "hung", "garbled", "other-limits", "not-emulated",
]  # fmt: skip

# `RobotState.end_reason` of a motion that ended as commanded; any other reason is a sentence.
ARRIVED: Final = "arrived"
STOPPED_ON_COMMAND: Final = "stopped on command"

# The longest cycle during recovery: the dashboard client waits 2.5 s for a reply, the control client 3 s for a program.
RECOVERY_HANG_S: Final = 6.0

ROBOT_MODE_POWER_OFF: Final = 3
ROBOT_MODE_IDLE: Final = 5
ROBOT_MODE_RUNNING: Final = 7
RUNTIME_STOPPING: Final = 0
RUNTIME_STOPPED: Final = 1
RUNTIME_PLAYING: Final = 2
SAFETY_NORMAL: Final = 1
SAFETY_REDUCED: Final = 2
SAFETY_PROTECTIVE_STOP: Final = 3
SAFETY_EMERGENCY_STOPS: Final = (6, 7)


# UR's RTDE guide, "Robot Mode", "Safety Mode" and "Runtime State".
ROBOT_MODES: Final = {
    -1: "no controller",
    0: "disconnected",
    1: "confirm safety",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle",
    6: "backdrive",
    7: "running",
    8: "updating",
}
SAFETY_MODES: Final = {
    1: "normal",
    2: "reduced",
    3: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "system emergency stop",
    7: "robot emergency stop",
    8: "violation",
    9: "fault",
    10: "validate joint",
    11: "undefined",
    12: "automatic mode safeguard stop",
    13: "three-position enabling stop",
}
RUNTIME_STATES: Final = {0: "stopping", 1: "stopped", 2: "playing", 3: "pausing", 4: "paused", 5: "resuming"}


class RobotLostError(DeviceLostError):
    """The robot cannot be driven, or its worker has to be replaced; `kind` says why."""

    def __init__(self, kind: FailureKind, sentence: str) -> None:
        super().__init__(sentence)
        self.kind: FailureKind = kind


def silent_sentence(host: str, seconds: float, activity: str) -> str:
    """Return the message about a controller that did not answer."""
    return (
        f"The UR controller at {host} said nothing for {seconds:.1f} s while {activity}: it is starting, hangs, or "
        "something else listens on its ports. Look at the teach pendant, and restart the controller "
        "if it hangs."
    )


class _Finite:
    """Makes pydantic refuse numbers that are not finite."""

    __slots__ = ()
    __pydantic_config__: ClassVar = {"allow_inf_nan": False}


@dataclass(frozen=True, slots=True)
class WristSpeed(_Finite):
    """Turn the tool about its axis. It holds for `command_timeout_s` after it was decided (monotonic, ns).

    A `decided_ns` of 0 stands for its arrival.
    """

    rad_per_s: float
    acceleration_rad_per_s2: float
    decided_ns: int = 0


@dataclass(frozen=True, slots=True)
class MoveLinear(_Finite):
    """Move the tool on a straight line to a pose: x, y, z in m and a rotation vector in rad, in the base frame."""

    pose: Six
    speed_m_per_s: float
    acceleration_m_per_s2: float


@dataclass(frozen=True, slots=True)
class Stop(_Finite):
    """Slow every joint down to rest."""

    deceleration_rad_per_s2: float


@dataclass(frozen=True, slots=True)
class ZeroForceTorque:
    """Make the present wrench zero; accepted only at rest."""


@dataclass(frozen=True, slots=True)
class Enable:
    """Allow motion: needed after each start of the worker and after everything that stopped the arm."""


@dataclass(frozen=True, slots=True)
class Unlock:
    """Recover from a stop on the operator's request: unlock, power on, start the control program, enable."""


@dataclass(frozen=True, slots=True)
class Held:
    """Whether a tool may load the wrench; and for a new worker the zero of the wrench that another one had.

    Sent to each new worker, and at each change.
    """

    __pydantic_config__: ClassVar = {"ser_json_inf_nan": "constants"}
    held: bool
    wrench_zero: Six | None = None


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Stop the arm, end the control program, exit."""


Command = WristSpeed | MoveLinear | Stop | ZeroForceTorque | Enable | Unlock | Disconnect


@dataclass(frozen=True, slots=True)
class CommandReply:
    """The reply to a command: what goes to the robot after clipping, or why the command is refused."""

    refusal: str = ""
    sent: WristSpeed | MoveLinear | Stop | None = None
    clipped: tuple[str, ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether the command is carried out."""
        return not self.refusal


@dataclass(frozen=True)
class RtdeOutputs:
    """The controller's outputs at one time (SI units, base frame, joints from base to wrist 3)."""

    __pydantic_config__: ClassVar = {"ser_json_inf_nan": "constants"}
    # By the controller's clock.
    timestamp_s: float
    q_rad: Six
    qd_rad_per_s: Six
    tcp_pose: Six
    tcp_speed: Six
    wrench: Six
    robot_mode: int
    safety_mode: int
    runtime_state: int
    # Factors on every commanded speed: of the pendant's speed slider, and of the controller's own limits.
    speed_slider: float
    limiter_scaling: float
    # Of the control script: 1 when ready, 2 when done with a command; its clock, and the time of one tick.
    script_state: int
    script_ticks: int
    script_step_s: float
    # The pendant's setting, at the flange; NaN where the controller does not report it.
    payload_kg: float
    payload_cog_m: Three
    tcp_offset: Six


@dataclass(frozen=True)
class RtdeSample(RtdeOutputs):
    """The controller's latest outputs and its connection's state."""

    # When it was read, by CLOCK_MONOTONIC, and the time since the controller made the sample, by its own clock.
    read_ns: int
    age_ns: int
    connected: bool
    moving_linearly: bool
    # A joint slower than this is at rest.
    rest_rad_per_s: float = field(default=REST_RAD_PER_S, kw_only=True)

    @property
    def measured_ns(self) -> int:
        """When the controller made the sample; a sample that is read again keeps its time."""
        return self.read_ns - self.age_ns

    @property
    def program_running(self) -> bool:
        """Whether the control program plays."""
        return self.runtime_state == RUNTIME_PLAYING

    @property
    def has_program(self) -> bool:
        """Whether a program is on the robot: it plays, is paused, or is pausing or resuming."""
        return self.runtime_state not in (RUNTIME_STOPPING, RUNTIME_STOPPED)

    @property
    def program_paused(self) -> bool:
        """Whether a program is paused, or is pausing or resuming."""
        return self.has_program and not self.program_running

    @property
    def robot_mode_name(self) -> str:
        """The robot mode in words."""
        return ROBOT_MODES.get(self.robot_mode, f"unknown mode {self.robot_mode}")

    @property
    def safety_mode_name(self) -> str:
        """The safety mode in words."""
        return SAFETY_MODES.get(self.safety_mode, f"unknown mode {self.safety_mode}")

    @property
    def runtime_name(self) -> str:
        """The state of the program in words."""
        return RUNTIME_STATES.get(self.runtime_state, f"unknown state {self.runtime_state}")

    @property
    def speed_scaling(self) -> float:
        """The fraction of a commanded speed that the controller carries out."""
        return self.speed_slider * self.limiter_scaling

    @property
    def protective_stop(self) -> bool:
        """Whether a protective stop holds the arm."""
        return self.safety_mode == SAFETY_PROTECTIVE_STOP

    @property
    def emergency_stop(self) -> bool:
        """Whether an emergency stop holds the arm."""
        return self.safety_mode in SAFETY_EMERGENCY_STOPS

    @property
    def rests(self) -> bool:
        """Whether every joint is at rest."""
        return self.fastest_rad_per_s < self.rest_rad_per_s

    @property
    def fastest_rad_per_s(self) -> float:
        """The speed of the fastest joint."""
        return max(map(abs, self.qd_rad_per_s))

    @property
    def tcp_speed_m_per_s(self) -> float:
        """The speed of the tool centre point."""
        return math.hypot(*self.tcp_speed[:3])

    @property
    def wrist_rad(self) -> float:
        """The angle of wrist 3, about which the tool twists."""
        return self.q_rad[5]

    @property
    def wrist_speed_rad_per_s(self) -> float:
        """The speed of wrist 3."""
        return self.qd_rad_per_s[5]

    @property
    def wrist_torque_nm(self) -> float:
        """The torque about the tool's own axis, from wrench and pose."""
        x, y, z = tool_axis(self.tcp_pose)
        _, _, _, torque_x, torque_y, torque_z = self.wrench
        return x * torque_x + y * torque_y + z * torque_z


@dataclass(frozen=True)
class RobotState(RtdeSample):
    """A sample and the state of the driver; `robot.state` has a part of it."""

    # Why motion is refused at present; empty when it is enabled.
    blocked: str
    # Whether motion is refused for want of `Enable` alone.
    awaits_enable: bool
    # Whether messages that came late can be why motion is refused.
    late: bool
    # Whether the robot is being unlocked, powered or started.
    recovering: bool
    motion: MotionKind
    # Number of the command that began the motion, and why the motion ended (`ARRIVED` when as commanded).
    motion_id: int
    end_reason: str
    # The last command sent to the robot, after clipping, and every reason for clipping it.
    sent: WristSpeed | MoveLinear | Stop | None
    clipped: tuple[str, ...]
    # Number of the worker's cycle.
    cycle: int
    # What `wrench` is measured from, where the controller's own zero is another one.
    wrench_zero: Six


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The daemon has decided that a straight move goes on."""


@dataclass(frozen=True, slots=True)
class WorkerPhase:
    """What the worker is about to do; sent first, because it may hang or crash there.

    `warning` is what the operator has to know of the controller. `controller` has its version and its serial number
    once they are known.
    """

    activity: str
    warning: str = ""
    controller: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class ControllerError:
    """An error code of the controller, and how serious it calls it."""

    code: int
    argument: int
    level: str

    def __str__(self) -> str:
        """Return it as UR's list of error codes has it."""
        return f"C{self.code}A{self.argument}"


@dataclass(frozen=True, slots=True)
class Failed:
    """Why the worker exits."""

    kind: FailureKind
    sentence: str


# The settings are the first message to the worker.
Message = Command | Held | CommandReply | RobotState | UrSettings | Heartbeat | WorkerPhase | ControllerError | Failed

# The largest message, a state with every reason for clipping, has about 2 kB.
LARGEST_MESSAGE: Final = 1 << 16
_ADAPTERS: Final = {kind.__name__: TypeAdapter[Message](kind) for kind in get_args(Message)}


def encode(message: Message, number: int = 0) -> bytes:
    """Return the line of a message; `number` pairs a command with its reply."""
    name = type(message).__name__
    return b"%d %s %s\n" % (number, name.encode(), _ADAPTERS[name].dump_json(message))


class MessageDecoder:
    """Splits a byte stream into messages."""

    def __init__(self) -> None:
        self._partial = b""

    def feed(self, data: bytes) -> list[tuple[int, Message]]:
        """Return the (number, message) pairs that are complete now.

        Raises:
            ProtocolError: the stream holds something else, or a motion command that is not finite.
        """
        *lines, self._partial = (self._partial + data).split(b"\n")
        if len(self._partial) > LARGEST_MESSAGE:
            raise ProtocolError("The pipe to the worker carries a message without an end.")
        return [_decode(line) for line in lines]


def _decode(line: bytes) -> tuple[int, Message]:
    try:
        number, name, content = line.split(b" ", 2)
        return int(number), _ADAPTERS[name.decode()].validate_json(content, strict=True)
    except (ValueError, KeyError) as error:
        raise ProtocolError(f"The pipe to the worker carries an invalid message: {line[:80]!r}.") from error
