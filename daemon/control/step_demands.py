"""What each step demands: its largest torque and angle, and its times."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ApproachStep,
    ExperimentFile,
    GripperStep,
    GripStep,
    HoldTorqueStep,
    IdentifyStep,
    ReleaseStep,
    Step,
    TareStep,
    TightenStep,
    TurnToStep,
    TwistStep,
    WaitStep,
)
from shearloop.daemon.control.known_tool import AT_REST, Interval, KnownTool, known_after
from shearloop.daemon.control.step_motions import AS_ASKED, Speeds
from shearloop.drivers.ranges import LARGEST_ANGLE_RAD
from shearloop.drivers.robotiq.models import LARGEST_STROKE_MM
from shearloop.drivers.ur.poses import ONLY_TURNS_M, along_tool, turn_between
from shearloop.drivers.ur.settings import UrLimits

# The reach of the largest UR arm.
_REACH_M: Final = 1.75
# A motion of the fingers at their default speed, and the time to begin one and to see its end.
_FINGERS_S, _BEGINS_S = 3.0, 0.7
# A reset and a pause, and the fingers open and close once.
_ACTIVATES_S = 5.0
# How far a turn to an angle of the wrist joint goes, as a guess: without a tool, and as a twist.
_GUESSED_TURN_RAD, _GUESSED_TWIST_RAD = 1.0, 0.2
# At 0.5 rad/s, and with the noise of a fingertip, motions take up to a fifth longer than planned.
_ACCURACY = 1.2


class Demand(NamedTuple):
    """The largest torque (N·m) and angle from the grip (rad) of a step, its longest turn (rad), and its times.

    It stands still for `stands_s` in all. Everything else takes about `moves_s`, and at most `longest_moves_s`. Where
    the step begins from an unknown state, `depends_on` names that state, `moves_s` is a guess, and `turn_rad` a bound.
    """

    torque_nm: float = 0.0
    angle_rad: float = 0.0
    stands_s: float = 0.0
    moves_s: float = 0.0
    longest_moves_s: float = 0.0
    turn_rad: float = 0.0
    depends_on: str = ""

    @property
    def takes_s(self) -> float:
        """About how long the step takes."""
        return self.stands_s + self.moves_s

    @property
    def longest_s(self) -> float:
        """How long the step may take."""
        return self.stands_s + max(self.moves_s, self.longest_moves_s)

    @property
    def safe_timeout_s(self) -> float:
        """The shortest timeout that does not stop the step: a motion takes somewhat longer than planned."""
        return self.stands_s + _ACCURACY * max(self.moves_s, self.longest_moves_s)


# The wrist slows down as it comes near an angle or a torque. At the default bandwidth this adds 0.3 s to a turn at
# 0.1 rad/s, and 0.7 s to one at 0.5 rad/s.
SETTLES_S: Final = 0.5


class Before(NamedTuple):
    """The known state before a step, and the limits that bound the unknown one."""

    tool: KnownTool = AT_REST
    # The tool's pose; None for an unknown one.
    pose_m_rad: Sequence[float] | None = None
    limit_nm: float = math.inf
    limit_rad: float = math.inf
    robot: UrLimits | None = None
    # Whether the gripper may be inactive, as after a loss of power: a release activates it then.
    may_be_inactive: bool = False


NOTHING_BEFORE: Final = Before()


def demands(
    file: ExperimentFile, speeds: Speeds = AS_ASKED, start: KnownTool = AT_REST, robot: UrLimits | None = None
) -> Iterator[Demand]:
    """Yield the demand of each step after those before it."""
    tool, pose_m_rad, may_be_inactive = start, None, True
    for step in file.steps:
        limits = file.limits_of(step)
        before = Before(tool, pose_m_rad, limits.torque_nm, limits.angle_rad, robot, may_be_inactive)
        yield demand(step, speeds, before)
        may_be_inactive = may_be_inactive and not isinstance(step, GripperStep)
        # A `tighten` may end at its angle, without its torque.
        tool, pose_m_rad = known_after(step, tool, reaches=False), _pose_after(step, pose_m_rad)


def _pose_after(step: Step, pose_m_rad: Sequence[float] | None) -> Sequence[float] | None:
    """Return the tool's pose after a step, from the one before; None where it is not known."""
    match step:
        case ApproachStep(pose_m_rad=tuple() as pose):
            return pose
        case ApproachStep(along_tool_m=float() as distance_m) if pose_m_rad is not None:
            return along_tool(pose_m_rad, distance_m)
        case TwistStep(return_to_start=True):
            return pose_m_rad
        case ApproachStep() | TurnToStep() | TwistStep() | TightenStep() | HoldTorqueStep() | IdentifyStep():
            return None
    return pose_m_rad


