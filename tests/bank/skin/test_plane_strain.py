from dataclasses import replace

import numpy as np
import pytest
import skfem
from numpy.typing import NDArray

from shearloop.bank.errors import GeometryError
from shearloop.bank.skin.membrane import PAPER_SECTION as SECTION
from shearloop.bank.skin.plane_strain import (
    CondensedSkin,
    MeshSize,
    annulus_mesh,
    midline_strain,
    plane_strain_stiffness,
    unloaded,
)

ELEMENT = skfem.ElementVector(skfem.ElementQuad2())
# A ring under pressure: any A, B satisfy equilibrium (Lamé).
A, B = 0.01, 0.5


def lame(x: NDArray[np.float64]) -> NDArray[np.float64]:
    r2 = x[0] ** 2 + x[1] ** 2
    return np.array([(A + B / r2) * x[0], (A + B / r2) * x[1]])


def lame_errors(size: MeshSize) -> tuple[float, float]:
    mesh = annulus_mesh(SECTION, size)
    basis = skfem.Basis(mesh, ELEMENT, intorder=6)
    stiffness = plane_strain_stiffness(basis, SECTION.young_mpa, SECTION.poisson_ratio)
    exact = basis.project(lame)
    found = skfem.solve(*skfem.condense(stiffness, x=exact, D=basis.get_dofs()))

    @skfem.Functional
    def squared(w: skfem.assembly.form.form.FormExtraParams) -> NDArray[np.float64]:
        return ((w["u"] - lame(w.x)) ** 2).sum(axis=0)

    @skfem.Functional
    def gradient_squared(w: skfem.assembly.form.form.FormExtraParams) -> NDArray[np.float64]:
        (x, y), r2 = w.x, w.x[0] ** 2 + w.x[1] ** 2
        outer = np.array([[x * x, x * y], [y * x, y * y]])
        exact = (A + B / r2) * np.eye(2)[:, :, None, None] - 2 * B * outer / r2**2
        return ((w["u"].grad - exact) ** 2).sum(axis=(0, 1))

    u = basis.interpolate(found)
    return float(np.sqrt(squared.assemble(basis, u=u))), float(np.sqrt(gradient_squared.assemble(basis, u=u)))


def test_a_ring_under_pressure_converges_at_the_rates_of_quadratic_elements() -> None:
    errors = np.array([lame_errors(MeshSize(1, 2, 3, 1, 2).refined(k)) for k in (2, 4, 8)])
    rates = np.log2(errors[:-1] / errors[1:])
    assert (rates[:, 0] > 2.8).all(), f"displacement: {rates[:, 0]}"
    assert (rates[:, 1] > 1.9).all(), f"strain: {rates[:, 1]}"


def test_the_mesh_is_the_half_annulus_with_the_load_s_and_gauges_ends_on_element_edges() -> None:
    mesh = annulus_mesh(SECTION)
    assert mesh.t.shape[1] == 112
    area = skfem.Functional(lambda _: 1.0).assemble(skfem.Basis(mesh, skfem.ElementQuad2()))
    assert area == pytest.approx(np.pi * SECTION.mid_radius_mm * SECTION.thickness_mm, rel=1e-7)
    vertices = np.unique(mesh.t)
    angles = np.degrees(np.arctan2(-mesh.p[1, vertices], -mesh.p[0, vertices]))
    for wanted in (SECTION.gauge_from_deg, SECTION.gauge_to_deg, 87.5, 92.5, 180 - SECTION.gauge_to_deg):
        assert abs(angles - wanted).min() < 1e-9


def test_condensation_only_leaves_out_what_was_eliminated(skin_112: CondensedSkin) -> None:
    """Without contact forces the skin is a clamped arch: solved whole, it has the same displacements and strains."""
    normal_n, shear_n = 0.3, 0.2
    mesh = annulus_mesh(SECTION)
    basis = skfem.Basis(mesh, ELEMENT, intorder=4)
    stiffness = SECTION.width_mm * plane_strain_stiffness(basis, SECTION.young_mpa, SECTION.poisson_ratio)
    half_mm = SECTION.outer_radius_mm * np.radians(2.6)
    arc = mesh.facets_satisfying(lambda x: (abs(x[0]) < half_mm) & (x[1] < -SECTION.outer_radius_mm + 0.02))
    facets = skfem.FacetBasis(mesh, ELEMENT, facets=arc)
    arc_mm = SECTION.outer_radius_mm * np.radians(SECTION.load_arc_deg)
    pull = skfem.LinearForm(lambda v, _: (shear_n * v[0] + normal_n * v[1]) / arc_mm).assemble(facets)
    clamps = basis.get_dofs(lambda x: abs(x[1]) < 1e-9)
    u = skfem.solve(*skfem.condense(stiffness, pull, D=clamps))

    def on_circle(radius_mm: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Angle, radial and circumferential displacement of the nodes on a circle, in order."""
        x, y = basis.doflocs
        theta = np.arctan2(-y, -x)
        here = np.flatnonzero(abs(np.hypot(x, y) - radius_mm) < 1e-9)
        here = here[np.argsort(theta[here].round(9), kind="stable")].reshape(-1, 2)
        theta = theta[here[:, 0]]
        ux, uy = u[here].T
        return theta, -ux * np.cos(theta) - uy * np.sin(theta), ux * np.sin(theta) - uy * np.cos(theta)

    theta, radial, along = on_circle(SECTION.inner_radius_mm)
    free = slice(1, -1)  # the clamped ends are no contact nodes
    np.testing.assert_allclose(np.degrees(theta[free]), skin_112.contact_deg)
    displacement = skin_112.load_displacement @ (normal_n, shear_n)
    np.testing.assert_allclose(np.concatenate([radial[free], along[free]]), displacement, atol=1e-8)

    # ε_θθ = (∂u_θ/∂θ + u_r)/R: its mean over a gauge needs u_θ at the ends and, by Simpson's rule, the mean of u_r.
    theta, radial, along = on_circle(SECTION.mid_radius_mm)
    strain = midline_strain(skin_112, replace(unloaded(skin_112), normal_n=normal_n, shear_n=shear_n))
    for gauge, weights in enumerate(skin_112.gauge_weights):
        ends = np.radians([SECTION.gauge_from_deg, SECTION.gauge_to_deg])
        begin, end = ends if gauge == 0 else np.pi - ends[::-1]
        inside = (theta > begin - 1e-9) & (theta < end + 1e-9)
        span, r, t = end - begin, radial[inside], along[inside]
        mean_radial = (r[0] + r[-1] + 4 * r[1::2].sum() + 2 * r[2:-1:2].sum()) / (3 * (len(r) - 1))
        expected = ((t[-1] - t[0]) / span + mean_radial) / SECTION.mid_radius_mm
        assert weights @ strain == pytest.approx(expected, rel=1e-4)
        assert abs(expected) > 1e-3


@pytest.mark.parametrize("wrong", [(0, 1, 1, 1, 2), (1, 1, 1, 1, 1), (1, 1, 1, 1, 3)])
def test_a_mesh_without_a_mid_line_is_refused(wrong: tuple[int, int, int, int, int]) -> None:
    with pytest.raises(GeometryError, match="even number of layers"):
        MeshSize(*wrong)
