"""Channels that die after the calibration or that a session begins without: told by the others, or refused."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.estimation import Calibration, Estimate, FrameSeries, Physics, Session, TactileFrame, fit
from shearloop.estimation.channel_imputer import ChannelImputer
from shearloop.estimation.estimator import Regression
from tests.estimation import conftest
from tests.estimation.conftest import IDLE_S, PERIOD_S, judged, twisting

# Some seconds into the first grip.
DEATH = 60
ELECTRODE = (PAPER_TABLE.electrodes == 5).any(axis=1)
DEAD = {
    "an electrode": ELECTRODE,
    "an electrode that measures": (PAPER_TABLE.electrodes[:, 2:] == 5).any(axis=1),
    "a fifth": np.random.default_rng(0).uniform(size=PAPER_TABLE.n_channels) < 0.2,
}


@pytest.fixture(scope="module", params=["regression", "bank"])
def calibration(request, recorded, bank) -> Calibration:
    return fit(request.param, [recorded], "rig", Physics(bank=bank))


def without(channels: np.ndarray, start: int, series: FrameSeries, tracker: Session) -> list[Estimate]:
    """Return the estimates of a session of which (896,) channels of the first side are dead from a frame on."""
    usable = np.ones(series.channels.shape, dtype=np.bool_)
    usable[start:, 0, channels] = False
    return conftest.follow(tracker, replace(series, channels=np.where(usable, series.channels, 0.0)), usable)


@cache
def _n_valid_of_whole(calibration: Calibration, bank: Bank) -> int:
    """Return how many torques of a session of which no channel dies are valid."""
    series = twisting(seed=3, cycles=3)
    return judged(without(~ELECTRODE, len(series.t_s), series, Session(calibration, bank)), series).n


@pytest.mark.parametrize("start", [0, DEATH])
@pytest.mark.parametrize("dead", list(DEAD))
def test_estimates_stay_valid_and_cover_the_truth_when_channels_die_after_calibration(calibration, bank, dead, start):
    series = twisting(seed=3, cycles=3)
    whole = _n_valid_of_whole(calibration, bank)
    found = judged(without(DEAD[dead], start, series, Session(calibration, bank)), series)
    assert whole > 120
    assert found.n > 0.95 * whole
    assert found.coverage > 0.88


def test_what_an_estimate_was_made_from_holds_nothing_of_dead_channels(calibration, bank):
    series, tracker, seen = twisting(seed=3, cycles=3), Session(calibration, bank), []
    for t_s, channels in zip(series.t_s, series.channels, strict=True):
        usable = np.ones(channels.shape, dtype=np.bool_)
        usable[0, ELECTRODE] = len(seen) < DEATH
        tracker.estimate(TactileFrame.of(float(t_s), np.where(usable, channels, 0.0), usable))
        seen.append(tracker.difference)
    after = np.array([one[0, ELECTRODE] for one in seen[DEATH:] if one is not None])
    assert len(after) > 50
    assert np.ptp(after, axis=0).min() > 0


@pytest.mark.parametrize("start", [0, DEATH])
def test_a_torque_that_only_dead_channels_respond_to_is_refused(monkeypatch, start):
    tip = conftest.tip

    def felt_by_one_electrode(number: int) -> conftest.Tip:
        one = tip(number)
        return replace(one, touch=np.where(ELECTRODE, 3 * one.touch, 0.0))

    monkeypatch.setattr(conftest, "tip", felt_by_one_electrode)
    calibration = fit("regression", [twisting(tips=(1,))], "rig")
    series = twisting(seed=3, cycles=3, tips=(1,))
    found = without(ELECTRODE, start, series, Session(calibration))
    assert judged(found, series).coverage > 0.95
    assert not any(one.valid for one in found[DEATH:])
    refused = [one for one in found[DEATH:] if "dead or saturated" in one.reasons[0]]
    assert len(refused) > 100
    for one in refused:
        assert one.reasons == (
            "right fingertip: the estimate depends on every channel that worked at calibration, and 112 are dead or "
            "saturated; check the ribbon cable, calibrate again, or use the estimator motion_regression",
        )
    # Other channels told nothing of it, and some of those that did leave a guess: the interval holds it (else 11 %).
    for dead in (DEAD["a fifth"] & ~ELECTRODE, DEAD["an electrode that measures"]):
        found = judged(without(dead, DEATH, series, Session(calibration)), series)
        assert found.n > 120
        assert found.coverage > 0.92


def test_channels_that_were_dead_at_calibration_refuse_nothing_and_change_nothing(recorded):
    def still(series: FrameSeries) -> FrameSeries:
        return replace(series, channels=np.where(ELECTRODE, 0.2, series.channels))

    calibration, series = fit("regression", [still(recorded)], "rig"), still(twisting(seed=3, cycles=3))
    expected = without(~ELECTRODE, len(series.t_s), series, Session(calibration))
    found = without(ELECTRODE, 0, series, Session(calibration))
    assert sum(one.valid for one in expected) > 120
    for one, other in zip(found, expected, strict=True):
        assert one.valid == other.valid
        if one.valid:
            assert one.torque_nm == pytest.approx(other.torque_nm, abs=1e-9)


def test_what_is_filled_in_is_the_conditional_mean_of_a_gaussian():
    rng = np.random.default_rng(1)
    shapes, variances = rng.normal(size=(3, 2, 6)), rng.uniform(0.5, 2.0, (2, 6))
    filling = ChannelImputer(rng.normal(size=(2, 6)), shapes, 1.0 / variances)
    usable, difference = rng.uniform(size=(2, 6)) < 0.7, rng.normal(size=(2, 6))
    found, ways = filling.impute(difference, usable)
    flat, seen = shapes.reshape(3, -1), usable.ravel()
    together = flat.T @ flat + np.diag(variances.ravel())
    gain = together[np.ix_(~seen, seen)] @ np.linalg.inv(together[np.ix_(seen, seen)])
    expected = filling.mean.ravel()[~seen] + gain @ (difference - filling.mean).ravel()[seen]
    left = together[np.ix_(~seen, ~seen)] - gain @ together[np.ix_(seen, ~seen)]
    np.testing.assert_array_equal(found[usable], difference[usable])
    np.testing.assert_allclose(found[~usable], expected, rtol=1e-9)
    off = ways.reshape(3, -1)[:, ~seen]
    np.testing.assert_allclose(off.T @ off + np.diag(variances[~usable]), left, rtol=1e-9)
    assert not ways[:, usable].any()


GRIPPED = round(IDLE_S / PERIOD_S) + 2


def session_without(dead: slice, kind: str, series: FrameSeries) -> list[TactileFrame]:
    """Return a session in some frames of which one side's electrode, or a fifth of all, are dead or lost."""
    usable = np.ones(series.channels.shape, dtype=np.bool_)
    if kind == "a fifth":
        usable[dead, :, DEAD[kind]] = False
    else:
        usable[dead, 0, ELECTRODE] = False
    channels = np.where(usable, series.channels, 0.01 * series.channels)
    if kind == "lost":
        usable[:] = True
    return [TactileFrame.of(float(t), *each) for t, *each in zip(series.t_s, channels, usable, strict=True)]


