"""Torques that are stamped at other times than the frames: measured by how single frames move as the load changes."""

import re
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import TRUSTED, fit, load_delay
from shearloop.estimation.grips import segment_grip
from shearloop.estimation.interval_fit import student_inflation
from shearloop.estimation.load_delay import (
    LoadDelay,
    find_clock_fault,
    find_load_delay,
    is_filtered,
    load_delay_warning,
    measure_timing,
    torque_bounds,
)


@pytest.mark.parametrize("late_s", [-2.0, -0.5, 0.0, 0.3, 1.0, 4.0])
def test_lateness_is_measured_far_finer_than_a_frame(recorded, late_s):
    found = find_load_delay(replace(recorded, torque_t_s=recorded.torque_t_s + late_s))
    assert found.delay_s == pytest.approx(late_s, abs=0.03)
    assert 0 < found.error_s < 0.03


def test_torques_that_are_stamped_at_other_times_are_taken_where_somebody_vouches_for_them(recorded):
    late = replace(recorded, torque_t_s=recorded.torque_t_s + 0.8)
    assert fit("regression", [late], "vouched for", timing=TRUSTED).torque is not None


def noise(like: np.ndarray, taps: list[float]) -> np.ndarray:
    white = np.random.default_rng(1).normal(0, 2e-5, len(like) + len(taps) - 1)
    return np.convolve(white, taps, "valid")


@pytest.mark.parametrize(
    ("taps", "filtered"), [([1.0], False), ([0.5, 0.5], True), ([0.2] * 5, None), ([0.0], None), ([1, 1, -1, -1], None)]
)
def test_a_filter_shows_in_the_noise_of_a_load_cell(recorded, taps, filtered):
    assert is_filtered(recorded.torque_nm + noise(recorded.torque_nm, taps)) is filtered
    assert is_filtered(recorded.torque_nm[:200]) is None


@pytest.mark.parametrize(
    ("taps", "late_s", "sound"),
    [
        ([0.5, 0.5], 0.2, True),
        ([0.5, 0.5], 0.0, False),  # a converter with a filter cannot be as early
        ([0.5, 0.5], 0.4, False),
        ([1.0], 0.0, True),
        ([1.0], -0.08, True),  # a gel that goes on moving
        ([1.0], -0.2, False),
        ([1.0], 0.3, False),  # and one without has no reason to be as late
        ([0.0], 0.0, True),
        ([0.0], 0.25, True),
        ([0.0], 0.4, False),
        ([0.0], -0.6, False),
        ([0.0], 4.0, False),
    ],
)
def test_what_is_late_depends_on_the_load_cell(recorded, taps, late_s, sound):
    torque_nm = recorded.torque_nm + noise(recorded.torque_nm, taps)
    late = replace(recorded, torque_t_s=recorded.torque_t_s + late_s, torque_nm=torque_nm)
    refusal = f"s {'before' if late_s >= 0 else 'after'} the load that moves them is stamped, .* own delay"
    with nullcontext() if sound else pytest.raises(CalibrationError, match=refusal):
        measure_timing([late])


def test_lateness_that_is_uncertain_is_not_refused(recorded, monkeypatch):
    late = replace(recorded, torque_t_s=recorded.torque_t_s + 0.4)
    monkeypatch.setattr(load_delay, "_delay_of_side", lambda *_: LoadDelay(0.4, 0.1, 0.5))
    measure_timing([late])
    monkeypatch.setattr(load_delay, "_delay_of_side", lambda *_: LoadDelay(0.4, 0.02, 0.5))
    with pytest.raises(CalibrationError, match=r"0\.40 ± 0\.02 s before the load .* --load-cell-delay-s 0\.32"):
        measure_timing([late])


def test_no_delay_is_advised_where_the_recordings_computer_was_too_busy(recorded, monkeypatch):
    late = replace(recorded, torque_t_s=recorded.torque_t_s - 2.0)
    with pytest.raises(CalibrationError, match=r"calibrate with --load-cell-delay-s -2\.0\d"):
        measure_timing([late])
    # Frames that waited come in bursts.
    t_s = late.t_s.copy()
    t_s[2::20] = t_s[1::20][: len(t_s[2::20])] + 0.01
    # A clock that jumps on the way; as with few changes of load, it is not named.
    monkeypatch.setattr(load_delay, "find_clock_fault", lambda *_: None)
    times_s = recorded.torque_t_s
    jumped = replace(recorded, torque_t_s=np.where(times_s < np.quantile(times_s, 0.55), times_s - 2.0, times_s - 1.0))
    for busy, why in ((replace(late, t_s=t_s), "came in bursts"), (jumped, "its halves show other delays")):
        with pytest.raises(CalibrationError, match=f"{why}.*too busy.*record again") as refused:
            measure_timing([busy])
        assert "--load-cell-delay-s" not in str(refused.value)
        assert "--load-cell-delay-s" not in load_delay_warning(busy)


