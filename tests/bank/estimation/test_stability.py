"""What used to break silently: lost electrodes and rails that the board does not tell of, drift, unfamiliar frames."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.bank.estimation import FrameSeries, fit
from shearloop.bank.estimation.fingertip_validator import mask_saturated
from tests.bank.estimation.conftest import follow, judged

STEP_V = 0.00215


def without_electrodes(series: FrameSeries, electrodes: tuple[int, ...], start: int) -> FrameSeries:
    lost = np.isin(PAPER_TABLE.electrodes, electrodes).any(axis=1)
    channels = series.channels.copy()
    channels[start:, :, lost] = STEP_V
    return replace(series, channels=channels)


@pytest.mark.parametrize("electrodes", [(5,), (5, 19)])
def test_electrodes_that_are_lost_without_a_word_are_done_without(motion_calibration, twisting, electrodes):
    whole = twisting(seed=31)
    spoilt = without_electrodes(whole, electrodes, 90)
    found = follow(motion_calibration, spoilt)
    before = follow(motion_calibration, whole)
    assert sum(one.valid for one in found) > 0.9 * sum(one.valid for one in before)
    assert judged(found, spoilt).rmse < 1.5 * judged(before, whole).rmse


def test_many_lost_electrodes_end_it(motion_calibration, twisting):
    found = follow(motion_calibration, without_electrodes(twisting(seed=32), (1, 4, 8, 12, 20, 25), 90))
    assert not any(one.valid for one in found[90:])


def test_channels_at_a_rail_are_found_and_done_without(motion_calibration, twisting):
    whole = twisting(seed=33)
    rail = np.quantile(whole.channels[5], 0.9)
    clipped = replace(whole, channels=np.minimum(whole.channels, rail))
    found = follow(motion_calibration, clipped)
    assert judged(found, clipped).rmse < 0.02 * 0.06
    # One side is clipped, the other is not.
    frame, usable = np.array([clipped.channels[100, 0], whole.channels[100, 0]]), np.ones((2, 896), dtype=np.bool_)
    left = mask_saturated(frame, usable)
    np.testing.assert_array_equal(left[0], frame[0] < rail)
    assert (~left[0]).mean() == pytest.approx(0.1, abs=0.05)
    assert left[1].all()
    # A channel that is dead already hides nothing by what it reads.
    frame[0, 3], usable[0, 3] = 5.0, False
    np.testing.assert_array_equal(mask_saturated(frame, usable), left & usable)
    assert not mask_saturated(frame, np.zeros_like(usable)).any()


def test_an_ordinary_frame_is_at_no_rail(twisting):
    frame = np.floor(twisting(seed=34).channels[50] / STEP_V) * STEP_V
    assert mask_saturated(frame, np.ones(frame.shape, dtype=np.bool_)).all()


def test_of_as_many_as_are_at_a_rail_one_less_is_chance():
    frame = np.linspace(0.1, 0.2, 896)[None]
    for count in range(1, 20):
        frame[0, :count] = 0.7
        left = mask_saturated(frame, np.ones((1, 896), dtype=np.bool_))
        assert np.count_nonzero(left) == (896 if count < 9 else 896 - count)


def test_a_drift_does_not_lead_a_regression_astray(twisting):
    past = twisting(seed=35)
    calibration = fit("regression", [past], "rig")
    later = twisting(seed=36)
    moved = np.random.default_rng(0).normal(0.0, 0.05, 896) * later.channels[5]
    drift = np.linspace(0, 1, len(later.t_s))[:, None, None] * moved
    found = follow(calibration, replace(later, channels=later.channels + drift))
    assert not any(one.valid for one in found[-60:-40])
