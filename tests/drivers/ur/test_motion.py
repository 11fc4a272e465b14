"""Distances of poses, against scipy's rotations."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shearloop.drivers.ur.motion_executor import is_close

angles = st.floats(-math.pi, math.pi)
vectors = st.tuples(angles, angles, angles)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ((0.0, math.pi, 0.0), (0.0, -math.pi, 0.0), True),
        ((0.0, math.pi - 5e-4, 0.0), (0.0, -math.pi + 5e-4, 0.0), True),
        ((0.0, 0.0, 0.0), (0.0, 2 * math.pi, 0.0), True),
        ((0.0, math.pi, 0.0), (math.pi, 0.0, 0.0), False),
        ((0.0, 0.0, 0.0), (0.0, 0.003, 0.0), False),
    ],
)
def test_half_a_turn_is_the_same_either_way(
    one: tuple[float, float, float], other: tuple[float, float, float], same: bool
) -> None:
    assert is_close((0.4, 0.1, 0.3, *one), (0.4, 0.1, 0.3, *other), 2e-3) is same
    assert not is_close((0.4, 0.1, 0.3, *one), (0.4, 0.103, 0.3, *other), 2e-3)


@given(vectors, vectors, st.floats(0.01, 3.0))
def test_angular_distance_agrees_with_scipy(
    one: tuple[float, float, float], other: tuple[float, float, float], within: float
) -> None:
    apart_rad = float((Rotation.from_rotvec(one).inv() * Rotation.from_rotvec(other)).magnitude())
    if not np.isclose(apart_rad, within, atol=1e-6):
        assert is_close((0.0, 0.0, 0.0, *one), (0.0, 0.0, 0.0, *other), within) == (apart_rad < within)
