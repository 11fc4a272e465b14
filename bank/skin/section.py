"""The skin's cross-section and material, with every assumption that the paper leaves to its reader.

Yin, Santos, Posner, "Bioinspired flexible microfluidic shear force sensor skin", Sensors and Actuators A 264 (2017).
The angle θ is the paper's: 0° and 180° at the two brackets, 90° under the load; a positive shear force pulls
towards larger θ, so that the skin below 90° is stretched.
"""

from dataclasses import dataclass

from shearloop.bank.errors import GeometryError


@dataclass(frozen=True, slots=True)
class Section:
    """Half an annulus of skin around a rigid core; lengths in mm, modulus in MPa (N/mm²), angles in degrees.

    The load coordinates of the paper, (0, −6.35) on the outer surface and (0, −6) on the mid-line, give the radii.
    They contradict its fabrication text (a 12 mm half-round under two 0.3 mm layers: mid-line at 6.3 mm, 0.6 mm
    thick); the coordinates are taken, because the computed results of the paper belong to them. The width is that
    of the sheet and of the half-round, 20 mm, loaded evenly. The gauge strips are 3 mm long, 28.65° on the
    mid-line; the paper says only "adjacent to the nail bed", here they begin at 15°, clear of the bracket's end
    effect by two thicknesses.
    """

    mid_radius_mm: float = 6.0
    thickness_mm: float = 0.70
    width_mm: float = 20.0
    young_mpa: float = 1.292
    poisson_ratio: float = 0.49
    friction: float = 0.04
    gauge_from_deg: float = 15.0
    gauge_to_deg: float = 43.65
    load_arc_deg: float = 5.0

    def __post_init__(self) -> None:
        """Refuse a section that cannot exist, naming the value."""
        for name in ("mid_radius_mm", "thickness_mm", "width_mm", "young_mpa", "load_arc_deg"):
            if not getattr(self, name) > 0:
                raise GeometryError(f"The skin's {name} is {getattr(self, name)!r}; give a positive number.")
        if self.thickness_mm >= 2 * self.mid_radius_mm:
            raise GeometryError(
                f"The skin's thickness_mm {self.thickness_mm} leaves no core inside mid_radius_mm {self.mid_radius_mm}."
            )
        if not 0 <= self.poisson_ratio < 0.5:
            raise GeometryError(f"The skin's poisson_ratio is {self.poisson_ratio!r}; it must lie in [0, 0.5).")
        if not 0 <= self.friction <= 1:
            raise GeometryError(f"The skin's friction is {self.friction!r}; it must lie in [0, 1].")
        if not 0 < self.gauge_from_deg < self.gauge_to_deg < 90 - self.load_arc_deg / 2:
            raise GeometryError(
                f"The gauge from {self.gauge_from_deg}° to {self.gauge_to_deg}° must lie between bracket (0°) and load."
            )

    @property
    def inner_radius_mm(self) -> float:
        """Radius of the rigid core."""
        return self.mid_radius_mm - self.thickness_mm / 2

    @property
    def outer_radius_mm(self) -> float:
        """Radius at which the load acts."""
        return self.mid_radius_mm + self.thickness_mm / 2


PAPER_SECTION = Section()
