"""What a calibration of slices can speak of, and what it says of a frame at the rim of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from shearloop.bank.channels import PAPER_TABLE
from shearloop.estimation.bank_match import BankMatch
from shearloop.estimation.estimator import match_reasons
from shearloop.estimation.ridge import Ridge
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.novelty import NoveltyDetector, ReciprocityCheck
from shearloop.studies.slices.regressor import SliceRegressor, fit_slice_regressor
from shearloop.studies.slices.series import SliceSeries
from tests.estimation.conftest import judged
from tests.studies.slices.conftest import mixed, read, sliced

ALL = np.ones(896, dtype=np.bool_)


def beyond(series: SliceSeries, below_nm: float) -> np.ndarray:
    """Return what the slices' frames become at a torque so far below the least of them, along their own slope."""
    frames, torque = series.channels, series.torque_at_frames()
    slope = np.polyfit(torque, frames.reshape(len(torque), -1), 1)[0].reshape(frames.shape[1:])
    return frames[np.argmin(torque)] - below_nm * slope


def test_a_frame_far_out_along_the_calibrations_own_directions_is_refused():
    series = sliced()
    guard = NoveltyDetector.fit(series.channels[:, 0], PAPER_TABLE)
    near, far = (beyond(series, nm)[0] for nm in (0.01, 0.15))
    assert guard.reasons(near, ALL) == ()
    # Its misfit is as small as any: only how far it lies out tells of it.
    assert guard.q_residual(far, ALL)[0] < guard.largest_q
    assert "standard deviations from the calibrated ones" in guard.reasons(far, ALL)[0]


@pytest.mark.parametrize("share", [0.35, 0.5, 1.0])
def test_a_foreign_frame_mixed_in_is_refused(sliced_calibration, share):
    calibration, later = sliced_calibration, sliced(seed=3)
    assert not any(one.valid for one in read(calibration, mixed(later, share)))
    assert all(one.valid for one in read(calibration, later))


def test_channels_that_vary_much_do_not_drown_the_others():
    rng = np.random.default_rng(0)
    scale = np.where(np.arange(896) < 90, 1e-2, 1e-4)
    frames = 5e-2 + scale * rng.normal(size=(30, 896))
    guard = NoveltyDetector.fit(frames, PAPER_TABLE)
    # Ten times its own spread on every quiet channel is nothing beside one spread of the loud ones, in volts.
    odd = frames[3] + np.where(np.arange(896) < 90, 0.0, 1e-3) * np.where(np.arange(896) % 2, 1, -1)
    assert guard.reasons(odd, ALL)
    assert not guard.reasons(frames[3], ALL)


def saturating(value):
    """Return features of values that cannot tell how far below a third a value is."""
    return np.column_stack([np.maximum(value, 0.3), np.maximum(value, 0.3) ** 2])


def reader_of(features, values, **options) -> SliceRegressor:
    return fit_slice_regressor(features, values, Ridge.fit, strengths=(1e-9,), fit_line=Ridge.fit, **options)


def test_a_saturated_reading_has_an_interval_far_beyond_the_range():
    rng = np.random.default_rng(1)
    values = rng.uniform(0.0, 1.0, 200)
    reader = reader_of(saturating(values) + rng.normal(0, 1e-3, (200, 2)), values - 0.5)
    low_value, below, above = reader.predict(saturating(np.array([-0.3]))[0])
    assert low_value == pytest.approx(-0.35, abs=0.1)
    assert low_value - below < -0.8
    assert above < 0.3
    _, below, above = reader.predict(saturating(np.array([0.6]))[0])
    assert max(below, above) < 0.3


def test_a_response_that_folds_back_beyond_the_range_widens_the_interval_upwards():
    """Left out, a tenth of the range beyond is read a tenth inside: so half a range beyond, half of it inside."""
    values = np.random.default_rng(5).uniform(0.0, 1.0, 200)

    def folded(value):
        return np.minimum(value, 1.6 - value)[:, None]

    features = folded(values) + np.random.default_rng(6).normal(0, 1e-3, (200, 1))
    reader = reader_of(features, values)
    assert reader.range.low_end == -np.inf, "below nothing is folded"
    assert reader.range.high_end == pytest.approx(0.5, abs=0.05)
    _, below, above = reader.predict(np.array([0.3]))
    assert max(below, above) < 0.5
    value, _, above = reader.predict(np.array([0.6]))
    assert value + above == pytest.approx(values.max() + 2 * np.ptp(values)), "as far beyond as is known to pass"
    vouched = reader_of(features, values, full_range=True)
    assert vouched.predict(np.array([0.6]))[2] < 0.5
    assert vouched.predict(np.array([0.6]))[0] == value