def set_forward(series, jump_s):
    times_s = series.torque_t_s
    return replace(series, torque_t_s=np.where(times_s < np.quantile(times_s, 0.55), times_s, times_s + jump_s))


def frames_set_forward(series, jump_s):
    t_s = series.t_s
    return replace(series, t_s=np.where(t_s < np.quantile(t_s, 0.45), t_s, t_s + jump_s))


def at_rate(series, rate):
    return replace(series, torque_t_s=series.torque_t_s * (1.0 + rate))


@pytest.mark.parametrize(
    ("changed", "by", "cause"),
    [
        (set_forward, 0.7, r"the load cell's clock was set forward by 0\.7 s, \d+ s after the first frame"),
        (set_forward, 3.0, r"the load cell's clock was set forward by 3\.0 s, \d+ s after the first frame"),
        (frames_set_forward, 3.0, r"the frames' clock was set forward by 3\.0 s, \d+ s after the first frame"),
        (at_rate, 0.01, r"the load cell's times run 1\.0% too fast for the frames'"),
        (at_rate, -0.02, r"the load cell's times run 2\.0% too slow for the frames'"),
    ],
)
def test_a_clock_that_jumped_or_ran_at_another_rate_is_named_and_refused(recorded, changed, by, cause):
    wrong = changed(recorded, by)
    with pytest.raises(CalibrationError, match=f"^{cause}: a calibration would learn.*record again") as refused:
        measure_timing([wrong])
    assert "--load-cell-delay-s" not in str(refused.value)
    assert re.match(f"{cause}; ", load_delay_warning(wrong))
    # The other fingertip shows it too.
    with pytest.raises(CalibrationError, match=cause):
        measure_timing([replace(unmoved(wrong), sides=wrong.sides)], [wrong])


def test_readings_that_are_missing_are_no_clock_that_was_set_forward(recorded):
    times_s = recorded.torque_t_s
    kept = (times_s < np.quantile(times_s, 0.5)) | (times_s > np.quantile(times_s, 0.53))
    lost = replace(recorded, torque_t_s=times_s[kept], torque_nm=recorded.torque_nm[kept])
    assert measure_timing([lost]).uncertainty_s == 0.0
    assert find_clock_fault(lost, None) is None
    assert find_clock_fault(unmoved(lost), None) is None


def test_no_delay_is_advised_on_a_quiet_part_of_a_recording_whose_computer_was_too_busy(recorded):
    late = replace(recorded, torque_t_s=recorded.torque_t_s - 2.0)
    n = len(late.t_s)
    begin = n // 3
    quiet = late.between(begin, n).between(0, n - begin)
    with pytest.raises(CalibrationError, match="calibrate with --load-cell-delay-s"):
        measure_timing([quiet])
    t_s = late.t_s.copy()
    t_s[2:begin:8] = t_s[1:begin:8][: len(t_s[2:begin:8])] + 0.01
    part = replace(late, t_s=t_s).between(begin, n).between(0, n - begin)
    np.testing.assert_array_equal(part.t_s, quiet.t_s)
    with pytest.raises(CalibrationError, match=r"came in bursts.*too busy.*record again") as refused:
        measure_timing([part])
    assert "--load-cell-delay-s" not in str(refused.value)


def test_a_knocked_frame_does_not_hide_the_rest(recorded):
    knocked = recorded.channels.copy()
    knocked[[90, 140]] *= 1.5
    found = find_load_delay(replace(recorded, channels=knocked))
    assert abs(found.delay_s) < 0.2


