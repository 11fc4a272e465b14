"""The skin in two dimensions: plane strain, small strain, quadratic quadrilaterals, condensed to the contact nodes.

With C the nodes on the core, λ the contact forces there and f the load, everything that is asked of the skin is
linear in them: u_C = W λ + w f and ε = V λ + v f. `condense` computes these matrices once per mesh; `contact`
then works on them alone. Condensation is exact: it only eliminates unknowns that carry no contact force.
"""

from dataclasses import dataclass

import numpy as np
import skfem
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from skfem.helpers import grad
from skfem.models.elasticity import lame_parameters, linear_elasticity

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.errors import GeometryError
from shearloop.bank.skin.section import Section


@dataclass(frozen=True, slots=True)
class MeshSize:
    """Elements from bracket to gauge, along the gauge, from gauge to load, under the load, and through the skin."""

    bracket: int = 5
    gauge: int = 9
    flank: int = 13
    load: int = 2
    layers: int = 2

    def __post_init__(self) -> None:
        """Refuse a mesh without elements or without a line of nodes and facets at mid-thickness."""
        if min(self.bracket, self.gauge, self.flank, self.load) < 1 or self.layers < 2 or self.layers % 2:
            raise GeometryError(f"{self} needs at least one element per stretch and an even number of layers.")

    def refined(self, times: int) -> "MeshSize":
        """Return the size with every element cut into times × times."""
        return MeshSize(
            times * self.bracket, times * self.gauge, times * self.flank, times * self.load, times * self.layers
        )

    @property
    def elements(self) -> int:
        """Number of quadrilaterals."""
        return (2 * (self.bracket + self.gauge + self.flank) + self.load) * self.layers


MESH_56 = MeshSize(3, 4, 6, 2, 2)
MESH_112 = MeshSize()
MESH_448 = MESH_112.refined(2)
MESH_1792 = MESH_112.refined(4)


def annulus_mesh(section: Section, size: MeshSize = MESH_112) -> skfem.MeshQuad2:
    """Return the half annulus as curved nine-node quadrilaterals, x = −r cos θ, y = −r sin θ, in mm.

    Element edges fall on the ends of the gauges and of the loaded arc.
    """
    radii = np.linspace(section.inner_radius_mm, section.outer_radius_mm, size.layers + 1)
    load_from = 90 - section.load_arc_deg / 2
    ends = [0.0, section.gauge_from_deg, section.gauge_to_deg, load_from]
    ends += [180 - end for end in reversed(ends)]
    side = [size.bracket, size.gauge, size.flank]
    counts = [*side, size.load, *reversed(side)]
    stretches = [
        np.linspace(begin, end, n, endpoint=False) for begin, end, n in zip(ends[:-1], ends[1:], counts, strict=True)
    ]
    angles = np.radians(np.append(np.concatenate(stretches), 180.0))
    flat = skfem.MeshQuad2.from_mesh(skfem.MeshQuad.init_tensor(radii, angles))
    r, theta = flat.doflocs
    return skfem.MeshQuad2(np.vstack([-r * np.cos(theta), -r * np.sin(theta)]), flat.t)


def plane_strain_stiffness(basis: skfem.Basis, young_mpa: float, poisson_ratio: float) -> csc_matrix:
    """Return the stiffness per millimetre of width, N/mm²."""
    form = linear_elasticity(*lame_parameters(young_mpa, poisson_ratio))
    return csc_matrix(form.assemble(basis))


@dataclass(frozen=True, slots=True)
class CondensedSkin:
    """The skin as seen from its n contact nodes and m mid-line facets; forces in N, displacements in mm.

    `compliance` is (2n, 2n): first the n radial, then the n circumferential components. `load_displacement` (2n, 2)
    and `load_strain` (m, 2) are the answers to a unit normal force (towards the core) and a unit shear force,
    `load_compliance` (2, 2) is how far the loaded arc itself gives way. `strain_of_contact` is (m, 2n).
    `gauge_weights` is (2, m): the mean over each gauge.
    """

    section: Section
    contact_deg: FloatArray
    compliance: FloatArray
    load_displacement: FloatArray
    load_compliance: FloatArray
    midline_deg: FloatArray
    strain_of_contact: FloatArray
    load_strain: FloatArray
    gauge_weights: FloatArray

    def load_movement_mm(self, contact_force_n: FloatArray, normal_n: float, shear_n: float) -> FloatArray:
        """Return how far the loaded arc has moved on average, (2,): towards the core and along the shear force."""
        moved: FloatArray = self.load_displacement.T @ contact_force_n + self.load_compliance @ (normal_n, shear_n)
        return moved

    def midline_strain(self, contact_force_n: FloatArray, normal_n: float, shear_n: float) -> FloatArray:
        """Return the (m,) mean circumferential strain of each mid-line facet."""
        strain: FloatArray = self.strain_of_contact @ contact_force_n + self.load_strain @ (normal_n, shear_n)
        return strain


def condense(section: Section, size: MeshSize = MESH_112) -> CondensedSkin:
    """Return the skin condensed to its contact nodes: clamped at both brackets, loaded evenly on the load's arc."""
    return _Assembly(section, size).condensed()


