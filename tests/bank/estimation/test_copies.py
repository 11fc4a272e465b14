"""A copy of a tracker in mid-stream, as other processes are handed one, goes on as the tracker itself does."""

import copy
import pickle
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.bank.estimation import Calibration, EstimatorSession, FrameSeries, Measured, TactileFrame, fit

COPIES: dict[str, Callable[[EstimatorSession], EstimatorSession]] = {
    "copied": copy.deepcopy,
    "pickled": lambda tracker: pickle.loads(pickle.dumps(tracker)),  # noqa: S301 - its own
}


@pytest.fixture(scope="module")
def calibration_of(recorded, motion_calibration) -> Callable[[str, int], Calibration]:
    """Return what gives the calibration of an estimator on so many fingertips of the shared recording."""
    right = recorded.select_sides(("right",))
    found = {
        ("motion_regression", 2): motion_calibration,
        ("motion_regression", 1): fit("motion_regression", [right], "the right one of a played rig"),
        ("regression", 2): fit("regression", [recorded], "rig"),
        ("regression", 1): fit("regression", [right], "the right one of a played rig"),
    }
    return lambda name, m: found[name, m]


def faulty(series: FrameSeries, faults: list[tuple[str, int, int, int]]) -> list[TactileFrame]:
    """Return a session's frames; a fault has a kind, its first frame, how many, and a seed."""
    channels, times = series.channels.copy(), series.t_s.copy()
    usable = np.ones(channels.shape, dtype=np.bool_)
    for kind, first, n, seed in faults:
        random, frames = np.random.default_rng(seed), slice(first, first + n)
        side, some = (
            random.integers(len(series.sides)),
            random.permutation(PAPER_TABLE.n_channels)[: random.integers(1, 120)],
        )
        match kind:
            case "dead":
                usable[frames, side, some] = False
            case "lost":
                channels[frames, side, some] *= 0.01
            case "not finite":
                channels[frames, side, some] = np.nan
            case "rail":
                channels[frames, side] = np.minimum(channels[frames, side], 0.4)
            case "garbled":
                channels[first, side] = random.permutation(channels[first, side])
            case "gap":
                times[first:] += 0.54 * (1 + seed % 4)
    return [TactileFrame.of(float(t), *each) for t, *each in zip(times, channels, usable, strict=True)]


FAULTS = st.lists(
    st.tuples(
        st.sampled_from(["dead", "dead", "lost", "lost", "not finite", "rail", "garbled", "gap"]),
        st.integers(0, 120), st.integers(1, 90), st.integers(0, 2**32 - 1),
    ),
    max_size=4,
)  # fmt: skip


@pytest.mark.parametrize("how", COPIES)
@settings(deadline=None, max_examples=12)
@given(
    st.sampled_from(["motion_regression", "motion_regression", "regression"]), st.integers(1, 2), FAULTS,
    st.integers(0, 130), st.booleans(),
)  # fmt: skip
def test_a_copy_goes_on_with_the_same_estimates_to_the_bit(how, calibration_of, twisting, name, m, faults, at, tared):
    calibration = calibration_of(name, m)
    series = twisting(cycles=2, seed=9).select_sides(calibration.sides)
    tracker = EstimatorSession(calibration, period_s=0.54)
    tracker.set_tool(Measured(20.0, 1.0))
    if tared:
        tracker.tare(6)
    frames = faulty(series, faults)
    for frame in frames[:at]:
        tracker.estimate(frame)
    again = COPIES[how](tracker)
    expected = [(tracker.estimate(frame), tracker.difference) for frame in frames[at:]]
    for frame, (estimate, difference) in zip(frames[at:], expected, strict=True):
        assert again.estimate(frame) == estimate
        np.testing.assert_array_equal(again.difference, difference)
    if not faults:
        assert sum(estimate.valid for estimate, _ in expected) > 80 - at
