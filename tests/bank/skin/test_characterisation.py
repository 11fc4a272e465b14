"""Every estimator on data with a known answer."""

import math

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.bank.skin.characterisation import (
    SkinFigures,
    estimated_figures,
    fit_line,
    loading,
    loop,
    noise_floor_n,
    responses,
)
from shearloop.bank.skin.membrane import THICK_SECTION, Membrane


def test_the_noise_floor_is_the_noise_put_in_and_not_the_wandering_between_windows():
    rng = np.random.default_rng(20)
    time_s = np.arange(0, 600, 0.1)
    wandering = 0.05 * np.floor(time_s) / 600
    still = wandering + rng.normal(0, 2e-4, len(time_s))
    assert noise_floor_n(time_s, still, 0.08) == pytest.approx(2e-4 / 0.08, rel=0.03)
    assert np.std(still) > 50 * 2e-4
    with pytest.raises(CalibrationError, match="at least two responses within"):
        noise_floor_n(np.arange(0, 100, 5.0), np.zeros(20), 0.08)


def test_a_line_by_hand():
    line = fit_line(np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0, 1.0, 3.0, 3.0]))
    assert (line.slope_per_n, line.kink_n) == pytest.approx((0.8, -1.0))
    # t(0.975, 2) = 4.3027
    assert line.prediction_half_width_n(1.5) == pytest.approx(4.3027 * math.sqrt(0.4) / 0.8 * math.sqrt(1.25), rel=1e-4)


@pytest.mark.parametrize("put_in", [SkinFigures(), SkinFigures(0.004, 0.05, 4e-4, 3e-4, -0.003)])
def test_what_is_put_into_a_synthetic_skin_is_found_again(put_in):
    found = [estimated_figures(0.088, put_in, np.random.default_rng(seed)) for seed in range(20)]
    noise = put_in.noise_floor_n * 0.088
    for name, spread in {
        "noise_floor_n": 0.01,
        "prediction_half_width_n": 0.04,
        # 36 readings give a standard deviation within 12 %.
        "drift_std": 0.06,
        "crosstalk": noise / math.sqrt(600) / put_in.crosstalk,
        "sensitivity_per_k": 0.1,
    }.items():
        mean = np.mean([getattr(one, name) for one in found])
        assert mean == pytest.approx(getattr(put_in, name), rel=spread), name


def test_friction_alone_makes_a_prediction_interval_of_the_paper_s_size():
    """Loading alone it is narrower than the paper's ± 0.0802 N, over a whole loop wider."""
    membrane = Membrane(THICK_SECTION)
    up = loading(1.0)
    rising = responses(membrane, up, 1.0)
    there = fit_line(np.concatenate([-up, up]), np.concatenate([-rising, rising]))
    path = loop(1.0)
    round_trip = fit_line(path, responses(membrane, path, 1.0))
    assert there.prediction_half_width_n(0.0) < 0.0802 < round_trip.prediction_half_width_n(0.0)


def test_the_paths_of_the_paper():
    np.testing.assert_allclose(loading(0.5), [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(loop(0.2), [0.1, 0.2, 0.1, 0.0, -0.1, -0.2, -0.1, 0.0, 0.1, 0.2], atol=1e-15)
