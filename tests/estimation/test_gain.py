import math
from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation.gain import FIRST_SPREAD, GainSpread
from shearloop.estimation.gain_correction import adapt_regressor, correct_gain
from shearloop.estimation.gain_fit import PRIOR_SPREADS, TOOL_SPREAD, fit_gain_spread, fit_tool_law
from shearloop.estimation.interval_fit import fit_interval_regressor
from shearloop.estimation.ridge import CensoredRidge, Ridge
from shearloop.estimation.twists import find_twists, first_twists, loaded_log_gain

TWISTS = np.tile([0.0, 0.0, 0.0, 0.03, 0.05, 0.04, 0.0, 0.0], 10)
# Of one fingertip.
NOISE_NM = 0.001


def twisted(gains, seed):
    """Return (n, 2) features of two fingertips whose torques are these factors too small, and (n,) torques."""
    rng = np.random.default_rng(seed)
    features = TWISTS[:, None] / gains + rng.normal(0.0, NOISE_NM, (len(TWISTS), 2))
    return features, TWISTS


def calibrated():
    numbers = np.zeros(len(TWISTS), dtype=int)
    return fit_interval_regressor(*twisted([1.0, 1.0], 0), Ridge.fit, strengths=(1e-6,), grips=numbers, fingertips=2)


def rmse(regressor, features, torque_nm):
    return float(
        np.sqrt(np.mean([(regressor.predict(x)[0] - y) ** 2 for x, y in zip(features, torque_nm, strict=True)]))
    )


def test_intervals_grow_with_the_load_alone():
    regressor = calibrated()
    free, loaded = regressor.predict(np.zeros(2)), regressor.predict(np.full(2, 0.05))
    factor = math.exp(1.96 * PRIOR_SPREADS[2])
    assert loaded[1] == pytest.approx(0.05 * (1 - 1 / factor), rel=0.1)
    assert loaded[2] == pytest.approx(0.05 * (factor - 1), rel=0.1)
    # Two fingertips share the noise. Of 80 errors the 95 % quantile has a standard error of 11 %.
    noise_nm = 1.96 * NOISE_NM / math.sqrt(2)
    assert max(free[1:]) == pytest.approx(1.05 * noise_nm, rel=0.22)


def spread_of(factors, left_out=(), first=1.0, halves=()):
    """Return the spread learned from one grip of twists whose truth is these factors times the prediction."""
    truth = np.concatenate([factor * TWISTS[:8] for factor in (first, *factors)])
    predicted = np.tile(TWISTS[:8], 1 + len(factors))
    grips = np.zeros(len(truth), dtype=int)
    return fit_gain_spread(predicted, truth, grips, first_twists(truth, grips), left_out, halves, 1)


@pytest.mark.parametrize(("gains", "bounds"), [([1.0] * 6, (0.0, 0.7)), ([0.4, 2.5] * 3, (1.5, 6.0))])
def test_the_spread_is_learned_from_recordings(gains, bounds):
    low, high = (bound * PRIOR_SPREADS[1] for bound in bounds)
    assert low <= spread_of([1.0] * 4, np.log(gains)).between <= high


def test_the_gain_of_a_tool_does_not_count_as_a_difference_between_twists():
    """Three tools whose gains differ by a factor of 4, and whose own twists agree."""
    factors = np.repeat([0.5, 1.0, 2.0], 5 * 8)
    predicted = np.tile(TWISTS[:8], 15)
    truth, grips = factors * predicted, np.repeat([0, 1, 2], 5 * 8)
    spread = fit_gain_spread(predicted, truth, grips, first_twists(truth, grips), [], [], 1)
    assert spread.within <= 0.05


def test_the_first_twist_after_a_grip_is_a_class_of_its_own():
    same, other = spread_of([1.0] * 4), spread_of([1.0] * 4, first=0.7)
    assert (same.first, same.within) == (pytest.approx(0.0, abs=1e-9), other.within)
    assert math.log(0.7) < other.first < 0.3 * math.log(0.7)
    assert same.first_spread < FIRST_SPREAD