class _Assembly:
    def __init__(self, section: Section, size: MeshSize) -> None:
        self.section = section
        self.mesh = annulus_mesh(section, size)
        self.element = skfem.ElementVector(skfem.ElementQuad2())
        self.basis = skfem.Basis(self.mesh, self.element, intorder=4)

    def condensed(self) -> CondensedSkin:
        contact, contact_deg = self._contact_rotation()
        strain, midline_deg, weights = self._midline_strain()
        load = self._load()
        free = self.basis.complement_dofs(self._clamped())
        stiffness = self.section.width_mm * plane_strain_stiffness(
            self.basis, self.section.young_mpa, self.section.poisson_ratio
        )
        factor = splu(stiffness[free][:, free].tocsc())
        contact, strain, load = contact[:, free], strain[:, free], load[free]
        by_load, by_contact = factor.solve(load), factor.solve(contact.T.toarray())
        return CondensedSkin(
            section=self.section,
            contact_deg=contact_deg,
            compliance=contact @ by_contact,
            load_displacement=contact @ by_load,
            load_compliance=load.T @ by_load,
            midline_deg=midline_deg,
            strain_of_contact=strain @ by_contact,
            load_strain=strain @ by_load,
            gauge_weights=weights,
        )

    def _facets_at(self, radius_mm: float) -> IntArray:
        """Facets along a circle; with curved elements all three nodes of such a facet lie on it."""
        r = np.hypot(*self.mesh.p[:, self.mesh.facets])
        on_circle = (abs(r - radius_mm) < 1e-9 * radius_mm).all(axis=0)
        return np.flatnonzero(on_circle)

    def _clamped(self) -> IntArray:
        facets = self.mesh.facets_satisfying(lambda x: abs(x[1]) < 1e-9, boundaries_only=True)
        clamped: IntArray = self.basis.get_dofs(facets).flatten()
        return clamped

    def _contact_rotation(self) -> tuple[csc_matrix, FloatArray]:
        """The (2n, dofs) matrix that takes radial and circumferential displacement of the contact nodes; their θ."""
        facets = self._facets_at(self.section.inner_radius_mm)
        nodes = np.unique(self.mesh.facets[:, facets])
        pairs = np.hstack([self.basis.nodal_dofs[:, nodes], self.basis.facet_dofs[:, facets]])
        theta = _angle(self.basis.doflocs[:, pairs[0]])
        kept = (theta > 1e-9) & (theta < np.pi - 1e-9)
        order = np.flatnonzero(kept)[np.argsort(theta[kept])]
        pairs, theta = pairs[:, order], theta[order]
        n = len(theta)
        radial, along = _radial(theta), _along(theta)
        rows = np.concatenate([np.arange(n), np.arange(n), n + np.arange(n), n + np.arange(n)])
        columns = np.concatenate([pairs[0], pairs[1], pairs[0], pairs[1]])
        values = np.concatenate([*radial, *along])
        return csc_matrix((values, (rows, columns)), shape=(2 * n, self.basis.N)), np.degrees(theta)

    def _midline_strain(self) -> tuple[csc_matrix, FloatArray, FloatArray]:
        """The (m, dofs) matrix of facet means of ε_θθ, the facets' angles, and the two gauges' weights on them."""
        facets = self._facets_at(self.section.mid_radius_mm)
        theta = _angle(self.mesh.p[:, self.mesh.facets[:, facets]].mean(axis=1))
        facets, theta = facets[np.argsort(theta)], np.sort(theta)
        basis = skfem.InteriorFacetBasis(self.mesh, self.element, facets=facets, side=0, intorder=5)
        dofs, values = [], []
        lengths = basis.dx.sum(axis=1)
        along = _along(_angle(np.asarray(basis.global_coordinates())))
        for i in range(basis.Nbfun):
            gradient = grad(basis.basis[i][0])
            strain = np.einsum("i...,ij...,j...->...", along, gradient, along)
            values.append((strain * basis.dx).sum(axis=1) / lengths)
            dofs.append(basis.element_dofs[i])
        m = len(facets)
        rows = np.tile(np.arange(m), basis.Nbfun)
        matrix = csc_matrix((np.concatenate(values), (rows, np.concatenate(dofs))), shape=(m, self.basis.N))
        degrees = np.degrees(theta)
        in_gauge = (degrees > self.section.gauge_from_deg) & (degrees < self.section.gauge_to_deg)
        weights = np.array([in_gauge * lengths, in_gauge[::-1] * lengths])
        return matrix, degrees, weights / weights.sum(axis=1, keepdims=True)

    def _load(self) -> FloatArray:
        """The (dofs, 2) nodal forces of 1 N towards the core and of 1 N of shear, even over the loaded arc."""
        facets = self._facets_at(self.section.outer_radius_mm)
        theta = _angle(self.mesh.p[:, self.mesh.facets[:, facets]].mean(axis=1))
        facets = facets[abs(np.degrees(theta) - 90) < self.section.load_arc_deg / 2]
        basis = skfem.FacetBasis(self.mesh, self.element, facets=facets, intorder=5)
        length = basis.dx.sum()
        normal = skfem.LinearForm(lambda v, _: v[1] / length).assemble(basis)
        shear = skfem.LinearForm(lambda v, _: v[0] / length).assemble(basis)
        return np.column_stack([normal, shear])


def _angle(points: FloatArray) -> FloatArray:
    theta: FloatArray = np.arctan2(-points[1], -points[0])
    return theta


def _radial(theta: FloatArray) -> FloatArray:
    return np.array([-np.cos(theta), -np.sin(theta)])


def _along(theta: FloatArray) -> FloatArray:
    return np.array([np.sin(theta), -np.cos(theta)])