def _line_s(step: ApproachStep, start: Sequence[float], end: Sequence[float], speeds: Speeds) -> float:
    """Return how long a straight move between two poses takes: the tool turns evenly, no faster than the wrist may."""
    speed = min(step.speed_m_per_s, speeds.linear_m_per_s)
    way_m, turn_rad = math.dist(start[:3], end[:3]), turn_between(start, end)
    if way_m <= ONLY_TURNS_M:
        # The speed is one in rad/s then.
        return turn_rad / min(speed, speeds.wrist_rad_per_s)
    return max(way_m / speed, turn_rad / speeds.wrist_rad_per_s)


def _farthest_line_s(step: ApproachStep, pose: Sequence[float], speeds: Speeds, robot: UrLimits | None) -> float:
    """Return the time of the longest straight move to a pose: across the workspace, or the reach of the largest arm."""
    place_m = pose[:3]
    farthest_m = math.hypot(*place_m) + _REACH_M
    if robot is not None:
        box = robot.box
        farthest_by_axis_m = [
            max(abs(at_m - low_m), abs(high_m - at_m))
            for at_m, low_m, high_m in zip(place_m, box.lower_m, box.upper_m, strict=True)
        ]
        farthest_m = math.hypot(*farthest_by_axis_m)
    return max(farthest_m / min(step.speed_m_per_s, speeds.linear_m_per_s), math.pi / speeds.wrist_rad_per_s)


def demand(step: Step, speeds: Speeds = AS_ASKED, before: Before = NOTHING_BEFORE) -> Demand:
    """Return the demand of a step; unknown values, as in an outline, are 0."""
    match step:
        case HoldTorqueStep(torque_nm=torque_nm):
            return _from_start(Demand(abs(torque_nm), stands_s=step.hold_s), step, speeds, before)
        case TightenStep(until_torque_nm=torque_nm, until_angle_rad=angle_rad):
            longest_s = SETTLES_S + angle_rad / min(step.speed_rad_per_s, speeds.wrist_rad_per_s)
            # At which angle it reaches its torque depends on the tool's stiffness.
            return Demand(torque_nm, angle_rad, 0.0, 0.5 * longest_s, longest_s, angle_rad)
        case IdentifyStep(amplitude_rad=angle_rad, hold_s=hold_s):
            # Two cycles at least, to half of the angle and to all of it; the first of five rests is twice as long.
            moves_s = 3.0 * angle_rad / speeds.wrist_rad_per_s + 5.0 * SETTLES_S
            # Up to eight cycles: twelve more rests, each after a turn that begins and ends gently. To sample each swing
            # at other phases, the rests are longer by up to 0.75 periods of the torque.
            longer_s = 12.0 * (angle_rad / speeds.wrist_rad_per_s + hold_s + 2.0 * SETTLES_S) + 6.0
            return Demand(0.0, angle_rad, 6.0 * hold_s, moves_s, moves_s + longer_s, angle_rad)
        case TwistStep(angles_rad=angles_rad):
            most_rad = 0.0 if step.absolute else max(map(abs, angles_rad))
            stands_s = step.hold_s * len(angles_rad) * step.repeats
            return _from_start(Demand(0.0, most_rad, stands_s), step, speeds, before)
        case TurnToStep(angle_rad=_):
            return _from_start(Demand(), step, speeds, before)
        case WaitStep(wait_s=wait_s):
            return Demand(stands_s=wait_s)
        case TareStep():
            return Demand(moves_s=6.0)
        case ApproachStep(along_tool_m=float() as distance_m):
            return Demand(moves_s=1.0 + abs(distance_m) / min(step.speed_m_per_s, speeds.linear_m_per_s))
        case ApproachStep(pose_m_rad=tuple() as pose) if before.pose_m_rad is not None:
            return Demand(moves_s=1.0 + _line_s(step, before.pose_m_rad, pose, speeds))
        case ApproachStep(pose_m_rad=tuple() as pose):
            longest_s = 1.0 + _farthest_line_s(step, pose, speeds, before.robot)
            return Demand(moves_s=min(3.0, longest_s), longest_moves_s=longest_s, depends_on="where the arm stands")
        case GripStep(width_mm=width_mm, speed_mm_per_s=speed_mm_per_s):
            longest_s = _BEGINS_S + (LARGEST_STROKE_MM - width_mm) / speed_mm_per_s
            fingers = "how far the fingers are apart" if longest_s > _FINGERS_S else ""
            return Demand(moves_s=_FINGERS_S, longest_moves_s=longest_s, depends_on=fingers)
        case ReleaseStep():
            longest_s = _FINGERS_S + (_ACTIVATES_S if before.may_be_inactive else 0.0)
            return Demand(moves_s=_FINGERS_S, longest_moves_s=longest_s)
        case ApproachStep() | AdaptStep():
            return Demand(moves_s=3.0)
        case HoldTorqueStep() | TightenStep() | IdentifyStep() | TwistStep() | TurnToStep() | WaitStep():
            return Demand()


