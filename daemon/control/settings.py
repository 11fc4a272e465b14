"""What the twist controller is told, with the range of each value."""

import math
from dataclasses import dataclass, fields

from shearloop.daemon.errors import UserError


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings:
    """Everything that the controller needs to know beforehand. Raises UserError for a value out of its range."""

    # Of the tool in the grip, as identified: torque over wrist angle, positive.
    stiffness_nm_per_rad: float
    # Of the torque that drives the loop: how often it comes, and how long one measurement averages.
    sample_period_s: float
    window_s: float
    # By how much the torque lags behind its own stamp, as identified; 0 where the stamps are right.
    lag_s: float = 0.0
    # Share of what a measurement says more than expected that is taken up at once, and per measurement from then on.
    kp: float
    ki: float = 0.0
    # Rate at which the wrist closes in on the angle that it should have.
    wrist_bandwidth_per_s: float = 5.0
    ramp_nm_per_s: float
    # The wrist rests until the torque expected at its angle is this far from what it should be.
    deadband_nm: float = 0.0
    # Standard deviation of one measurement: what goes on differing beyond it is a jump, and is caught up with faster
    # than kp would. 0 where that is not wanted.
    noise_nm: float = 0.0
    # One measurement is believed to differ from the expected one by no more than this.
    innovation_limit_nm: float = math.inf
    # Bound on the integral: how fast the torque at a fixed angle may be held to drift.
    creep_limit_nm_per_s: float = math.inf
    # The wrist is held when the torque at a fixed angle has moved by this much: slip, or a screw that broke loose.
    offset_limit_nm: float = math.inf
    torque_limit_nm: float
    speed_limit_rad_per_s: float
    acceleration_limit_rad_per_s2: float
    # From the angle at the start, either way.
    travel_limit_rad: float
    # A measurement that is older than this when it arrives is refused.
    age_limit_s: float = 2.0
    # No measurement for so many periods: the wrist is held.
    stale_periods: float = 2.5

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        for item in fields(self):
            value = getattr(self, item.name)
            low, high, may_be_low = _RANGES.get(item.name, (0.0, math.inf, False))
            fits = low <= value <= high if may_be_low else low < value <= high
            if not fits or (math.isinf(value) and item.name not in _MAY_BE_OFF):
                bound = f"{'at least' if may_be_low else 'above'} {low:g}"
                bound += "" if math.isinf(high) else f" and at most {high:g}"
                raise UserError(f"controller: {item.name} is {value!r}, and must be a number {bound}")
        if self.ki > self.kp:
            raise UserError(f"controller: ki ({self.ki:g}) must not exceed kp ({self.kp:g}); a quarter of kp² is usual")


_RANGES = {
    "window_s": (0.0, 60.0, True),
    "lag_s": (0.0, 5.0, True),
    "kp": (0.0, 4.0, False),
    "ki": (0.0, 4.0, True),
    "noise_nm": (0.0, math.inf, True),
    "deadband_nm": (0.0, math.inf, True),
    "creep_limit_nm_per_s": (0.0, math.inf, True),
    "stale_periods": (1.0, math.inf, True),
}
_MAY_BE_OFF = frozenset({"innovation_limit_nm", "creep_limit_nm_per_s", "offset_limit_nm", "stale_periods"})
