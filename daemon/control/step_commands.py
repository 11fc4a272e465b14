"""What an experiment sees at each tick, and what it may wish for. Values only; somebody else carries them out."""

from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Hold:
    """The wrist stands."""


@dataclass(frozen=True, slots=True)
class MoveToAngle:
    """The wrist turns to an angle, measured from where the tool was gripped, no faster than this."""

    angle_rad: float
    speed_rad_per_s: float


@dataclass(frozen=True, slots=True)
class ConstantVelocity:
    """The wrist turns on at a speed, counterclockwise positive."""

    speed_rad_per_s: float


@dataclass(frozen=True, slots=True)
class TrackTorque:
    """The wrist follows a torque set point in closed loop."""

    torque_nm: float
    ramp_nm_per_s: float


WristSetpoint: TypeAlias = Hold | MoveToAngle | ConstantVelocity | TrackTorque


@dataclass(frozen=True, slots=True)
class MoveTo:
    """Move the tool centre in a straight line: to a pose, or, without one, so far along the tool's own axis."""

    pose_m_rad: tuple[float, ...] | None
    speed_m_per_s: float
    along_tool_m: float = 0.0


@dataclass(frozen=True, slots=True)
class GripTo:
    """Close or open the gripper."""

    width_mm: float
    speed_mm_per_s: float
    force_n: float
    expect_object: bool


@dataclass(frozen=True, slots=True)
class Tare:
    """Tare every torque sensor, with the wrist standing still."""


@dataclass(frozen=True, slots=True)
class IdentifyStiffness:
    """Identify stiffness, delay and noise with small twists."""

    amplitude_rad: float


Action: TypeAlias = MoveTo | GripTo | Tare | IdentifyStiffness


class ActionState(Enum):
    """How far the action that was wished for has come."""

    IDLE = "idle"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class StepContext:
    """What the experiment sees: the wrist from where the tool was gripped, the driving torque, its own action.

    `gripped_at_rad` is the wrist joint's own angle where the tool was gripped; `torque_nm` is None while no valid
    estimate is fresh.
    """

    wrist_rad: float
    torque_nm: float | None
    gripped_at_rad: float = 0.0
    action: ActionState = ActionState.IDLE
    failure: str = ""


@dataclass(frozen=True, slots=True)
class StepCommand:
    """What the experiment wants now.

    An action is begun when it is first wished for; `number`, the step's, tells two equal actions apart. From the next
    `StepContext` on, `StepContext.action` tells of it. `hold` numbers the angles or torques of a step while they are
    held, from 1.
    """

    wrist: WristSetpoint = Hold()
    action: Action | None = None
    doing: str = ""
    number: int = -1
    hold: int = 0
