"""What crosses the pipe between the daemon and the robot's own process, as values; `shearloop.drivers.ur.wire` has
the bytes."""

from dataclasses import dataclass
from typing import Final, Literal

from shearloop.drivers.ur.settings import Six, UrSettings

MotionKind = Literal["idle", "wrist", "linear", "stopping"]
FailureKind = Literal["not-installed", "unreachable", "silent", "version", "registers-in-use", "local-control", "lost"]


@dataclass(frozen=True, slots=True)
class WristSpeed:
    """Turn the tool about its axis; holds for `command_timeout_s`, then has to be commanded again."""

    rad_per_s: float
    acceleration_rad_per_s2: float


@dataclass(frozen=True, slots=True)
class MoveLinear:
    """Move the tool on a straight line to a pose: x, y, z in m and the rotation vector in rad, in the base frame."""

    pose: Six
    speed_m_per_s: float
    acceleration_m_per_s2: float


@dataclass(frozen=True, slots=True)
class Stop:
    """Slow every joint down to rest, whatever moves."""

    deceleration_rad_per_s2: float


@dataclass(frozen=True, slots=True)
class ZeroForceTorque:
    """Take the present wrench as zero; only at rest."""


@dataclass(frozen=True, slots=True)
class Enable:
    """Allow motion: after every start of the robot's process, and after everything that stopped the arm."""


@dataclass(frozen=True, slots=True)
class Unlock:
    """The operator's word after a protective or emergency stop: unlock, power, start the control program, enable."""


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Stop, end the control program, go."""


Command = WristSpeed | MoveLinear | Stop | ZeroForceTorque | Enable | Unlock | Disconnect


@dataclass(frozen=True, slots=True)
class CommandReply:
    """The one answer to a command: what is sent to the robot after clipping, or why nothing is."""

    refused: str = ""
    sent: WristSpeed | MoveLinear | Stop | None = None
    clipped: tuple[str, ...] = ()

    @property
    def accepted(self) -> bool:
        """Whether the command is carried out."""
        return not self.refused


@dataclass(frozen=True, slots=True)
class Sample:
    """What the controller says of itself at one time: SI units, base frame, joints from base to wrist 3."""

    # By the controller's own clock.
    timestamp_s: float
    q_rad: Six
    qd_rad_per_s: Six
    tcp_pose: Six
    wrench: Six
    robot_mode: int
    safety_mode: int
    runtime_state: int
    speed_scaling: float


@dataclass(frozen=True, slots=True)
class RtdeSample(Sample):
    """The controller's latest sample as it was read here, and what is known of the connection."""

    t_mono_ns: int
    # How long ago the controller made the sample, by its own clock: it can be new to us, and have waited.
    age_ns: int
    connected: bool
    moving_linearly: bool

    @property
    def program_running(self) -> bool:
        """Whether the control program plays."""
        return self.runtime_state == RUNTIME_PLAYING

    @property
    def program_paused(self) -> bool:
        """Whether a program is there that neither plays nor ends: it was paused, or is on its way there or back."""
        return self.runtime_state not in (RUNTIME_STOPPING, RUNTIME_STOPPED, RUNTIME_PLAYING)

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
class RobotState(RtdeSample):
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
    # Number of the process's cycle.
    cycle: int
    # Whether a program on the robot is one that was started here, or that a process before has left behind.
    ours: bool
    # How many times such a program was paused, asked to stop, and did not.
    stops_in_vain: int


@dataclass(frozen=True, slots=True)
class Configure:
    """The first message to the process."""

    settings: UrSettings
    # Whether a program that runs on the robot is one that a process before this one has just left behind.
    takes_over: bool = False


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The daemon is alive."""


@dataclass(frozen=True, slots=True)
class RobotPhase:
    """What the process is about to do, said before doing it: it may hang or crash there."""

    doing: str


@dataclass(frozen=True, slots=True)
class Failed:
    """Why the process ends."""

    kind: FailureKind
    sentence: str


Message = Command | CommandReply | RobotState | Configure | Heartbeat | RobotPhase | Failed

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
RUNTIME_STOPPING: Final = 0
RUNTIME_STOPPED: Final = 1
RUNTIME_PLAYING: Final = 2
SAFETY_NORMAL: Final = 1
SAFETY_REDUCED: Final = 2
SAFETY_PROTECTIVE_STOP: Final = 3
SAFETY_EMERGENCY_STOPS: Final = (6, 7)
