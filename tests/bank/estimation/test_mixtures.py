"""What of something foreign a slice may hold unseen: intervals include it, and cost nothing where it is seen."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.bank.estimation import FrameSeries, fit
from shearloop.bank.estimation.fitting import ContaminationTest, Mixtures
from shearloop.bank.estimation.interval_regressor import Ridge, fit_interval_regressor
from shearloop.bank.estimation.motion_regression import MotionRegression
from shearloop.bank.estimation.novelty import NoveltyDetector
from tests.bank.estimation.conftest import follow, judged, mixed, slices_of


def shrinking(seed: int) -> FrameSeries:
    """Return slices whose response shrinks as the torque rises, and that differ from each other by a fifth of it.

    So much drift hides a tenth of a foreign frame; and that shrinks what is left of the own one.
    """
    rng, shape = np.random.default_rng(seed), np.random.default_rng(78)
    base = np.abs(shape.normal(0, 6e-3, 896))
    slope = 0.1 * base * shape.normal(1, 0.5, 896)
    torque = np.tile(np.linspace(0.01, 0.14, 10), 5) + rng.normal(0, 0.002, 50)
    drift = rng.normal(0, 0.2, (50, 896)) * base
    frames = base - ((torque - 0.075) / 0.04)[:, None] * slope + drift + rng.normal(0, 3e-4, (50, 896))
    return slices_of(frames, torque)


def test_what_a_guard_cannot_see_lies_within_the_interval():
    found, pure = [], []
    for seed in range(3):
        whole = shrinking(seed)
        calibration = fit("regression", [whole.between(0, 30)], "earlier")
        later = whole.between(30, 50)
        found.append(judged(follow(calibration, mixed(later, 0.1)), later))
        pure.append(judged(follow(calibration, later), later))
    assert np.mean([one.n for one in found]) > 18, "or nothing would be tested"
    for each in (found, pure):
        assert np.mean([one.coverage for one in each]) >= 0.9


def test_where_it_is_seen_intervals_are_as_wide_as_without(sliced, sliced_calibration):
    calibration = sliced_calibration
    reader = calibration.torque.regressor
    without = replace(
        calibration, torque=replace(calibration.torque, regressor=replace(reader, contamination_below=0.0))
    )
    later = sliced(seed=3)
    assert judged(follow(calibration, mixed(later, 0.2)), later).n < 5
    widths = [judged(follow(one, later), later).width for one in (calibration, without)]
    assert widths[0] < 1.15 * widths[1]


@pytest.mark.parametrize("name", ["motion_regression", "regression"])
def test_a_fifth_of_something_that_hardly_responds_lies_within_the_interval(name, sliced, sliced_calibration):
    """It only makes the own response smaller, which is what another torque does: no misfit tells of it."""
    calibration = sliced_calibration if name == "motion_regression" else fit(name, [sliced()], "all")
    later = sliced(seed=3)
    guard = calibration.torque.novelty
    blind = replace(calibration, torque=replace(calibration.torque, novelty=replace(guard, typical_response=0.0)))
    foreign = 0.2 * later.channels.mean(axis=0)[:, np.random.default_rng(7).permutation(896)]
    spoilt = replace(later, channels=0.8 * later.channels + 0.2 * foreign)
    found = judged(follow(calibration, spoilt), later)
    assert found.n > 45, "or nothing would be tested"
    assert found.coverage >= 0.95
    assert judged(follow(blind, spoilt), later).coverage < 0.8, "or there was nothing to hold"
    widths = [judged(follow(one, later), later).width for one in (calibration, blind)]
    assert widths[0] < 1.2 * widths[1]


def test_a_streams_intervals_know_nothing_of_mixtures(motion_calibration):
    reader = motion_calibration.torque.regressor
    assert (reader.contamination_below, reader.contamination_above) == (0.0, 0.0)


def test_mixtures_are_those_that_the_guard_of_the_earlier_slices_lets_pass():
    differences = shrinking(0).channels[:, 0]
    past, future = np.arange(30), np.arange(30, 50)
    guard = NoveltyDetector.fit(differences[past], PAPER_TABLE)
    usable = np.ones(896, dtype=bool)
    mixtures = ContaminationTest(differences, np.arange(50.0), MotionRegression(np.ones((1, 896))), None)
    passing = mixtures.accepted(past, future)
    assert 0 < len(passing.rows) < 20 * 15 * 3
    for row, features, nearness in zip(passing.rows, passing.features, passing.limit_shares, strict=True):
        assert features[-1] == row
        assert not guard.assess(features[:-1], usable).reasons
        assert nearness == guard.assess(features[:-1], usable).limit_share <= 1.0


@pytest.mark.parametrize("sign", [1, -1])
def test_the_interval_reaches_to_the_side_on_which_the_truth_is_hidden(sign):
    """Mixtures that read 0.3 too much at a nearness of ½ hide the truth 0.6 below at the limit."""
    rng = np.random.default_rng(4)
    values = rng.uniform(0.0, 1.0, 100)
    features = values[:, None] + rng.normal(0, 1e-3, (100, 1))

    class Moved:
        def accepted(self, _, later):
            return Mixtures(later, features[later] + sign * 0.3, np.full(len(later), 0.5))

    reader = fit_interval_regressor(features, values, Ridge.fit, strengths=(1e-9,), mixtures=Moved().accepted)
    _, *plain = reader.predict(np.array([0.8]))
    _, *at_limit = reader.predict(np.array([0.8]), limit_share=1.0)
    hidden, other = (0, 1) if sign > 0 else (1, 0)
    assert at_limit[hidden] == pytest.approx(0.6, abs=0.01)
    assert at_limit[other] == plain[other] < 0.01
