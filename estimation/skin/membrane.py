"""The skin in one dimension: cross-section, small-strain slope, and the membrane at finite strain used at run time.

Yin, Santos, Posner, "Bioinspired flexible microfluidic shear force sensor skin", Sensors and Actuators A 264 (2017).
The angle θ is the paper's: 0° and 180° at the brackets, 90° under the load. A positive shear force pulls towards
larger θ and stretches the skin below 90°.
"""

import math
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

EXCITATION_A = 5e-3
# ρ N L / (w h): eutectic gallium indium at room temperature, in 70 strips of 3 mm without the turns between them (the
# paper's section 2), 50 µm wide and high.
GAUGE_RESISTANCE_OHM = 29.4e-8 * 70 * 3e-3 / (50e-6 * 50e-6)
# One gauge, 7 mm by 3 mm.
SENSOR_AREA_M2 = 7e-3 * 3e-3
# Usual for still air.
CONVECTION_W_M2_K = 10.0
# 1 + 2ν, the change of resistance per strain at small strain, of an incompressible elastomer.
GAUGE_FACTOR = 2.0


@dataclass(frozen=True, slots=True)
class Section:
    """Half an annulus of skin around a rigid core; lengths in mm, modulus in MPa (N/mm²), angles in degrees.

    The paper's load coordinates, (0, −6.35) on the outer surface and (0, −6) on the mid-line, give the radii. They
    contradict its fabrication text (mid-line at 6.3 mm, 0.6 mm thick), but its computed results belong to them. The
    width is the sheet's, 20 mm, loaded evenly. The gauge strips are 3 mm long, 28.65° on the mid-line. The paper
    places them "adjacent to the nail bed"; here they begin at 15°, two thicknesses clear of the bracket. Their depth
    counts from mid-thickness, outwards.
    """

    mid_radius_mm: float = 6.0
    thickness_mm: float = 0.70
    width_mm: float = 20.0
    young_mpa: float = 1.292
    poisson_ratio: float = 0.49
    friction: float = 0.04
    gauge_from_deg: float = 15.0
    gauge_to_deg: float = 43.65
    gauge_depth_mm: float = 0.0
    load_arc_deg: float = 5.0

    @property
    def inner_radius_mm(self) -> float:
        """Radius of the rigid core."""
        return self.mid_radius_mm - self.thickness_mm / 2

    @property
    def outer_radius_mm(self) -> float:
        """Radius of the surface, where the load acts."""
        return self.mid_radius_mm + self.thickness_mm / 2

    @property
    def gauge_angle_rad(self) -> float:
        """φ, the angle from the load to the middle of a gauge."""
        return math.radians(90 - (self.gauge_from_deg + self.gauge_to_deg) / 2)


PAPER_SECTION = Section()
# The other reading of the paper: the thickness that its F/(EA) = 0.088 1/N needs, below the same load.
THICK_SECTION = Section(mid_radius_mm=5.91, thickness_mm=0.88)


def joule_heating_k(power_w: float) -> float:
    """Return the steady temperature rise of a gauge's area in still air, one side cooled: P / (h A).

    Conduction into skin and core is neglected, so the true rise is smaller; the paper gives at most 5 K.
    """
    return power_w / (CONVECTION_W_M2_K * SENSOR_AREA_M2)


# Of the paper's eutectic and elastomer: 1.1 % over 15 K, and the linear expansion.
RESISTIVITY_PER_K, EXPANSION_PER_K = 0.011 / 15, 3.2e-4


def warming_change(kelvin: float) -> float:
    """Return ΔR/R of a gauge that warms: its liquid conducts less, and its channel expands in all directions."""
    return (1 + RESISTIVITY_PER_K * kelvin) / (1 + EXPANSION_PER_K * kelvin) - 1


# At small strain the closed form balances moments about the core's centre. The tension at mid-thickness, F_t R_out/R,
# is shared by the two sides, and ε₁ − ε₂ does not depend on how. Plane strain and the core's pressure, −σ_r ≈ N/(2 R w)
# at mid-thickness, turn tension N into strain. Friction takes e^(−μφ) on the way to the gauge and μ F_n R_in/R_out at
# the load.


def sensitivity_per_n(section: Section) -> float:
    """Return S = F (1−ν²)/(E w t) · (1 + ν/(1−ν) · t/2R) · (R_out/R) · e^(−μφ), beyond the deadband, in 1/N."""
    nu, radius, thickness = section.poisson_ratio, section.mid_radius_mm, section.thickness_mm
    flat = (1 - nu**2) / (section.young_mpa * section.width_mm * thickness)
    pressed = 1 + nu / (1 - nu) * thickness / (2 * radius)
    lever = section.outer_radius_mm / radius
    capstan = math.exp(-section.friction * section.gauge_angle_rad)
    return GAUGE_FACTOR * flat * pressed * lever * capstan


