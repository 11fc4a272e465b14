"""What each step demands: its largest torque and angle, and its times."""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from shearloop.daemon.control.experiment_schema import (
    AdaptStep,
    ApproachStep,
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
from shearloop.daemon.control.known_tool import AT_REST, KnownTool, known_after
from shearloop.daemon.control.step_motions import AS_ASKED, Speeds
from shearloop.drivers.ur.poses import ONLY_TURNS_M, along_tool, turn_between


class Demand(NamedTuple):
    """The largest torque (N·m) and angle from the grip (rad) of a step, and its times.

    It stands still for `stands_s` in all, and takes about `moves_s` for everything else. `begins_anywhere`: it moves to
    a pose from one that is not known before, so that `moves_s` is a guess.
    """

    torque_nm: float = 0.0
    angle_rad: float = 0.0
    stands_s: float = 0.0
    moves_s: float = 0.0
    begins_anywhere: bool = False

    @property
    def takes_s(self) -> float:
        """About how long the step takes."""
        return self.stands_s + self.moves_s


# The wrist slows down as it comes near an angle or a torque. At the default bandwidth this adds 0.3 s to a turn at
# 0.1 rad/s, and 0.7 s to one at 0.5 rad/s.
SETTLES_S: Final = 0.5


def _travel_rad(angles_rad: Sequence[float]) -> float:
    """Return how far the wrist turns from angle to angle."""
    return sum(abs(later - earlier) for earlier, later in pairwise(angles_rad))


class Before(NamedTuple):
    """The known state of the tool before a step, and the tool's pose; None for an unknown one."""

    tool: KnownTool = AT_REST
    pose_m_rad: Sequence[float] | None = None


NOTHING_BEFORE: Final = Before()


def demands(planned: Iterable[Step], speeds: Speeds = AS_ASKED, start: KnownTool = AT_REST) -> Iterator[Demand]:
    """Yield the demand of each step after those before it."""
    before = Before(start)
    for step in planned:
        yield demand(step, speeds, before)
        before = Before(known_after(step, before.tool), _pose_after(step, before.pose_m_rad))


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


def demand(step: Step, speeds: Speeds = AS_ASKED, before: Before = NOTHING_BEFORE) -> Demand:
    """Return the demand of a step; unknown values, as in an outline, are 0."""
    match step:
        case HoldTorqueStep(torque_nm=torque_nm):
            # An unknown torque counts as none.
            ramped_nm = abs(step.signed_torque_nm - (before.tool.torque_nm.exact or 0.0))
            moves_s = ramped_nm / step.ramp_nm_per_s + (SETTLES_S if ramped_nm else 0.0)
            return Demand(abs(torque_nm), stands_s=step.hold_s, moves_s=moves_s)
        case TightenStep(until_torque_nm=torque_nm, until_angle_rad=angle_rad):
            speed_rad_per_s = min(step.speed_rad_per_s, speeds.wrist_rad_per_s)
            return Demand(torque_nm, angle_rad, moves_s=angle_rad / speed_rad_per_s)
        case IdentifyStep(amplitude_rad=angle_rad, hold_s=hold_s):
            # Two cycles at least, to half of the angle and to all of it; the first of five rests is twice as long.
            moves_s = 3.0 * angle_rad / speeds.wrist_rad_per_s + 5.0 * SETTLES_S
            return Demand(angle_rad=angle_rad, stands_s=6.0 * hold_s, moves_s=moves_s)
        case TwistStep(angles_rad=angles_rad):
            return _twist_demand(step, angles_rad, speeds, before.tool)
        case WaitStep(wait_s=wait_s):
            return Demand(stands_s=wait_s)
        case TareStep():
            return Demand(moves_s=6.0)
        case ApproachStep(along_tool_m=float() as distance_m):
            return Demand(moves_s=1.0 + abs(distance_m) / min(step.speed_m_per_s, speeds.linear_m_per_s))
        case TurnToStep(angle_rad=angle_rad):
            # Where the wrist is, is known only there.
            wrist_rad = before.tool.wrist_rad.exact
            travel_rad = 1.0 if wrist_rad is None else abs(angle_rad - wrist_rad)
            return Demand(moves_s=SETTLES_S + travel_rad / min(step.speed_rad_per_s, speeds.wrist_rad_per_s))
        case ApproachStep(pose_m_rad=tuple() as pose) if before.pose_m_rad is not None:
            return Demand(moves_s=1.0 + _line_s(step, before.pose_m_rad, pose, speeds))
        case ApproachStep():
            return Demand(moves_s=3.0, begins_anywhere=True)
        case GripStep() | ReleaseStep() | AdaptStep():
            return Demand(moves_s=3.0)
        case HoldTorqueStep() | TightenStep() | IdentifyStep() | TwistStep() | TurnToStep() | WaitStep():
            return Demand()


def _twist_demand(step: TwistStep, angles_rad: Sequence[float], speeds: Speeds, tool: KnownTool) -> Demand:
    stands_s = step.hold_s * len(angles_rad) * step.repeats
    if step.absolute:
        # How far an absolute angle is from the grip is known only there, unless the wrist was turned to one.
        start_rad = tool.wrist_rad.exact
        reach = [0.2 if start_rad is None else abs(one - start_rad) for one in angles_rad]
    else:
        # An unknown angle counts as that of the grip.
        start_rad = tool.angle_rad.exact
        reach = [abs(one - (start_rad or 0.0)) for one in angles_rad]
    moves = step.repeats * len(angles_rad)
    if step.return_to_start:
        moves, travel_rad = 2 * moves, step.repeats * 2.0 * sum(reach)
    else:
        # Each round begins at the last angle of the one before.
        between_rounds_rad = abs(angles_rad[0] - angles_rad[-1])
        travel_rad = reach[0] + step.repeats * _travel_rad(angles_rad)
        travel_rad += (step.repeats - 1) * between_rounds_rad
    moves_s = travel_rad / min(step.speed_rad_per_s, speeds.wrist_rad_per_s) + SETTLES_S * moves
    most_rad = 0.0 if step.absolute else max(abs(angle_rad) for angle_rad in angles_rad)
    return Demand(0.0, most_rad, stands_s, moves_s)