def torques(estimates: list[Estimate]) -> np.ndarray:
    return np.array([(one.torque_low_nm, one.torque_nm, one.torque_high_nm) for one in estimates], dtype=np.float64)


@pytest.mark.parametrize("kind", ["electrode", "a fifth", "lost"])
def test_channels_that_the_session_began_without_say_nothing_when_they_come_back(motion_calibration, kind):
    """Their idle voltages are not known: what is measured from made-up ones would be wrong, and pass for certain."""
    series, back = twisting(seed=3, cycles=2), GRIPPED + 30
    trackers = [Session(motion_calibration, period_s=PERIOD_S) for _ in range(2)]
    found, expected = (
        [tracker.estimate(frame) for frame in session_without(slice(0, end), kind, series)]
        for tracker, end in zip(trackers, (back, None), strict=True)
    )
    np.testing.assert_allclose(torques(found), torques(expected), rtol=1e-6, atol=1e-9)
    assert judged(found, series).n > 60
    assert judged(found, series).coverage > 0.88


@pytest.mark.parametrize("kind", ["electrode", "a fifth", "lost"])
@pytest.mark.parametrize("with_motion", [True, False])
def test_channels_that_come_back_while_idle_are_used_from_then_on(motion_calibration, with_motion, kind):
    calibration, series = motion_calibration, twisting(seed=3, cycles=2)
    if not with_motion:
        calibration = replace(calibration, estimator=Regression(calibration.estimator.scale))
    memory = Session(calibration, period_s=PERIOD_S)
    moments = [memory.process(frame) for frame in session_without(slice(0, 12), kind, series)]
    whole = Session(calibration, period_s=PERIOD_S)
    expected = [whole.process(frame) for frame in session_without(slice(0, 0), kind, series)]
    gripped = [(one, other) for one, other in zip(moments, expected, strict=True) if not other.reasons]
    assert len(gripped) > 60
    for one, other in gripped:
        assert not one.reasons
        assert one.usable.all()
        # Ten idle frames are averaged, and of fewer the mean is as much noisier.
        np.testing.assert_allclose(one.difference, other.difference, rtol=0, atol=0.003)


@pytest.mark.parametrize("start", [0, DEATH])
def test_a_channel_that_reads_0_is_masked_without_a_flag(calibration, bank, start):
    """Recordings and callers of the library hand over channels alone."""
    series = twisting(seed=3, cycles=2)
    expected = without(ELECTRODE, start, series, Session(calibration, bank))
    silent = np.zeros(series.channels.shape, dtype=np.bool_)
    silent[start:, 0, ELECTRODE] = True
    zeros = replace(series, channels=np.where(silent, 0.0, series.channels))
    found = conftest.follow(Session(calibration, bank), zeros)
    assert sum(one.valid for one in found) > 60
    np.testing.assert_array_equal(torques(found), torques(expected))


def test_a_calibration_uses_no_channel_that_read_0_during_the_grip(recorded):
    gripped = np.flatnonzero(recorded.t_s > IDLE_S)
    channels = recorded.channels.copy()
    channels[gripped[0] :, 0, ELECTRODE] = 0.0
    (first, second) = fit("regression", [replace(recorded, channels=channels)], "rig").validators
    assert (~np.isfinite(first.noise)).tolist() == ELECTRODE.tolist()
    assert np.abs(first.grip_weights[ELECTRODE]).max() == 0
    assert np.isfinite(second.noise).all()
