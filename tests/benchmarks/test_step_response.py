"""The step benchmark: on the rig's physics, and with the default estimator in the loop."""

import json
import sys

import pytest

from benchmarks import step_response
from benchmarks.step_response import estimator_in_the_loop, rig_calibration
from tests.cli.emulate_rig.rig import write_rig_bank


def test_the_step_on_the_rigs_physics_is_held_and_a_screw_ends_at_its_target(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["step_response", "--out", str(tmp_path / "out" / "step.json"), "--seeds", "2"])
    step_response.main()
    numbers = json.loads((tmp_path / "out" / "step.json").read_text())
    assert set(numbers) == {"eit", "load_cell", "tighten"}
    assert numbers["eit"]["time_in_band_mean"] > 0.95
    assert max(numbers[name]["overshoot_worst_seed"] for name in ("eit", "load_cell")) <= 0.15
    assert numbers["load_cell"]["in_band_at_settling_time_share"] == 1.0
    assert numbers["load_cell"]["mean_error_worst_seed"] < 0.02
    assert numbers["tighten"]["within_share"] == 1.0
    creep = step_response.calibrated_creep()
    assert (creep.share, creep.time_s) == (pytest.approx(0.08, abs=0.02), pytest.approx(20.0, rel=0.5))


def test_the_default_estimator_holds_a_torque_on_both_fingertips(tmp_path):
    bank = write_rig_bank(tmp_path / "rig.bank")
    figures = estimator_in_the_loop(bank, rig_calibration(bank, 7), (0, 1))
    assert figures["time_in_band_mean"] > 0.95
    assert figures["overshoot_worst_seed"] < 0.15
    assert figures["not_valid_share"] < 0.02
    assert figures["coverage_95"] > 0.9
    assert figures["kick_back_s_worst"] <= 2.5
    assert figures["slip_found_s_worst"] <= 2.5
