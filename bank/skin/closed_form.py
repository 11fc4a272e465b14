"""The skin's response in closed form: thick-walled membrane in plane strain, balanced about the core's centre.

Moment balance about the centre gives the tension at mid-thickness, N = F_t R_out/R, shared between the two sides:
ε₁ − ε₂ does not depend on how. Plane strain and the pressure of the core, −σ_r ≈ N/(2 R w) at mid-thickness, turn N
into strain. The core's friction takes e^(−μφ) on the way to the gauge and μ F_n R_in/R_out under the load.
"""

import math

from shearloop.bank.skin.gauge import gauge_factor
from shearloop.bank.skin.section import Section


def gauge_angle_rad(section: Section) -> float:
    """φ, the angle from the load to the middle of a gauge."""
    return math.radians(90 - (section.gauge_from_deg + section.gauge_to_deg) / 2)


def sensitivity_per_n(section: Section, factor: float | None = None) -> float:
    """Return S = F (1−ν²)/(E w t) · (1 + ν/(1−ν) · t/2R) · (R_out/R) · e^(−μφ), beyond the deadband, in 1/N.

    F is that of an incompressible elastomer, 2, unless given.
    """
    nu, radius, thickness = section.poisson_ratio, section.mid_radius_mm, section.thickness_mm
    flat = (1 - nu**2) / (section.young_mpa * section.width_mm * thickness)
    pressed = 1 + nu / (1 - nu) * thickness / (2 * radius)
    lever = section.outer_radius_mm / radius
    capstan = math.exp(-section.friction * gauge_angle_rad(section))
    return (gauge_factor() if factor is None else factor) * flat * pressed * lever * capstan


def deadband_n(section: Section, normal_n: float) -> float:
    """Return the shear force at which the skin under the load begins to slip, μ F_n R_in/R_out."""
    return section.friction * normal_n * section.inner_radius_mm / section.outer_radius_mm


def loading_response(section: Section, normal_n: float, shear_n: float) -> float:
    """Return the response while a shear force rises from zero."""
    beyond = max(abs(shear_n) - deadband_n(section, normal_n), 0.0)
    return math.copysign(sensitivity_per_n(section) * beyond, shear_n)
