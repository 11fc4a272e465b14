from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import FrameSeries, HeldTool, Measured, TactileFrame, combine
from shearloop.estimation.series import distinct
from shearloop.estimation.values import torque_at

measurements = st.builds(Measured, st.floats(-1e3, 1e3, allow_nan=False), st.floats(1e-3, 1e3, allow_nan=False))


@given(st.lists(measurements, min_size=1, max_size=4))
def test_fused_measurements_lie_between_and_cover_the_ones_that_contradict_each_other(several):
    both = combine(*several, None)
    low, high = min(m.value for m in several), max(m.value for m in several)
    assert low - 1e-6 <= both.value <= high + 1e-6
    assert both.half_width >= sum(m.half_width**-2 for m in several) ** -0.5 * (1 - 1e-12)
    alike = combine(*(Measured(low, m.half_width) for m in several))
    assert alike.half_width <= min(m.half_width for m in several) * (1 + 1e-12)


@given(st.lists(measurements, max_size=6), st.randoms())
def test_measurements_within_their_uncertainty_count_as_one_value(several, random):
    things = distinct(several)
    assert set(things) <= set(several)
    assert (things == []) == (several == [])
    assert len(distinct([Measured(one.value, 0.0) for one in several])) == len({one.value for one in several})
    assert len(distinct([Measured(one.value, 3e3) for one in several])) == min(len(several), 1)
    random.shuffle(several)
    assert distinct(several) == things


def test_two_that_contradict_each_other_are_not_a_sure_one_in_between():
    both = combine(Measured(10.0, 1.0), Measured(40.0, 1.0))
    assert both.value == pytest.approx(25.0)
    # Both of them are within it, and it is not wider than they are apart.
    assert 15.0 < both.half_width < 30.0


def test_the_interval_of_fused_measurements_holds_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(4)
    halves = np.array([1.0, 3.0])
    drawn = rng.normal(0.0, halves / 1.96, (4000, 2))
    found = [combine(*(Measured(x, h) for x, h in zip(row, halves.tolist(), strict=True))) for row in drawn.tolist()]
    assert 0.94 < np.mean([one is not None and abs(one.value) <= one.half_width for one in found]) < 0.99


@pytest.mark.parametrize(("measured_mm", "is_another"), [(23.05, False), (23.4, True), (16.95, False), (16.6, True)])
def test_a_calibration_and_an_experiment_name_the_same_measured_tool_another_one(
    motion_calibration, measured_mm, is_another
):
    measured, calibration = Measured(measured_mm, 0.1), replace(motion_calibration, tool_mm=20.0)
    refused = pytest.raises(CalibrationError, match="made with a tool of 20 mm") if is_another else nullcontext()
    with refused:
        assert calibration.for_tool(measured) is calibration
    assert bool(HeldTool(measured, 20.0).conflict) is is_another


def test_combining_no_finite_measurement_gives_none():
    assert combine(None, None) is None
    assert combine(Measured(1.0, float("inf")), Measured(2.0, float("inf"))) is None, "each may be anything"
    with pytest.raises(ValueError, match="without uncertainty"):
        combine(Measured(1.0, 0.0), Measured(1.0, 1.0))


LOAD = np.array([0.5, 1.5]), np.array([0.0, 1.0])
EMPTY = FrameSeries(("right",), np.arange(3.0), np.zeros((3, 1, 896)), *LOAD, np.full(3, np.nan))


def test_where_the_load_cell_was_silent_for_long_no_torque_is_made_up():
    t_s, nothing = np.arange(0.0, 12.0, 0.5), np.zeros(24)
    torque_t_s = np.array([*np.arange(0.0, 3.0, 0.1), *np.arange(9.0, 12.0, 0.1)])
    series = FrameSeries(("right",), t_s, np.zeros((24, 1, 896)), torque_t_s, np.sin(torque_t_s), nothing)
    torque = series.torque_at_frames()
    known = (t_s < 3.0) | (t_s >= 9.0)
    np.testing.assert_array_equal(np.isfinite(torque), known)
    np.testing.assert_allclose(torque[known], np.sin(t_s[known]), atol=2e-3)


def test_a_slow_load_cell_is_known_between_its_readings():
    t_s, readings_s = np.arange(0.0, 30.0, 0.5), np.delete(np.arange(0.0, 30.0, 1.5), [10, 11])
    torque = torque_at(t_s, readings_s, np.ones(len(readings_s)))
    gap = (t_s > 13.5) & (t_s < 18.0)
    np.testing.assert_array_equal(np.isfinite(torque), ~gap & (t_s <= readings_s[-1]))


@pytest.mark.parametrize("readings_s", [[0.0, 60.0], [0.0, 0.1, 60.0], [10.0 * one for one in range(12)]])
def test_readings_that_are_far_apart_say_nothing_of_the_time_between(readings_s):
    t_s = np.arange(0.3, readings_s[-1], 0.5)
    torque = torque_at(t_s, np.array(readings_s), np.ones(len(readings_s)))
    assert not np.isfinite(torque).any()


def test_torque_at_frames_is_interpolated_and_never_extrapolated():
    np.testing.assert_array_equal(EMPTY.torque_at_frames(), [np.nan, 0.5, np.nan])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"channels": np.zeros((3, 2, 896))}, "need channels of shape"),
        ({"torque_nm": np.zeros(3)}, "do not match"),
        ({"t_s": np.array([0.0, 2.0, 1.0])}, "must not decrease"),
    ],
)
def test_what_does_not_belong_together_is_refused(changed, message):
    with pytest.raises(CalibrationError, match=message):
        replace(EMPTY, **changed)


def test_frames_know_which_of_their_sides_saw_the_fingers_move():
    moved = np.array([[False, False], [True, False], [False, True]])
    series = replace(EMPTY, sides=("right", "left"), channels=np.zeros((3, 2, 896)), fingers_moved=moved)
    assert [one.fingers_moved for one in series.frames()] == [False, True, True]
    assert [one.fingers_moved for one in series.select_sides(("left",)).frames()] == [False, False, True]
    assert [one.fingers_moved for one in series.between(1, 2).frames()] == [True]
    assert [one.fingers_moved for one in EMPTY.frames()] == [False] * 3
    with pytest.raises(CalibrationError, match="do not match motions"):
        replace(EMPTY, fingers_moved=moved)


def test_a_missing_side_is_named():
    with pytest.raises(CalibrationError, match="not left"):
        EMPTY.select_sides(("left",))


def test_values_that_are_not_finite_are_not_usable():
    channels, usable = np.zeros((1, 896)), np.ones((1, 896), dtype=np.bool_)
    channels[0, 5] = np.nan
    frame = TactileFrame.of(0.0, channels)
    assert list(np.flatnonzero(~frame.usable)) == [5]
    assert np.isfinite(frame.channels).all()
    channels[0, 5], usable[0, 7] = np.inf, False
    frame = TactileFrame.of(0.0, channels, usable)
    assert list(np.flatnonzero(~frame.usable)) == [5, 7]
    assert usable[0, 5], "the caller's mask is left as it is"
