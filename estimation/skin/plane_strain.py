"""The skin in two dimensions: plane strain, small strain, quadratic quadrilaterals, contact with Coulomb friction.

With C the nodes on the core, λ the contact forces there and f the load, the skin is linear in them:
u_C = W λ + w f and ε = V λ + v f. `condense` computes these matrices once per mesh, exactly; it only eliminates
unknowns without contact force. With u = W λ + u₀ at n contact nodes (radial components first, then circumferential)
the contact conditions are

    radial:           0 ≤ λ_n,  0 ≤ u_n,  λ_n u_n = 0
    circumferential:  |λ_t| ≤ μ λ_n,  λ_t = −μ λ_n sign(u_t − u_t,before) where that difference is not 0.

Both are one piecewise linear equation Φ(λ) = 0 (Alart & Curnier 1991; Hüeber, Stadler & Wohlmuth, SIAM J. Sci. Comput.
30 (2008)), solved by a semismooth Newton method: each step guesses which nodes are apart, stick or slip, and solves the
linear system of that guess. If this does not converge, Lemke's method solves the same conditions as a linear
complementarity problem.
"""

import math
from collections.abc import Iterable
from dataclasses import astuple, dataclass, replace
from typing import NamedTuple

import numpy as np
import skfem
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from skfem.helpers import grad
from skfem.models.elasticity import lame_parameters, linear_elasticity

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import BankError
from shearloop.estimation.skin.membrane import GAUGE_FACTOR, Section

# More steps go in a circle.
MAX_STEPS = 30
# Relative to the largest contact force: about a thousand roundings.
TOLERANCE = 1e-11
# Lemke's method takes about one pivot to two rows.
MAX_PIVOTS_PER_ROW, PIVOT_TOLERANCE = 20, 1e-12


class ContactError(BankError):
    """The contact conditions could not be met."""


@dataclass(frozen=True, slots=True)
class MeshSize:
    """Elements from bracket to gauge, along the gauge, from gauge to load, under the load, and through the skin."""

    bracket: int = 5
    gauge: int = 9
    flank: int = 13
    load: int = 2
    layers: int = 2

    def refined(self, times: int) -> "MeshSize":
        """Return the size with every element cut into times × times."""
        return MeshSize(*(times * n for n in astuple(self)))


MESH_112 = MeshSize()


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
    """The skin as seen from its n contact nodes and m elements at the gauges' depth; forces in N, displacements in mm.

    `compliance` is (2n, 2n), radial components first. `load_displacement` (2n, 2) and `load_strain` (m, 2) answer a
    unit normal force (towards the core) and a unit shear force. `strain_of_contact` is (m, 2n). `gauge_weights` (2, m)
    average over each gauge.
    """

    section: Section
    contact_deg: FloatArray
    compliance: FloatArray
    load_displacement: FloatArray
    line_deg: FloatArray
    strain_of_contact: FloatArray
    load_strain: FloatArray
    gauge_weights: FloatArray


def condense(section: Section, size: MeshSize = MESH_112) -> CondensedSkin:
    """Return the skin condensed to its contact nodes: clamped at both brackets, loaded evenly on the load's arc."""
    mesh = SkinMesh(section, size)
    nodes, theta = mesh.contact_nodes()
    contact = mesh.contact_frame(nodes, theta).T[:, mesh.free]
    line = mesh.gauge_line()
    strain = line.mean_strain()[:, mesh.free]
    stiffness = section.width_mm * plane_strain_stiffness(mesh.basis, section.young_mpa, section.poisson_ratio)
    factor = splu(stiffness[mesh.free][:, mesh.free].tocsc())
    by_load, by_contact = factor.solve(mesh.load()[mesh.free]), factor.solve(contact.T.toarray())
    return CondensedSkin(
        section=section,
        contact_deg=np.degrees(theta),
        compliance=contact @ by_contact,
        load_displacement=contact @ by_load,
        line_deg=line.degrees,
        strain_of_contact=strain @ by_contact,
        load_strain=strain @ by_load,
        gauge_weights=line.weights,
    )


