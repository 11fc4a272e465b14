import math
from typing import Any

import pytest

from shearloop.daemon.control.torque_controller import ControllerSettings, TorqueController, WristLimit
from shearloop.daemon.torques import TorqueSample

DEFAULTS: dict[str, Any] = {
    "stiffness_nm_per_rad": 0.25,
    "sample_period_s": 0.5,
    "window_s": 0.5,
    "kp": 0.1,
    "ki": 0.001,
    "wrist_bandwidth_per_s": 4.0,
    "ramp_nm_per_s": 0.05,
    "deadband_nm": 0.001,
    "noise_nm": 0.012,
    "innovation_limit_nm": 0.036,
    "creep_limit_nm_per_s": 0.005,
    "offset_limit_nm": 0.06,
    "wrist_limit": WristLimit(speed_rad_per_s=0.6, acceleration_rad_per_s2=2.0),
    "travel_limit_rad": 1.0,
    "age_limit_s": 2.0,
    "fresh_s": 1.25,
}


class Bench:
    """A controller on a rigid clock: one command every 8 ms, the wrist does what it is told."""

    period_ns = 8_000_000

    def __init__(self, **changes: Any) -> None:
        self.settings = ControllerSettings(**(DEFAULTS | changes))
        self.t_ns, self.angle, self.speed = 10**12, 0.3, 0.0
        self.controller = TorqueController(self.settings, self.t_ns, self.angle, 0.0, 100.0)

    def advance(self, seconds: float) -> list[float]:
        speeds = []
        for _ in range(round(seconds * 1e9 / self.period_ns)):
            self.t_ns += self.period_ns
            self.angle += self.speed * self.period_ns / 1e9
            self.speed = self.controller.command(self.t_ns, self.angle).speed_rad_per_s
            speeds.append(self.speed)
        return speeds

    def measure(self, torque_nm: float | None, age_s: float = 0.3) -> object:
        return self.controller.measure(TorqueSample("bench", torque_nm, "", self.t_ns - int(age_s * 1e9), self.t_ns))

    def seen_rad(self) -> float:
        """Return the mean angle of the half second that has ended 50 ms ago, NaN where it is not known."""
        mean = self.controller.filter.angles.mean(self.t_ns - 550_000_000, self.t_ns - 50_000_000)
        return math.nan if mean is None else mean

    def measured_for(self, seconds: float, stiffness: float = 0.25, origin_rad: float = 0.3) -> list[float]:
        """Advance, with a perfect measurement of a spring every half second."""
        speeds = []
        for _ in range(round(seconds / 0.5)):
            speeds += self.advance(0.5)
            self.measure(stiffness * (self.seen_rad() - origin_rad))
        return speeds


@pytest.fixture
def bench() -> Bench:
    return Bench()
