"""The limit of all speeds that the daemon forms; the worker and the script on the robot check the speeds again."""

import math
from dataclasses import dataclass
from typing import Self

from shearloop.daemon.loop_config import LoopConfig


@dataclass(frozen=True, slots=True)
class WristLimit:
    """The wrist's largest speed, and how fast it may speed up."""

    speed_rad_per_s: float
    acceleration_rad_per_s2: float

    @classmethod
    def of(cls, config: LoopConfig) -> Self:
        """Return the limit that the loop plans with."""
        return cls(config.wrist_speed_rad_per_s, config.planned_acceleration_rad_per_s2)

    def clip(self, wanted_rad_per_s: float) -> float:
        """Return the wanted speed, or the largest one in its direction."""
        return max(-self.speed_rad_per_s, min(self.speed_rad_per_s, wanted_rad_per_s))

    def speed_up(self, sent_rad_per_s: float, wanted_rad_per_s: float, elapsed_s: float) -> float:
        """Return the speed after `elapsed_s` on the way from the sent to the wanted speed; braking is not limited."""
        turning = abs(sent_rad_per_s) if wanted_rad_per_s * sent_rad_per_s > 0.0 else 0.0
        fastest = turning + self.acceleration_rad_per_s2 * elapsed_s
        return math.copysign(min(abs(wanted_rad_per_s), fastest), wanted_rad_per_s)
