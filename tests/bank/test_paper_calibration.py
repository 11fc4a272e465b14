"""Curves through measurements, and the paper's calibration made from them."""

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation import Calibration
from shearloop.bank.polynomial import Polynomial

BANK = "ab" * 32
SIGMA, K = np.linspace(1.2, 1.9, 30), np.linspace(3.4, 3.8, 12)
NOISE = np.random.default_rng(1)
TORQUE = 0.4 - 0.1 * SIGMA - 0.05 * SIGMA**2 + NOISE.normal(0, 0.003, 30)
DIAMETER = 250 - 60 * K + NOISE.normal(0, 1.0, 12)
CALIBRATION = Calibration.from_matches(BANK, "made up", torque=(SIGMA, TORQUE), diameter=(K, DIAMETER))


def test_a_curve_without_noise_is_found_exactly():
    fit = Polynomial.fit(SIGMA, 0.4 - 0.1 * SIGMA - 0.05 * SIGMA**2, 2)
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


def test_outside_of_the_calibrated_range_a_reason_is_given():
    def reasons(k: float, sigma: float) -> tuple[str, ...]:
        return tuple(
            reason
            for model, feature, name, unit in (
                (CALIBRATION.torque, sigma, "torque", "N·m"),
                (CALIBRATION.diameter, k, "diameter", "mm"),
            )
            if model is not None
            for reason in model.regressor.range_reasons(0.0, np.array([feature]), name, unit)
        )

    assert reasons(3.6, 1.5) == reasons(K[0], SIGMA[-1]) == ()
    assert reasons(3.2, 2.0) == (
        "sigma = 2 cm is outside of 1.2 to 1.9 cm, where torque was calibrated",
        "k = 3.2 cm is outside of 3.4 to 3.8 cm, where diameter was calibrated",
    )
    assert len(reasons(np.nan, np.nan)) == 2


def test_one_of_the_fits_may_be_missing_and_not_both():
    assert Calibration.from_matches(BANK, "torque only", torque=(SIGMA, TORQUE)).diameter is None
    assert Calibration.from_matches(BANK, "diameter only", diameter=(K, DIAMETER)).torque is None
    with pytest.raises(CalibrationError, match="of torque, of diameter, or of both"):
        Calibration.from_matches(BANK, "nothing")


def test_a_saved_calibration_is_loaded_as_it_was(tmp_path):
    CALIBRATION.save(tmp_path / "a.cal")
    assert Calibration.load(tmp_path / "a.cal").torque.regressor == CALIBRATION.torque.regressor
