"""Rotation vectors and matrices against SciPy's."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shearloop.emulators.rotations import matrix_of, rotation_vector_of

components = st.floats(-1.0, 1.0)
axes = (
    st.tuples(components, components, components)
    .map(np.array)
    .filter(lambda axis: np.linalg.norm(axis) > 0.1)
    .map(lambda axis: axis / np.linalg.norm(axis))
)
# Also within the rounding of a float of no turn and of half a turn, where formulas lose their digits.
near_the_ends = st.floats(-12.0, -1.0).flatmap(lambda power: st.sampled_from([10.0**power, math.pi - 10.0**power]))
angles = st.floats(0.0, math.pi - 1e-6) | near_the_ends | st.just(0.0)


@given(axes, st.floats(0.0, 7.0) | near_the_ends)
def test_the_matrix_of_a_rotation_vector_is_scipys(axis, angle_rad):
    expected = Rotation.from_rotvec(angle_rad * axis).as_matrix()
    assert np.abs(matrix_of(angle_rad * axis) - expected).max() < 1e-14


@given(axes, angles)
def test_a_rotation_vector_comes_back_from_its_matrix(axis, angle_rad):
    matrix = Rotation.from_rotvec(angle_rad * axis).as_matrix()
    assert rotation_vector_of(matrix) == pytest.approx(angle_rad * axis, abs=1e-14)


@given(axes)
def test_half_a_turn_has_two_rotation_vectors(axis):
    found = rotation_vector_of(Rotation.from_rotvec(math.pi * axis).as_matrix())
    assert min(np.abs(found - math.pi * axis).max(), np.abs(found + math.pi * axis).max()) < 1e-14
