import pytest

from shearloop.daemon.control.fingertip_diameters import FingertipDiameters
from shearloop.daemon.torques import TorqueSource
from shearloop.estimation import Estimate

SOURCES = {
    name: TorqueSource(name=name, period_s=0.5, min_fresh_s=min_fresh_s)
    for name, min_fresh_s in (("right", 0.0), ("left", 5.0), ("combined", 0.0))
}


def estimate(diameter_mm: float, half_width_mm: float) -> Estimate:
    return Estimate(
        valid=True,
        diameter_mm=diameter_mm,
        diameter_low_mm=diameter_mm - half_width_mm,
        diameter_high_mm=diameter_mm + half_width_mm,
    )


def test_the_diameter_of_two_fingertips_is_their_weighted_mean_or_the_combined_one():
    diameters = FingertipDiameters("combined", SOURCES)
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
    diameters = FingertipDiameters("combined", SOURCES)
    diameters.update("right", estimate(20.0, 2.0), 0)
    diameters.update("left", estimate(22.0, 4.0), 0)
    assert diameters.latest(1_250_000_000).value < 22.0, "2.5 periods"
    assert diameters.latest(1_250_000_001).value == 22.0
    assert diameters.latest(5_000_000_000).value == 22.0, "as long as its torque"
    assert diameters.latest(5_000_000_001) is None
    diameters.update("right", Estimate(valid=False), 1)
    assert diameters.latest(1).value == 22.0
