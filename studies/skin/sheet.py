"""The skin as a sheet on the arc, at small strain: for plates narrower than the skin, and for transverse forces.

The sheet is unrolled: x = R θ goes along the arc, z across it, 0 in the middle. A rigid plate moves a patch of it, as
wide as the plate and as long as the load's arc. The side that the shear force stretches is in plane stress, pressed by
the core with T/R, and slips against the friction of that pressure. The other side is slack: a ring that bends, with the
share of the stiffness that `SLACK_STIFFNESS` gives. The sheet is loaded from rest and has no hysteresis.
"""

import math

import numpy as np
import skfem
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from shearloop.bank.arrays import FloatArray
from shearloop.estimation.skin.membrane import GAUGE_FACTOR, SLACK_STIFFNESS, Section

# The paper's loading plate and the width of its gauges.
PLATE_MM, GAUGE_WIDTH_MM = 14.0, 7.0


# Elements along the arc from bracket to gauge, of the gauge, to the load and to its middle; and across from the middle
# to the gauge's edge, to the plate's edge and to the skin's edge. They make 520.
ALONG, ACROSS = (3, 3, 6, 1), (4, 3, 3)


class SheetSkin:
    """A section's sheet under a plate; `held_edges` keeps the sheet from narrowing, as plane strain does."""

    def __init__(
        self, section: Section, plate_mm: float = PLATE_MM, finer: int = 1, *, held_edges: bool = False
    ) -> None:
        """Solve for both directions, for a plate that is wider than the gauges and no wider than the skin.

        Every element is cut into finer × finer.
        """
        self.section = section
        self._plate_mm = plate_mm
        self._basis = skfem.Basis(self._mesh(finer), skfem.ElementVector(skfem.ElementQuad2()), intorder=4)
        stiffness = csc_matrix(skfem.BilinearForm(self._work).assemble(self._basis))
        gauges = np.array([self._mean_strain(side) for side in (0, 1)])
        x, z = self._basis.doflocs
        across = np.zeros(self._basis.N, dtype=bool)
        across[self._basis.split_indices()[1]] = True
        load_mm = section.mid_radius_mm * math.radians(section.load_arc_deg / 2)
        plate = (abs(x - self._half_mm) < load_mm + 1e-9) & (abs(z) < plate_mm / 2 + 1e-9)
        held = plate | (x < 1e-9) | (x > 2 * self._half_mm - 1e-9) | (across & held_edges)
        moved = np.column_stack([plate & ~across, plate & across & (not held_edges)]).astype(float)
        free = ~held
        moved[free] = splu(stiffness[free][:, free]).solve(-(stiffness @ moved)[free])
        reaction = stiffness @ moved
        # Force on the plate (along, across) by its movement (along, across), at mid-thickness.
        by_movement = np.array([reaction[plate & ~across].sum(axis=0), reaction[plate & across].sum(axis=0)])
        lever = section.outer_radius_mm / section.mid_radius_mm
        self._gauges_per_n = lever * gauges @ moved @ np.linalg.pinv(by_movement)

    def gauge_strains(self, normal_n: float, shear_n: float, transverse_n: float = 0.0) -> FloatArray:
        """Return the (2,) mean strains of both gauges under forces (N) that rise from zero, the normal force first.

        Friction under the load opposes the resultant of shear and transverse force.
        """
        section, force = self.section, np.array([abs(shear_n), transverse_n])
        hold_n = section.friction * normal_n * section.inner_radius_mm / section.outer_radius_mm
        size_n = float(np.hypot(*force))
        slips = max(1 - hold_n / size_n, 0.0) if size_n > 0 else 0.0
        strains: FloatArray = self._gauges_per_n @ force * slips
        return strains if shear_n >= 0 else strains[::-1]

    def response(self, normal_n: float, shear_n: float, transverse_n: float = 0.0) -> float:
        """Return F (ε₁ − ε₂), equation (1) of the paper."""
        first, second = self.gauge_strains(normal_n, shear_n, transverse_n)
        return float(GAUGE_FACTOR * (first - second))

    @property
    def _half_mm(self) -> float:
        return math.pi / 2 * self.section.mid_radius_mm

    @property
    def _slack_share(self) -> float:
        return SLACK_STIFFNESS * (self.section.thickness_mm / self.section.mid_radius_mm) ** 2

    def _mesh(self, finer: int) -> skfem.MeshQuad2:
        section = self.section
        ends = [0.0, section.gauge_from_deg, section.gauge_to_deg, 90 - section.load_arc_deg / 2, 90.0]
        along = section.mid_radius_mm * np.radians(_stretches(ends, ALONG, finer))
        across = _stretches([0.0, GAUGE_WIDTH_MM / 2, self._plate_mm / 2, section.width_mm / 2], ACROSS, finer)
        x = np.append(along, 2 * self._half_mm - along[-2::-1])
        return skfem.MeshQuad2.from_mesh(skfem.MeshQuad.init_tensor(x, np.append(-across[:0:-1], across)))

    def _work(self, u: skfem.DiscreteField, v: skfem.DiscreteField, w: skfem.DiscreteField) -> FloatArray:
        """Return the work of tension and friction per area, N/mm; x is the first coordinate."""
        section = self.section
        young, nu, thickness = section.young_mpa, section.poisson_ratio, section.thickness_mm
        pressed, slack = thickness / (2 * section.mid_radius_mm), w.x[0] > self._half_mm
        taut = np.linalg.inv(np.array([[1 + nu * pressed, -nu], [-nu * (1 - pressed), 1]])) * young * thickness
        bent = np.linalg.inv(np.array([[1, -nu], [-nu, 1]])) * young * thickness * self._slack_share
        law = np.where(slack, bent[:, :, None, None], taut[:, :, None, None])
        strain = np.array([u.grad[0, 0], u.grad[1, 1]])
        tension = np.einsum("ij...,j...->i...", law, strain)
        shear = np.where(slack, self._slack_share, 1.0) * young * thickness / (2 * (1 + nu))
        friction = section.friction * section.inner_radius_mm / section.mid_radius_mm**2
        work: FloatArray = tension[0] * v.grad[0, 0] + tension[1] * v.grad[1, 1]
        work += shear * (u.grad[0, 1] + u.grad[1, 0]) * (v.grad[0, 1] + v.grad[1, 0])
        work += np.where(slack, 0.0, friction * tension[0]) * v[0]
        return work

    def _mean_strain(self, side: int) -> FloatArray:
        """Return the (dofs,) weights of a gauge's mean strain; the slack gauge's comes from the ring's tension."""
        section = self.section
        ends = section.mid_radius_mm * np.radians([section.gauge_from_deg, section.gauge_to_deg])
        if side == 1:
            ends = 2 * self._half_mm - ends[::-1]
        mesh = self._basis.mesh
        inside = mesh.elements_satisfying(
            lambda x: (ends[0] < x[0]) & (x[0] < ends[1]) & (abs(x[1]) < GAUGE_WIDTH_MM / 2)
        )
        basis = skfem.Basis(mesh, self._basis.elem, elements=inside, intorder=4)
        mean = skfem.LinearForm(lambda v, _: v.grad[0, 0]).assemble(basis) / basis.dx.sum()
        weights: FloatArray = mean * (self._slack_share if side == 1 else 1.0)
        return weights


def _stretches(ends: list[float], counts: tuple[int, ...], finer: int) -> FloatArray:
    """Return the points that cut each stretch between neighbouring ends into equal parts; empty stretches vanish."""
    parts = [np.linspace(a, b, finer * n + 1) for a, b, n in zip(ends[:-1], ends[1:], counts, strict=True)]
    return np.unique(np.concatenate(parts))
