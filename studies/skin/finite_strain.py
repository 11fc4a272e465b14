"""The skin at finite strain: plane strain, neo-Hookean, contact with Coulomb friction. The reference for large shear.

The energy per volume is μ/2 (F:F − 2 − 2 ln J) + Λ/2 (ln J)², with Lamé's constants μ and Λ. The load keeps its
direction and size (a dead load) and moves with the skin. A gauge's resistance goes with the square of its stretch, so
its response is the mean of λ² − 1. Each Newton step linearises the skin about its present shape, condenses it to its
contact nodes, and solves the contact there (Josephy–Newton); the frames at the nodes turn with them.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import skfem
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu
from skfem.models.elasticity import lame_parameters

from shearloop.bank.arrays import FloatArray
from shearloop.estimation.skin.membrane import Section
from shearloop.estimation.skin.plane_strain import (
    MESH_112,
    ContactError,
    ContactProblem,
    MeshSize,
    SkinMesh,
    along,
    angle,
    radial,
)

MAX_NEWTON_STEPS = 15
# The last Newton step, relative to the thickness.
TOLERANCE = 1e-9
# A load step that does not converge is halved, at most this often.
MAX_HALVINGS = 6


def internal_force(basis: skfem.Basis, displacement: FloatArray, young_mpa: float, poisson_ratio: float) -> FloatArray:
    """Return the nodal forces (dofs,) of the stresses, N per millimetre of width."""
    lame, shear = lame_parameters(young_mpa, poisson_ratio)

    def work(v: skfem.DiscreteField, w: skfem.DiscreteField) -> FloatArray:
        deformation, inverse, log_volume = _kinematics(w["u"].grad)
        stress = shear * deformation + (lame * log_volume - shear) * inverse
        found: FloatArray = np.einsum("ij...,ij...->...", stress, v.grad)
        return found

    force: FloatArray = skfem.LinearForm(work).assemble(basis, u=basis.interpolate(displacement))
    return force


def tangent(basis: skfem.Basis, displacement: FloatArray, young_mpa: float, poisson_ratio: float) -> csc_matrix:
    """Return the derivative of `internal_force`, N/mm per millimetre of width."""
    lame, shear = lame_parameters(young_mpa, poisson_ratio)

    def work(u: skfem.DiscreteField, v: skfem.DiscreteField, w: skfem.DiscreteField) -> FloatArray:
        _, inverse, log_volume = _kinematics(w["u"].grad)
        swelling = np.einsum("ij...,ij...->...", inverse, u.grad) * np.einsum("ij...,ij...->...", inverse, v.grad)
        turning = np.einsum("ij...,kj...,kl...,il...->...", inverse, u.grad, inverse, v.grad)
        stretching = np.einsum("ij...,ij...->...", u.grad, v.grad)
        found: FloatArray = shear * stretching + lame * swelling - (lame * log_volume - shear) * turning
        return found

    return csc_matrix(skfem.BilinearForm(work).assemble(basis, u=basis.interpolate(displacement)))


def _kinematics(gradient: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the deformation gradient F, its inverse transposed (both (2, 2, …)), and the logarithm of J."""
    (a, b), (c, d) = gradient
    a, d = 1 + a, 1 + d
    volume = a * d - b * c
    if not (volume > 0).all():
        raise ContactError("The skin's elements turn inside out; apply the load in smaller steps.")
    return np.array([[a, b], [c, d]]), np.array([[d, -c], [-b, a]]) / volume, np.log(volume)


def _stretch(basis: skfem.Basis, displacement: FloatArray) -> FloatArray:
    """Return the stretches (elements, points) of the skin's circumferential direction."""
    directions = along(angle(np.asarray(basis.global_coordinates())))
    gradient = basis.interpolate(displacement).grad
    return np.asarray(np.hypot(*(directions + np.einsum("ij...,j...->i...", gradient, directions))))


@dataclass(frozen=True, slots=True, eq=False)
class FiniteState:
    """The skin at rest: load in N, displacement (dofs,) in mm, contact forces (2n,) in N, angles (n,) of the nodes."""

    normal_n: float
    shear_n: float
    displacement_mm: FloatArray
    contact_force_n: FloatArray
    contact_rad: FloatArray


