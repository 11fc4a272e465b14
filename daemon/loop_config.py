"""The settings of the closed loop, `loop` in the configuration."""

from typing import TYPE_CHECKING, Self

from pydantic import Field

from shearloop.daemon.config_file import ConfigModel

if TYPE_CHECKING:
    from shearloop.drivers.ur.settings import UrLimits


class LoopConfig(ConfigModel):
    """Settings of the closed loop; docs/faults.md lists what each fault leads to."""

    allowed_noise_nm: float = Field(
        default=0.0025, gt=0, le=1, description="standard deviation of the true torque that noise may cause"
    )
    kp: float | None = Field(
        default=None, gt=0, le=1, description="fixed gain; without it the gain follows from the noise"
    )
    deadband_nm: float = Field(default=0.001, ge=0, le=1, description="error below which the wrist rests")
    disagreement_nm: float = Field(
        default=0.05, gt=0, le=5, description="largest difference of two torques, plus the wrench's noise"
    )
    max_innovation_nm: float = Field(default=0.08, gt=0, le=5, description="largest error of the expected torque")
    max_offset_drift_nm: float = Field(
        default=0.06,
        gt=0,
        le=5,
        description="drift at one angle since `identify`, pauses included, that counts as a slip",
    )
    wrist_speed_rad_per_s: float = Field(default=0.5, gt=0, le=3.14, description="largest wrist speed of the loop")
    stale_after_s: float = Field(default=0.1, ge=0, le=10, description="minimum age of a stale torque")
    wrist_acceleration_rad_per_s2: float = Field(
        default=4.0, gt=0, le=1000, description="wrist acceleration that the robot gets"
    )
    angle_bandwidth_per_s: float = Field(
        default=5.0, gt=0, le=80, description="bandwidth with which the wrist approaches an angle"
    )
    torque_bandwidth_per_s: float = Field(
        default=4.0, gt=0, le=30, description="bandwidth with which the wrist approaches a torque"
    )
    actuation_s: float = Field(
        default=0.02, ge=0, le=0.2, description="delay from the sending of a speed until the angle shows it"
    )
    gain_margin: float = Field(default=2.0, ge=1, le=100, description="minimum gain margin, as a factor")
    phase_margin_deg: float = Field(default=45.0, ge=0, le=90, description="minimum phase margin")

    def within(self, robot: "UrLimits") -> Self:
        """Return the settings with the speed and the acceleration that the robot's limits leave of them."""
        names = ("wrist_speed_rad_per_s", "wrist_acceleration_rad_per_s2")
        return self.model_copy(update={name: min(getattr(self, name), getattr(robot, name).inner) for name in names})

    @property
    def planned_acceleration_rad_per_s2(self) -> float:
        """The acceleration that controller and identification plan with: half of what the robot is given."""
        return 0.5 * self.wrist_acceleration_rad_per_s2