class SkinMesh:
    """A section's mesh with its basis, its dofs that are not clamped, and its places of contact, gauges and load."""

    def __init__(self, section: Section, size: MeshSize) -> None:
        self.section = section
        self.mesh = annulus_mesh(section, size)
        self.basis = skfem.Basis(self.mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=4)
        clamped = self.mesh.facets_satisfying(lambda x: abs(x[1]) < 1e-9, boundaries_only=True)
        self.free: IntArray = self.basis.complement_dofs(self.basis.get_dofs(clamped).flatten())
        self._layers = size.layers

    def _facets_at(self, radius_mm: float) -> IntArray:
        """Return the facets along a circle; all three nodes of such a curved facet lie on it."""
        r = np.hypot(*self.mesh.p[:, self.mesh.facets])
        on_circle = (abs(r - radius_mm) < 1e-9 * radius_mm).all(axis=0)
        return np.flatnonzero(on_circle)

    def contact_nodes(self) -> tuple[IntArray, FloatArray]:
        """Return the (2, n) dofs of x and y of the nodes that may touch the core, and their θ (n,), rising."""
        facets = self._facets_at(self.section.inner_radius_mm)
        nodes = np.unique(self.mesh.facets[:, facets])
        pairs = np.hstack([self.basis.nodal_dofs[:, nodes], self.basis.facet_dofs[:, facets]])
        theta = angle(self.basis.doflocs[:, pairs[0]])
        kept = (theta > 1e-9) & (theta < np.pi - 1e-9)
        order = np.flatnonzero(kept)[np.argsort(theta[kept])]
        return pairs[:, order], theta[order]

    def contact_frame(self, nodes: IntArray, theta: FloatArray) -> csc_matrix:
        """Return the (dofs, 2n) unit vectors at these nodes: radial ones first, then along the core."""
        n = len(theta)
        columns = np.tile(np.arange(n), 2)
        values = np.concatenate([*radial(theta), *along(theta)])
        rows = np.concatenate([nodes.ravel(), nodes.ravel()])
        return csc_matrix((values, (rows, np.concatenate([columns, n + columns]))), shape=(self.basis.N, 2 * n))

    def gauge_line(self) -> "GaugeLine":
        """Return the elements at the gauges' depth."""
        height = self._layers * (0.5 + self.section.gauge_depth_mm / self.section.thickness_mm)
        layer = min(int(height), self._layers - 1)
        corners = self.mesh.p[:, self.mesh.t]
        inner, step = self.section.inner_radius_mm, self.section.thickness_mm / self._layers
        elements = np.flatnonzero((np.hypot(*corners).mean(axis=0) - inner) // step == layer)
        theta = np.degrees(angle(corners[:, :, elements]))
        order = np.argsort(theta.mean(axis=0))
        elements, theta = elements[order], theta[:, order]
        # The first reference coordinate goes along the skin, the second outwards.
        places, shares = np.polynomial.legendre.leggauss(3)
        points = np.vstack([(places + 1) / 2, np.full(3, height - layer)])
        basis = skfem.Basis(self.mesh, self.basis.elem, elements=elements, quadrature=(points, shares / 2))
        degrees, spans = theta.mean(axis=0), np.ptp(theta, axis=0)
        in_gauge = (degrees > self.section.gauge_from_deg) & (degrees < self.section.gauge_to_deg)
        weights = np.array([in_gauge * spans, in_gauge[::-1] * spans])
        return GaugeLine(basis, degrees, weights / weights.sum(axis=1, keepdims=True), shares / 2)

    def load(self) -> FloatArray:
        """Return the (dofs, 2) nodal forces of 1 N towards the core and of 1 N of shear, even over the loaded arc."""
        facets = self._facets_at(self.section.outer_radius_mm)
        theta = angle(self.mesh.p[:, self.mesh.facets[:, facets]].mean(axis=1))
        facets = facets[abs(np.degrees(theta) - 90) < self.section.load_arc_deg / 2]
        basis = skfem.FacetBasis(self.mesh, self.basis.elem, facets=facets, intorder=5)
        length = basis.dx.sum()
        normal = skfem.LinearForm(lambda v, _: v[1] / length).assemble(basis)
        shear = skfem.LinearForm(lambda v, _: v[0] / length).assemble(basis)
        return np.column_stack([normal, shear])


@dataclass(frozen=True, slots=True, eq=False)
class GaugeLine:
    """The m elements at the gauges' depth, by rising angle: middles, gauges' weights (2, m), fractions of 3 points."""

    basis: skfem.Basis
    degrees: FloatArray
    weights: FloatArray
    shares: FloatArray

    def mean_strain(self) -> csc_matrix:
        """Return the (m, dofs) matrix of each element's mean ε_θθ."""
        basis = self.basis
        directions = along(angle(np.asarray(basis.global_coordinates())))
        values = [
            np.einsum("i...,ij...,j...->...", directions, grad(basis.basis[i][0]), directions) @ self.shares
            for i in range(basis.Nbfun)
        ]
        m = len(self.degrees)
        rows = np.tile(np.arange(m), basis.Nbfun)
        places = rows, np.concatenate([basis.element_dofs[i] for i in range(basis.Nbfun)])
        return csc_matrix((np.concatenate(values), places), shape=(m, basis.N))


def angle(points: FloatArray) -> FloatArray:
    """Return the paper's angle θ of points (2, …), in rad."""
    theta: FloatArray = np.arctan2(-points[1], -points[0])
    return theta


def radial(theta: FloatArray) -> FloatArray:
    """Return the (2, …) unit vectors away from the core."""
    return np.array([-np.cos(theta), -np.sin(theta)])


def along(theta: FloatArray) -> FloatArray:
    """Return the (2, …) unit vectors along the core, towards larger angles."""
    return np.array([np.sin(theta), -np.cos(theta)])


@dataclass(frozen=True, slots=True, eq=False)
class ContactState:
    """The skin at rest under a load: contact forces (2n,) in N, circumferential displacements (n,) in mm.

    `steps` of Newton's method found it, `pivoted` after Lemke's method.
    """

    normal_n: float
    shear_n: float
    contact_force_n: FloatArray
    along_mm: FloatArray
    steps: int = 0
    pivoted: bool = False


def unloaded(skin: CondensedSkin) -> ContactState:
    """Return the skin as it is mounted: without load, without contact force."""
    n = len(skin.contact_deg)
    return ContactState(0.0, 0.0, np.zeros(2 * n), np.zeros(n))


def apply_load(skin: CondensedSkin, before: ContactState, normal_n: float, shear_n: float) -> ContactState:
    """Return the state after one increment of load (N); ContactError where the contact conditions cannot be met."""
    free = skin.load_displacement @ (normal_n, shear_n)
    stiffness = 1 / np.diag(skin.compliance)
    problem = ContactProblem(skin.compliance, free, before.along_mm, skin.section.friction, stiffness)
    found, n = problem.solution(before.contact_force_n), len(before.along_mm)
    along_mm = skin.compliance[n:] @ found.force_n + free[n:]
    return ContactState(normal_n, shear_n, found.force_n, along_mm, found.steps, found.pivoted)


def states_along(skin: CondensedSkin, normal_n: float, shear_n: Iterable[float]) -> list[ContactState]:
    """Return one state per shear force along a path; the normal force is applied first, to the unloaded skin.

    Friction depends on the path: the paper's steps are 0.1 N.
    """
    state, states = apply_load(skin, unloaded(skin), normal_n, 0.0), []
    for shear in shear_n:
        state = apply_load(skin, state, normal_n, float(shear))
        states.append(state)
    return states


def line_strain(skin: CondensedSkin, state: ContactState) -> FloatArray:
    """Return the (m,) circumferential strain at the gauges' depth, at the angles `skin.line_deg`."""
    strain: FloatArray = skin.strain_of_contact @ state.contact_force_n
    strain += skin.load_strain @ (state.normal_n, state.shear_n)
    return strain


def gauge_strains(skin: CondensedSkin, states: Iterable[ContactState]) -> FloatArray:
    """Return the (states, 2) mean circumferential strains of the two gauges."""
    return np.array([skin.gauge_weights @ line_strain(skin, state) for state in states])


def gauge_depth_mm(section: Section, slack_ratio: float) -> float | None:
    """Return the depth (mm, outwards from mid-thickness) where the slack gauge reads this fraction of the other one.

    The slack side bends, so the fraction rises outwards. None where no depth within the skin has this fraction.
    """
    depths = np.linspace(-0.5, 0.5, 5) * section.thickness_mm
    shares = []
    for depth in depths.tolist():
        skin = condense(replace(section, gauge_depth_mm=depth))
        strain_1, strain_2 = gauge_strains(skin, states_along(skin, 1.0, [1.0]))[0]
        shares.append(strain_2 / strain_1)
    depth = float(np.interp(slack_ratio, shares, depths, left=math.nan, right=math.nan))
    return None if math.isnan(depth) else depth


def gauge_responses(skin: CondensedSkin, states: Iterable[ContactState]) -> FloatArray:
    """Return the (states,) responses F (ε₁ − ε₂), the modelled side of the paper's equation (1)."""
    return gauge_strains(skin, states) @ [GAUGE_FACTOR, -GAUGE_FACTOR]


class ContactSolution(NamedTuple):
    """Contact forces (2n,) in N, the steps of Newton's method, and whether Lemke's method came before the last ones."""

    force_n: FloatArray
    steps: int
    pivoted: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class ContactProblem:
    """One increment of contact at n nodes.

    `compliance` (2n, 2n) mm/N; `displacement` (2n,) mm without contact; `along_before` (n,) mm at the previous
    increment; `stiffness` (2n,) N/mm, positive, scales displacements to forces: any numbers give the same solution.
    """

    compliance: FloatArray
    displacement: FloatArray
    along_before: FloatArray
    friction: float
    stiffness: FloatArray

    def solution(self, start: FloatArray) -> ContactSolution:
        """Return the contact forces, from a start (2n,) in N.

        There is a solution wherever the compliance is positive definite. Raises ContactError for a load that is not a
        number.
        """
        if not (np.isfinite(self.displacement).all() and np.isfinite(start).all()):
            raise ContactError("The skin's load is not a number; give its normal and shear force in N.")
        force, steps, converged = self.newton(start)
        if converged:
            return ContactSolution(force, steps)
        pivoted = self.pivot()
        # Newton's method removes the rounding of the pivots.
        polished, more, converged = self.newton(pivoted)
        return ContactSolution(polished if converged else pivoted, steps + more, True)

    def newton(self, force: FloatArray) -> tuple[FloatArray, int, bool]:
        """Return where a semismooth Newton method comes from these forces, its steps, and whether it converged."""
        smallest = np.finfo(np.float64).tiny
        for step in range(MAX_STEPS):
            residual, touching, slipping = self.residual(force)
            if np.linalg.norm(residual) <= max(TOLERANCE * abs(force).max(), smallest):
                return force, step, True
            solved = self.solve(touching, slipping)
            if solved is None:
                return force, step, False
            force = solved
        return force, MAX_STEPS, False

    def residual(self, force: FloatArray) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Return Φ (2n,) in N, and the piece of Φ that contains the forces.

        That is which nodes (n,) touch, and the sign (n,) of λ_t where one slips, 0 where it sticks; the sign means
        nothing at a node that does not touch.
        """
        n = len(self.along_before)
        moved = self.compliance @ force + self.displacement
        moved[n:] -= self.along_before
        trial = force - self.stiffness * moved
        pressing = np.maximum(trial[:n], 0.0)
        bound = self.friction * pressing
        wanted = np.concatenate([pressing, np.clip(trial[n:], -bound, bound)])
        slipping = np.sign(trial[n:]) * (abs(trial[n:]) >= bound)
        return force - wanted, trial[:n] > 0, slipping

    def solve(self, touching: BoolArray, slipping: FloatArray) -> FloatArray | None:
        """Return the forces of a piece: u_n = 0 where touching; there u_t as before or λ_t = ±μ λ_n.

        None where the piece is singular: the sliding skin wedges.
        """
        n, nodes = len(self.along_before), np.flatnonzero(touching)
        sticking = n + nodes[slipping[nodes] == 0]
        slip = self.friction * slipping[nodes]
        rows = np.concatenate([nodes, sticking])
        by_pressing = self.compliance[np.ix_(rows, nodes)] + self.compliance[np.ix_(rows, n + nodes)] * slip
        matrix = np.hstack([by_pressing, self.compliance[np.ix_(rows, sticking)]])
        wanted = -self.displacement[rows]
        wanted[len(nodes) :] += self.along_before[sticking - n]
        try:
            solution = np.linalg.solve(matrix, wanted)
        except np.linalg.LinAlgError:
            return None
        force = np.zeros(2 * n)
        force[nodes] = solution[: len(nodes)]
        force[n + nodes] = slip * force[nodes]
        force[sticking] = solution[len(nodes) :]
        return force

    def pivot(self) -> FloatArray:
        """Return the solution by Lemke's method: exact but for rounding, from any load and any history.

        With λ_t = β⁺ − β⁻ and γ the slip, the conditions are a linear complementarity problem in (λ_n, β⁺, β⁻, γ) ≥ 0
        with the slacks (u_n, γ + u_t − u_t,before, γ − u_t + u_t,before, μ λ_n − β⁺ − β⁻). Its matrix is copositive.
        Without displacements only γ alone solves it, which no displacement multiplies, so the method cannot end in a
        ray (Cottle, Pang & Stone, The Linear Complementarity Problem, section 4.4).
        """
        n = len(self.along_before)
        scale = np.sqrt(self.stiffness)
        scaled, moved = self.compliance * np.outer(scale, scale), self.displacement.copy()
        moved[n:] -= self.along_before
        moved *= scale
        size = max(abs(moved).max(), np.finfo(np.float64).tiny)
        one, none = np.eye(n), np.zeros((n, n))
        (rr, rt), (tr, tt) = (np.hsplit(half, 2) for half in np.vsplit(scaled, 2))
        bound = np.diag(self.friction * scale[:n] / scale[n:])
        matrix = np.block([[rr, rt, -rt, none], [tr, tt, -tt, one], [-tr, -tt, tt, one], [bound, -one, -one, none]])
        gaps, slips = np.split(moved / size, 2)
        found = lemke(matrix, np.concatenate([gaps, slips, -slips, np.zeros(n)]))
        force: FloatArray = np.concatenate([found[:n], found[n : 2 * n] - found[2 * n : 3 * n]]) * scale * size
        return force


def lemke(matrix: FloatArray, constant: FloatArray) -> FloatArray:
    """Return z ≥ 0 with w = matrix z + constant ≥ 0 and wᵀz = 0, by complementary pivoting.

    Raises ContactError where it ends in a ray.
    """
    n = len(constant)
    # Uneven weights of the artificial variable break ties.
    weights = np.random.default_rng(0).uniform(1.0, 2.0, n)
    # Rows are the basic variables, columns the others and the constant. Variables: z, w, then the artificial one.
    table = np.column_stack([matrix, weights, constant])
    artificial = 2 * n
    basic, others = np.arange(n, 2 * n), np.append(np.arange(n), artificial)
    row, column = int(np.argmin(constant / weights)), n
    if constant[row] >= 0:
        return np.zeros(n)
    for _ in range(MAX_PIVOTS_PER_ROW * n):
        pivot = table[row, column]
        swapped, factors = -table[row] / pivot, table[:, column].copy()
        swapped[column], factors[row] = 1 / pivot, 0.0
        table[row] = table[:, column] = 0.0
        table += np.outer(factors, swapped)
        table[row] = swapped
        left = basic[row]
        basic[row], others[column] = others[column], left
        values = np.zeros(artificial + 1)
        values[basic] = np.maximum(table[:, -1], 0.0)
        if values[artificial] <= PIVOT_TOLERANCE:
            return values[:n]
        column = int(np.flatnonzero(others == (left + n) % artificial)[0])
        rate = table[:, column]
        falling = np.flatnonzero(rate < -PIVOT_TOLERANCE)
        if not falling.size:
            break
        row = int(falling[np.argmin(np.maximum(table[falling, -1], 0.0) / -rate[falling])])
    raise ContactError("The contact of the skin could not be solved by pivoting.")