class Direction(Enum):
    """Which way the magnitude of the shear force goes."""

    LOADING = "loading"
    UNLOADING = "unloading"
    UNKNOWN = "unknown"


class ShearInterval(NamedTuple):
    """A shear force with the interval that holds it, in N; an infinite end lies beyond the calibrated range."""

    shear_n: float
    low_n: float
    high_n: float

    @property
    def in_deadband(self) -> bool:
        """Whether the force may be zero."""
        return self.low_n <= 0 <= self.high_n


@dataclass(frozen=True, slots=True)
class BeltState:
    """The belt at rest: net tension at the load (positive: side 1) and tension at both gauges, in N of load."""

    net_tension_n: float = 0.0
    gauge_tension_1_n: float = 0.0
    gauge_tension_2_n: float = 0.0


UNSTRETCHED = BeltState()


@dataclass(frozen=True, slots=True)
class Belt:
    """Friction of a skin on its core: coefficient μ of the load's forces, and angle φ from load to gauge.

    It carries tension only: the compressed side buckles. Coulomb friction holds under the load, capstan friction along
    the arc. This is a hysteresis of two plays: the tension under the load follows the shear force within ±μF_n, and the
    tension at a gauge follows the tension under the load within factors e^(±μφ). Slip starts at the load and runs
    outwards, so this is the exact solution of the belt, not a time step.

    The load keeps its direction and moves with the skin. If the skin has turned by α about the core, the load pulls
    along it by F_t cos α + F_n sin α and presses by F_n cos α − F_t sin α. α and forces have the same sign.
    """

    friction: float
    gauge_angle_rad: float

    def step(self, state: BeltState, shear_n: float, normal_n: float, turned_rad: float) -> BeltState:
        """Return the state after the forces (N) have gone straight to these values and the load has turned."""
        low, high = (self.pull(shear_n, normal_n, turned_rad, sign) for sign in (1.0, -1.0))
        return self.follow(state, _clip(state.net_tension_n, low, high))

    def pull(self, shear_n: float, normal_n: float, turned_rad: float, sign: float) -> float:
        """Return the net tension (N) that makes the skin slip under the load; a positive sign is towards side 2."""
        cosine, sine = math.cos(turned_rad), math.sin(turned_rad)
        pressing = max(normal_n * cosine - shear_n * sine, 0.0)
        return shear_n * cosine + normal_n * sine - sign * self.friction * pressing

    def follow(self, state: BeltState, net_tension_n: float) -> BeltState:
        """Return the state with this net tension at the load."""
        up, net = math.exp(self.friction * self.gauge_angle_rad), net_tension_n
        tension_1 = _clip(state.gauge_tension_1_n, max(net, 0.0) / up, max(net, 0.0) * up)
        tension_2 = _clip(state.gauge_tension_2_n, max(-net, 0.0) / up, max(-net, 0.0) * up)
        return BeltState(net, tension_1, tension_2)

    def shear_range(
        self, tension_n: float, normal_n: float, turned_rad: float, direction: Direction
    ) -> tuple[float, float]:
        """Return the lowest and the highest shear force (N) for a net tension at the gauges and a load that has turned.

        While the magnitude of the response rises or falls, the skin slips all the way to the gauge, and one tension
        gives one force. In an unknown direction it lies between the two; without tension, within the deadband.
        """
        if tension_n == 0:
            hold = self.friction * max(normal_n, 0.0)
            return -hold, hold
        up = math.exp(self.friction * self.gauge_angle_rad)
        sign = math.copysign(1.0, tension_n)
        loading = self._shear(tension_n * up, normal_n, turned_rad, sign)
        unloading = self._shear(tension_n / up, normal_n, turned_rad, -sign)
        if direction is Direction.LOADING:
            return loading, loading
        if direction is Direction.UNLOADING:
            return unloading, unloading
        return min(loading, unloading), max(loading, unloading)

    def _shear(self, net_n: float, normal_n: float, turned_rad: float, sign: float) -> float:
        """Return the shear force for a net tension: the inverse of `pull`."""
        normal_n, friction = max(normal_n, 0.0), sign * self.friction
        cosine, sine = math.cos(turned_rad), math.sin(turned_rad)
        shear_n = (net_n - normal_n * (sine - friction * cosine)) / (cosine + friction * sine)
        return shear_n if normal_n * cosine > shear_n * sine else (net_n - normal_n * sine) / cosine


