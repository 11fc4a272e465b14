"""Many solutions at once against the direct solve of each, and against what a Schur complement is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.eit.elimination import LANES, Elimination
from shearloop.bank.eit.forward import MAX_LEAK, BatchForwardModel, rounding_leaks
from shearloop.bank.eit.mesh import Terms
from shearloop.bank.eit.models import MODELS, conductivity
from shearloop.bank.errors import ConductivityError
from tests.bank.conftest import relative


@pytest.fixture(scope="module")
def batch(fingertip) -> BatchForwardModel:
    return BatchForwardModel(fingertip)


def chained(rng: np.random.Generator, n: int, far: int, factors: int) -> Terms:
    """Return a Laplacian, each unknown linked to some that follow, each link with a factor; and 1 on the diagonal."""
    diagonal, i = np.arange(n), np.repeat(np.arange(n - 1), 2)
    j, factor = np.minimum(i + rng.integers(1, far + 1, len(i)), n - 1), np.arange(len(i)) % factors
    return Terms(
        np.concatenate([i, j, i, j, diagonal]),
        np.concatenate([i, j, j, i, diagonal]),
        np.repeat([1.0, -1.0, 1.0], [2 * len(i), 2 * len(i), n]),
        np.concatenate([np.tile(factor, 4), np.full(n, factors)]),
    )


@given(st.integers(0, 2**32 - 1), st.integers(2, 200), st.integers(1, 9), st.integers(1, 20))
@settings(max_examples=40, deadline=None)
def test_what_is_left_is_the_schur_complement(seed, n, kept, far):
    rng = np.random.default_rng(seed)
    kept = min(kept, n - 1)
    pattern = chained(rng, n, far, 30)
    factors = rng.uniform(0.1, 10, (LANES + 3, 30))
    found = Elimination(pattern, n, kept).schur_complements(factors)
    for each, factor in zip(found, factors, strict=True):
        matrix = np.zeros((n, n))
        np.add.at(matrix, (pattern.rows, pattern.columns), pattern.values * np.append(factor, 1.0)[pattern.source])
        inner, coupling = matrix[:-kept, :-kept], matrix[:-kept, -kept:]
        expected = matrix[-kept:, -kept:] - coupling.T @ np.linalg.solve(inner, coupling)
        np.testing.assert_allclose(each, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("model", MODELS)
def test_all_models_give_the_direct_solves_signals(batch, fingertip, model):
    rng = np.random.default_rng(3)
    cells = [conductivity(fingertip, model, *rng.uniform(0.05, 4.4, 2)) for _ in range(60)]
    cells = np.array([each for each in cells if each.min() > 0])
    assert len(cells) > LANES // 2
    homogeneous = batch.direct.homogeneous()
    found = batch.voltages(cells) - homogeneous
    for signal, cell in zip(found, cells, strict=True):
        expected = batch.direct.voltages(cell) - homogeneous
        assert np.linalg.norm(signal - expected) <= 1e-9 * np.linalg.norm(expected) + 1e-12


def test_the_bits_do_not_depend_on_what_else_is_solved(batch, fingertip):
    cells = np.random.default_rng(5).uniform(0.2, 3, (2 * LANES + 1, len(fingertip.triangles)))
    together = batch.voltages(cells)
    np.testing.assert_array_equal(together[7:8], batch.voltages(cells[7:8]))
    np.testing.assert_array_equal(together[-3:], batch.voltages(cells[-3:]))
    assert batch.voltages(cells[:0]).shape == (0, 896)


def test_a_cell_that_rounding_spoils_is_solved_directly(batch, fingertip):
    """An island of the gel hardly conducts to the rest: its potential is all but free."""
    middle = fingertip.nodes[fingertip.triangles].mean(axis=1)
    cells = np.ones((3, len(fingertip.triangles)))
    cells[1, middle[:, 1] > 1.6] = 1e-13
    leaks = rounding_leaks(batch._elimination.schur_complements(cells))
    assert leaks[1] > MAX_LEAK > 1e-13 > max(leaks[0], leaks[2])
    found = batch.voltages(cells)
    np.testing.assert_array_equal(found[1], batch.direct.voltages(cells[1]))
    assert relative(found[0], batch.direct.voltages(cells[0])) < 1e-12


def test_matrices_that_mean_nothing_leak_without_bound():
    broken = np.array([np.eye(2), [[1.0, -1.0], [-1.0, 1.0]], [[np.nan, 1.0], [1.0, 1.0]], [[-1.0, 1.0], [2.0, -1.0]]])
    np.testing.assert_array_equal(rounding_leaks(broken), [1.0, 0.0, np.inf, np.inf])


def test_what_has_no_solution_is_refused(batch, fingertip):
    cells = np.ones((2, len(fingertip.triangles)))
    cells[1, 5] = -1
    with pytest.raises(ConductivityError, match="smallest value is -1"):
        batch.voltages(cells)
