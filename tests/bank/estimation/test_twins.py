"""What is measured twice: half of the noise, drift in a few channels weighs little, a foreign frame is in all."""

import numpy as np
import pytest
from scipy.stats import chi2

from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.bank.estimation.novelty import NoveltyDetector, ReciprocityCheck

ALL = np.ones(896, dtype=np.bool_)


def slices(n: int, seed: int, noise: float = 1e-3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    mean, ways = rng.uniform(0.02, 0.08, 896), 0.002 * rng.normal(size=(3, 896))
    return mean + rng.normal(size=(n, 3)) @ ways + rng.normal(0.0, noise, (n, 896))


def test_the_misfit_of_noise_is_that_of_noise():
    """By the chi-squared distribution: twice the noise is four times the median square, which has a closed form."""
    frames = slices(400, 2)
    twins = ReciprocityCheck.fit(frames[:200], PAPER_TABLE)
    expected = float(chi2.median(1)) * np.median(frames[:200].var(axis=0)) / 2 / np.median(twins.spread**2)
    quiet = np.median([twins.residual(one, ALL) for one in frames[200:]])
    assert quiet == pytest.approx(expected * 1e-6 / np.median(frames[:200].var(axis=0)), rel=0.15)
    loud = slices(400, 2, noise=2e-3)[200:]
    assert np.median([twins.residual(one, ALL) for one in loud]) == pytest.approx(4 * quiet, rel=0.1)


def test_drift_in_a_few_channels_is_familiar_and_a_share_of_a_foreign_frame_is_not():
    frames = slices(60, 3)
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


def test_what_one_of_the_two_does_not_say_is_left_out():
    frames = slices(50, 5)
    twins = ReciprocityCheck.fit(frames[:40], PAPER_TABLE)
    usable = ALL.copy()
    usable[PAPER_TABLE.twins[1][:100]] = False
    wrong = np.where(usable, frames[45], 1e3)
    assert twins.residual(wrong, usable) == pytest.approx(twins.residual(frames[45], usable), rel=1e-12)
    assert twins.residual(wrong, usable) < twins.largest_residual < twins.residual(wrong, ALL)
