import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from shearloop.estimation.skin.membrane import (
    EXCITATION_A,
    GAUGE_RESISTANCE_OHM,
    PAPER_SECTION,
    THICK_SECTION,
    UNSTRETCHED,
    BeltState,
    Direction,
    Membrane,
    direction_of,
    joule_heating_k,
    sensitivity_per_n,
    stretch,
)
from shearloop.studies.skin.characterisation import loading, origin_slope, responses

MEMBRANE = Membrane(THICK_SECTION)
BELT = MEMBRANE.belt
UP = math.exp(BELT.friction * BELT.gauge_angle_rad)
forces = st.lists(st.tuples(st.floats(-5, 5), st.floats(0, 3)), min_size=1, max_size=12)


def walk(path: list[tuple[float, float]]) -> list[BeltState]:
    states = [UNSTRETCHED]
    for shear_n, normal_n in path:
        states.append(MEMBRANE.step(states[-1], shear_n, normal_n))
    return states[1:]


def net(state: BeltState) -> float:
    return state.gauge_tension_1_n - state.gauge_tension_2_n


@pytest.mark.parametrize("section", [PAPER_SECTION, THICK_SECTION])
def test_at_small_strain_the_slope_is_that_of_the_closed_form(section):
    slippery = replace(section, friction=0.0)
    membrane = Membrane(slippery)
    found = membrane.response(membrane.step(UNSTRETCHED, 1e-6, 0.0)) / 1e-6
    assert found == pytest.approx(sensitivity_per_n(slippery), rel=0.005)


def test_the_sheet_stretches_as_rubber_in_plane_strain_does():
    for small in np.linspace(0.0, 0.1, 6):
        exact = brentq(lambda stretched, s=small: (stretched - stretched**-3) / 4 - s, 1.0, 2.0, xtol=1e-14)
        assert stretch(small) == pytest.approx(exact, rel=1e-4)


def test_without_friction_pull_and_angle_balance():
    """Moments about the core: a load that has turned by α pulls by F_t cos α + F_n sin α."""
    membrane = Membrane(replace(PAPER_SECTION, friction=0.0))
    state = membrane.step(UNSTRETCHED, 1.6, 2.0)
    turned = math.pi / 2 * (stretch(membrane.sheet_per_n * state.net_tension_n) - 1)
    assert state.net_tension_n == pytest.approx(1.6 * math.cos(turned) + 2.0 * math.sin(turned), rel=1e-6)
    assert state.gauge_tension_1_n == state.net_tension_n


@pytest.mark.parametrize("normal_n", [0.5, 1.0, 1.5, 2.0])
def test_the_deadband_is_friction_times_normal_force_exactly(normal_n):
    edge = BELT.friction * normal_n
    for sign in (1, -1):
        inside = MEMBRANE.step(UNSTRETCHED, sign * edge * (1 - 1e-12), normal_n)
        assert MEMBRANE.response(inside) == 0
        beyond = MEMBRANE.response(MEMBRANE.step(UNSTRETCHED, sign * (edge + 1e-6), normal_n))
        assert beyond * sign > 0.07 * 1e-6


@pytest.mark.parametrize("normal_n", [0.5, 1.0, 1.5, 2.0])
def test_a_fit_through_the_origin_of_loading_from_zero_gives_the_paper_s_0_078(normal_n):
    """The rule: least squares through the origin over the paper's loading, 0.1 N steps to 1.2 N."""
    shear_n = loading(1.2)
    assert shear_n[[0, -1]] == pytest.approx([0.1, 1.2])
    assert origin_slope(shear_n, responses(MEMBRANE, shear_n, normal_n)) == pytest.approx(0.078, rel=0.03)


@given(forces)
def test_one_side_alone_is_stretched_and_left_and_right_are_alike(path):
    for state, mirrored in zip(walk(path), walk([(-s, n) for s, n in path]), strict=True):
        tensions_n = (state.gauge_tension_1_n, state.gauge_tension_2_n)
        assert min(tensions_n) == 0
        assert tensions_n == (mirrored.gauge_tension_2_n, mirrored.gauge_tension_1_n)


@given(forces, st.integers(2, 7))
def test_a_step_taken_in_parts_ends_where_the_whole_one_does(path, parts):
    normal_n = path[0][1]
    whole = walk([(shear_n, normal_n) for shear_n, _ in path])
    turns = [0.0, *(shear_n for shear_n, _ in path)]
    pieces = [np.linspace(a, b, parts + 1)[1:] for a, b in itertools.pairwise(turns)]
    in_parts = walk([(float(s), normal_n) for piece in pieces for s in piece])[parts - 1 :: parts]
    for one, other in zip(whole, in_parts, strict=True):
        assert one.gauge_tension_1_n == pytest.approx(other.gauge_tension_1_n, abs=2e-4)
        assert one.gauge_tension_2_n == pytest.approx(other.gauge_tension_2_n, abs=2e-4)


def shear_range(state: BeltState, normal_n: float, direction: Direction = Direction.UNKNOWN) -> tuple[float, float]:
    return BELT.shear_range(net(state), normal_n, MEMBRANE.turned_rad(state), direction)


@given(forces)
def test_the_range_holds_the_force_whatever_came_before(path):
    for state, (shear_n, normal_n) in zip(walk(path), path, strict=True):
        low_n, high_n = shear_range(state, normal_n)
        assert low_n - 1e-3 <= shear_n <= high_n + 1e-3


@given(forces)
def test_a_change_of_response_gives_the_direction_and_with_it_the_force(path):
    before = 0.0
    for state, (shear_n, normal_n) in zip(walk(path), path, strict=True):
        now = net(state)
        direction = direction_of(before, now, 1e-3)
        if direction is not Direction.UNKNOWN:
            assert shear_range(state, normal_n, direction) == pytest.approx((shear_n, shear_n), abs=1e-3)
        before = now


def test_without_tension_the_force_is_anything_within_the_deadband():
    for direction in Direction:
        assert BELT.shear_range(0.0, 1.0, 0.0, direction) == pytest.approx((-BELT.friction, BELT.friction))


def test_an_unknown_direction_costs_the_deadband_on_both_sides_and_the_capstan():
    found = BELT.shear_range(0.5, 1.0, 0.0, Direction.UNKNOWN)
    assert found == pytest.approx((0.5 / UP - BELT.friction, 0.5 * UP + BELT.friction))


def test_a_load_that_pulls_the_skin_off_its_core_has_no_friction():
    """Turned by 0.3 rad, 1 N of shear lifts the load."""
    for sign in (1.0, -1.0):
        assert BELT.pull(1.0, 0.1, 0.3, sign) == pytest.approx(math.cos(0.3) + 0.1 * math.sin(0.3))
    pulled = BELT.pull(1.0, 0.1, 0.3, 1.0)
    assert BELT.shear_range(pulled / UP, 0.1, 0.3, Direction.LOADING) == pytest.approx((1.0, 1.0))


def test_the_paper_s_gauge_has_25_ohm_and_stays_within_5_kelvin():
    assert pytest.approx(25.0, rel=0.02) == GAUGE_RESISTANCE_OHM
    assert 0 < joule_heating_k(EXCITATION_A**2 * GAUGE_RESISTANCE_OHM) < 5.0