def test_the_first_twist_corrects_less_than_a_later_one_and_only_from_its_own_mean():
    spread = GainSpread(between=0.28, within=0.05, noise_nm=0.001)
    parts, truth = TWISTS[:8, None] / 1.4, TWISTS[:8]
    ordinary, first, expected = (
        float(correct_gain(one, parts, truth, find_twists(truth), first=mark, bounded=False).factors[0])
        for one, mark in ((spread, truth < 0), (spread, truth > 0), (replace(spread, first=math.log(1.4)), truth > 0))
    )
    assert ordinary == pytest.approx(1.4, abs=0.05)
    assert 1.1 < first < 1.33
    assert expected == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("gain", [0.8, 1.0, 1.25])
def test_a_first_twist_whose_deviation_may_be_chance_changes_nothing(gain):
    """First twists deviate by 20 %. Following one on a grip with the calibration's gain would add that error."""
    spread = GainSpread(between=0.28, within=0.05, noise_nm=0.001)
    parts, truth = TWISTS[:8, None] / gain, TWISTS[:8]
    found = correct_gain(spread, parts, truth, find_twists(truth), first=truth > 0, bounded=False)
    assert found.factors[0] == pytest.approx(1.0, abs=0.001)
    # It does not show either that the gain is the calibration's.
    assert found.spread.between > 0.2


def test_a_first_twist_that_deviates_further_than_first_twists_do_is_followed():
    spread = GainSpread(between=0.28, within=0.05, noise_nm=0.001)
    parts, truth = TWISTS[:8, None] / 2.0, TWISTS[:8]
    found = correct_gain(spread, parts, truth, find_twists(truth), first=truth > 0, bounded=False)
    assert 1.5 < found.factors[0] < 2.0
    assert found.spread.between < 0.22


def test_later_twists_that_agree_with_the_calibration_narrow_the_interval():
    spread = GainSpread(between=0.28, within=0.05, noise_nm=0.001)
    found = correct_gain(spread, TWISTS[:24, None] / 1.03, TWISTS[:24], find_twists(TWISTS[:24]), bounded=False)
    assert found.factors[0] == pytest.approx(1.0, abs=0.001)
    assert found.spread.between < 0.08


def test_every_grip_has_a_first_twist():
    grips = np.repeat([0, 1], 40)
    assert np.flatnonzero(first_twists(TWISTS, grips)).tolist() == [3, 4, 5, 43, 44, 45]


@pytest.mark.parametrize("unit", [100.0, 1000.0])
def test_torques_in_another_unit_correct_nothing(unit):
    features, torque_nm = twisted([1.0, 1.0], 3)
    with pytest.raises(CalibrationError, match="look at the unit and the lever"):
        adapt_regressor(calibrated(), features, unit * torque_nm, np.array([0, 1]))


@pytest.mark.parametrize("gain", [0.6, 1.0, 1.5])
def test_one_twist_corrects_the_gain_and_narrows_the_interval(gain):
    before = calibrated()
    features, torque_nm = twisted([gain, gain], 1)
    after, correction = adapt_regressor(before, features[:8], torque_nm[:8], np.array([0, 1]))
    assert rmse(after, features, torque_nm) < max(0.3 * rmse(before, features, torque_nm), 0.0015)
    assert correction.twists == 1
    assert after.gain.between < 0.5 * before.gain.between
    assert after.predict(features[4])[1] < before.predict(features[4])[1]


