"""The two-dimensional skin against the paper, against closed form, and against the conditions of contact."""

from dataclasses import replace

import numpy as np
import pytest
import skfem
from numpy.typing import NDArray

from benchmarks.skin import random_states
from shearloop.bank.arrays import FloatArray
from shearloop.estimation.skin import membrane as membrane_model
from shearloop.estimation.skin.membrane import PAPER_SECTION as SECTION
from shearloop.estimation.skin.plane_strain import (
    MESH_112,
    CondensedSkin,
    ContactError,
    ContactProblem,
    ContactState,
    MeshSize,
    SkinMesh,
    annulus_mesh,
    apply_load,
    condense,
    gauge_depth_mm,
    gauge_responses,
    gauge_strains,
    line_strain,
    plane_strain_stiffness,
    states_along,
    unloaded,
)
from shearloop.studies.skin.characterisation import fit_line, loading, origin_slope

ELEMENT = skfem.ElementVector(skfem.ElementQuad2())
# A ring under pressure: any A, B satisfy equilibrium (Lamé).
A, B = 0.01, 0.5


@pytest.fixture(scope="session")
def skin_112() -> CondensedSkin:
    return condense(SECTION)


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


def test_a_ring_under_pressure_converges_at_the_rates_of_quadratic_elements():
    errors = np.array([lame_errors(MeshSize(1, 2, 3, 1, 2).refined(k)) for k in (2, 4, 8)])
    rates = np.log2(errors[:-1] / errors[1:])
    assert (rates[:, 0] > 2.8).all(), f"displacement: {rates[:, 0]}"
    assert (rates[:, 1] > 1.9).all(), f"strain: {rates[:, 1]}"


def test_the_mesh_is_the_half_annulus_with_the_load_s_and_gauges_ends_on_element_edges():
    mesh = annulus_mesh(SECTION)
    assert mesh.t.shape[1] == 112
    area = skfem.Functional(lambda _: 1.0).assemble(skfem.Basis(mesh, skfem.ElementQuad2()))
    assert area == pytest.approx(np.pi * SECTION.mid_radius_mm * SECTION.thickness_mm, rel=1e-7)
    vertices = np.unique(mesh.t)
    angles = np.degrees(np.arctan2(-mesh.p[1, vertices], -mesh.p[0, vertices]))
    for wanted in (SECTION.gauge_from_deg, SECTION.gauge_to_deg, 87.5, 92.5, 180 - SECTION.gauge_to_deg):
        assert abs(angles - wanted).min() < 1e-9


@pytest.mark.parametrize(("depth_mm", "layers"), [(-0.35, 2), (-0.1, 4), (0.0, 3), (0.2, 2), (0.35, 3)])
def test_strain_at_a_depth_is_that_of_a_ring_under_pressure(depth_mm, layers):
    mesh = SkinMesh(replace(SECTION, gauge_depth_mm=depth_mm), replace(MESH_112, layers=layers))
    strain = mesh.gauge_line().mean_strain() @ mesh.basis.project(lame)
    np.testing.assert_allclose(strain, A + B / (SECTION.mid_radius_mm + depth_mm) ** 2, rtol=1e-4)


@pytest.mark.parametrize("depth_mm", [-0.3, -0.026, 0.0, 0.2])
def test_both_gauges_give_their_depth(depth_mm):
    """One load, whose fibres of the slack side differ: −1.8 % inside, −0.5 % in the middle, +0.7 % outside."""
    skin = condense(replace(SECTION, gauge_depth_mm=depth_mm))
    strain_1, strain_2 = gauge_strains(skin, states_along(skin, 1.0, loading(1.0)))[-1]
    assert gauge_depth_mm(SECTION, strain_2 / strain_1) == pytest.approx(depth_mm, abs=2e-3)
    assert gauge_depth_mm(SECTION, 0.5) is None


NORMAL_FORCES = (0.5, 1.0, 1.5, 2.0)
Loadings = dict[float, list[ContactState]]


@pytest.fixture(scope="session")
def loadings(skin_112) -> Loadings:
    """The paper's four cases: normal force first, then shear in 0.1 N steps up to it."""
    return {normal_n: states_along(skin_112, normal_n, loading(normal_n)) for normal_n in NORMAL_FORCES}


