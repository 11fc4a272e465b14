"""Poses: x, y, z in m and a rotation vector in rad, as URScript has them."""

import math
from collections.abc import Sequence

# A straight move over a shorter way only turns the tool, and the controller takes its speed in rad/s. This limit is an
# assumption: UR publishes none.
ONLY_TURNS_M = 1e-6


def turn_between(pose: Sequence[float], other: Sequence[float]) -> float:
    """Return the angle between the orientations of two poses, 0 to pi."""
    dot = sum(one * another for one, another in zip(_quaternion(pose), _quaternion(other), strict=True))
    return 2.0 * math.acos(min(abs(dot), 1.0))


def is_close(pose: Sequence[float], other: Sequence[float], within: float) -> bool:
    """Return whether two poses are less than `within` metres and radians apart; poses with NaN are not."""
    return math.dist(pose[:3], other[:3]) < within and turn_between(pose, other) < within


def _quaternion(pose: Sequence[float]) -> tuple[float, float, float, float]:
    x, y, z = pose[3:]
    half_rad = 0.5 * math.hypot(x, y, z)
    # sin(a)/(2 a) is 1/2 at 0.
    part = math.sin(half_rad) / (2.0 * half_rad) if half_rad else 0.5
    return math.cos(half_rad), part * x, part * y, part * z


def tool_axis(pose: Sequence[float]) -> tuple[float, float, float]:
    """Return the direction of the tool's z axis: the third column of the pose's rotation, by Rodrigues' formula."""
    x, y, z = pose[3:]
    angle_rad = math.hypot(x, y, z)
    if angle_rad == 0.0:
        return 0.0, 0.0, 1.0
    x, y, z = x / angle_rad, y / angle_rad, z / angle_rad
    sine, versine = math.sin(angle_rad), 1.0 - math.cos(angle_rad)
    return x * z * versine + y * sine, y * z * versine - x * sine, 1.0 - (x * x + y * y) * versine


def along_tool(pose: Sequence[float], distance_m: float) -> tuple[float, float, float, float, float, float]:
    """Return the pose at a distance along the tool's axis."""
    x, y, z, rx, ry, rz = pose
    dx, dy, dz = tool_axis(pose)
    return x + dx * distance_m, y + dy * distance_m, z + dz * distance_m, rx, ry, rz
