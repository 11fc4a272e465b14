"""What used to break silently: lost electrodes and rails that the board does not tell of, drift, unfamiliar frames."""

from dataclasses import replace

import numpy as np
import pytest

from bank.channels import CHANNELS
from bank.estimators import FrameSeries, TactileFrame, Tracker, fit
from bank.estimators.familiar import DifferenceGuard
from bank.estimators.guard import at_rail

STEP_V = 0.00215


def estimates(calibration, series: FrameSeries):
    tracker = Tracker(calibration)
    return [
        tracker.estimate(TactileFrame.of(float(t), frame)) for t, frame in zip(series.t_s, series.channels, strict=True)
    ]


def rms_error(found, series: FrameSeries) -> float:
    pairs = zip(found, series.torque_at_frames(), strict=True)
    return float(np.sqrt(np.mean([(one.torque_nm - truth) ** 2 for one, truth in pairs if one.valid])))


def without_electrodes(series: FrameSeries, electrodes: tuple[int, ...], start: int) -> FrameSeries:
    lost = np.isin(CHANNELS, electrodes).any(axis=1)
    channels = series.channels.copy()
    channels[start:, :, lost] = STEP_V
    return replace(series, channels=channels)


@pytest.mark.parametrize("electrodes", [(5,), (5, 19)])
def test_electrodes_that_are_lost_without_a_word_are_done_without(fused_calibration, twisting, electrodes):
    whole = twisting(seed=31)
    spoilt = without_electrodes(whole, electrodes, 90)
    found = estimates(fused_calibration, spoilt)
    before = estimates(fused_calibration, whole)
    assert sum(one.valid for one in found) > 0.9 * sum(one.valid for one in before)
    assert rms_error(found, spoilt) < 1.5 * rms_error(before, whole)


def test_many_lost_electrodes_end_it(fused_calibration, twisting):
    found = estimates(fused_calibration, without_electrodes(twisting(seed=32), (1, 4, 8, 12, 20, 25), 90))
    assert not any(one.valid for one in found[90:])


def test_channels_at_a_rail_are_found_and_done_without(fused_calibration, twisting):
    whole = twisting(seed=33)
    rail = np.quantile(whole.channels[5], 0.9)
    clipped = replace(whole, channels=np.minimum(whole.channels, rail))
    found = estimates(fused_calibration, clipped)
    assert rms_error(found, clipped) < 0.02 * 0.06
    frame, usable = clipped.channels[100, 0].copy(), np.ones(896, dtype=np.bool_)
    clipped_ones = at_rail(frame, usable)
    assert clipped_ones.mean() == pytest.approx(0.1, abs=0.05)
    # A channel that is dead already hides nothing by what it reads.
    frame[3], usable[3] = 5.0, False
    np.testing.assert_array_equal(at_rail(frame, usable), clipped_ones & usable)
    assert not at_rail(frame, np.zeros_like(usable)).any()


def test_an_ordinary_frame_is_at_no_rail(twisting):
    frame = np.floor(twisting(seed=34).channels[50, 0] / STEP_V) * STEP_V
    assert not at_rail(frame, np.ones(896, dtype=np.bool_)).any()


def test_a_drift_does_not_lead_a_regression_astray(twisting):
    past = twisting(seed=35)
    calibration = fit("regression", [past], "a played rig")
    later = twisting(seed=36)
    moved = np.random.default_rng(0).normal(0.0, 0.05, 896) * later.channels[5]
    found = estimates(
        calibration, replace(later, channels=later.channels + np.linspace(0, 1, len(later.t_s))[:, None, None] * moved)
    )
    assert not any(one.valid for one in found[-60:-40])


def test_the_less_a_difference_is_explained_the_wider_the_interval(sliced):
    series = sliced()
    guard = DifferenceGuard.fit(series.channels[:, 0])
    usable = np.ones(896, dtype=np.bool_)
    noise = np.random.default_rng(1).normal(0.0, 1.0, 896)
    frame = series.channels[10, 0]
    widths = [guard.widening(np.abs(frame + scale * guard.spread * noise), usable) for scale in (0.0, 0.8, 1.6)]
    assert 1.0 <= widths[0] < 1.2
    assert widths[0] < widths[1] < widths[2]
