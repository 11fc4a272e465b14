import pytest

from shearloop.daemon.control.fingertip_diameters import STALE_AFTER_NS, FingertipDiameters
from shearloop.estimation import Estimate


def estimate(diameter_mm: float, half_width_mm: float) -> Estimate:
    return Estimate(
        valid=True,
        diameter_mm=diameter_mm,
        diameter_low_mm=diameter_mm - half_width_mm,
        diameter_high_mm=diameter_mm + half_width_mm,
    )


def test_the_diameter_of_two_fingertips_is_their_weighted_mean_or_the_combined_one():
    diameters = FingertipDiameters("combined")
    assert diameters.latest(0) is None
    diameters.update("right", estimate(20.0, 2.0), 0)
    diameters.update("left", estimate(22.0, 4.0), 0)
    said = diameters.latest(0)
    # Weights 1 / 2² and 1 / 4².
    assert said.value == pytest.approx((20.0 / 4 + 22.0 / 16) / (1 / 4 + 1 / 16))
    assert said.half_width == pytest.approx((1 / 4 + 1 / 16) ** -0.5)
    # Six apart is 2.6 standard deviations of the difference: so much less sure is the mean.
    diameters.update("left", estimate(26.0, 4.0), 0)
    apart = diameters.latest(0)
    deviations = 6.0 / ((2.0**2 + 4.0**2) ** 0.5 / 1.96)
    assert apart.half_width == pytest.approx(deviations * said.half_width)
    diameters.update("combined", estimate(21.0, 1.0), 0)
    both = diameters.latest(0)
    assert (both.value, both.half_width) == (21.0, 1.0)


def test_what_is_old_or_taken_back_is_no_diameter():
    diameters = FingertipDiameters("combined")
    diameters.update("right", estimate(20.0, 2.0), 0)
    assert diameters.latest(STALE_AFTER_NS) is not None
    assert diameters.latest(STALE_AFTER_NS + 1) is None
    diameters.update("right", Estimate(valid=False), 1)
    assert diameters.latest(1) is None
