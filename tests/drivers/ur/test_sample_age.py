"""The age of a controller's samples, from timestamps and times of arrival."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shearloop.drivers.ur.sample_age import _OFFSET_RISE, SampleAge

PERIOD_NS = 8_000_000
STARTED_NS = 7 * 10**12


def ages_s(waits_s: list[float], *, drift: float = 0.0) -> list[float]:
    """Return the ages of samples with these waits, by a clock that is `drift` slower than ours."""
    age, ages = SampleAge(), []
    for number, wait_s in enumerate(waits_s):
        made_ns = number * PERIOD_NS
        timestamp_s = 3600.0 + (1.0 - drift) * made_ns / 1e9
        ages.append(age.age_ns(timestamp_s, STARTED_NS + made_ns + round(wait_s * 1e9)) / 1e9)
    return ages


def test_unchanged_sample_grows_older():
    age = SampleAge()
    assert age.age_ns(5.0, STARTED_NS) == 0
    assert age.age_ns(5.0, STARTED_NS + 300_000_000) == 300_000_000


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_timestamp_that_is_not_finite_is_ignored(bad):
    age = SampleAge()
    age.age_ns(5.0, STARTED_NS)
    assert age.age_ns(bad, STARTED_NS + 300_000_000) == 300_000_000
    assert age.age_ns(5.3, STARTED_NS + 310_000_000) == pytest.approx(10_000_000, abs=1.01 * _OFFSET_RISE * 310_000_000)


def test_old_samples_that_come_again_are_not_new():
    age = SampleAge()
    age.age_ns(5.000, STARTED_NS)
    age.age_ns(5.008, STARTED_NS + 8_000_000)
    for cycle in range(2, 50):
        assert age.age_ns((5.0, 5.008)[cycle % 2], STARTED_NS + cycle * 8_000_000) == (cycle - 1) * 8_000_000


@pytest.mark.parametrize("drift", [-1e-4, 1e-4, 5e-4, 5e-3])
def test_clocks_that_drift_apart_do_not_make_samples_old(drift):
    assert max(ages_s([0.001] * 50_000, drift=drift)) < 1e-4


def test_samples_of_a_slow_clock_become_old():
    ages = ages_s([0.001] * 900, drift=0.05)
    old_s = next(number * PERIOD_NS / 1e9 for number, age_s in enumerate(ages) if age_s > 0.25)
    assert old_s == pytest.approx(6.25, abs=0.1), "as docs/faults.md says: it cannot be told from a network's delay"


def test_controller_clock_pause_is_forgotten_in_time():
    ages = ages_s([0.001] * 10 + [0.101] * round(1.01 * 0.1 / _OFFSET_RISE / 0.008))
    assert ages[10] > 0.09
    assert ages[-1] == 0.0


@given(st.lists(st.floats(0.0, 0.5), min_size=1, max_size=60))
@example([0.0, 0.234375, 0.4765625, 0.5])
def test_age_is_the_wait_beyond_the_shortest_one(waits_s):
    # What was sent later comes later.
    for number in range(1, len(waits_s)):
        waits_s[number] = max(waits_s[number], waits_s[number - 1] - 0.008)
    for number, age_s in enumerate(ages_s(waits_s)):
        beyond_s = waits_s[number] - min(waits_s[: number + 1])
        assert beyond_s - _OFFSET_RISE * (number * 0.008 + 0.5) - 1e-6 <= age_s <= beyond_s + 1e-6
