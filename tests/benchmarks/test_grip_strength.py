"""The strengths that the benchmark prints are those that the check compares."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.grip_strength import shown, strengths, without_check
from shearloop.estimation import FrameSeries, fit
from shearloop.tools.estimate_tracks import estimate_series, values_of
from tests.estimation.conftest import elastic, tip


def weakened(series: FrameSeries, ratio: float) -> FrameSeries:
    """Return a recording with a grip that is this much as strong."""
    idle, grips = (np.array([getattr(tip(number), name) for number in (1, 2)]) for name in ("idle", "grip"))
    held = np.abs(series.channels - idle).mean(axis=(1, 2)) > 0.5 * np.abs(grips).mean()
    return replace(series, channels=series.channels - (1.0 - ratio) * held[:, None, None] * grips)


@pytest.fixture(scope="module")
def calibration():
    """A calibration on a grip and on one half as strong."""
    return fit("motion_regression", [elastic(4), weakened(elastic(4, seed=1), 0.5)], "two strengths")


@pytest.mark.parametrize(("ratio", "expected"), [(0.4, 0.8), (0.5, 1.0), (0.75, 1.0), (1.0, 1.0), (1.6, 1.6)])
def test_a_strength_is_the_ratio_of_the_nearest_calibrated_one(calibration, ratio, expected):
    judged = weakened(elastic(4, seed=2), ratio)
    valid = np.isfinite(values_of(estimate_series(without_check(calibration), judged).estimates)[0])
    assert valid.sum() > 30
    for one in strengths(calibration, judged, valid):
        assert one.least <= one.median <= one.largest
        assert (one.least, one.largest) == pytest.approx((expected, expected), rel=0.1)


def test_the_least_and_the_largest_are_of_the_valid_frames_alone(calibration):
    judged = weakened(elastic(4, seed=2), 1.6)
    valid = np.isfinite(values_of(estimate_series(without_check(calibration), judged).estimates)[0])
    (whole, _), (last, _) = (
        strengths(calibration, judged, rows) for rows in (valid, np.arange(len(valid)) == np.flatnonzero(valid)[-1])
    )
    assert last.least == last.median == last.largest
    assert whole.least < last.median or whole.largest > last.median
    assert shown(whole) == f"{whole.median:.2f} ({whole.least:.2f} to {whole.largest:.2f})"