def test_what_would_be_refused_is_doubted_and_so_is_a_clear_peak_of_few_frames(recorded, monkeypatch):
    assert load_delay_warning(recorded) == ""
    assert load_delay_warning(replace(recorded, torque_nm=0.0 * recorded.torque_nm)) == ""
    late = replace(recorded, torque_t_s=recorded.torque_t_s + 0.8)
    assert "s before the load that moves them is stamped" in load_delay_warning(late)
    assert "too few" not in load_delay_warning(late)
    gripped = len(recorded.t_s[segment_grip(recorded)[1]])
    monkeypatch.setattr(load_delay, "_SURE_FRAMES", gripped + 1)
    assert find_load_delay(late).few_frames == gripped
    measure_timing([late])
    assert f"though {gripped} gripped frames are too few to be sure" in load_delay_warning(late)
    monkeypatch.setattr(load_delay, "_WARN_EXPLAINED", 1.0)
    assert load_delay_warning(late) == "", "a peak that is less high may be chance"


def unmoved(recorded):
    """Return a recording whose frames say nothing of when the load changes."""
    noise = np.random.default_rng(0).normal(0, 1e-3, recorded.channels.shape)
    return replace(recorded, channels=recorded.channels[50] + noise)


def test_times_are_uncertain_where_no_recording_shows_the_delay_well(recorded, monkeypatch):
    assert find_load_delay(unmoved(recorded)) is None
    assert measure_timing([recorded]).uncertainty_s == 0.0
    assert measure_timing([unmoved(recorded)]).uncertainty_s == 0.75
    assert measure_timing([unmoved(recorded), recorded]).uncertainty_s == 0.0, "one clock has stamped them all"
    for error_s, unsure_s in ((0.05, 0.0), (0.2, 0.392), (2.0, 0.75)):
        monkeypatch.setattr(load_delay, "_delay_of_side", lambda *_, e=error_s: LoadDelay(0.0, e, 0.5))
        assert measure_timing([recorded]).uncertainty_s == pytest.approx(unsure_s, abs=1e-3)


def test_values_that_waited_in_a_buffer_may_be_seconds_off(recorded):
    waited = replace(unmoved(recorded), load_doubt="the load's values waited in a buffer")
    assert measure_timing([waited]).uncertainty_s == 3.0
    assert measure_timing([waited, recorded]).uncertainty_s == 3.0, "the other recording's delay is not this one's"


def test_a_board_beside_that_was_dead_garbled_or_away_spoils_no_times(recorded):
    dead = replace(recorded, channels=np.zeros_like(recorded.channels))
    garbled = replace(recorded, channels=np.where(np.arange(896) == 3, np.nan, recorded.channels))
    away = recorded.between(0, 12)
    for beside in (dead, garbled, away):
        timing = measure_timing([recorded], [beside])
        assert timing.references == [recorded]
        assert timing.uncertainty_s == 0.0
        still = unmoved(recorded)
        assert measure_timing([still], [beside]).references == [still], "it says nothing, and is not to be blamed"
        assert measure_timing([still], [beside, recorded]).references == [recorded]


def test_a_torque_within_some_time_is_any_from_the_least_to_the_largest(recorded):
    rising = replace(recorded, torque_t_s=np.array([0.0, 100.0]), torque_nm=np.array([0.0, 1.0]))
    least, largest = torque_bounds(rising, 0.5)
    inner = (recorded.t_s > 1) & (recorded.t_s < 99)
    np.testing.assert_allclose(least[inner], recorded.t_s[inner] / 100 - 0.005, atol=1e-9)
    np.testing.assert_allclose(largest[inner], recorded.t_s[inner] / 100 + 0.005, atol=1e-9)


@pytest.mark.long
def test_intervals_hold_what_times_that_could_not_be_checked_do_to_the_torque(recorded, monkeypatch):
    checked = fit("motion_regression", [recorded], "checked").torque.regressor
    monkeypatch.setattr(load_delay, "_delay_of_side", lambda *_: None)
    unchecked = fit("motion_regression", [recorded], "unchecked").torque.regressor
    vouched = fit("motion_regression", [recorded], "vouched for", timing=TRUSTED).torque.regressor
    assert checked.timing_widening == vouched.timing_widening == 1.0
    assert unchecked.timing_widening > 1.1 * student_inflation(5), (
        "blocks of few loads tell little, and other times' loads are wider"
    )
    assert unchecked.intervals.half_widths[-1] == pytest.approx(
        unchecked.timing_widening * checked.intervals.half_widths[-1]
    )
    np.testing.assert_array_equal(vouched.intervals.half_widths, checked.intervals.half_widths)
    np.testing.assert_array_equal(unchecked.point.weights, checked.point.weights)
