"""Many solutions at once against the direct solve of each."""

import numpy as np
import pytest

from shearloop.bank.elimination import LANES
from shearloop.bank.errors import ConductivityError
from shearloop.bank.forward import MAX_LEAK, BatchForwardModel, rounding_leaks
from shearloop.bank.models import MODELS, conductivity
from tests.fixtures.physics import relative


@pytest.fixture(scope="module")
def batch(fingertip) -> BatchForwardModel:
    return BatchForwardModel(fingertip)


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
    leaks = rounding_leaks(batch.elimination.schur_complements(cells))
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
