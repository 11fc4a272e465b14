"""The skin at finite strain, against closed forms, finer meshes and the linear skin; and the membrane against it."""

from dataclasses import replace

import numpy as np
import pytest
import skfem
from scipy.optimize import brentq

from shearloop.bank.arrays import FloatArray
from shearloop.estimation.skin.membrane import PAPER_SECTION, THICK_SECTION, Membrane
from shearloop.estimation.skin.plane_strain import MESH_112, MeshSize, condense, gauge_responses, states_along
from shearloop.studies.skin import characterisation
from shearloop.studies.skin.characterisation import fit_line, loading, origin_slope
from shearloop.studies.skin.finite_strain import FiniteStrainSkin, internal_force, tangent

YOUNG, NU = PAPER_SECTION.young_mpa, PAPER_SECTION.poisson_ratio
SHEAR = YOUNG / (2 * (1 + NU))
LAME = 2 * SHEAR * NU / (1 - 2 * NU)


def test_one_element_stretches_as_the_closed_form_says():
    """A square pulled to λ between frictionless grips: its sides are free, so J solves P_yy = 0."""
    basis = skfem.Basis(skfem.MeshQuad().with_defaults(), skfem.ElementVector(skfem.ElementQuad2()), intorder=6)
    for stretch in (0.8, 1.1, 1.6):

        def thickness_of(width: float, stretch: float = stretch) -> float:
            return SHEAR * (width - 1 / width) + LAME * np.log(stretch * width) / width

        width = brentq(thickness_of, 0.2, 5.0, xtol=1e-14)
        expected_n = SHEAR * (stretch - 1 / stretch) + LAME * np.log(stretch * width) / stretch
        left, right = (basis.get_dofs(side).all("u^1") for side in ("left", "right"))
        fixed = np.concatenate([left, right, basis.get_dofs("bottom").all("u^2")])
        free = basis.complement_dofs(fixed)
        u = np.concatenate([[stretch - 1], [1 / stretch - 1]])[:, None] * np.ones(basis.N // 2)
        u = u.T.ravel() * basis.doflocs[np.tile([0, 1], basis.N // 2), np.arange(basis.N)]
        for _ in range(30):
            out_of_balance = internal_force(basis, u, YOUNG, NU)
            u += skfem.solve(*skfem.condense(tangent(basis, u, YOUNG, NU), -out_of_balance, I=free))
        assert internal_force(basis, u, YOUNG, NU)[right].sum() == pytest.approx(expected_n, rel=1e-6)
        assert u[basis.get_dofs("top").all("u^2")] == pytest.approx(width - 1, rel=1e-6)


def test_the_tangent_is_the_derivative_of_the_force():
    skin = FiniteStrainSkin(PAPER_SECTION, MeshSize(1, 2, 2, 1, 1))
    rng = np.random.default_rng(1)
    u, way = rng.normal(0, 0.02, (2, skin.mesh.basis.N))
    basis, step = skin.mesh.basis, 1e-6
    ahead, behind = (internal_force(basis, u + sign * step * way, YOUNG, NU) for sign in (1, -1))
    expected = (ahead - behind) / (2 * step)
    np.testing.assert_allclose(tangent(basis, u, YOUNG, NU) @ way, expected, atol=1e-7 * abs(expected).max())


def test_a_small_load_gives_the_linear_skin_s_response():
    linear = condense(PAPER_SECTION)
    expected = gauge_responses(linear, states_along(linear, 1e-3, [1e-3]))
    skin = FiniteStrainSkin(PAPER_SECTION)
    found = skin.gauge_responses(skin.states_along(1e-3, [1e-3])) @ [1, -1]
    assert found == pytest.approx(expected, rel=1e-3)


def responses(skin: FiniteStrainSkin, normal_n: float, shear_n: FloatArray) -> FloatArray:
    found: FloatArray = skin.gauge_responses(skin.states_along(normal_n, shear_n.tolist())) @ [1, -1]
    return found


def test_three_meshes_agree_within_one_percent():
    """Loads that rise need few steps in between."""
    coarse, middle, fine = (
        responses(FiniteStrainSkin(THICK_SECTION, size), 1.0, np.array([1.6]))
        for size in (MeshSize(3, 5, 7, 1, 1), MESH_112, MeshSize(8, 14, 20, 3, 3))
    )
    assert coarse == pytest.approx(fine, rel=0.01)
    assert middle == pytest.approx(fine, rel=0.003)


@pytest.mark.parametrize(("normal_n", "sensitivity", "kink_n"), [(0.5, 0.0760, 0.027), (1.0, 0.0764, 0.043)])
def test_the_thick_skin_responds_as_an_independent_solution_and_as_the_membrane(normal_n, sensitivity, kink_n):
    shear_n = loading(1.6)
    found, up_to_12 = responses(FiniteStrainSkin(THICK_SECTION), normal_n, shear_n), slice(0, 12)
    assert origin_slope(shear_n[up_to_12], found[up_to_12]) == pytest.approx(sensitivity, rel=0.004)
    assert fit_line(shear_n[up_to_12], found[up_to_12]).kink_n == pytest.approx(kink_n, abs=5e-4)
    membrane = characterisation.responses(Membrane(THICK_SECTION), shear_n.tolist(), normal_n)
    np.testing.assert_allclose(membrane[3:], found[3:], rtol=0.015)


@pytest.mark.parametrize("section", [THICK_SECTION, PAPER_SECTION, replace(PAPER_SECTION, friction=0.0)])
def test_the_membrane_is_within_three_percent(section):
    shear_n = np.array([0.4, 1.6])
    found = characterisation.responses(Membrane(section), shear_n.tolist(), 2.0)
    np.testing.assert_allclose(found, responses(FiniteStrainSkin(section), 2.0, shear_n), rtol=0.03)


def test_the_membrane_s_hysteresis_is_that_of_the_reference():
    path = np.array([0.5, 1.0, 0.9, 0.5, -0.5])
    reference = responses(FiniteStrainSkin(PAPER_SECTION), 1.0, path)
    found = characterisation.responses(Membrane(PAPER_SECTION), path.tolist(), 1.0)
    np.testing.assert_allclose(found, reference, rtol=0.01)
    assert found[3] - found[0] > 0.1 * found[0], "unloading runs above loading"
