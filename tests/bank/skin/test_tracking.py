"""Direction and force from noisy responses, against forces that are known."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.skin.calibration import MEMORY_S, DirectionFinder, ForceFollower, SkinCalibration
from shearloop.bank.skin.membrane import UNSTRETCHED, Direction, paper_membrane

MEMBRANE = paper_membrane()
CALIBRATION = SkinCalibration(
    friction=MEMBRANE.friction,
    gauge_angle_deg=math.degrees(MEMBRANE.gauge_angle_rad),
    linear_to_n=1.2,
    tension_n=(-5.0, -1.2, 1.2, 5.0),
    response=(-0.44, -0.1056, 0.1056, 0.44),
    response_half_width=3e-4,
    rows=100,
    rows_beyond=0,
    rest_ohm=(24.6, 25.3),
)
NOISE, NORMAL_N = 1.4e-4, 1.0
HOLD_N = MEMBRANE.friction * NORMAL_N


def followed(path: list[float], seed: int = 0, noise: float = NOISE) -> list[tuple[Direction, float, float, float]]:
    """Return direction, force and band at each step of a path of shear forces, ten a second."""
    random, state = np.random.default_rng(seed), UNSTRETCHED
    finder = DirectionFinder(noise)
    follower = ForceFollower(CALIBRATION, finder.threshold)
    found = []
    for number, shear_n in enumerate(path):
        state = MEMBRANE.step(state, shear_n, NORMAL_N)
        response = MEMBRANE.response(state) + random.normal(0.0, noise)
        direction = finder.update(number / 10, response)
        found.append((direction, *follower.update(response, NORMAL_N, direction)))
    return found


def ramp(begin_n: float, end_n: float, n_per_s: float) -> list[float]:
    return np.linspace(begin_n, end_n, max(round(abs(end_n - begin_n) / n_per_s * 10), 2)).tolist()


@pytest.mark.parametrize("n_per_s", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_ramp_is_followed_up_and_down_through_zero(n_per_s: float, sign: float) -> None:
    path = [0.0] * 20 + ramp(0.0, sign, n_per_s) + ramp(sign, -sign, n_per_s)
    found = followed(path)
    errors = np.abs([shear_n - true_n for (_, shear_n, _, _), true_n in zip(found, path, strict=True)])
    loading = [shear_n for direction, shear_n, _, _ in found if direction is Direction.LOADING]
    assert len(loading) > 5
    assert any(direction is Direction.UNLOADING for direction, *_ in found)
    # At a reversal friction hides 2 μFₙ and the capstan's part; the direction is known some samples late.
    assert errors.max() < 2.5 * HOLD_N + 0.05 + 4 * n_per_s / 10
    steady = slice(20 + len(ramp(0.0, sign, n_per_s)) // 2, 20 + len(ramp(0.0, sign, n_per_s)))
    assert errors[steady].max() < 0.02 + 0.3 * n_per_s / 10, "while the skin slips the force is one number"


def test_a_force_that_stays_is_neither_loading_nor_unloading_for_an_hour() -> None:
    path = ramp(0.0, 0.8, 0.2) + [0.8] * 36_000
    found = followed(path, seed=3)
    held = found[60:]
    assert {direction for direction, *_ in held} == {Direction.UNKNOWN}
    assert all(abs(shear_n - 0.8) < 0.012 for _, shear_n, _, _ in held)


def test_within_the_band_the_force_stays_where_it_was_known_and_the_band_holds_the_truth() -> None:
    path = ramp(0.0, 0.8, 0.2) + ramp(0.8, 0.76, 0.02) + [0.76] * 30
    direction, shear_n, low_n, high_n = followed(path)[-1]
    assert direction is Direction.UNKNOWN
    assert shear_n == pytest.approx(0.8, abs=0.012), "a sticking skin says nothing of 0.04 N less"
    assert low_n < 0.76 < high_n
    assert low_n == pytest.approx(0.8 - 2 * HOLD_N - 0.07, abs=0.02)


def test_below_friction_nothing_is_told_from_nothing() -> None:
    for direction, shear_n, low_n, high_n in followed([0.0] * 20 + ramp(0.0, 0.035, 0.05) + [0.035] * 20):
        assert direction is Direction.UNKNOWN
        assert abs(shear_n) < 0.01
        assert low_n < 0.035 < high_n


def test_after_a_gap_the_direction_is_found_anew() -> None:
    finder = DirectionFinder(NOISE)
    for number in range(20):
        finder.update(number / 10, 0.002 * number)
    assert finder.update(2.0, 0.04) is Direction.LOADING
    finder.restart()
    assert finder.update(2.1, 0.02) is Direction.UNKNOWN


def test_a_direction_is_remembered_for_a_moment_only() -> None:
    finder = DirectionFinder(NOISE)
    for number in range(10):
        finder.update(number / 10, 0.004 * number)
    held = [finder.update(1.0 + number / 10, 0.036) for number in range(8)]
    assert held[0] is Direction.LOADING
    assert held[-1] is Direction.UNKNOWN
    assert held.index(Direction.UNKNOWN) <= 3 + round(MEMORY_S * 10)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-1.1, 1.1), st.floats(0.03, 1.0), st.integers(0, 20)), min_size=1, max_size=5),
    st.integers(0, 1000),
)
def test_whatever_the_hand_does_the_band_with_its_noise_holds_the_force_but_for_moments(
    moves: list[tuple[float, float, int]], seed: int
) -> None:
    path = [0.0] * 10
    for target_n, n_per_s, rest in moves:
        path += ramp(path[-1], target_n, n_per_s) + [target_n] * rest
    margin_n = 5 * NOISE / CALIBRATION.slope_per_n * 1.05
    missed = [
        true_n
        for (_, _, low_n, high_n), true_n in zip(followed(path, seed), path, strict=True)
        if not low_n - margin_n <= true_n <= high_n + margin_n
    ]
    # Only at a reversal, until the direction is forgotten.
    assert len(missed) <= 5 * len(moves)
