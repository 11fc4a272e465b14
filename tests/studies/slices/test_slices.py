"""Slices: frames by themselves, with a torque or a diameter each."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import Calibration
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.series import SliceSeries
from tests.estimation.conftest import judged
from tests.studies.slices.conftest import read, sliced


@pytest.mark.parametrize("name", ["motion_regression", "regression"])
def test_later_slices_are_read_through_the_drift(name):
    whole = sliced()
    later = whole.between(30, 50)
    found = judged(read(fit_slices(name, [whole.between(0, 30)], "earlier"), later), later)
    assert found.n == 20
    assert found.rmse < 0.008
    assert found.coverage >= 0.85


def test_what_is_not_familiar_is_not_valid(sliced_calibration):
    calibration = sliced_calibration
    later = sliced(seed=3)
    assert np.mean([one.valid for one in read(calibration, later)]) > 0.95
    rng = np.random.default_rng(0)
    noisy = later.channels.copy()
    for frame in noisy[:, 0]:
        frame[rng.choice(896, 224, replace=False)] = np.abs(rng.normal(0, 0.02, 224))
    idle = np.abs(rng.normal(0, 0.0008, later.channels.shape))
    foreign = later.channels[..., ::-1]
    for frames, why in ((noisy, "outside the calibration"), (idle, "no grip"), (foreign, "outside the")):
        estimates = read(calibration, replace(later, channels=frames))
        assert not any(one.valid for one in estimates)
        assert all(why in one.reasons[0] and one.torque_nm is None for one in estimates)


@pytest.mark.parametrize("name", ["motion_regression", "regression"])
def test_with_a_fifth_of_the_channels_dead_the_rest_say_nearly_as_much(sliced_calibration, name):
    """A dead channel that was given the calibration's mean would pull the torque towards its mean."""
    later = sliced(seed=4)
    calibration = sliced_calibration if name == "motion_regression" else fit_slices(name, [sliced()], "all")
    usable = np.random.default_rng(1).random((1, 896)) > 0.2
    dead = replace(later, channels=np.where(usable, later.channels, 1.0))
    whole, left = (judged(read(calibration, *one), later) for one in ((later,), (dead, usable)))
    assert whole.n == left.n == len(later.t_s)
    assert left.rmse < 1.25 * whole.rmse


def test_slices_of_two_fingertips_are_not_judged_by_one_of_them():
    one = sliced()
    both = replace(one, sides=("right", "left"), channels=np.repeat(one.channels, 2, axis=1))
    with pytest.raises(CalibrationError, match=r"slices of 2 fingertips \(right, left\) do not fit into one"):
        fit_slices("motion_regression", [both], "both")


def test_cylinders_give_a_diameter_and_no_torque():
    torque = sliced()
    rng = np.random.default_rng(2)
    shape = np.abs(np.random.default_rng(55).normal(0, 4e-3, (2, 896)))
    diameter = np.tile([10.0, 20.0, 30.0, 40.0], 4)
    frames = shape[0] + (diameter / 25 - 1)[:, None] * 0.5 * shape[1] + rng.normal(0, 3e-4, (16, 896))
    t = np.arange(16.0)
    cylinders = SliceSeries(("right",), t, np.abs(frames)[:, None], t, np.full(16, 0.1), diameter)
    calibration = fit_slices("motion_regression", [torque, cylinders.between(0, 12)], "both")
    for one, truth in zip(read(calibration, cylinders.between(12, 16)), diameter[12:], strict=True):
        assert one.valid
        assert one.diameter_mm == pytest.approx(truth, abs=4)
        assert one.torque_nm is None
    assert all(one.diameter_mm is None for one in read(calibration, torque))


FEW = "slices have too few different torques .*, {}; record more"


