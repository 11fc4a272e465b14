"""Diameters from grips of a few cylinders, each with the noise of its own idle frame."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from shearloop.bank.channels import PAPER_TABLE
from shearloop.estimation import TRUSTED, Session, fit
from shearloop.estimation.cylinder_fit import fit_cylinders, fit_line
from shearloop.estimation.estimator import CalibrationRows
from shearloop.estimation.ridge import Ridge
from tests.estimation.conftest import follow, twisting

KNOWN_MM = (10.0, 25.0, 40.0)
N_FRAMES = 150
_SHAPES = gaussian_filter1d(np.random.default_rng(3).normal(size=(2, 2 * PAPER_TABLE.n_channels)), 4.0, axis=1)
# A millimetre moves all channels together by less than a frame's noise moves one of them.
PER_MM, TWIST = (size * one / np.linalg.norm(one) for size, one in zip((0.6, 40.0), _SHAPES, strict=True))


def grip(diameter_mm, seed):
    """Return a grip of both fingertips, twisted to and fro, in units of a channel's noise."""
    rng = np.random.default_rng(seed)
    idle = rng.normal(0.0, 10**-0.5, 2 * PAPER_TABLE.n_channels)
    twist = (rng.uniform(0.0, 1.0) + rng.uniform(0.0, 1.0, (N_FRAMES, 1))) * TWIST
    frames = diameter_mm * PER_MM + twist - idle + rng.normal(size=(N_FRAMES, 2 * PAPER_TABLE.n_channels))
    held = np.cumsum(frames, axis=0) / np.arange(1, N_FRAMES + 1)[:, None]
    none = np.zeros(N_FRAMES)
    return CalibrationRows(none, none, none, none, frames, held, none, np.full(N_FRAMES, diameter_mm), none.astype(int))


@pytest.fixture(scope="module")
def known():
    return [grip(mm, seed) for seed, mm in enumerate(KNOWN_MM)]


def test_another_grip_is_read_without_a_pull_to_the_mean(known):
    """The noise of three idle frames parts three recordings as well as their tools do."""
    head = fit_line(known, PAPER_TABLE)
    read = {
        mm: np.mean([head.predict(grip(mm, 100 + seed).mean_position[-1:]) for seed in range(5)]) for mm in (12.0, 38.0)
    }
    slope = (read[38.0] - read[12.0]) / 26
    assert slope == pytest.approx(1.0, abs=0.1)
    frames, diameters = np.concatenate([one.position for one in known]), np.repeat(KNOWN_MM, N_FRAMES)
    ridge = Ridge.fit(frames, diameters, 1e-5)
    assert np.ptp([ridge.predict(grip(mm, 100).position).mean() for mm in read]) / 26 < 0.6


@pytest.mark.long
def test_intervals_hold_cylinders_that_the_line_was_not_fitted_to():
    """Within a recording all is alike: how far estimates go astray shows on cylinders that were left out."""
    inside = []
    for number in range(4):
        reader = fit_cylinders([grip(mm, 10 * number + seed) for seed, mm in enumerate(KNOWN_MM)], PAPER_TABLE)
        for seed, mm in enumerate((12.0, 15.0, 20.0, 30.0, 35.0)):
            value, below, above = reader.predict(grip(mm, 200 + 10 * number + seed).mean_position[-1])
            inside.append(-below <= mm - value <= above)
    assert np.mean(inside) >= 0.85


def test_the_interval_covers_grips_that_differ_although_the_line_fits_them():
    """A line through four places that differ in more than the diameter is exact for these, and for no other."""
    places = gaussian_filter1d(np.random.default_rng(8).normal(size=(4, 2 * PAPER_TABLE.n_channels)), 4.0, axis=1)
    placed = []
    for mm, place in zip((10.0, 20.0, 30.0, 40.0), 20 * places / np.linalg.norm(places[0]), strict=True):
        one = grip(mm, int(mm))
        placed.append(replace(one, position=one.position + place, mean_position=one.mean_position + place))
    # Another grip of the same cylinder vouches for no other.
    reader = fit_cylinders([*placed, *map(replace, placed)], PAPER_TABLE)
    read = [reader.predict(one.mean_position[-1]) for one in placed]
    assert max(abs(one.diameter_mm[0] - value) for one, (value, _, _) in zip(placed, read, strict=True)) < 2.0
    assert read[0][1] > 10.0