# The slack side is a quarter of a ring that bends; its stiffness against the rotation of its end about the core, over
# the sheet's, goes with (t/R)².
SLACK_STIFFNESS = math.pi / 2 / (12 * (math.pi / 2 - 8 / (math.pi + 2)))
# The ring's compliance grows with the slip in thicknesses: fitted to the finite-strain reference.
SLACK_SOFTENING = 0.72
# The first leaves 0.1 % at 5 N, the third 1e-5.
NEWTON_STEPS = 3


class Membrane:
    """The skin of a section at finite strain: a sheet of neo-Hookean rubber on the stretched side, T ∝ (λ − λ⁻³)/4.

    The load turns by the sheet's lengthening, α = π/2 (λ − 1). Forces and friction are those at the outer radius.
    """

    def __init__(self, section: Section) -> None:
        radius, thickness, nu = section.mid_radius_mm, section.thickness_mm, section.poisson_ratio
        self.section = section
        self.belt = Belt(section.friction * section.inner_radius_mm / section.outer_radius_mm, section.gauge_angle_rad)
        axial_n = section.young_mpa / (1 - nu**2) * section.width_mm * thickness
        per_n = section.outer_radius_mm / radius / axial_n
        slack_share = 1 - 1 / (1 + SLACK_STIFFNESS * (thickness / radius) ** 2)
        begin, end = math.radians(section.gauge_from_deg), math.radians(section.gauge_to_deg)
        # Mean of sin θ + cos θ, the course of the ring's axial force from the bracket, over the gauge.
        course = (math.sin(end) - math.cos(end) - math.sin(begin) + math.cos(begin)) / (end - begin)
        # Strains per N at small strain, of the sheet and of the slack gauge.
        self.sheet_per_n = (1 + nu / (1 - nu) * thickness / (2 * radius)) * (1 - slack_share) * per_n
        self._slack_per_n = 4 / (math.pi + 2) * course * slack_share * per_n
        self._softening = SLACK_SOFTENING * radius / thickness

    def step(self, state: BeltState, shear_n: float, normal_n: float) -> BeltState:
        """Return the state after the forces (N) have gone straight to these values."""
        normal_n, turned = max(normal_n, 0.0), self.turned_rad(state)
        net = state.net_tension_n
        if net < self.belt.pull(shear_n, normal_n, turned, 1.0):
            net = self._slip(shear_n, normal_n, 1.0)
        elif net > self.belt.pull(shear_n, normal_n, turned, -1.0):
            net = self._slip(shear_n, normal_n, -1.0)
        return self.belt.follow(state, net)

    def response(self, state: BeltState) -> float:
        """Return λ₁² − λ₂², the normalised response of equation (1) at finite strain."""
        first, second = (stretch(self.sheet_per_n * t) for t in (state.gauge_tension_1_n, state.gauge_tension_2_n))
        bent = 1 + self._softening * abs(self.turned_rad(state))
        return first**2 - second**2 + GAUGE_FACTOR * self._slack_per_n * state.net_tension_n / bent

    def turned_rad(self, state: BeltState) -> float:
        """Return the load's angle about the core."""
        return self._turned(state.net_tension_n)[0]

    def _turned(self, net_n: float) -> tuple[float, float]:
        """Return the load's angle for a net tension, and its derivative."""
        stretched = stretch(self.sheet_per_n * abs(net_n))
        slope = 4 / (1 + 3 * stretched**-4) * self.sheet_per_n
        return math.copysign(math.pi / 2 * (stretched - 1), net_n), math.pi / 2 * slope

    def _slip(self, shear_n: float, normal_n: float, sign: float) -> float:
        """Return the net tension of a skin that slips under the load: pull and angle depend on each other."""
        net = self.belt.pull(shear_n, normal_n, 0.0, sign)
        for _ in range(NEWTON_STEPS):
            turned, slope = self._turned(net)
            pressing = normal_n * math.cos(turned) - shear_n * math.sin(turned)
            net -= (net - self.belt.pull(shear_n, normal_n, turned, sign)) / (1 - slope * pressing)
        return net


def stretch(small: float) -> float:
    """Return λ with (λ − λ⁻³)/4 equal to the strain that the same tension makes at small strain, by a Newton step."""
    start = 1 + small * (1 + 1.5 * small)
    return start - ((start - start**-3) / 4 - small) / ((1 + 3 * start**-4) / 4)


def direction_of(before: float, now: float, noise: float) -> Direction:
    """Return the direction of loading that two responses prove; UNKNOWN where they differ by no more than the noise.

    A response of rising magnitude proves slip at the gauge, hence loading. A constant one proves nothing.
    """
    change = abs(now) - abs(before)
    if before * now < 0 or abs(change) <= noise:
        return Direction.UNKNOWN
    return Direction.LOADING if change > 0 else Direction.UNLOADING


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
