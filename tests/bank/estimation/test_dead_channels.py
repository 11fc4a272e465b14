"""Channels that a session begins without, and that come back: what they never read is not passed off as read."""

import numpy as np
import pytest

from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.bank.estimation import Estimate, EstimatorSession, FrameSeries, TactileFrame
from shearloop.bank.estimation.session_state import Motion, SessionState
from tests.bank.estimation.conftest import IDLE_S, PERIOD_S, judged

GRIPPED = round(IDLE_S / PERIOD_S) + 2


def without(dead: slice, kind: str, series: FrameSeries) -> list[TactileFrame]:
    """Return a session in some frames of which one side's electrode, or a fifth of all, are dead or lost."""
    usable = np.ones(series.channels.shape, dtype=np.bool_)
    electrode, some = (
        (PAPER_TABLE.electrodes == 5).any(axis=1),
        np.random.default_rng(0).uniform(size=PAPER_TABLE.n_channels) < 0.2,
    )
    if kind == "a fifth":
        usable[dead, :, some] = False
    else:
        usable[dead, 0, electrode] = False
    channels = np.where(usable, series.channels, 0.01 * series.channels)
    if kind == "lost":
        usable[:] = True
    return [TactileFrame.of(float(t), *each) for t, *each in zip(series.t_s, channels, usable, strict=True)]


def torques(estimates: list[Estimate]) -> np.ndarray:
    rows = [(one.torque_low_nm, one.torque_nm, one.torque_high_nm) for one in estimates]
    return np.array(rows, dtype=np.float64)


@pytest.mark.parametrize("kind", ["electrode", "a fifth", "lost"])
def test_channels_that_the_session_began_without_say_nothing_when_they_come_back(motion_calibration, twisting, kind):
    """Their idle voltages are not known: what is measured from made-up ones would be wrong, and pass for certain."""
    series, back = twisting(seed=3, cycles=2), GRIPPED + 30
    trackers = [EstimatorSession(motion_calibration, period_s=PERIOD_S) for _ in range(2)]
    found, expected = (
        [tracker.estimate(frame) for frame in without(slice(0, end), kind, series)]
        for tracker, end in zip(trackers, (back, None), strict=True)
    )
    np.testing.assert_allclose(torques(found), torques(expected), rtol=1e-6, atol=1e-9)
    assert judged(found, series).n > 60
    assert judged(found, series).coverage > 0.88


@pytest.mark.parametrize("kind", ["electrode", "a fifth", "lost"])
@pytest.mark.parametrize("with_motion", [True, False])
def test_channels_that_come_back_while_idle_are_used_from_then_on(motion_calibration, twisting, with_motion, kind):
    calibration, series = motion_calibration, twisting(seed=3, cycles=2)
    motion = calibration.estimator.motion if with_motion else Motion()
    memory = SessionState(calibration.validators, motion, period_s=PERIOD_S)
    moments = [memory.process(frame) for frame in without(slice(0, 12), kind, series)]
    whole = SessionState(calibration.validators, motion, period_s=PERIOD_S)
    expected = [whole.process(frame) for frame in without(slice(0, 0), kind, series)]
    gripped = [(one, other) for one, other in zip(moments, expected, strict=True) if not other.reasons]
    assert len(gripped) > 60
    for one, other in gripped:
        assert not one.reasons
        assert one.usable.all()
        # Ten idle frames are averaged, and of fewer the mean is as much noisier.
        np.testing.assert_allclose(one.difference, other.difference, rtol=0, atol=0.003)
