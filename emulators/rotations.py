"""Rotation vectors, as Universal Robots' poses have them, and rotation matrices.

SciPy's `Rotation` does the same, and takes longer to import than all else of an emulator.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]

# Below this angle sin(a)/a and (1 - cos(a))/a² are 1 and 1/2 to the last digit of a float.
_SMALL_RAD = 1e-8


def matrix_of(rotation_vector: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) of a rotation vector (3,), by Rodrigues' formula."""
    x, y, z = (float(one) for one in rotation_vector)
    angle_rad = math.sqrt(x * x + y * y + z * z)
    if angle_rad < _SMALL_RAD:
        sine, cosine = 1.0, 0.5
    else:
        sine = math.sin(angle_rad) / angle_rad
        # 1 - cos(a) would lose the digits of a small angle.
        cosine = 2.0 * (math.sin(0.5 * angle_rad) / angle_rad) ** 2
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + sine * cross + cosine * (cross @ cross))


def rotation_vector_of(matrix: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) of a matrix (3, 3), at most pi long.

    By way of the quaternion, and there by the largest of its four parts (Shepperd): no angle is ill-conditioned.
    """
    trace = float(np.trace(matrix))
    diagonal = [float(one) for one in np.diag(matrix)]
    largest = diagonal.index(max(diagonal))
    parts = np.empty(3)
    if trace >= diagonal[largest]:
        scalar = 1.0 + trace
        parts[:] = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
    else:
        i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
        parts[i] = 1.0 - trace + 2.0 * matrix[i, i]
        parts[j] = matrix[j, i] + matrix[i, j]
        parts[k] = matrix[k, i] + matrix[i, k]
        scalar = float(matrix[k, j] - matrix[j, k])
    length = math.sqrt(float(parts @ parts))
    if scalar < 0.0:
        scalar, parts = -scalar, -parts
    if length == 0.0:
        return np.zeros(3)
    return np.asarray(2.0 * math.atan2(length, scalar) / length * parts)
