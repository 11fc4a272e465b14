import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.bank.polynomial import Polynomial


def test_a_curve_without_noise_is_found_exactly():
    sigma = np.linspace(1.2, 1.9, 30)
    fit = Polynomial.fit(sigma, 0.4 - 0.1 * sigma - 0.05 * sigma**2, 2)
    assert fit.residual_std < 1e-15
    for sigma in (1.2, 1.55, 2.5):
        value, low, high = fit.interval(sigma)
        assert value == pytest.approx(0.4 - 0.1 * sigma - 0.05 * sigma**2, abs=1e-13)
        assert (low, high) == pytest.approx((value, value), abs=1e-13)


def test_the_interval_of_a_line_is_the_textbook_one():
    x, y = np.array([1.0, 2.0, 4.0, 7.0]), np.array([2.0, 3.0, 3.0, 9.0])
    slope = ((x - 3.5) * (y - 4.25)).sum() / ((x - 3.5) ** 2).sum()
    std = np.sqrt(((y - 4.25 - slope * (x - 3.5)) ** 2).sum() / 2)
    half = 4.302652730 * std * np.sqrt(1 + 1 / 4 + (6.0 - 3.5) ** 2 / ((x - 3.5) ** 2).sum())
    value = 4.25 + slope * 2.5
    assert Polynomial.fit(x, y, 1).interval(6.0) == pytest.approx((value, value - half, value + half))


@pytest.mark.parametrize(
    ("x", "y", "says"),
    [
        ([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], "3 measurements at 3 distinct places do not determine .* degree 2"),
        ([1.0, 1.0, 2.0, 2.0], [1.0, 2.0, 3.0, 4.0], "4 measurements at 2 distinct places"),
        ([1.0, 2.0, 3.0, np.nan], [1.0, 2.0, 3.0, 4.0], "as many finite x as y"),
        ([1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0], "as many finite x as y"),
    ],
)
def test_points_that_do_not_determine_a_curve_are_refused(x, y, says):
    with pytest.raises(CalibrationError, match=says):
        Polynomial.fit(np.array(x), np.array(y), 2)
