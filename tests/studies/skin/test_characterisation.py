"""The line, the paths, and what friction alone does to the prediction interval."""

import math

import numpy as np
import pytest

from shearloop.estimation.skin.membrane import THICK_SECTION, Membrane
from shearloop.studies.skin.characterisation import fit_line, loading, loop, responses


def test_the_fitted_line_and_its_prediction_interval_have_the_textbook_values():
    line = fit_line(np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0, 1.0, 3.0, 3.0]))
    assert (line.slope_per_n, line.kink_n) == pytest.approx((0.8, -1.0))
    # t(0.975, 2) = 4.3027
    half_width = 4.3027 * math.sqrt(0.4) / 0.8 * math.sqrt(1 + 1 / 4 + 1.5**2 / 5)
    assert line.prediction_half_width_n == pytest.approx(half_width, rel=1e-4)


def test_friction_alone_makes_a_prediction_interval_of_the_paper_s_size():
    """Loading alone it is narrower than the paper's ± 0.0802 N, over a whole loop wider."""
    membrane = Membrane(THICK_SECTION)
    up = loading(1.0)
    rising = responses(membrane, up, 1.0)
    there = fit_line(np.concatenate([-up, up]), np.concatenate([-rising, rising]))
    path = loop(1.0)
    round_trip = fit_line(path, responses(membrane, path, 1.0))
    assert there.prediction_half_width_n < 0.0802 < round_trip.prediction_half_width_n


def test_the_paths_of_the_paper():
    np.testing.assert_allclose(loading(0.5), [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(loop(0.2), [0.1, 0.2, 0.1, 0.0, -0.1, -0.2, -0.1, 0.0, 0.1, 0.2], atol=1e-15)
