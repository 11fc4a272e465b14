"""The pair of liquid-metal gauges: from strain to resistance and back, and what the current does to them.

Yin, Santos, Posner 2017, section 2 and equation (1).
"""

from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError

EXCITATION_A = 5e-3
# Eutectic gallium indium at room temperature.
EGAIN_RESISTIVITY_OHM_M = 29.4e-8
# Of one gauge, 7 mm by 3 mm.
SENSOR_AREA_M2 = 7e-3 * 3e-3


@dataclass(frozen=True, slots=True)
class Gauge:
    """A serpentine of N strips; the turns between them are left out, as in the paper (N ≫ 1)."""

    strips: int = 70
    strip_length_m: float = 3e-3
    channel_width_m: float = 50e-6
    channel_height_m: float = 50e-6
    resistivity_ohm_m: float = EGAIN_RESISTIVITY_OHM_M
    sensor_area_m2: float = SENSOR_AREA_M2

    @property
    def resistance_ohm(self) -> float:
        """ρ N L / (w h), unloaded."""
        length_m = self.strips * self.strip_length_m
        return self.resistivity_ohm_m * length_m / (self.channel_width_m * self.channel_height_m)

    def power_w(self, voltage_v: float) -> float:
        """V² w h / (ρ N L), turned to heat."""
        return voltage_v**2 / self.resistance_ohm

    def power_at_current_w(self, current_a: float = EXCITATION_A) -> float:
        """The same power where a current source feeds the gauge, as in the paper: 5 mA."""
        return self.power_w(current_a * self.resistance_ohm)

    def joule_heating_k(self, current_a: float = EXCITATION_A) -> float:
        """Steady temperature rise of the gauge's area in still air."""
        return joule_heating_k(self.power_at_current_w(current_a), self.sensor_area_m2)


def joule_heating_k(power_w: float, area_m2: float = SENSOR_AREA_M2, convection_w_m2_k: float = 10.0) -> float:
    """Return the steady temperature rise of an area in air, one side cooled: P / (h A).

    10 W/(m² K) is the usual figure for still air; conduction into the skin and the core is left out, so the true
    rise is smaller. The paper's own analysis gives no more than 5 K.
    """
    return power_w / (convection_w_m2_k * area_m2)


def gauge_factor(poisson_ratio: float = 0.5) -> float:
    """Return 1 + 2ν, the change of resistance per strain at small strain; 2 for an incompressible elastomer."""
    return 1 + 2 * poisson_ratio


def resistance_change(strain: FloatArray, poisson_ratio: float = 0.5) -> FloatArray:
    """Return ΔR/R₀ of a channel stretched along itself, (1+ε)/(1−νε)² − 1; gauge_factor · ε is its first term."""
    change: FloatArray = (1 + strain) / (1 - poisson_ratio * strain) ** 2 - 1
    return change


def response(r1_ohm: FloatArray, r2_ohm: FloatArray, r1_unloaded_ohm: float, r2_unloaded_ohm: float) -> FloatArray:
    """Return the normalised response ΔR₁/R₁₀ − ΔR₂/R₂₀ = F (ε₁ − ε₂), the measured side of equation (1).

    Raises CalibrationError where an unloaded resistance is not a positive number.
    """
    for name, unloaded in (("R1", r1_unloaded_ohm), ("R2", r2_unloaded_ohm)):
        if not (np.isfinite(unloaded) and unloaded > 0):
            raise CalibrationError(
                f"The unloaded resistance of {name} is {unloaded} Ω; measure it again with the skin at rest."
            )
    ratio: FloatArray = r1_ohm / r1_unloaded_ohm - r2_ohm / r2_unloaded_ohm
    return ratio


def response_of_strains(strain_1: FloatArray, strain_2: FloatArray, factor: float = 2.0) -> FloatArray:
    """Return F (ε₁ − ε₂), the modelled side of equation (1)."""
    modelled: FloatArray = factor * (strain_1 - strain_2)
    return modelled
