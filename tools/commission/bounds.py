"""The bounds of every motion of a commissioning, and the robot's settings within them."""

from dataclasses import replace
from typing import Final, TypeVar

from shearloop.drivers.ur.settings import Bound, UrSettings

LARGEST_RAD_PER_S: Final = 0.5
LARGEST_RAD: Final = 0.1
LARGEST_M_PER_S: Final = 0.05
LARGEST_M: Final = 0.02
BoundT = TypeVar("BoundT", bound=Bound)


def bounded(settings: UrSettings, wrist_rad: float) -> UrSettings:
    """Return settings that keep the wrist within `LARGEST_RAD` of an angle, and speeds within the largest ones.

    The worker and the script on the robot enforce them for every request.
    """
    limits = settings.limits
    joints = limits.joints
    reach_rad = LARGEST_RAD + joints.margin_rad
    lower_rad = max(joints.lower_rad[-1], wrist_rad - reach_rad)
    upper_rad = min(joints.upper_rad[-1], wrist_rad + reach_rad)
    joints = replace(joints, lower_rad=(*joints.lower_rad[:5], lower_rad), upper_rad=(*joints.upper_rad[:5], upper_rad))
    limits = replace(
        limits,
        joints=joints,
        wrist_speed_rad_per_s=_at_most(limits.wrist_speed_rad_per_s, LARGEST_RAD_PER_S),
        linear_speed_m_per_s=_at_most(limits.linear_speed_m_per_s, LARGEST_M_PER_S),
    )
    return replace(settings, limits=limits)


def _at_most(bound: BoundT, largest: float) -> BoundT:
    return replace(bound, inner=min(bound.inner, largest))
