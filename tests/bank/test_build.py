"""Building banks: the same bytes however it is done, and refusals."""

from pathlib import Path

import numpy as np
import pytest

from shearloop.bank.bank_file import MIN_SIGNAL_NORM, Bank, BankDefinition
from shearloop.bank.build import build_bank, solve_row
from shearloop.bank.errors import BankFileError, ConductivityError, ModelError
from shearloop.bank.mesh import Mesh
from shearloop.bank.models import conductivity

MODEL = "gaussian_derivative"
K, SIGMA = np.linspace(0.4, 9.0, 5), np.linspace(0.3, 1.2, 4)


def defined(mesh: Mesh) -> BankDefinition:
    return BankDefinition(mesh.digest, MODEL, K, SIGMA)


@pytest.fixture(scope="module")
def finished(fingertip, tmp_path_factory) -> Path:
    """Return a bank built in one go by one process."""
    path = tmp_path_factory.mktemp("finished") / "one.bank"
    build_bank(fingertip, defined(fingertip), path)
    return path


def test_every_cell_is_the_difference_of_two_solutions_or_marked_not_valid(finished, fingertip, forward):
    bank = Bank.open(finished)
    np.testing.assert_allclose(bank.homogeneous, forward.homogeneous(), rtol=1e-12)
    kinds = set()
    for i, k in enumerate(K):
        for j, sigma in enumerate(SIGMA):
            values = conductivity(fingertip, MODEL, k, sigma)
            assert bank.min_conductivity[i, j] == values.min()
            try:
                signal_ = forward.voltages(values) - forward.homogeneous()
            except ConductivityError:
                kinds.add("not positive")
                expected = None
            else:
                expected = signal_ if np.linalg.norm(signal_) >= MIN_SIGNAL_NORM else None
                kinds.add("signal" if expected is not None else "no signal")
            assert bank.valid[i, j] == (expected is not None)
            if expected is None:
                assert not bank.signals[i, j].any()
            else:
                np.testing.assert_allclose(bank.signals[i, j], expected, rtol=1e-6, atol=1e-9)
    assert kinds == {"signal", "no signal", "not positive"}


def test_threads_and_workers_elsewhere_build_the_same_bytes(finished, fingertip, tmp_path):
    progress = []
    definition = defined(fingertip)
    build_bank(fingertip, definition, tmp_path / "two.bank", jobs=2, on_row=progress.append)
    assert progress == list(range(1, len(K) + 1))
    rows = (solve_row((fingertip, definition), row) for row in range(len(K)))
    build_bank(fingertip, definition, tmp_path / "there.bank", elsewhere=rows)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(
        ("two.bank", "there.bank"), finished.read_bytes()
    )


@pytest.mark.parametrize(
    ("place", "sentence"),
    [
        ("", "is a directory; give the name of a file in it"),
        ("none/a.bank", r"none/a\.bank: there is no folder .*none;"),
    ],
)
def test_places_that_cannot_be_written_are_refused_before_anything_is_solved(fingertip, tmp_path, place, sentence):
    with pytest.raises(BankFileError, match=sentence):
        build_bank(fingertip, defined(fingertip), tmp_path / place, on_row=lambda *_: pytest.fail("a row was solved"))


def test_a_bank_without_a_valid_cell_is_refused_with_the_reason(fingertip, tmp_path):
    for k, sigma, reason in (
        (1.0, 0.01, "falls to .* or below, and must be above 0"),
        (90.0, 0.3, "no signal has a norm"),
    ):
        narrow = BankDefinition(fingertip.digest, MODEL, np.array([k]), np.array([sigma]))
        with pytest.raises(ModelError, match=rf"a\.bank: no cell of this bank is valid: .*{reason}"):
            build_bank(fingertip, narrow, tmp_path / "a.bank")
    assert list(tmp_path.iterdir()) == []