def shears(states: list[ContactState]) -> FloatArray:
    return np.array([state.shear_n for state in states])


def test_its_response_is_homogeneous_of_degree_one(skin_112, loadings):
    """Linear contact with Coulomb friction: all loads times two, all responses times two. No finding on the sensor."""
    twice = gauge_responses(skin_112, states_along(skin_112, 2.0, 2 * loading(1.0)))
    np.testing.assert_allclose(twice, 2 * gauge_responses(skin_112, loadings[1.0]), rtol=1e-9)


def test_its_sensitivity_is_the_paper_s_within_20_percent(skin_112, loadings):
    for estimate in (origin_slope, lambda x, y: fit_line(x, y).slope_per_n):
        found = [estimate(shears(states), gauge_responses(skin_112, states)) for states in loadings.values()]
        assert 0.085 <= min(found) <= max(found) <= 0.090 < 1.2 * 0.078


def test_it_begins_to_respond_at_the_paper_s_0_04_newton(skin_112, loadings):
    line = fit_line(shears(loadings[1.0]), gauge_responses(skin_112, loadings[1.0]))
    assert line.kink_n == pytest.approx(0.040, abs=0.005)
    assert line.kink_n == pytest.approx(SECTION.friction * SECTION.inner_radius_mm / SECTION.outer_radius_mm, rel=0.02)
    # And seen from near by: before it only the loaded patch itself gives way, behind it is the full slope.
    fine = np.arange(1, 13) * 0.01
    response = gauge_responses(skin_112, states_along(skin_112, 1.0, fine))
    slopes = np.diff(response) / 0.01 / line.slope_per_n
    assert abs(slopes[fine[1:] < 0.0301]).max() < 0.1
    assert slopes[fine[1:] > 0.0499] == pytest.approx(1.0, abs=0.03)


def test_tension_is_even_along_the_skin_and_falls_to_the_bracket(skin_112, loadings):
    strain = line_strain(skin_112, loadings[1.0][-1])
    flank = strain[(skin_112.line_deg > 15) & (skin_112.line_deg < 75)]
    assert flank.min() > 0
    assert 0.02 < np.ptp(flank) / flank.mean() < 0.04, "friction takes something, but less than 4 %"


def test_the_compressed_side_lifts_off_and_hardly_responds(skin_112, loadings):
    for states in loadings.values():
        strain_1, strain_2 = gauge_strains(skin_112, states)[-1]
        assert strain_2 < 0 < strain_1
        assert abs(strain_2 / strain_1) < 0.15
        touching = states[-1].contact_force_n[: len(skin_112.contact_deg)] > 0
        compressed, stretched = skin_112.contact_deg > 95, (skin_112.contact_deg > 5) & (skin_112.contact_deg < 85)
        assert touching[compressed].mean() < 0.1
        assert touching[stretched].mean() > 0.95


def test_there_is_no_response_to_normal_force_alone(skin_112):
    for normal_n in NORMAL_FORCES:
        pressed = apply_load(skin_112, unloaded(skin_112), normal_n, 0.0)
        assert abs(gauge_responses(skin_112, [pressed])).max() < 1e-6
        under_load = abs(skin_112.line_deg - 90) < 5
        strain = abs(line_strain(skin_112, pressed))
        assert strain[under_load].max() > 50 * strain[~under_load & (abs(skin_112.line_deg - 90) > 20)].max()


@pytest.mark.parametrize(
    ("changed", "tolerance"),
    [
        ({}, 0.01),
        ({"young_mpa": 2.0}, 0.01),
        ({"thickness_mm": 0.4}, 0.01),
        # The closed form puts the core's pressure on both sides, though one has lifted off and bends; at the paper's
        # friction its taking the capstan from both sides makes that good.
        ({"friction": 0.0}, 0.015),
    ],
)
def test_it_agrees_with_the_closed_form_within_one_percent(changed, tolerance):
    section = replace(SECTION, **changed)
    skin = condense(section)
    states = states_along(skin, 1.0, loading(1.0))
    slope = fit_line(shears(states), gauge_responses(skin, states)).slope_per_n
    assert slope == pytest.approx(membrane_model.sensitivity_per_n(section), rel=tolerance)


