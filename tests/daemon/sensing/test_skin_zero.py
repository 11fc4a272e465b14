"""The zero of the skin: taken when it is one, and refused with the reason when it is not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.sensing.skin_estimator import MAX_CHANGE, SkinZero, SkinZeroTaker

REST, SLOPE = (24.6, 25.3), 0.088
NOISE = 1e-4


def taken(r1: "np.ndarray | float", r2: "np.ndarray | float", seed: int = 0, n: int = 20) -> SkinZero | str:
    random = np.random.default_rng(seed)
    taker = SkinZeroTaker(n, REST, SLOPE)
    found = None
    for one, two in np.broadcast_to(np.array([r1 * np.ones(n), r2 * np.ones(n)]), (2, n)).T:
        assert found is None
        found = taker.add(one * (1 + random.normal(0, NOISE)), two * (1 + random.normal(0, NOISE)))
    return found


def test_a_skin_at_rest_gives_its_mean_and_its_noise():
    zero = taken(*REST, seed=1)
    assert (zero.r1_ohm, zero.r2_ohm) == pytest.approx(REST, rel=1e-4)
    assert 0.8 * 2**0.5 * NOISE < zero.noise < 2.5 * 2**0.5 * NOISE
    assert zero.uncertainty < 3e-4
    assert zero.changes(24.6 * 1.01, 25.3) == pytest.approx((0.01, 0.0), abs=2e-4)


def test_temperature_changes_both_gauges_and_is_no_load():
    zero = taken(24.6 * 1.011, 25.3 * 1.011)
    assert zero.uncertainty < 3e-4


@pytest.mark.parametrize("shear_n", [-2.0, -0.5, 0.4, 1.0])
def test_a_zero_under_load_is_refused_and_the_refusal_quotes_the_load(shear_n):
    stretch = SLOPE * abs(shear_n)
    r1, r2 = (24.6 * (1 + stretch), 25.3) if shear_n > 0 else (24.6, 25.3 * (1 + stretch))
    why = taken(r1, r2)
    told_n = float(why.split("about ")[1].split(" N")[0])
    assert told_n == pytest.approx(shear_n, rel=0.1)
    assert "take the load off" in why


def test_a_zero_under_a_load_too_small_to_be_refused_says_how_wrong_it_may_be():
    zero = taken(24.6 * (1 + SLOPE * 0.1), 25.3)
    assert zero.uncertainty == pytest.approx(SLOPE * 0.1, rel=0.1)


def test_a_zero_names_swapped_gauges_and_does_not_mistake_a_load_for_them():
    assert "swapped" in taken(25.3, 24.6)
    assert "swapped" not in taken(24.6 * 1.12, 25.3)


@pytest.mark.parametrize("gauge", [1, 2])
def test_a_gauge_that_drifts_while_the_zero_is_taken_is_named(gauge):
    drift = 1 + 0.003 * np.linspace(0, 1, 20)
    why = taken(24.6 * drift, 25.3) if gauge == 1 else taken(24.6, 25.3 * drift)
    assert f"gauge {gauge} changed by +0.3" in why


def test_a_zero_names_the_gauge_with_a_bad_contact_by_its_noise():
    jitter = 1 + 0.01 * np.random.default_rng(1).normal(0, 1, 20)
    assert "gauge 2 scatters" in taken(24.6, 25.3 * jitter)


@given(st.floats(-MAX_CHANGE, MAX_CHANGE), st.integers(0, 50))
def test_every_zero_that_is_taken_covers_what_it_is_short_of_rest(change, seed):
    zero = taken(24.6 * np.exp(0.95 * change), 25.3, seed)
    assert zero.uncertainty >= abs(0.95 * change) - 1.5e-4
