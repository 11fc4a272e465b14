"""Ridges and curves from features to a value, and their intervals."""

from types import SimpleNamespace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation.interval_fit import best_strength, fit_interval_regressor, fit_intervals, student_inflation
from shearloop.estimation.left_out import later_origins, later_splits, left_out_blocks
from shearloop.estimation.ridge import CensoredRidge, Ridge
from shearloop.studies.slices.curve import InverseCalibration


def test_a_ridge_without_strength_is_least_squares():
    rng = np.random.default_rng(0)
    x, weights = rng.normal(size=(60, 5)), np.arange(5.0)
    y = 2 + x @ weights + 0.01 * rng.normal(size=60)
    ridge = Ridge.fit(x, y, 1e-12)
    expected = np.linalg.lstsq(np.column_stack([np.ones(60), x]), y, rcond=None)[0]
    np.testing.assert_allclose(ridge.weights, expected[1:], rtol=1e-7)
    np.testing.assert_allclose(ridge.predict(np.zeros((1, 5))), expected[:1], rtol=1e-7)


@pytest.mark.parametrize("shape", [(30, 200), (200, 30)])
def test_a_ridge_has_the_least_sum_of_squared_errors_and_penalty(shape):
    """There the gradient is 0, of more features than frames too."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=shape), rng.normal(size=shape[0])
    ridge = Ridge.fit(x, y, 1e-3)
    penalty = 1e-3 * ((x - x.mean(axis=0)) ** 2).sum()
    gradient = (x - x.mean(axis=0)).T @ (ridge.predict(x) - y) + penalty * ridge.weights
    np.testing.assert_allclose(gradient, 0.0, atol=1e-11)


def test_a_scaled_ridge_does_not_care_for_units():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(40, 3)), rng.normal(size=40)
    units = np.array([1.0, 1e3, 1e-4])
    metric = Ridge.fit_scaled(x, y, 0.1).predict(x)
    np.testing.assert_allclose(Ridge.fit_scaled(x * units, y, 0.1).predict(x * units), metric, rtol=1e-9)


def test_what_a_free_lever_hides_is_not_taken_for_zero():
    """y = max(0, z): least squares through the zeros finds half the slope, the censored fit all of it."""
    rng = np.random.default_rng(2)
    x = rng.normal(size=(800, 2))
    latent = x @ [0.05, 0.02] - 0.03
    y = np.maximum(latent + 0.002 * rng.normal(size=800), 0.0)
    censored = CensoredRidge.fit(x, y, 1e-9)
    np.testing.assert_allclose(censored.weights, [0.05, 0.02], rtol=0.05)
    assert censored.offset - censored.weights @ censored.mean == pytest.approx(-0.03, rel=0.1)
    assert Ridge.fit(x, y, 1e-9).weights[0] < 0.03


def frames_on_a_curve(values, rng, noise=0.05, drift=1.0, begins_at=0.0, shrinking=0.0):
    """Return (n, 201) frames, one a second; the response to a value shrinks by a share with each e-folding of age."""
    shapes = np.random.default_rng(9).normal(size=(4, 200))
    times = begins_at + np.arange(len(values))
    value = np.asarray(values)[:, None]
    z = value * (1 - shrinking * np.log1p(times))[:, None]
    frames = (
        shapes[0]
        + z * shapes[1]
        + 0.2 * z**2 * shapes[2]
        + drift * rng.normal(size=z.shape) * shapes[3]
        + noise * (rng.normal(size=(len(z), 200)))
    )
    return np.column_stack([frames, times])


def test_a_curve_finds_the_value_through_drift_ten_times_the_noise():
    rng = np.random.default_rng(4)
    values = rng.uniform(-1, 2, 60)
    curve = InverseCalibration.fit(frames_on_a_curve(values, rng), values, 2, 1)
    later = rng.uniform(-1, 2, 40)
    errors = curve.predict(frames_on_a_curve(later, rng)) - later
    assert np.sqrt((errors**2).mean()) < 0.03


def test_a_curve_does_not_pull_towards_the_mean():
    """A ridge does, with few frames of many noisy channels."""
    rng = np.random.default_rng(5)
    values = rng.uniform(-1, 2, 25)
    noisy = frames_on_a_curve(values, rng, noise=1.5, drift=0.1)
    later = np.linspace(-1, 2, 60)
    future = frames_on_a_curve(later, rng, noise=1.5, drift=0.1)

    def slope(predicted):
        return np.polyfit(later, predicted, 1)[0]

    assert slope(Ridge.fit(noisy, values, 0.1).predict(future)) < 0.8
    assert 0.85 < slope(InverseCalibration.fit(noisy, values, 1, 0).predict(future)) < 1.15


def test_a_curve_works_on_with_the_channels_that_are_left():
    rng = np.random.default_rng(6)
    values = rng.uniform(-1, 2, 60)
    curve = InverseCalibration.fit(frames_on_a_curve(values, rng), values, 2, 1)
    frame = frames_on_a_curve([1.3], rng)[0]
    usable = rng.random(200) > 0.4
    frame[:-1][~usable] = np.nan
    assert curve.predict(frame[None])[0] == pytest.approx(1.3, abs=0.05)


def test_a_response_that_shrinks_with_age_is_followed_beyond_what_was_fitted():
    rng = np.random.default_rng(8)
    values, later = rng.uniform(-1, 2, 60), rng.uniform(-1, 2, 60)
    past = frames_on_a_curve(values, rng, drift=0.0, shrinking=0.08)
    future = frames_on_a_curve(later, rng, drift=0.0, begins_at=60.0, shrinking=0.08)
    still, followed = (
        np.sqrt(np.mean((InverseCalibration.fit(past, values, 2, 1, trend=trend).predict(future) - later) ** 2))
        for trend in (False, True)
    )
    assert followed < 0.6 * still
    # Frames that are numbered from the beginning again are read as at the end of what was fitted.
    curve, anew = InverseCalibration.fit(past, values, 2, 1, trend=True), future.copy()
    anew[:, -1] -= 60.0
    at_the_end = future.copy()
    at_the_end[:, -1] = 59.0
    np.testing.assert_array_equal(curve.predict(anew), curve.predict(at_the_end))


def test_a_curve_needs_enough_frames():
    rng = np.random.default_rng(7)
    with pytest.raises(CalibrationError, match="4 frames at 2 distinct values cannot determine"):
        InverseCalibration.fit(rng.normal(size=(4, 9)), np.array([1.0, 1.0, 2.0, 2.0]), 2, 1)


@pytest.mark.parametrize("n", [8, 13, 19, 20, 49, 500])
def test_judged_rows_come_after_the_fitted_ones_or_are_left_out_of_them(n):
    for past, future in [*later_splits(n), *later_origins(n)]:
        assert past.max() < future.min()
    assert all(future.max() == n - 1 for _, future in later_origins(n))
    assert len(later_origins(n)) <= 11
    assert bool(later_origins(n)) == (n >= 20)
    blocks = [block for _, block in left_out_blocks(n)]
    np.testing.assert_array_equal(np.concatenate(blocks), np.arange(n))
    assert all(not set(rest) & set(block) for rest, block in left_out_blocks(n))


def test_the_strongest_of_equally_good_strengths_is_chosen():
    def fit(_features, _values, strength):
        return SimpleNamespace(predict=lambda rows: rows[:, 0] + (5.0 if strength == 10.0 else 1.0))

    values = np.arange(20.0)
    assert best_strength(values[:, None], values, fit, (0.1, 1.0, 10.0)) == (1.0, 1.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_twist_the_other_way_than_the_lever_pushed_is_no_sure_zero(sign):
    """The load cell read 0 whenever the tool was twisted the other way: a 0 that may be anything on that side."""
    rng = np.random.default_rng(9)
    twist = np.sin(np.arange(400) / 9.0)
    frames = twist[:, None] * rng.normal(size=(1, 12)) + rng.normal(0.0, 0.05, (400, 12))
    reader = fit_interval_regressor(frames, sign * np.maximum(twist, 0.0) * 0.1, CensoredRidge.fit, strengths=(1e-5,))
    other_way = np.flatnonzero(twist < -0.1)
    read = [reader.predict(frames[i]) for i in other_way.tolist()]
    truth = (sign * 0.1 * twist[other_way]).tolist()
    inside = [value - below <= true <= value + above for (value, below, above), true in zip(read, truth, strict=True)]
    assert np.mean(inside) > 0.95
    for _, below, above in read:
        # Towards the side that the lever pushes to, it is as sure as it was.
        assert (above if sign > 0 else below) < 0.02
    far, below, above = reader.predict(frames[np.argmin(twist)])
    assert far == 0.0
    assert (below if sign > 0 else above) > 0.1


def test_each_stratum_covers_its_own_future():
    """Most frames are free of load and exact; the few loaded ones are not, and must not borrow their certainty."""
    rng = np.random.default_rng(0)
    past, future = (rng.uniform(-1, 0.2, 3000) for _ in range(2))

    def residuals(predicted):
        return rng.normal(size=len(predicted)) * np.where(predicted > 0, 0.01, 1e-4)

    intervals = fit_intervals(past, residuals(past), (0.0,), 1.0)
    inside = np.abs(residuals(future)) <= [intervals.half_width(one) for one in future]
    for stratum in (future > 0, future <= 0):
        assert 0.92 < inside[stratum].mean() < 0.98


def test_strata_with_few_residuals_join():
    rng = np.random.default_rng(1)
    predicted = np.concatenate([rng.uniform(-1, 0, 100), [0.5, 0.6]])
    intervals = fit_intervals(predicted, rng.normal(size=102), (0.0, 0.4), 1.1)
    assert len(intervals.edges) == 0
    assert intervals.half_width(-5) == intervals.half_width(5)


@pytest.mark.parametrize(("n", "students_t"), [(5, 2.776), (20, 2.093), (1001, 1.962)])
def test_of_few_values_an_interval_is_as_wide_as_students(n, students_t):
    assert student_inflation(n) == pytest.approx(students_t / 1.96, abs=3e-4)


def test_too_few_residuals_are_refused():
    with pytest.raises(CalibrationError, match="record more repeats"):
        fit_intervals(np.zeros(3), np.zeros(3), (), 1.0)


def loads(frames):
    """Return torques (600,), loaded for so many frames in turn, and features that hardly and that clearly show them."""
    rng = np.random.default_rng(3)
    torque = np.where(np.arange(600) % 40 < frames, rng.uniform(0.02, 0.06, 600), 0.0)
    blind = rng.normal(0, 1, (600, 2)) + torque[:, None]
    return torque, blind, np.column_stack([torque, rng.normal(0, 1, 600)]) + rng.normal(0, 1e-3, (600, 2))


def test_a_load_that_an_estimator_does_not_see_lies_in_its_interval():
    """Of a stream most is free of load: its small residuals must not stand for a load that leaves no trace."""
    torque, blind, seeing = loads(frames=3)
    reader = fit_interval_regressor(blind, torque, Ridge.fit)
    loaded = np.flatnonzero(torque > 0.01)
    read = np.array([reader.predict(blind[i]) for i in loaded])
    assert (torque[loaded] - read[:, 0] <= read[:, 2]).mean() > 0.9
    assert reader.misses_loads
    # One that sees it pays nothing.
    assert not fit_interval_regressor(seeing, torque, Ridge.fit).misses_loads


def test_a_load_that_is_not_seen_is_not_seen_at_any_other_time_either():
    torque, blind, seeing = loads(frames=5)
    beside = np.array([np.roll(torque, shift) for shift in range(-6, 7)])
    reader = fit_interval_regressor(blind, torque, Ridge.fit, bounds=(beside.min(axis=0), beside.max(axis=0)))
    assert reader.timing_widening > 1.2
    loaded = torque > 0.01
    read = np.array([reader.predict(one) for one in blind[loaded]])
    half = np.array([reader.intervals.half_width(one) for one in read[:, 0]])
    assert (np.abs(torque[loaded] - read[:, 0]) <= half).mean() > 0.75, "as wide as that they would hold these loads"
    assert reader.misses_loads
    sighted = fit_interval_regressor(seeing, torque, Ridge.fit, bounds=(beside.min(axis=0), beside.max(axis=0)))
    assert not sighted.misses_loads, "one that sees loads pays no more than the times cost"
