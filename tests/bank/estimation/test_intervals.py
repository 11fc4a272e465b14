import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.interval_regressor import Intervals, student_inflation


def test_each_stratum_covers_its_own_future():
    """Most frames are free of load and exact; the few loaded ones are not, and must not borrow their certainty."""
    rng = np.random.default_rng(0)
    past, future = (rng.uniform(-1, 0.2, 3000) for _ in range(2))

    def residuals(predicted):
        return rng.normal(size=len(predicted)) * np.where(predicted > 0, 0.01, 1e-4)

    intervals = Intervals.fit(past, residuals(past), (0.0,), 1.0)
    inside = np.abs(residuals(future)) <= [intervals.half_width(one) for one in future]
    for stratum in (future > 0, future <= 0):
        assert 0.92 < inside[stratum].mean() < 0.98


def test_strata_with_few_residuals_join():
    rng = np.random.default_rng(1)
    predicted = np.concatenate([rng.uniform(-1, 0, 100), [0.5, 0.6]])
    intervals = Intervals.fit(predicted, rng.normal(size=102), (0.0, 0.4), 1.1)
    assert len(intervals.edges) == 0
    assert intervals.half_width(-5) == intervals.half_width(5)


@pytest.mark.parametrize(("n", "students_t"), [(5, 2.776), (20, 2.093), (1001, 1.962)])
def test_of_few_values_an_interval_is_as_wide_as_students(n, students_t):
    assert student_inflation(n) == pytest.approx(students_t / 1.96, abs=3e-4)


def test_too_few_residuals_are_refused():
    with pytest.raises(CalibrationError, match="record more repeats"):
        Intervals.fit(np.zeros(3), np.zeros(3), (), 1.0)
