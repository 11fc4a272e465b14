import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.bank.errors import CalibrationError, GeometryError
from shearloop.bank.skin.characterisation import loading, origin_slope, responses
from shearloop.bank.skin.membrane import (
    EXCITATION_A,
    GAUGE_RESISTANCE_OHM,
    UNSTRETCHED,
    Direction,
    Membrane,
    MembraneState,
    Section,
    ShearInterval,
    direction_of,
    joule_heating_k,
    paper_membrane,
    section_membrane,
)

MEMBRANE = paper_membrane()
CAPSTAN = math.exp(-MEMBRANE.friction * MEMBRANE.gauge_angle_rad)
forces = st.lists(st.tuples(st.floats(-5, 5), st.floats(0, 3)), min_size=1, max_size=12)


def walk(path: list[tuple[float, float]], membrane: Membrane = MEMBRANE) -> list[MembraneState]:
    states = [UNSTRETCHED]
    for shear_n, normal_n in path:
        states.append(membrane.step(states[-1], shear_n, normal_n))
    return states[1:]


def force(response: float, normal_n: float, direction: Direction = Direction.UNKNOWN) -> ShearInterval:
    tension = response / 0.088
    return MEMBRANE.shear_from_tensions(tension, tension, tension, normal_n, direction)


def test_without_friction_it_is_the_paper_s_0_088_per_newton():
    slippery = Membrane(MEMBRANE.axial_stiffness_n, 0.0, MEMBRANE.gauge_angle_rad)
    assert slippery.response(slippery.step(UNSTRETCHED, 1.0, 2.0)) == pytest.approx(0.088)


@pytest.mark.parametrize("normal_n", [0.5, 1.0, 1.5, 2.0])
def test_the_deadband_is_friction_times_normal_force_exactly(normal_n):
    edge = MEMBRANE.friction * normal_n
    for sign in (1, -1):
        inside = MEMBRANE.step(UNSTRETCHED, sign * edge, normal_n)
        assert MEMBRANE.response(inside) == 0
        beyond = MEMBRANE.response(MEMBRANE.step(UNSTRETCHED, sign * (edge + 1e-9), normal_n))
        assert beyond * sign == pytest.approx(0.088 * CAPSTAN * 1e-9, rel=1e-6)


@pytest.mark.parametrize("normal_n", [0.5, 1.0, 1.5, 2.0])
def test_a_fit_through_the_origin_of_loading_from_zero_gives_the_paper_s_0_078(normal_n):
    """The rule: least squares through the origin over the paper's loading, 0.1 N steps up to the normal force."""
    shear_n = loading(normal_n)
    assert shear_n[0] == pytest.approx(0.1)
    assert shear_n[-1] == pytest.approx(normal_n)
    assert origin_slope(shear_n, responses(MEMBRANE, shear_n, normal_n)) == pytest.approx(0.078, rel=0.03)


@given(forces)
def test_one_side_alone_is_stretched_and_none_compressed(path):
    for state in walk(path):
        assert min(state.gauge_tension_1_n, state.gauge_tension_2_n) == 0
        assert max(state.gauge_tension_1_n, state.gauge_tension_2_n) >= 0


@given(forces)
def test_left_and_right_are_alike(path):
    for state, mirrored in zip(walk(path), walk([(-s, n) for s, n in path]), strict=True):
        assert (state.gauge_tension_1_n, state.gauge_tension_2_n) == (
            mirrored.gauge_tension_2_n,
            mirrored.gauge_tension_1_n,
        )


@given(forces, st.integers(2, 7))
def test_a_step_taken_in_parts_ends_where_the_whole_one_does(path, parts):
    normal_n = path[0][1]
    whole = walk([(shear_n, normal_n) for shear_n, _ in path])
    turns = [0.0, *(shear_n for shear_n, _ in path)]
    pieces = [np.linspace(a, b, parts + 1)[1:] for a, b in itertools.pairwise(turns)]
    in_parts = walk([(float(s), normal_n) for piece in pieces for s in piece])[parts - 1 :: parts]
    for one, other in zip(whole, in_parts, strict=True):
        assert one.gauge_tension_1_n == pytest.approx(other.gauge_tension_1_n, abs=1e-11)
        assert one.gauge_tension_2_n == pytest.approx(other.gauge_tension_2_n, abs=1e-11)


