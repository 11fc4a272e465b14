"""Which controller is played."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Make:
    """What kind of controller this is."""

    version: tuple[int, ...] = (5, 17, 3, 0)
    serial_number: str = "20235500001"
    unlock_wait_s: float = 5.0
    power_on_s: float = 1.0
    tool_length_m: float = 0.0
    remote_control: bool = True
    # Elbow up, the tool pointing straight down.
    start_rad: tuple[float, ...] = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)
