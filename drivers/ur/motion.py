"""How long a motion may take, whether it is there, and the torque about the tool's own axis; pure functions."""

import math

from shearloop.drivers.ur.messages import MoveLinear, RtdeSample, Stop
from shearloop.drivers.ur.settings import Six

# How long a linear move may take beyond its nominal time before it is stopped.
MOVE_SLACK, MOVE_SLACK_S = 1.5, 2.0
# How long a stop may take beyond its nominal time before nothing is sent to the robot any more; an arm swings a little.
STOP_SLACK, STOP_SLACK_S = 1.5, 1.0
# The pendant's speed slider slows everything down; at its lowest it would leave a motion without an end.
SLOWEST_SCALING = 0.05


def longest_move_s(move: MoveLinear, reading: RtdeSample) -> float:
    """Return how long a linear move may take: distance or turn at its speed, the pendant's speed slider, and slack."""
    distance_m = math.dist(move.pose[:3], reading.tcp_pose[:3])
    # At most half a turn; a move that only turns takes its speed as rad/s.
    way = max(distance_m, math.pi if distance_m < 1e-3 else 0.0)
    nominal_s = way / move.speed_m_per_s + move.speed_m_per_s / move.acceleration_m_per_s2
    return MOVE_SLACK * nominal_s / max(SLOWEST_SCALING, reading.speed_scaling) + MOVE_SLACK_S


def longest_stop_s(stop: Stop, reading: RtdeSample) -> float:
    """Return how long a stop may take: the fastest joint's speed at this deceleration, the speed slider, and slack."""
    nominal_s = reading.fastest_rad_per_s / stop.deceleration_rad_per_s2
    if not math.isfinite(nominal_s):
        # What reports no numbers is not waited for.
        return STOP_SLACK_S
    return STOP_SLACK * nominal_s / max(SLOWEST_SCALING, reading.speed_scaling) + STOP_SLACK_S


def tool_axis_torque(reading: RtdeSample) -> float:
    """Return the torque about the tool's z axis: the third column of the pose's rotation, times the torque."""
    x, y, z = reading.tcp_pose[3:]
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return reading.wrench[5]
    x, y, z = x / angle, y / angle, z / angle
    sine, versine = math.sin(angle), 1 - math.cos(angle)
    _, _, _, tx, ty, tz = reading.wrench
    return (x * z * versine + y * sine) * tx + (y * z * versine - x * sine) * ty + (1 - (x * x + y * y) * versine) * tz


def is_close(pose: Six, other: Six, within: float) -> bool:
    """Return whether two poses are less than so many metres and radians apart.

    A turn has more than one rotation vector: at half a turn, as of a tool that points down, both signs are the same.
    """
    same = abs(sum(a * b for a, b in zip(_quaternion(pose), _quaternion(other), strict=True)))
    return math.dist(pose[:3], other[:3]) < within and 2.0 * math.acos(min(same, 1.0)) < within


def _quaternion(pose: Six) -> tuple[float, float, float, float]:
    x, y, z = pose[3:]
    angle = math.sqrt(x * x + y * y + z * z)
    share = math.sin(angle / 2) / angle if angle > 0.0 else 0.5
    return math.cos(angle / 2), x * share, y * share, z * share