def belt_of_sliders(
    friction: float, angle_rad: float, pulls: list[float], sliders: int = 16
) -> list[tuple[float, float]]:
    """Tension at the load and at the clamp of a chain of springs over sliders, pulled through the given movements.

    Slow and with no notion of a play: each slider moves until friction, μ Δφ times the mean tension beside it,
    holds the difference, and so on round the chain until nothing moves.
    """
    hold = friction * angle_rad / sliders / 2
    x, found = [0.0] * (sliders + 2), []
    for pull in pulls:
        x[0] = pull
        moved = 1.0
        while moved > 1e-13:
            moved = 0.0
            for i in range(1, sliders + 1):
                ahead, behind = max(x[i - 1] - x[i], 0.0), max(x[i] - x[i + 1], 0.0)
                excess = abs(ahead - behind) - hold * (ahead + behind)
                if excess > 0:
                    move = math.copysign(excess / 2 / (1 + hold), ahead - behind)
                    x[i] += move
                    moved = max(moved, abs(move))
        found.append((max(x[0] - x[1], 0.0), max(x[-2] - x[-1], 0.0)))
    return found


def test_tension_at_the_gauge_is_that_of_a_slow_chain_of_springs_and_sliders():
    friction, angle = 0.3, 1.0
    pulls = [0.5, 1.0, 0.9, 0.7, 0.75, 1.1, 0.6, 0.3, 0.35, 0.8, 0.0]
    membrane, state = Membrane(1.0, friction, angle, 1.0), UNSTRETCHED
    stuck = 0
    for at_load, at_clamp in belt_of_sliders(friction, angle, pulls):
        before = state.gauge_tension_1_n
        state = membrane.step(state, at_load, 0.0)
        assert state.gauge_tension_1_n == pytest.approx(at_clamp, rel=1e-3, abs=1e-9)
        stuck += state.gauge_tension_1_n == before
    assert stuck >= 3, "the path must show the gauge standing still while the force turns round"


@given(forces)
def test_the_interval_holds_the_force_whatever_came_before(path):
    for state, (shear_n, normal_n) in zip(walk(path), path, strict=True):
        found = force(MEMBRANE.response(state), normal_n)
        assert found.low_n - 1e-9 <= shear_n <= found.high_n + 1e-9
        assert found.low_n <= found.shear_n <= found.high_n


@given(forces)
def test_a_change_of_response_tells_the_direction_and_with_it_the_force(path):
    before = 0.0
    for state, (shear_n, normal_n) in zip(walk(path), path, strict=True):
        now = MEMBRANE.response(state)
        direction = direction_of(before, now, 1e-9)
        if direction is not Direction.UNKNOWN and now != 0:
            found = force(now, normal_n, direction)
            assert found.shear_n == pytest.approx(shear_n, abs=1e-6)
        before = now


def test_without_response_the_force_is_anything_within_the_deadband():
    for direction in Direction:
        found = force(0.0, 1.0, direction)
        assert found == pytest.approx((0.0, -0.04, 0.04))
        assert found.in_deadband
    assert not force(0.05, 1.0).in_deadband


def test_an_unknown_direction_costs_the_deadband_on_both_sides_and_the_capstan():
    response = 0.0462
    found = force(response, 1.0)
    tension = response / 0.088
    assert found.low_n == pytest.approx(tension * CAPSTAN - 0.04)
    assert found.high_n == pytest.approx(tension / CAPSTAN + 0.04)


def test_a_belt_that_cannot_be_is_refused():
    with pytest.raises(CalibrationError, match="stiffness must be positive"):
        Membrane(0.0, 0.04, 1.0)
    assert section_membrane().axial_stiffness_n == pytest.approx(MEMBRANE.axial_stiffness_n, rel=0.1)


def test_the_paper_s_gauge_has_25_ohm_and_stays_within_5_kelvin():
    assert pytest.approx(25.0, rel=0.02) == GAUGE_RESISTANCE_OHM
    assert 0 < joule_heating_k(EXCITATION_A**2 * GAUGE_RESISTANCE_OHM) < 5.0


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"width_mm": 0.0}, "width_mm"),
        ({"thickness_mm": 12.0}, "thickness_mm"),
        ({"poisson_ratio": 0.5}, "poisson_ratio"),
        ({"friction": 1.5}, "friction"),
        ({"gauge_to_deg": 89.0}, "gauge"),
    ],
)
def test_an_impossible_section_is_refused_by_name(wrong, named):
    with pytest.raises(GeometryError, match=named):
        Section(**wrong)
