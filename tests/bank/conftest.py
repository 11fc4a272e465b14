"""A small fingertip that every test here can solve on in milliseconds, and the reference solutions."""

import numpy as np
import pytest
from numpy.typing import NDArray

from shearloop.bank.eit.forward import ForwardModel
from shearloop.bank.eit.mesh import Mesh, load_mesh


def rectangle(columns: int, rows: int, width_cm: float, height_cm: float) -> tuple[NDArray, NDArray]:
    """Return the nodes and triangles of a rectangle cut into columns × rows cells of two triangles."""
    x, y = np.meshgrid(np.linspace(0, width_cm, columns + 1), np.linspace(0, height_cm, rows + 1))
    nodes = np.column_stack([x.ravel(), y.ravel()])
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    a, b, c, d = corner, corner + 1, corner + columns + 2, corner + columns + 1
    return nodes, np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def relative(found: NDArray, expected: NDArray) -> float:
    """Return the relative L2 error."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def small_fingertip() -> Mesh:
    """Return a square of 16 × 16 cells: the electrodes are every second edge around it."""
    nodes, triangles = rectangle(16, 16, 3.2, 3.2)
    n = 17
    ring = np.concatenate(
        [np.arange(16), 16 + n * np.arange(16), n * n - 1 - np.arange(16), n * (n - 1) - n * np.arange(16)]
    )
    return Mesh(nodes, triangles, np.column_stack([ring, np.roll(ring, -1)])[::2], np.arange(32), [0.01] * 32)


@pytest.fixture(scope="session")
def fingertip() -> Mesh:
    return small_fingertip()


@pytest.fixture(scope="session")
def forward(fingertip) -> ForwardModel:
    return ForwardModel(fingertip)


@pytest.fixture(scope="session")
def paper_mesh(shared) -> Mesh:
    return load_mesh(shared / "reference" / "fingertip_mesh.npz")


@pytest.fixture(scope="session")
def paper_forward(paper_mesh) -> ForwardModel:
    return ForwardModel(paper_mesh)


@pytest.fixture(scope="session")
def eidors(shared) -> dict[str, NDArray[np.float64]]:
    with np.load(shared / "reference" / "eidors_forward.npz") as archive:
        return dict(archive)
