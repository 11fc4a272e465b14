"""The step benchmark: on the rig's physics, and with the default estimator in the loop."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import step_response
from benchmarks.step_response import estimator_in_the_loop, rig_calibration
from shearloop.bank.eit.bank_file import BankDefinition, write_bank


@pytest.fixture(scope="module")
def bank(tmp_path_factory) -> Path:
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


def test_the_step_on_the_rigs_physics_is_held_and_a_screw_ends_at_its_target(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["step_response", "--out", str(tmp_path / "out" / "step.json"), "--seeds", "2"])
    step_response.main()
    numbers = json.loads((tmp_path / "out" / "step.json").read_text())
    assert set(numbers) == {"eit", "load_cell", "tighten"}
    assert numbers["eit"]["time_in_band_mean"] > 0.95
    assert max(numbers[name]["overshoot_worst_seed"] for name in ("eit", "load_cell")) <= 0.15
    assert numbers["eit"]["refused_by_margins"] == numbers["load_cell"]["refused_by_margins"] == 0
    assert numbers["load_cell"]["in_band_at_settling_time_share"] == 1.0
    assert numbers["load_cell"]["mean_error_worst_seed"] < 0.02
    assert numbers["tighten"]["within_share"] == 1.0
    creep = step_response.calibrated_creep()
    assert (creep.share, creep.time_s) == (pytest.approx(0.08, abs=0.02), pytest.approx(20.0, rel=0.5))


def test_the_default_estimator_holds_a_torque_on_both_fingertips(bank):
    figures = estimator_in_the_loop(bank, rig_calibration(bank, 7), (0, 1))
    assert figures["time_in_band_mean"] > 0.85
    assert figures["overshoot_worst_seed"] < 0.2
    assert figures["not_valid_share"] < 0.02
    assert figures["coverage_95"] > 0.9
    assert figures["kick_back_s_worst"] <= 3.0
    assert figures["slip_found_s_worst"] <= 3.0
