"""Kinematics against UR's zero pose, scipy's rotations and finite differences."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shearloop.emulators.ur_arm import jacobian, link_frames, rotation_matrix, rotation_vector

angles = st.floats(-math.pi, math.pi)
joints = st.tuples(*[angles] * 6).map(np.array)


def test_stretched_arm_pose_follows_the_dimensions():
    x, y, z = link_frames(np.zeros(6))[-1][:3, 3]
    assert x == pytest.approx(-0.425 - 0.3922)
    assert y == pytest.approx(-0.1333 - 0.0996)
    assert z == pytest.approx(0.1625 - 0.0997)


@given(joints, angles)
def test_wrist_3_turns_the_tool_about_its_own_axis(q, turn):
    turned = q + np.array([0, 0, 0, 0, 0, turn])
    before, after = link_frames(q)[-1], link_frames(turned)[-1]
    assert after[:3, 3] == pytest.approx(before[:3, 3], abs=1e-12)
    about_z = Rotation.from_rotvec([0, 0, turn]).as_matrix()
    assert after[:3, :3] == pytest.approx(before[:3, :3] @ about_z, abs=1e-12)


@given(joints)
def test_jacobian_is_the_derivative_of_the_pose(q):
    step = 1e-6
    frames = link_frames(q)
    for joint, column in enumerate(jacobian(frames).T):
        moved = link_frames(q + step * np.eye(6)[joint])[-1]
        linear = (moved[:3, 3] - frames[-1][:3, 3]) / step
        angular = Rotation.from_matrix(moved[:3, :3] @ frames[-1][:3, :3].T).as_rotvec() / step
        assert column == pytest.approx(np.concatenate([linear, angular]), abs=1e-5)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 1e-3, 1.0, np.pi - 1e-9, np.pi, 4.0])
def test_rotations_are_scipys_numbers(angle_rad):
    rng = np.random.default_rng(0)
    axes = [*np.eye(3), *-np.eye(3), *rng.normal(size=(50, 3))]
    for axis in axes:
        vector = angle_rad * axis / np.linalg.norm(axis)
        rotation = Rotation.from_rotvec(vector).as_matrix()
        assert rotation_matrix(vector) == pytest.approx(rotation, rel=1e-12, abs=1e-15)
        assert rotation_vector(rotation) == pytest.approx(
            Rotation.from_matrix(rotation).as_rotvec(), rel=1e-12, abs=1e-12
        )