def test_each_fingertip_has_its_own_gain():
    before = calibrated()
    rng = np.random.default_rng(3)
    shares = rng.uniform(0.0, 2.0, 80)
    features = np.column_stack([shares * TWISTS / 1.3, (2 - shares) * TWISTS / 0.8])
    _, correction = adapt_regressor(before, features, TWISTS, np.array([0, 1]))
    np.testing.assert_allclose(correction.factors, [1.3, 0.8], atol=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_intervals_grow_with_the_gain_where_twists_go_both_ways(seed):
    rng = np.random.default_rng(seed)
    torque_nm = np.concatenate([TWISTS[:16], -TWISTS[:16]])
    share = rng.uniform(0.5, 1.5, len(torque_nm))
    features = np.column_stack([share, 2 - share]) * torque_nm[:, None] / 1.5 + rng.normal(0, 0.001, (32, 2))
    before = calibrated()
    after, _ = adapt_regressor(before, features, torque_nm, np.array([0, 1]))
    assert after.intervals.half_widths / before.intervals.half_widths == pytest.approx(1.5, rel=0.05)


def test_twists_that_disagree_correct_little_or_are_refused():
    """A correction is right on average only as far as the twists of one recording agree."""
    spread = GainSpread(between=0.3, within=0.05, noise_nm=0.001)
    parts, twists = TWISTS[:8, None] / 1.5, find_twists(TWISTS[:8])
    factors = [
        float(correct_gain(replace(spread, within=within), parts, TWISTS[:8], twists, bounded=False).factors[0])
        for within in (0.05, 0.2, 0.4)
    ]
    assert factors[0] > 1.4 > factors[1] > factors[2] > 1.0
    with pytest.raises(CalibrationError, match="leave the gain as uncertain as it was"):
        correct_gain(replace(spread, within=1.5), parts, TWISTS[:8], twists, bounded=False)


def test_halves_of_a_grip_that_differ_more_than_grips_do_show_a_drift():
    prior = PRIOR_SPREADS[1]
    assert spread_of([1.0] * 4).drift == 0.0
    assert spread_of([1.0] * 4, halves=[prior, -prior]).drift == pytest.approx(0.0, abs=1e-9)
    assert spread_of([1.0] * 4, halves=[0.7, -0.1]).drift == pytest.approx(math.sqrt(0.25 - prior**2))


def test_several_twists_of_a_gain_that_drifts_are_followed_less_and_the_first_one_as_without():
    steady = GainSpread(between=0.3, within=0.05, noise_nm=0.001, first_spread=0.1)
    drifting, twists = replace(steady, drift=0.4), find_twists(TWISTS[:24])
    parts, first = TWISTS[:24, None] / 1.7, np.arange(24) < 8
    found, alone = (
        [
            correct_gain(one, parts[:end], TWISTS[:end], twists[:n], first=first[:end], bounded=False)
            for one in (steady, drifting)
        ]
        for end, n in ((24, 3), (8, 1))
    )
    assert found[0].factors[0] == pytest.approx(1.7, abs=0.05)
    assert 1.0 <= found[1].factors[0] < 1.3
    assert found[1].spread.between > 2 * found[0].spread.between
    assert alone[0].factors == alone[1].factors
    assert alone[0].spread.between == alone[1].spread.between


@pytest.mark.parametrize(("begins_at", "drifts"), [(1.0, False), (3.0, True)])
def test_a_gain_that_falls_over_a_grip_is_a_drift(begins_at, drifts):
    """Ten twists, of which the gel shows less and less."""
    gains = np.repeat(np.geomspace(begins_at, 1.0, 10), 8)
    noise = np.random.default_rng(0).normal(0, 5e-4, 80)
    regressor = fit_interval_regressor(
        (TWISTS / gains + noise)[:, None], TWISTS, CensoredRidge.fit, strengths=(1e-6,), grips=np.zeros(80, int)
    )
    assert (regressor.gain.drift > 0.2) is drifts
    assert drifts or regressor.gain.drift == 0.0


def test_a_gain_far_from_the_prior_is_not_clipped():
    """Another tool's torque can be wrong by more than a factor of five."""
    spread = GainSpread(between=TOOL_SPREAD, within=0.05, noise_nm=0.001, zero=TOOL_SPREAD)
    found = correct_gain(spread, TWISTS[:24, None] / 12.0, TWISTS[:24], find_twists(TWISTS[:24]), bounded=False)
    assert found.factors[0] == pytest.approx(12.0, rel=0.1)
    assert found.spread.between < 0.15


@pytest.mark.parametrize("factor", [0.0, -1.0])
def test_estimates_that_do_not_follow_the_torque_are_refused(factor):
    with pytest.raises(CalibrationError, match="do not follow the known torque"):
        correct_gain(
            GainSpread(between=0.3, noise_nm=0.001),
            factor * TWISTS[:8, None],
            TWISTS[:8],
            find_twists(TWISTS[:8]),
            bounded=False,
        )


def test_corrections_lower_the_error_in_expectation():
    """Over gains drawn from the prior, and twists that scatter as much, the corrected gain is nearer than 1 is."""
    rng, spread = np.random.default_rng(5), GainSpread(between=0.3, within=0.3, noise_nm=0.003)
    before, after = [], []
    for _ in range(400):
        gain, scatter = np.exp(0.3 * rng.normal()), np.exp(0.3 * rng.normal(size=2))
        parts = TWISTS[:8, None] / (gain * scatter[0]) + rng.normal(0.0, 0.003, (8, 1))
        factor = correct_gain(spread, parts, TWISTS[:8], find_twists(TWISTS[:8]), bounded=False).factors[0]
        later = 1.0 / (gain * scatter[1])
        before.append((later - 1) ** 2)
        after.append((factor * later - 1) ** 2)
    assert np.mean(after) < 0.9 * np.mean(before)


def test_bounds_that_do_not_bind_count_for_nothing():
    """A lever that does not touch reads 0 however far the gel has turned away from it."""
    features = (TWISTS - np.where(TWISTS > 0, 0.0, 0.04))[:, None] + np.random.default_rng(0).normal(0, 5e-4, (80, 1))
    regressor = fit_interval_regressor(
        features, TWISTS, CensoredRidge.fit, strengths=(1e-6,), grips=np.zeros(80, dtype=int)
    )
    _, correction = adapt_regressor(regressor, features[:16] / 1.4, TWISTS[:16], np.array([0]))
    assert correction.factors[0] == pytest.approx(1.4, abs=0.06)


def test_loads_too_small_to_show_a_gain_are_refused():
    features, torque_nm = twisted([1.0, 1.0], 1)
    with pytest.raises(CalibrationError, match=r"no twist reaches 0\.005 N·m"):
        adapt_regressor(calibrated(), features, 0.05 * torque_nm, np.array([0, 1]))


def test_a_missed_load_has_no_gain():
    assert loaded_log_gain(np.zeros(80), TWISTS) is None
    assert loaded_log_gain(-TWISTS, TWISTS) is None
    assert loaded_log_gain(TWISTS / 9.0, TWISTS) == pytest.approx(math.log(9.0))


def test_a_law_over_tools_predicts_those_left_out_and_says_how_far_it_is_off():
    diameters_mm = np.array([10.0, 20.0, 30.0, 40.0])
    exact = fit_tool_law(diameters_mm, 5.0 * diameters_mm**-3.0)
    assert exact.gain(25.0) == pytest.approx(5.0 * 25.0**-3)
    assert exact.factor == pytest.approx(4.0, rel=0.02), "a few tools on a line are chance"
    scattered = fit_tool_law(diameters_mm, 5.0 * diameters_mm**-3.0 * [3.0, 1 / 3.0, 3.0, 1 / 3.0])
    assert scattered.spread > 1.5 * exact.spread
    assert fit_tool_law(diameters_mm[1:], diameters_mm[1:]).gain(10.0) is None


def test_the_shape_of_a_twist_does_not_count_as_gain():
    """Estimates that fall earlier than the torque have the right gain all the same."""
    truth = np.array([0.0, 0.025, 0.056, 0.058, 0.053, 0.028, 0.0])
    early = np.array([0.0, 0.050, 0.058, 0.057, 0.033, 0.005, 0.0])
    spread = GainSpread(between=0.3, within=0.2, noise_nm=0.006)
    assert loaded_log_gain(early, truth) == pytest.approx(0.0, abs=0.06)
    factor = correct_gain(spread, early[:, None], truth, find_twists(truth), bounded=True).factors[0]
    assert factor == pytest.approx(1.0, abs=0.1)
