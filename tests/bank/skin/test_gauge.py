import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError, GeometryError
from shearloop.bank.skin import membrane
from shearloop.bank.skin.membrane import Section


def test_the_paper_s_gauge_has_25_ohm_and_stays_within_5_kelvin() -> None:
    channel = membrane.Gauge()
    assert channel.resistance_ohm == pytest.approx(25.0, rel=0.02)
    assert channel.power_at_current_w(5e-3) == pytest.approx(5e-3**2 * channel.resistance_ohm)
    assert channel.power_w(1.0) == pytest.approx(1 / channel.resistance_ohm)
    assert 0 < channel.joule_heating_k() < 5.0


def test_equation_1_takes_resistances_to_the_difference_of_strains() -> None:
    strain_1, strain_2 = np.array([0.03, 0.0]), np.array([-0.002, 0.01])
    r1, r2 = 24.0 * (1 + 2 * strain_1), 26.0 * (1 + 2 * strain_2)
    measured = membrane.measured_response(r1, r2, 24.0, 26.0)
    np.testing.assert_allclose(measured, membrane.response_of_strains(strain_1, strain_2), atol=1e-15)


@pytest.mark.parametrize("unloaded", [(0.0, 25.0), (25.0, -1.0), (float("nan"), 25.0)])
def test_an_unloaded_resistance_that_cannot_be_is_refused(unloaded: tuple[float, float]) -> None:
    with pytest.raises(CalibrationError, match=r"unloaded resistance of R[12]"):
        membrane.measured_response(np.ones(1), np.ones(1), *unloaded)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"width_mm": 0.0}, "width_mm"),
        ({"thickness_mm": 12.0}, "thickness_mm"),
        ({"poisson_ratio": 0.5}, "poisson_ratio"),
        ({"friction": 1.5}, "friction"),
        ({"gauge_to_deg": 89.0}, "gauge"),
    ],
)
def test_an_impossible_section_is_refused_by_name(wrong: dict[str, float], named: str) -> None:
    with pytest.raises(GeometryError, match=named):
        Section(**wrong)