def assert_contact(skin: CondensedSkin, before: ContactState, state: ContactState) -> None:
    """Check the contact conditions: no force at a gap, and a friction that is at its bound against every slip."""
    free = skin.load_displacement @ (state.normal_n, state.shear_n)
    gap, along_mm = np.split(skin.compliance @ state.contact_force_n + free, 2)
    pressing, along = np.split(state.contact_force_n, 2)
    force_n, way_mm = abs(state.contact_force_n).max(), abs(free).max()
    assert gap.min() > -1e-9 * way_mm
    assert pressing.min() >= 0
    assert (pressing * gap).max() <= 1e-9 * force_n * way_mm
    bound, slipped = skin.section.friction * pressing, along_mm - before.along_mm
    assert (abs(along) <= bound + 1e-9 * force_n).all()
    assert abs(along * slipped + bound * abs(slipped)).max() <= 1e-9 * force_n * way_mm


@pytest.mark.parametrize("friction", [0.04, 1.0])
def test_forces_and_slips_meet_the_contact_conditions(friction):
    skin = condense(replace(SECTION, friction=friction), MeshSize(1, 1, 1, 1, 2))
    state = unloaded(skin)
    for normal_n, shear_n in [(1.0, 0.0), (1.0, 0.5), (1.0, 1.0), (1.0, 0.3), (0.5, -0.2)]:
        before, state = state, apply_load(skin, state, normal_n, shear_n)
        assert_contact(skin, before, state)
        assert abs(state.contact_force_n).max() > 0.01


@pytest.mark.parametrize("friction", [0.0, 0.04, 0.3, 1.0])
def test_it_converges_from_random_starts_and_in_one_jump(skin_112, friction):
    rng = np.random.default_rng(1)
    n = len(skin_112.contact_deg)
    for normal_n, shear_n in [(1.0, 0.0), (1.0, 1.0), (2.0, -1.5), (0.5, 3.0)]:
        free = skin_112.load_displacement @ (normal_n, shear_n)
        problem = ContactProblem(skin_112.compliance, free, np.zeros(n), friction, 1 / np.diag(skin_112.compliance))
        starts = [np.zeros(2 * n), *rng.normal(0, (0.01, 1, 10), (2 * n, 3)).T]
        jumps = [problem.solution(start).force_n for start in starts]
        for jump in jumps[1:]:
            np.testing.assert_allclose(jump, jumps[0], atol=1e-12)


def test_a_load_that_rises_at_a_tilt_is_solved_on_a_fine_mesh():
    skin = condense(SECTION, MeshSize(5, 9, 26, 16, 4))
    state = unloaded(skin)
    for load_n in np.arange(1, 21) * 0.1:
        before, state = state, apply_load(skin, state, load_n * np.cos(np.radians(1)), load_n * np.sin(np.radians(1)))
        assert_contact(skin, before, state)


@pytest.mark.parametrize("seed", [1, 8, 45])
def test_random_loads_on_random_skins_are_solved(seed):
    before = None
    for skin, state in random_states(seed):
        assert_contact(skin, before or unloaded(skin), state)
        before = state


def test_pivoting_finds_newton_s_forces():
    skin = condense(SECTION, MeshSize(3, 4, 6, 2, 2))
    before = np.random.default_rng(3).normal(0, 0.1, len(skin.contact_deg))
    for load_n in [(1.0, 0.0), (1.0, 1.0), (0.5, -2.0)]:
        problem = ContactProblem(
            skin.compliance, skin.load_displacement @ load_n, before, SECTION.friction, 1 / np.diag(skin.compliance)
        )
        newton_n, _, converged = problem.newton(np.zeros(2 * len(before)))
        assert converged
        np.testing.assert_allclose(problem.pivot(), newton_n, atol=1e-9 * abs(newton_n).max())


def test_numbers_that_are_none_are_refused_not_returned(skin_112):
    with pytest.raises(ContactError, match="is not a number"):
        apply_load(skin_112, unloaded(skin_112), float("nan"), 0.0)


def test_the_response_converges_long_before_the_corners_do(skin_112):
    fine = condense(SECTION, MeshSize(10, 18, 26, 4, 4))
    path = loading(1.0)[2::3]  # growing loads need no steps in between
    found = [gauge_responses(skin, states_along(skin, 1.0, path)) for skin in (skin_112, fine)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3, atol=1e-5)
