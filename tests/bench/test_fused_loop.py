"""The loop closed by `fused` on both fingertips of the emulated rig, in simulated time."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.fused_loop import SETTLED_S, calibrated, held
from benchmarks.step_response import PERIOD_S, TARGET_NM
from shearloop.bank.eit.bank_file import BankDefinition, write_bank


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bank whose signals are smooth in k and sigma."""
    path = tmp_path_factory.mktemp("bank") / "smooth.bank"
    random = np.random.default_rng(3)
    k_grid, sigma_grid = np.linspace(3.2, 4.0, 6), np.linspace(0.6, 3.0, 25)
    # A grip moves the frame further than a twist does.
    shapes = random.normal(0.0, 1.0, (4, 896)) * np.array([0.03, 0.02, 0.015, 0.003])[:, None]
    k, sigma = np.meshgrid(k_grid - 3.6, sigma_grid - 1.8, indexing="ij")
    signals = np.einsum("jkl,jc->klc", np.array([np.ones_like(k), k, sigma, sigma**2]), shapes)
    valid = np.ones(k.shape, bool)
    homogeneous = random.uniform(0.1, 0.5, 896)
    definition = BankDefinition("ab" * 32, "gaussian_derivative", k_grid, sigma_grid)
    write_bank(path, definition, homogeneous, np.ones(k.shape), valid, signals.astype(np.float32))
    return path


def test_fused_holds_a_torque_on_both_fingertips(bank: Path) -> None:
    table, figures = held(bank, calibrated(bank, 7), (0, 1))
    late = table[:, round(SETTLED_S / PERIOD_S) :]
    assert np.abs(late - TARGET_NM).max() < 0.1 * TARGET_NM
    assert table.max() < 1.2 * TARGET_NM
    assert figures["not_valid_share"] < 0.02
    assert figures["coverage_95"] > 0.9
