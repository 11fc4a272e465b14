"""Inputs of the control loop: its settings, and torques and device states with their times. Values only."""

import math
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from shearloop.daemon.config_file import ConfigModel

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


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


@dataclass(frozen=True, slots=True)
class TorqueSample:
    """One torque of one source, with the time of its measurement (`t_mid_ns`) and of its arrival (`t_ns`).

    `torque_nm` is None if it is not valid, for `reason`. `low_nm` and `high_nm` bound the friction band that
    hides the torque.
    """

    source: str
    torque_nm: float | None
    reason: str
    t_mid_ns: int
    t_ns: int
    low_nm: float | None = None
    high_nm: float | None = None

    def __post_init__(self) -> None:
        """Treat NaN and infinity as no torque."""
        if self.torque_nm is not None and not math.isfinite(self.torque_nm):
            object.__setattr__(self, "torque_nm", None)


@dataclass(frozen=True, slots=True)
class ArmStatus:
    """State of the robot, as far as the loop needs it."""

    wrist_rad: float
    t_ns: int
    protective_stop: bool = False
    emergency_stop: bool = False
    blocked: str = ""


@dataclass(frozen=True, slots=True)
class GripperStatus:
    """State of the gripper, as far as the loop needs it.

    `uncertain`: the gripper cannot say whether it holds an object, because it is inactive, lost its power, or was
    stopped on its way.
    """

    t_ns: int
    width_mm: float
    holding: bool
    moving: bool
    fault: str = ""
    uncertain: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class TorqueSource:
    """A source of torques: its period and the averaging window of one torque.

    `has_friction_band`: friction hides the torque within a band; the wrist turns through it without a change.
    `from_robot`: the torque comes with the robot's state, so its age is checked there. `measures_torque` is False for a
    fingertip without a calibration; a silent one is a fault all the same.
    """

    name: str
    period_s: float
    window_s: float = 0.0
    has_friction_band: bool = False
    from_robot: bool = False
    measures_torque: bool = True