@pytest.mark.parametrize(
    ("name", "torque_nm", "message"),
    [
        ("paper", np.linspace(0.01, 0.14, 50), "needs a bank"),
        ("reconstruction", np.linspace(0.01, 0.14, 50), "needs a mesh"),
        ("motion_regression", np.full(50, 0.1), "cannot determine a calibration"),
        ("motion_regression", np.full(50, np.nan), "neither torque nor diameter"),
        ("motion_regression", np.resize([0.01, 0.05, 0.1], 50), f"50 of the 50 {FEW.format(3)}"),
        ("motion_regression", np.repeat([0.01, 0.03, 0.05, 0.07, 0.1], 10), f"40 of the 50 {FEW.format(4)}"),
    ],
)
def test_what_cannot_be_calibrated_says_why(name, torque_nm, message):
    with pytest.raises(CalibrationError, match=message):
        fit_slices(name, [replace(sliced(), torque_nm=torque_nm)], "x")


@pytest.mark.parametrize(("name", "least"), [("motion_regression", 15), ("regression", 10)])
def test_as_many_slices_as_an_estimator_asks_for_are_enough(name, least):
    whole = sliced()
    for n in (5, least - 1):
        with pytest.raises(CalibrationError, match=f"^too few slices with a torque .* {name}: {n}; record {least} "):
            fit_slices(name, [whole.between(0, n)], "too few")
    assert fit_slices(name, [whole.between(0, least)], "enough").torque is not None


def test_where_few_torques_are_left_without_the_outermost_it_is_they_that_are_asked_for():
    few = sliced().between(0, 15)
    few = replace(few, torque_t_s=few.t_s, torque_nm=np.resize([0.01, 0.05, 0.08, 0.1, 0.14], 15))
    message = "12 frames at 4 distinct values .* at more values: 5 values and 12 frames must remain"
    with pytest.raises(CalibrationError, match=message):
        fit_slices("motion_regression", [few], "five torques")


def one_nan(slices):
    channels = slices.channels.copy()
    channels.flat[100] = np.nan
    return replace(slices, channels=channels)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda slices: [slices, slices.between(0, 0)], "recording 2 of 2 has no frames"),
        (lambda slices: [one_nan(slices)], "recording 1 of 1 holds 1 value that is not a finite number"),
    ],
)
def test_slices_that_determine_nothing_are_refused(spoil, message):
    with pytest.raises(CalibrationError, match=message):
        fit_slices("motion_regression", spoil(sliced()), "spoilt")


def test_a_calibration_is_kept_in_a_file_that_live_code_refuses(tmp_path):
    path = tmp_path / "slices.cal"
    made = fit_slices("regression", [sliced()], "slices", full_range=True)
    made.save(path)
    kept = SliceCalibration.load(path)
    kept.save(tmp_path / "again.cal")
    assert path.read_bytes() == (tmp_path / "again.cal").read_bytes()
    assert kept.assumption_text == "no torque exceeds its slices (--assume-full-range)"
    later = sliced(seed=3)
    assert read(kept, later) == read(made, later)
    with pytest.raises(CalibrationError, match=r"slices\.cal is of the kind 'calibration of slices', not 'estimator"):
        Calibration.load(path)


FIFTY, CHANNEL = np.arange(50)[:, None, None], np.arange(896)
LOST = "of the channels never change: .* check the ribbon cable"


@pytest.mark.parametrize("name", ["motion_regression", "regression"])
@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        (lambda v: np.resize(v[:1], v.shape), "50 of the 50 slices are all alike; record slices as they come"),
        (lambda v: (1 + FIFTY / 49) * v[:1], "the slices have no noise: they are multiples or sums of a few"),
        # A ribbon cable that does not carry some of the wires, always or in the first forty slices.
        (lambda v: v * (CHANNEL >= 448), f"in 50 of the 50 slices 50 % {LOST}"),
        (lambda v: v * ((FIFTY >= 40) | (CHANNEL < 600)), f"in 40 of the 50 slices 33 % {LOST}"),
    ],
)
def test_slices_that_no_sound_board_sends_are_refused(name, spoilt, message):
    whole = sliced()
    with pytest.raises(CalibrationError, match=message):
        fit_slices(name, [replace(whole, channels=spoilt(whole.channels))], "spoilt")


def test_up_to_a_quarter_of_the_channels_may_be_dead_as_in_a_live_frame():
    whole = sliced()
    quarter = replace(whole, channels=np.where(np.arange(896) < 224, 0.0, whole.channels))
    assert fit_slices("motion_regression", [quarter], "a quarter is dead").torque is not None
