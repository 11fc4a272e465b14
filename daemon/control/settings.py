"""Settings of the closed loop: what the user configures, and what a controller of one tool needs."""

import math
from typing import Annotated

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass

from shearloop.daemon.config_file import ConfigModel


class LoopConfig(ConfigModel):
    """Settings of the closed loop; docs/safety.md lists what each fault leads to."""

    allowed_noise_nm: float = Field(default=0.0025, gt=0, le=1, description="true torque's std that noise may cause")
    kp: float | None = Field(default=None, gt=0, le=1, description="fixes the gain, which else follows from the noise")
    deadband_nm: float = Field(default=0.001, ge=0, le=1, description="error below which the wrist rests")
    disagreement_nm: float = Field(default=0.05, gt=0, le=5)
    max_innovation_nm: float = Field(default=0.08, gt=0, le=5)
    max_offset_drift_nm: float = Field(
        default=0.06, gt=0, le=5, description="drift of the torque at a fixed angle: slip"
    )
    wrist_speed_rad_per_s: float = Field(default=0.5, gt=0, le=3.14)
    stale_after_s: float = Field(default=0.1, ge=0, le=10, description="no torque that is younger counts as stale")
    wrist_acceleration_rad_per_s2: float = Field(default=4.0, gt=0, le=1000, description="given to the robot")
    angle_bandwidth_per_s: float = Field(default=5.0, gt=0, le=80, description="how fast the wrist approaches an angle")
    torque_bandwidth_per_s: float = Field(default=4.0, gt=0, le=30, description="how fast it approaches a torque")
    actuation_s: float = Field(default=0.02, ge=0, le=0.2, description="from sending a speed until the angle shows it")
    gain_margin: float = Field(default=2.0, ge=1, le=100)
    phase_margin_deg: float = Field(default=45.0, ge=0, le=90)

    @property
    def planned_acceleration_rad_per_s2(self) -> float:
        """The acceleration that controller and identification plan with; the robot keeps twice as much in reserve."""
        return 0.5 * self.wrist_acceleration_rad_per_s2


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


@checked_dataclass(frozen=True, slots=True, kw_only=True, config=ConfigDict(allow_inf_nan=False))
class ControllerSettings:
    """A controller's settings for one tool. Raises pydantic's ValidationError for a value out of its range."""

    # Of the tool in the grip, as identified: torque over wrist angle.
    stiffness_nm_per_rad: Positive
    # Of the driving torque: how often it comes, and how long one measurement averages.
    sample_period_s: Positive
    window_s: Annotated[float, Field(ge=0, le=60)]
    # By how much the torque lags behind its own stamp, as identified; 0 where the stamps are right.
    lag_s: Annotated[float, Field(ge=0, le=5)] = 0.0
    # Shares of an innovation: taken up at once, and per measurement from then on.
    kp: Annotated[float, Field(gt=0, le=4)]
    ki: Annotated[float, Field(ge=0, le=4)] = 0.0
    wrist_bandwidth_per_s: Positive
    ramp_nm_per_s: Positive
    # The wrist rests until the expected torque is this far from the set point.
    deadband_nm: NotNegative = 0.0
    # Standard deviation of one measurement; 0 turns the detection of jumps off.
    noise_nm: NotNegative = 0.0
    # Innovations are clipped to this.
    innovation_limit_nm: Annotated[float, Field(gt=0, allow_inf_nan=True)] = math.inf
    # Bound on the integral: how fast the torque at a fixed angle may drift.
    creep_limit_nm_per_s: Annotated[float, Field(ge=0, allow_inf_nan=True)] = math.inf
    # The wrist is held when the torque at a fixed angle has moved by this much: slip, or a screw that broke loose.
    offset_limit_nm: Annotated[float, Field(gt=0, allow_inf_nan=True)] = math.inf
    torque_limit_nm: Positive
    speed_limit_rad_per_s: Positive
    acceleration_limit_rad_per_s2: Positive
    # From the angle at the start, either way.
    travel_limit_rad: Positive
    # A measurement that is older than this on arrival is refused.
    age_limit_s: Positive = 2.0
    # Without a measurement for this many periods the wrist is held.
    stale_periods: Annotated[float, Field(ge=1, allow_inf_nan=True)] = 2.5

    @model_validator(mode="after")
    def _damped(self) -> "ControllerSettings":
        if self.ki > self.kp:
            raise ValueError(f"ki ({self.ki:g}) must not exceed kp ({self.kp:g}); a tenth of kp² is usual")
        return self
