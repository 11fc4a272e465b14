import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.daemon.control.controller import AngleHistory

STEP_NS = 8_000_000


def history_of(angles: list[float], span_ns: int = 10**12) -> AngleHistory:
    history = AngleHistory(span_ns)
    for number, angle in enumerate(angles):
        assert history.add(number * STEP_NS, angle)
    return history


@given(
    st.lists(st.floats(-7.0, 7.0), min_size=2, max_size=40),
    st.floats(0.0, 1.0),
    st.floats(0.0, 1.0),
)
def test_the_mean_is_that_of_the_line_through_the_samples(angles: list[float], one: float, other: float) -> None:
    last_ns = (len(angles) - 1) * STEP_NS
    low, high = sorted((int(one * last_ns), int(other * last_ns)))
    mean = history_of(angles).mean(low, high)
    knots = np.arange(len(angles)) * STEP_NS
    # The mean of a broken line: exact by the trapezoid rule over its knots and the two ends.
    times = np.unique(np.concatenate([[low, high], knots[(knots > low) & (knots < high)]])).astype(float)
    values = np.interp(times, knots, angles)
    expected = np.trapezoid(values, times) / (high - low) if high > low else values[0]
    assert mean == pytest.approx(expected, abs=1e-6)


def test_an_angle_is_never_extrapolated() -> None:
    history = history_of([0.0, 1.0, 2.0])
    assert history.mean(-1, STEP_NS) is None
    assert history.mean(0, 2 * STEP_NS + 1) is None
    assert AngleHistory(1).mean(0, 0) is None


def test_a_time_that_does_not_advance_is_refused() -> None:
    history = history_of([0.0, 1.0])
    assert not history.add(STEP_NS, 5.0)
    assert not history.add(0, 5.0)
    assert history.mean(STEP_NS, STEP_NS) == 1.0


def test_memory_is_bounded_and_the_span_is_kept() -> None:
    history = history_of([0.001 * number for number in range(20_000)], span_ns=1_000_000_000)
    newest_ns = 19_999 * STEP_NS
    assert history.mean(newest_ns - 1_000_000_000, newest_ns) == pytest.approx(0.001 * (19_999 - 62.5))
    assert history.mean(0, STEP_NS) is None
