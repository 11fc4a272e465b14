"""The run-time model of the shear skin and its inverse: a membrane over a rigid core.

Tension only (the compressed side buckles away from the core and carries nothing), Coulomb friction μF_n under the
load and capstan friction along the arc. Friction makes it a hysteresis of two plays: the tension under the load
follows the shear force within ±μF_n, and the tension at a gauge follows that one within factors e^(±μφ). Slip starts
at the load and runs outwards, so the clipping below is the exact solution of the belt, not a time step.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

from shearloop.bank.errors import CalibrationError
from shearloop.bank.skin.closed_form import gauge_angle_rad, sensitivity_per_n
from shearloop.bank.skin.gauge import gauge_factor
from shearloop.bank.skin.section import PAPER_SECTION, Section

# The paper's own estimate of F/(EA); its E and width would make the skin 0.88 mm thick.
PAPER_SENSITIVITY_PER_N = 0.088


class Direction(Enum):
    """Which way the magnitude of the shear force goes."""

    LOADING = "loading"
    UNLOADING = "unloading"
    UNKNOWN = "unknown"


class ShearInterval(NamedTuple):
    """A shear force with the interval that holds it, in N; an infinite end is beyond what was calibrated."""

    shear_n: float
    low_n: float
    high_n: float

    @property
    def in_deadband(self) -> bool:
        """Whether the response does not tell the force from none."""
        return self.low_n <= 0 <= self.high_n


@dataclass(frozen=True, slots=True)
class MembraneState:
    """The membrane at rest: net tension at the load (positive: side 1) and tension at both gauges, in N; strains."""

    net_tension_n: float = 0.0
    gauge_tension_1_n: float = 0.0
    gauge_tension_2_n: float = 0.0
    strain_1: float = 0.0
    strain_2: float = 0.0


UNSTRETCHED = MembraneState()


@dataclass(frozen=True, slots=True)
class Membrane:
    """EA in N, the friction coefficient μ, the angle φ from load to gauge, the gauge factor F."""

    axial_stiffness_n: float
    friction: float
    gauge_angle_rad: float
    gauge_factor: float = gauge_factor()

    def __post_init__(self) -> None:
        """Refuse what no belt can have."""
        if not (self.axial_stiffness_n > 0 and self.friction >= 0 and self.gauge_angle_rad >= 0):
            raise CalibrationError(f"{self}: the stiffness must be positive, friction and angle must not be negative.")

    def step(self, state: MembraneState, shear_n: float, normal_n: float) -> MembraneState:
        """Return the state after the forces (N) have gone straight to these values; ε₁ and ε₂ stand in it."""
        hold = self.friction * max(normal_n, 0.0)
        net = _clip(state.net_tension_n, shear_n - hold, shear_n + hold)
        up = math.exp(self.friction * self.gauge_angle_rad)
        tension_1 = _clip(state.gauge_tension_1_n, max(net, 0.0) / up, max(net, 0.0) * up)
        tension_2 = _clip(state.gauge_tension_2_n, max(-net, 0.0) / up, max(-net, 0.0) * up)
        stiffness = self.axial_stiffness_n
        return MembraneState(net, tension_1, tension_2, tension_1 / stiffness, tension_2 / stiffness)

    def response(self, state: MembraneState) -> float:
        """Return F (ε₁ − ε₂), equation (1) of the paper."""
        return self.gauge_factor * (state.strain_1 - state.strain_2)

    def shear_from_response(
        self, response: float, normal_n: float, direction: Direction = Direction.UNKNOWN
    ) -> ShearInterval:
        """Return the shear force (N) that belongs to a response, with the interval that friction leaves open.

        Where the response rises or falls in magnitude, the skin slips all the way to the gauge, and the force is
        one number. Where the direction is not known it is anything between the two; without response, anything
        within the deadband.
        """
        tension = response * self.axial_stiffness_n / self.gauge_factor
        return self.shear_from_tensions(tension, tension, tension, normal_n, direction)

    def shear_from_tensions(
        self, low_n: float, tension_n: float, high_n: float, normal_n: float, direction: Direction
    ) -> ShearInterval:
        """Return the shear force for a net tension at the gauges (N) that is known to lie within low and high."""
        low, high = self._bounds(low_n, normal_n, direction)[0], self._bounds(high_n, normal_n, direction)[1]
        if low_n <= 0 <= high_n:
            slack = self._bounds(0.0, normal_n, direction)
            low, high = min(low, slack[0]), max(high, slack[1])
        inner = self._bounds(tension_n, normal_n, direction)
        return ShearInterval((inner[0] + inner[1]) / 2, low, high)

    def _bounds(self, tension_n: float, normal_n: float, direction: Direction) -> tuple[float, float]:
        hold = self.friction * max(normal_n, 0.0)
        if tension_n == 0:
            return -hold, hold
        up = math.exp(self.friction * self.gauge_angle_rad)
        sign = math.copysign(1.0, tension_n)
        loading, unloading = tension_n * up + sign * hold, tension_n / up - sign * hold
        if direction is Direction.LOADING:
            return loading, loading
        if direction is Direction.UNLOADING:
            return unloading, unloading
        return min(loading, unloading), max(loading, unloading)


def direction_of(before: float, now: float, noise: float) -> Direction:
    """Return the direction of loading that two responses tell: neither, unless they differ by more than the noise.

    A response that rises in magnitude proves slip at the gauge, hence loading; one that stays proves nothing.
    """
    change = abs(now) - abs(before)
    if before * now < 0 or abs(change) <= noise:
        return Direction.UNKNOWN
    return Direction.LOADING if change > 0 else Direction.UNLOADING


def paper_membrane(section: Section = PAPER_SECTION) -> Membrane:
    """Return the membrane with the paper's own F/(EA) = 0.088 1/N."""
    return Membrane(gauge_factor() / PAPER_SENSITIVITY_PER_N, section.friction, gauge_angle_rad(section))


def section_membrane(section: Section = PAPER_SECTION) -> Membrane:
    """Return the membrane with the stiffness that modulus and cross-section give in plane strain (`closed_form`)."""
    without_friction = replace(section, friction=0.0)
    stiffness = gauge_factor() / sensitivity_per_n(without_friction)
    return Membrane(stiffness, section.friction, gauge_angle_rad(section))


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
