"""Controller settings for the tool in hand: what was identified, and what the operator asks of the loop."""

from dataclasses import dataclass

from shearloop.daemon.control.identify import ToolModel
from shearloop.daemon.control.loop_inputs import TorqueSource
from shearloop.daemon.control.settings import ControllerSettings
from shearloop.daemon.control.step_commands import TrackTorque
from shearloop.daemon.control.tuning import gain_for_noise, integral_gain


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneSettings:
    """What is asked of the loop. The gain follows from the noise; a fixed `kp` overrides it."""

    # Standard deviation of the true torque that the sensor's noise may cause.
    allowed_noise_nm: float = 0.0025
    kp: float | None = None
    wrist_bandwidth_per_s: float = 4.0
    deadband_nm: float = 0.001
    creep_limit_nm_per_s: float = 0.005
    slip_nm: float = 0.06
    speed_limit_rad_per_s: float = 0.5
    acceleration_limit_rad_per_s2: float = 2.0
    travel_limit_rad: float = 3.2


def tuned(
    own: TuneSettings, found: ToolModel, source: TorqueSource, wish: TrackTorque, torque_limit_nm: float
) -> ControllerSettings:
    """Return the controller for an identified tool; raises UserError where a value is out of its range."""
    kp = own.kp if own.kp is not None else gain_for_noise(found.noise_nm, own.allowed_noise_nm)
    return ControllerSettings(
        stiffness_nm_per_rad=found.stiffness_nm_per_rad,
        sample_period_s=found.sample_period_s,
        window_s=source.window_s,
        lag_s=max(found.significant_lag_s, 0.0),
        kp=kp,
        # What is integrated while friction hides the torque is paid back with a swing from one end of its band to the
        # other.
        ki=0.0 if source.sticks else integral_gain(kp),
        wrist_bandwidth_per_s=own.wrist_bandwidth_per_s,
        ramp_nm_per_s=wish.ramp_nm_per_s,
        noise_nm=found.noise_nm,
        deadband_nm=own.deadband_nm,
        # A single measurement is believed to three times its noise, and at least to 10 mN·m.
        innovation_limit_nm=max(3.0 * found.noise_nm, 0.01),
        creep_limit_nm_per_s=own.creep_limit_nm_per_s,
        offset_limit_nm=own.slip_nm,
        torque_limit_nm=torque_limit_nm,
        speed_limit_rad_per_s=own.speed_limit_rad_per_s,
        acceleration_limit_rad_per_s2=own.acceleration_limit_rad_per_s2,
        travel_limit_rad=own.travel_limit_rad,
    )
