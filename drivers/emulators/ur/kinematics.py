"""Kinematics of a UR5e by its Denavit-Hartenberg table, and poses as UR writes them: position and rotation vector.

The table is the one that Universal Robots publishes for the UR5e ("DH Parameters for calculations of kinematics and
dynamics"). The tool is a point on the flange's z axis, so that wrist 3 turns the tool about its own axis.
"""

import math

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

A_M = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)
D_M = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)
ALPHA_RAD = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)


def link_frames(q_rad: Vector, tool_length_m: float) -> list[Matrix]:
    """Return the seven frames (4, 4) from the base to the tool centre point, in base coordinates."""
    frames = [np.eye(4)]
    for theta, a, d, alpha in zip(q_rad, A_M, D_M, ALPHA_RAD, strict=True):
        c, s, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        link = np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
        )
        frames.append(frames[-1] @ link)
    frames[-1] = frames[-1].copy()
    frames[-1][:3, 3] += tool_length_m * frames[-1][:3, 2]
    return frames


def jacobian(frames: list[Matrix]) -> Matrix:
    """Return the geometric Jacobian (6, 6): joint speeds to the tool's linear and angular velocity in the base."""
    tip = frames[-1][:3, 3]
    columns = [np.concatenate([_cross(f[:3, 2], tip - f[:3, 3]), f[:3, 2]]) for f in frames[:-1]]
    return np.array(columns).T


def pose_of(frame: Matrix) -> Vector:
    """Return a frame as UR's pose (6,): x, y, z in m and the rotation vector in rad."""
    return np.concatenate([frame[:3, 3], rotation_vector(frame[:3, :3])])


def rotation_vector(rotation: Matrix) -> Vector:
    """Return the rotation vector (3,) in rad of a rotation matrix, of magnitude at most pi.

    By way of the quaternion's largest component, which stays exact for half turns: a tool that points down is one.
    """
    r = rotation
    squares = np.array(
        [
            1 + r[0, 0] + r[1, 1] + r[2, 2],
            1 + r[0, 0] - r[1, 1] - r[2, 2],
            1 - r[0, 0] + r[1, 1] - r[2, 2],
            1 - r[0, 0] - r[1, 1] + r[2, 2],
        ]
    )
    largest = int(np.argmax(squares))
    skew = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    if largest == 0:
        quaternion = np.concatenate([[squares[0]], skew])
    else:
        k = largest - 1
        column = r[:, k] + r[k, :]
        column[k] = squares[largest]
        quaternion = np.concatenate([[skew[k]], column])
    quaternion /= np.linalg.norm(quaternion)
    if quaternion[0] < 0:
        quaternion = -quaternion
    sine = float(np.linalg.norm(quaternion[1:]))
    scale: float = 2.0 if sine < 1e-12 else 2 * math.atan2(sine, float(quaternion[0])) / sine
    return np.asarray(quaternion[1:] * scale, dtype=np.float64)


def rotation_matrix(vector: Vector) -> Matrix:
    """Return the rotation matrix (3, 3) of a rotation vector in rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Matrix = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k)
    return rotation


def _cross(a: Vector, b: Vector) -> Vector:
    # numpy.cross spends ten times as long on looking at its arguments, 6 times per control cycle.
    product: Vector = np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    return product