class FiniteStrainSkin:
    """The skin of a section on a mesh."""

    def __init__(self, section: Section, size: MeshSize = MESH_112) -> None:
        self.section = section
        self.mesh = SkinMesh(section, size)
        self._nodes, angles = self.mesh.contact_nodes()
        self._rest = self.mesh.basis.doflocs[:, self._nodes[0]]
        self._load = self.mesh.load()
        self._line = self.mesh.gauge_line()
        n = len(angles)
        self.unloaded = FiniteState(0.0, 0.0, np.zeros(self.mesh.basis.N), np.zeros(2 * n), angles)
        # Without the core the pressed skin is unstable, and its own compliance no scale.
        compliance = self._linearised(self.unloaded.displacement_mm, np.zeros(2 * n), angles, (0.0, 0.0))[1]
        self._stiffness = 1 / np.diag(compliance)

    def states_along(self, normal_n: float, shear_n: Iterable[float]) -> list[FiniteState]:
        """Return one state per shear force (N) along a path; the normal force is applied first."""
        state, states = self.apply_load(self.unloaded, normal_n, 0.0), []
        for shear in shear_n:
            state = self.apply_load(state, normal_n, float(shear))
            states.append(state)
        return states

    def apply_load(self, before: FiniteState, normal_n: float, shear_n: float, halvings: int = 0) -> FiniteState:
        """Return the state after an increment of load (N); ContactError where its smallest part does not converge."""
        try:
            return self._newton(before, normal_n, shear_n)
        except ContactError:
            if halvings == MAX_HALVINGS:
                raise
        middle = (before.normal_n + normal_n) / 2, (before.shear_n + shear_n) / 2
        return self.apply_load(self.apply_load(before, *middle, halvings + 1), normal_n, shear_n, halvings + 1)

    def gauge_responses(self, states: Iterable[FiniteState]) -> FloatArray:
        """Return the (states, 2) changes of resistance of both gauges, ΔR/R₀ = mean of λ² − 1."""
        line = self._line
        stretches = (_stretch(line.basis, state.displacement_mm) for state in states)
        return np.array([line.weights @ (stretch**2 - 1) @ line.shares for stretch in stretches])

    def strain_map(self, state: FiniteState) -> tuple[FloatArray, FloatArray]:
        """Return a moved grid of places in each element, (2, elements, 3, 3) in mm, and λ − 1 along the skin there."""
        ends = np.linspace(0.0, 1.0, 3)
        grid = np.array(np.meshgrid(ends, ends, indexing="ij")).reshape(2, 9)
        basis = skfem.Basis(self.mesh.mesh, self.mesh.basis.elem, quadrature=(grid, np.full(9, 1 / 9)))
        places = np.asarray(basis.global_coordinates() + basis.interpolate(state.displacement_mm))
        strain = _stretch(basis, state.displacement_mm) - 1
        return places.reshape(2, -1, 3, 3), strain.reshape(-1, 3, 3)

    def _newton(self, before: FiniteState, normal_n: float, shear_n: float) -> FiniteState:
        displacement, force = before.displacement_mm.copy(), before.contact_force_n
        none = np.zeros(len(before.contact_rad))
        for _ in range(MAX_NEWTON_STEPS):
            step, compliance, way, by_contact = self._linearised(
                displacement, force, before.contact_rad, (normal_n, shear_n)
            )
            problem = ContactProblem(compliance, way, none, self.section.friction, self._stiffness)
            force = problem.solution(force).force_n
            step = step + by_contact @ force
            displacement[self.mesh.free] += step
            if abs(step).max() <= TOLERANCE * self.section.thickness_mm:
                return FiniteState(normal_n, shear_n, displacement, force, angle(self._places(displacement)))
        raise ContactError("The shape of the skin did not converge; apply the load in smaller steps.")

    def _linearised(
        self, displacement: FloatArray, force: FloatArray, angles_before: FloatArray, load_n: tuple[float, float]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return, without contact forces, the step (free dofs,) to balance, and the skin at its contact nodes.

        The latter are compliance (2n, 2n), gap and slip (2n,) after the step, and the step by contact force.
        """
        section, free = self.section, self.mesh.free
        material = section.young_mpa, section.poisson_ratio
        places = self._places(displacement)
        theta, radius = angle(places), np.hypot(*places)
        n, inner = len(theta), section.inner_radius_mm
        # A contact force turns with its node.
        turned = along(theta) * force[:n] - radial(theta) * force[n:]
        turning = np.einsum("in,jn->ijn", turned, along(theta) / radius)
        rows, columns = np.broadcast_arrays(self._nodes[:, None], self._nodes[None])
        frames = coo_matrix((turning.ravel(), (rows.ravel(), columns.ravel())), shape=(self.mesh.basis.N,) * 2)
        stiffness = (section.width_mm * tangent(self.mesh.basis, displacement, *material) - frames).tocsc()
        out_of_balance = self._load @ load_n - section.width_mm * internal_force(
            self.mesh.basis, displacement, *material
        )
        frame = self.mesh.contact_frame(self._nodes, theta)[free]
        factor = splu(stiffness[free][:, free])
        step, by_contact = factor.solve(out_of_balance[free]), factor.solve(frame.toarray())
        way = np.concatenate([radius - inner, inner * (theta - angles_before)])
        return step, frame.T @ by_contact, way + frame.T @ step, by_contact

    def _places(self, displacement: FloatArray) -> FloatArray:
        places: FloatArray = self._rest + displacement[self._nodes]
        return places