def test_fingertips_that_see_no_diameter_say_so_by_their_interval(known):
    blind = [
        replace(one, position=one.position - mm * PER_MM, mean_position=one.mean_position - 25 * PER_MM)
        for one, mm in zip(known, KNOWN_MM, strict=True)
    ]
    value, below, above = fit_cylinders(blind, PAPER_TABLE).predict(blind[0].mean_position[-1])
    assert 15.0 < min(below, above) < 150.0
    assert -50.0 < value < 100.0


def test_places_that_have_no_noise_still_make_a_line(known):
    still = [replace(one, position=np.tile(mm * PER_MM, (5, 1))) for one, mm in zip(known, KNOWN_MM, strict=True)]
    assert fit_line([*still, *still], PAPER_TABLE).predict(20 * PER_MM[None])[0] == pytest.approx(20.0, abs=1e-6)


@pytest.mark.parametrize("frames", [1, N_FRAMES])
def test_one_recording_under_three_diameters_reads_none_of_them_apart(known, frames):
    one = replace(known[0], position=known[0].position[:frames])
    reader = fit_cylinders([replace(one, diameter_mm=np.array([mm])) for mm in KNOWN_MM], PAPER_TABLE)
    value, below, above = reader.predict(one.mean_position[-1])
    assert value == pytest.approx(25.0, abs=0.1)
    assert min(below, above) > 15.0


def cylinder(tips, millimetre, mm, seed):
    """Return a grip of a cylinder on the played rig; a millimetre moves channels by up to that many volts."""
    whole = twisting(cycles=1, tips=tips, seed=seed)
    gripped = (whole.t_s > 20.0) & (whole.t_s < 50.0)
    moved = gripped[:, None, None] * (mm - 25) * millimetre * np.sin(np.arange(PAPER_TABLE.n_channels) / 9.0)
    return replace(whole, channels=whole.channels + moved, diameter_mm=np.full(len(whole.t_s), mm))


def test_a_diameter_is_of_this_grip_alone():
    """It is read from the mean place of a grip, and each grip has its own."""
    of = partial(cylinder, (1,), 2e-4)
    calibration = fit("motion_regression", [of(mm, seed) for seed, mm in enumerate(KNOWN_MM)], "rig", timing=TRUSTED)
    tracker, read = Session(calibration), []
    for number, mm in enumerate((12.0, 38.0)):
        later = of(mm, 10 + number)
        later = replace(later, t_s=later.t_s + number * (later.t_s[-1] + 0.54))
        read += [(mm, one.diameter_mm) for one in follow(tracker, later) if one.diameter_mm is not None]
    truth, found = np.array(read).T
    assert {12.0, 38.0} == set(truth)
    assert np.abs(found - truth).max() < 6.0


@pytest.mark.long
def test_the_first_frames_of_a_grip_have_the_interval_of_a_mean_of_few():
    of = partial(cylinder, (1, 2), 2e-5)
    calibration = fit("motion_regression", [of(mm, seed) for seed, mm in enumerate(KNOWN_MM)], "rig", timing=TRUSTED)
    inside, widths = [], []
    for seed in range(20, 40):
        known_half_mm = calibration.diameter.regressor.intervals.half_widths[0]
        grip = [one for one in follow(calibration, of(15.0, seed)) if one.diameter_mm is not None]
        inside.append(grip[0].diameter_low_mm <= 15.0 <= grip[0].diameter_high_mm)
        widths.append([0.5 * (one.diameter_high_mm - one.diameter_low_mm) for one in (grip[0], grip[-1])])
    assert np.mean(inside) >= 0.9
    assert np.mean(widths, axis=0)[1] < 1.1 * known_half_mm
