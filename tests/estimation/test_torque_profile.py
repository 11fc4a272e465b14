"""The torque without a sensor: the calibration's mean twist at the same phase."""

import numpy as np
import pytest

from shearloop.estimation import TRUSTED, fit
from shearloop.estimation.torque_profile import TorqueProfile
from shearloop.tools.estimate_tracks import estimate_series
from shearloop.tools.figures import figures_by_load
from tests.estimation.conftest import twisting


def test_equal_twists_are_known_without_a_sensor():
    played = twisting(cycles=5)
    profile = TorqueProfile.fit([played])
    loaded = played.torque_at_frames() > 0.02
    error = profile.predict(played)[loaded] - played.torque_at_frames()[loaded]
    # The peaks grow by 3 % from twist to twist.
    assert np.sqrt(np.mean(error**2)) < 0.1 * 0.06


def test_evaluate_says_what_a_sensor_adds():
    calibration = fit("motion_regression", [twisting(cycles=5)], "rig", timing=TRUSTED)
    judged = figures_by_load([estimate_series(calibration, twisting(cycles=4, seed=3, peak_nm=0.03))])["loaded"]
    assert "zero_rmse_nm" not in judged
    # Half of the torque: the stopwatch says twice as much.
    assert judged["baseline_profile_rmse_nm"] == pytest.approx(judged["baseline_zero_rmse_nm"], rel=0.25)
    least = min(judged["baseline_zero_rmse_nm"], judged["baseline_profile_rmse_nm"])
    assert judged["baseline_ratio"] == pytest.approx(judged["rmse_nm"] / least)