@pytest.mark.parametrize("sign", [1, -1])
def test_what_is_read_at_the_end_towards_zero_may_be_no_load_at_all(sign):
    rng = np.random.default_rng(1)
    values = rng.uniform(0.0, 1.0, 200)
    reader = reader_of(saturating(values) + rng.normal(0, 1e-3, (200, 2)), sign * (values + 3.0))
    value, *reach = reader.predict(saturating(np.array([-3.0]))[0])
    assert value - sign * reach[0 if sign > 0 else 1] == pytest.approx(0.0)


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_the_range_ends_below_the_largest_values_where_they_are_equal(steps):
    """As torques that were commanded, not measured: more than a fifth are the largest, and some of these were kept.

    Of one step nothing is left to tell the others by, and as far as the largest are read now nothing is known.
    """
    values = np.round(np.random.default_rng(5).uniform(0.0, 1.0, 200) ** 0.5 * steps) / steps
    features = np.minimum(values, 1.4 - values)[:, None] + np.random.default_rng(6).normal(0, 0.1, (200, 1))
    reader = reader_of(features, values)
    assert (values == 1.0).mean() > 0.2
    assert reader.range.high_end < 0.95


def test_values_that_are_nearly_equal_say_nothing_of_how_it_goes_on_beyond_them():
    """Where the cut parts a level, what is left out lies a hair's breadth beyond, and is read with an error."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        values = np.resize([0.0, 0.3, 0.7, 1.0], 200) + 1e-6 * rng.normal(size=200)
        reader = reader_of(values[:, None] + rng.normal(0, 0.03, (200, 1)), values)
        assert reader.range.low_end < 0.2
        assert reader.range.high_end > 0.8


def test_where_values_beyond_are_read_as_such_intervals_reach_twice_as_far_beyond():
    rng = np.random.default_rng(2)
    values = rng.uniform(0.0, 1.0, 200)
    reader = reader_of(values[:, None] + rng.normal(0, 1e-3, (200, 1)), values)
    assert (reader.range.low_end, reader.range.high_end) == (-np.inf, np.inf)
    assert reader.predict(np.array([0.02]))[1] < 0.01
    value, below, above = reader.predict(np.array([1.2]))
    assert value + above == pytest.approx(1.4, abs=0.02)
    assert below < 0.01


def test_the_response_share_does_not_depend_on_the_torque():
    frames = sliced().channels[:, 0]
    guard = NoveltyDetector.fit(frames, PAPER_TABLE)
    own = guard.response_share(frames[35], ALL)
    assert own == pytest.approx(1.0, abs=0.1)
    assert guard.response_share(0.8 * frames[35], ALL) == pytest.approx(0.8 * own)
    along = guard.spread * guard.directions[0] * np.sqrt(guard.variances[0])
    assert guard.response_share(frames[35] + 2 * along, ALL) == pytest.approx(own), "so another torque moves it"
    some = ALL & (np.arange(896) % 4 > 0)
    assert guard.response_share(np.where(some, 0.8 * frames[35], 9.0), some) == pytest.approx(0.8 * own, abs=0.03)


def test_a_judgement_says_how_much_of_the_own_response_may_be_missing():
    frames = sliced().channels[:, 0]
    guard = NoveltyDetector.fit(frames, PAPER_TABLE)
    less = 0.8 * frames[35]
    missing = 1 - guard.response_share(less, ALL) / guard.typical_response
    assert guard.missing_share(less, ALL) == pytest.approx(missing)
    assert missing > 0.15 > guard.missing_share(frames[35], ALL)
    # More than ever is nothing missing, and no frame is made larger than twice.
    for typical, share in ((1e-3, 0.0), (9.0, 0.5)):
        assert replace(guard, typical_response=typical).missing_share(frames[35], ALL) == share
    # But for one in twenty of those left out none is larger; so of good ones hardly any is.
    assert np.mean([guard.response_share(one, ALL) <= guard.typical_response for one in frames]) >= 0.9


@pytest.mark.parametrize("sign", [1, -1])
def test_what_may_be_missing_widens_to_the_side_where_it_would_be_read(sign):
    rng = np.random.default_rng(5)
    values = rng.uniform(0.0, 1.0, 100)
    reader = reader_of(sign * values[:, None] + rng.normal(0, 1e-3, (100, 1)), values)
    features = np.array([sign * 0.5])
    _, *plain = reader.predict(features)
    assert reader.predict(features, complete=features)[1:] == pytest.approx(plain)
    low, high = reader.predict(features, complete=features - sign * 0.2)[1:]
    assert (low, high) == (pytest.approx(plain[0] + 0.2, abs=0.01), pytest.approx(plain[1]))
    low, high = reader.predict(features, complete=features + sign * 0.2)[1:]
    assert (low, high) == (pytest.approx(plain[0]), pytest.approx(plain[1] + 0.2, abs=0.01))


def test_a_match_on_another_ridge_of_the_bank_is_refused():
    k_range, place = np.array([3.12, 3.17]), BankMatch(3.19, 1.5, 0.0, 0.99, None, ambiguous=False)
    assert match_reasons(k_range, place) == ()
    assert "another ridge" in match_reasons(k_range, replace(place, k=3.41))[0]


@pytest.mark.parametrize("name", ["motion_regression", "regression"])
def test_a_fifth_of_something_that_hardly_responds_lies_within_the_interval(name, sliced_calibration):
    """It only makes the own response smaller, which is what another torque does: no misfit tells of it."""
    calibration = sliced_calibration if name == "motion_regression" else fit_slices(name, [sliced()], "all")
    later = sliced(seed=3)
    guard = calibration.torque.novelty
    blind = replace(calibration, torque=replace(calibration.torque, novelty=replace(guard, typical_response=0.0)))
    foreign = 0.2 * later.channels.mean(axis=0)[:, np.random.default_rng(7).permutation(896)]
    spoilt = replace(later, channels=0.8 * later.channels + 0.2 * foreign)
    found = judged(read(calibration, spoilt), later)
    assert found.n > 45, "or nothing would be tested"
    assert found.coverage >= 0.95
    assert judged(read(blind, spoilt), later).coverage < 0.8, "or there was nothing to hold"
    widths = [judged(read(one, later), later).width for one in (calibration, blind)]
    assert widths[0] < 1.2 * widths[1]


def noisy_slices(n: int, seed: int, noise: float = 1e-3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    mean, ways = rng.uniform(0.02, 0.08, 896), 0.002 * rng.normal(size=(3, 896))
    return mean + rng.normal(size=(n, 3)) @ ways + rng.normal(0.0, noise, (n, 896))


def test_the_misfit_of_noise_is_that_of_noise():
    """By the chi-squared distribution: twice the noise is four times the median square, which has a closed form."""
    frames = noisy_slices(400, 2)
    twins = ReciprocityCheck.fit(frames[:200], PAPER_TABLE)
    expected = float(chi2.median(1)) * np.median(frames[:200].var(axis=0)) / 2 / np.median(twins.spread**2)
    quiet = np.median([twins.residual(one, ALL) for one in frames[200:]])
    assert quiet == pytest.approx(expected * 1e-6 / np.median(frames[:200].var(axis=0)), rel=0.15)
    loud = noisy_slices(400, 2, noise=2e-3)[200:]
    assert np.median([twins.residual(one, ALL) for one in loud]) == pytest.approx(4 * quiet, rel=0.1)


def test_drift_in_a_few_channels_is_familiar_and_a_share_of_a_foreign_frame_is_not():
    frames = noisy_slices(60, 3)
    guard, later = NoveltyDetector.fit(frames[:40], PAPER_TABLE), frames[50]
    drifted = later + np.where(np.arange(896) % 28 < 2, 4e-3, 0.0)
    foreign = 0.85 * later + 0.15 * later[np.random.default_rng(4).permutation(896)]
    by_mean, by_twins = (
        [one(frame, ALL) for frame in (drifted, foreign)]
        for one in (lambda *a: guard.q_residual(*a)[0], guard.reciprocity.residual)
    )
    # The drift hides the foreign frame from the mean of the squares; the median tells them apart.
    assert by_twins[1] / by_twins[0] > 1.5 * by_mean[1] / by_mean[0]
    assert by_twins[0] < guard.reciprocity.largest_residual < by_twins[1]
    assert any("opposite injections" in why or "Q residual" in why for why in guard.reasons(foreign, ALL))


def test_the_reciprocity_check_leaves_out_pairs_with_an_unusable_channel():
    frames = noisy_slices(50, 5)
    twins = ReciprocityCheck.fit(frames[:40], PAPER_TABLE)
    usable = ALL.copy()
    usable[PAPER_TABLE.twins[1][:100]] = False
    wrong = np.where(usable, frames[45], 1e3)
    assert twins.residual(wrong, usable) == pytest.approx(twins.residual(frames[45], usable), rel=1e-12)
    assert twins.residual(wrong, usable) < twins.largest_residual < twins.residual(wrong, ALL)