class _Start(NamedTuple):
    """The angle or torque from which a step begins: its possible values, the likely value, and its name in words."""

    bounds: Interval
    likely: float
    name: str


def _from_start(needs: Demand, step: HoldTorqueStep | TurnToStep | TwistStep, speeds: Speeds, before: Before) -> Demand:
    """Return a step's demand with its times, which depend on the value from which it begins."""
    start = _start_of(step, before)
    moves_s, turn_rad = _moves(step, start.likely, speeds)
    if start.bounds.exact is not None:
        return needs._replace(moves_s=moves_s, longest_moves_s=moves_s, turn_rad=turn_rad)
    # Each distance is a convex function of the start, so the largest one is from an end of its bounds.
    from_ends = [_moves(step, end, speeds) for end in start.bounds]
    longest_s, longest_rad = (max(values) for values in zip(*from_ends, strict=True))
    return needs._replace(moves_s=moves_s, longest_moves_s=longest_s, turn_rad=longest_rad, depends_on=start.name)


def _start_of(step: HoldTorqueStep | TurnToStep | TwistStep, before: Before) -> _Start:
    tool, limit_rad, robot = before.tool, before.limit_rad, before.robot
    name = "where wrist 3 stands"
    farthest_rad = LARGEST_ANGLE_RAD
    if robot is not None:
        farthest_rad = max(-robot.joints.lower_rad[-1], robot.joints.upper_rad[-1])
    match step:
        case HoldTorqueStep():
            bounds, likely, name = tool.torque_nm.within(before.limit_nm), tool.last_nm, "the torque before it"
        case TurnToStep(angle_rad=angle_rad):
            bounds, likely = tool.wrist_rad.within(farthest_rad), angle_rad - _GUESSED_TURN_RAD
        case TwistStep(angles_rad=angles_rad, absolute=True):
            # All of its angles are within the limit from the grip, and so is the angle from which it begins.
            turned = tool.angle_rad.within(limit_rad)
            near = Interval(max(angles_rad) - limit_rad + turned.low, min(angles_rad) + limit_rad + turned.high)
            bounds = tool.wrist_rad
            if bounds.exact is None:
                bounds = Interval(max(bounds.low, near.low), min(bounds.high, near.high))
            likely = angles_rad[0] - _GUESSED_TWIST_RAD
        case TwistStep():
            bounds, likely, name = tool.angle_rad.within(limit_rad), 0.0, "the tool's angle before it"
    return _Start(bounds, min(max(likely, bounds.low), bounds.high), name)


def _moves(step: HoldTorqueStep | TurnToStep | TwistStep, start: float, speeds: Speeds) -> tuple[float, float]:
    """Return how long a step moves from a torque or an angle, and its longest turn; 0 where that is not known."""
    repeats = 1
    match step:
        case HoldTorqueStep():
            ramped_nm = abs(step.signed_torque_nm - start)
            return ramped_nm / step.ramp_nm_per_s + (SETTLES_S if ramped_nm else 0.0), 0.0
        case TurnToStep(angle_rad=angle_rad):
            angles_rad = [start, angle_rad]
        case TwistStep(return_to_start=True, repeats=repeats):
            angles_rad = [start]
            for angle_rad in step.angles_rad:
                angles_rad += [angle_rad, start]
        case TwistStep(repeats=repeats):
            angles_rad = [start, *step.angles_rad]
    turns_rad = _turns(angles_rad)
    travel_rad, longest_rad = sum(turns_rad), max(turns_rad)
    if repeats > 1:
        # Each later round begins at the last angle of the one before.
        again_rad = _turns([angles_rad[-1], *angles_rad[1:]])
        travel_rad += (repeats - 1) * sum(again_rad)
        longest_rad = max(longest_rad, *again_rad)
    speed_rad_per_s = min(step.speed_rad_per_s, speeds.wrist_rad_per_s)
    return travel_rad / speed_rad_per_s + SETTLES_S * len(turns_rad) * repeats, longest_rad


def _turns(angles_rad: Sequence[float]) -> list[float]:
    """Return how far the wrist turns from angle to angle."""
    return [abs(later - earlier) for earlier, later in pairwise(angles_rad)]
