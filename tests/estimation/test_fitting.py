"""What cannot be calibrated on is said in a sentence."""

from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import TRUSTED, Physics, Session, adapt, fit
from shearloop.estimation.bank_estimators import BankEstimator
from shearloop.estimation.bank_match import BankMatch
from shearloop.estimation.estimator import Estimator, OutputModel
from shearloop.estimation.motion_regression import MotionRegression
from tests.estimation.conftest import kept, twisting


def with_a_nan(series, name):
    spoilt = getattr(series, name).copy()
    spoilt.flat[len(spoilt) // 2] = np.nan
    return replace(series, **{name: spoilt})


def of_a_single_frame(series):
    torque = series.torque_nm.copy()
    torque[900] = 1000.0
    return replace(series, torque_nm=torque)


NO_NUMBER = "holds 1 value that is not a finite number"


@pytest.mark.parametrize(
    ("recordings_of", "message"),
    [
        (lambda raw: [raw, with_a_nan(raw, "t_s")], f"recording 2 of 2 {NO_NUMBER}"),
        (lambda raw: [raw, with_a_nan(raw, "channels")], f"recording 2 of 2 {NO_NUMBER}"),
        (lambda raw: [raw, with_a_nan(raw, "torque_nm")], f"recording 2 of 2 {NO_NUMBER}"),
        (lambda raw: [raw.between(0, 0)], "recording 1 of 1 has no frames"),
        (lambda raw: [raw, raw.between(0, 0)], "recording 2 of 2 has no frames"),
        (lambda raw: [of_a_single_frame(raw)], "from the first torque to the last there are 1 frames"),
    ],
)
def test_recordings_that_determine_nothing_are_refused(recorded, recordings_of, message):
    with pytest.raises(CalibrationError, match=message):
        fit("motion_regression", recordings_of(recorded), "rig", timing=TRUSTED)


def test_a_recording_may_be_given_alone_and_must_be_read():
    series = twisting(cycles=2)
    alone, listed = (fit("motion_regression", given, "twists") for given in (series, [series]))
    assert np.array_equal(alone.validators[0].idle, listed.validators[0].idle)
    with pytest.raises(CalibrationError, match="'t' is no series of frames; `read_series` reads one"):
        fit("motion_regression", "twists.mcap", "twists")
    with pytest.raises(CalibrationError, match=r"'a.mcap' is no series"):
        fit("motion_regression", ["a.mcap"], "twists")


def test_a_diameter_is_not_fitted_before_the_fingertips_were_seen_idle(monkeypatch):
    """The daemon gives no diameter there: without its idle position the gel's position means nothing."""
    fitted = []

    def fit_diameter(_estimator, rows):
        fitted.append(rows)
        return OutputModel(None, np.zeros(0))

    process = Session.process

    def seen_idle_late(session, frame):
        processed = process(session, frame)
        return replace(processed, has_baseline=processed.has_baseline and frame.t_s > 40.0)

    monkeypatch.setattr(MotionRegression, "fit_diameter", fit_diameter)
    monkeypatch.setattr(Session, "process", seen_idle_late)
    series = zip((twisting(cycles=3, tips=(1,), seed=seed) for seed in range(3)), (10.0, 20.0, 40.0), strict=True)
    recordings = [replace(one, diameter_mm=np.full(len(one.t_s), tool_mm)) for one, tool_mm in series]
    fit("motion_regression", recordings, "rig", timing=TRUSTED)
    (rows,) = fitted
    assert len(rows.frame) > 100
    assert all(recordings[0].t_s[rows.frame] > 40.0)


def test_a_frame_that_fits_two_positions_of_the_bank_is_not_fitted(monkeypatch, bank):
    class TwoPositions:
        """Finds the position of a frame in the bank by its size; every third one fits another position too."""

        found = 0

        def match(self, difference):
            self.found += 1
            size = float(np.abs(difference).mean())
            ambiguous = self.found % 3 == 0
            return BankMatch(9.0 if ambiguous else 1.0 + size, 1.0, size, 0.9, 0.9, ambiguous)

    fitted = []
    fit_torque = Estimator.fit_torque

    def noted(estimator, features, *others):
        fitted.append(features)
        return fit_torque(estimator, features, *others)

    monkeypatch.setattr(BankEstimator, "prepare", classmethod(lambda cls, material: cls(material.scale)))
    monkeypatch.setattr(BankEstimator, "matcher", lambda *_: TwoPositions())
    monkeypatch.setattr(BankEstimator, "fit_torque", noted)
    fit("bank", [twisting(tips=(1,))], "rig", Physics(bank=bank), timing=TRUSTED)
    (features,) = fitted
    assert len(features) > 100
    assert features[:, 0].max() < 9.0


def test_of_a_board_that_leaves_out_half_of_its_frames_nothing_is_fitted():
    """The daemon knows the board's period, and gives no torque there."""
    whole = twisting(tips=(1,))
    number = np.arange(len(whole.t_s))
    half = kept(whole, number % 5 % 2 == 0)
    with pytest.raises(CalibrationError, match=r"no frame of the recordings can be calibrated on: .* \(\d+ of"):
        fit("motion_regression", [replace(half, period_s=0.54)], "rig", timing=TRUSTED)


def test_a_bank_in_which_no_frame_has_one_position_is_named_as_the_cause(monkeypatch, bank):
    """It was said that no frame was gripped and undisturbed for long enough, though hundreds were."""

    class TwoPositions:
        def match(self, _difference):
            return BankMatch(9.0, 1.0, 0.1, 0.9, 0.9, ambiguous=True)

    monkeypatch.setattr(BankEstimator, "prepare", classmethod(lambda cls, material: cls(material.scale)))
    monkeypatch.setattr(BankEstimator, "matcher", lambda *_: TwoPositions())
    with pytest.raises(CalibrationError, match=r"two positions of the bank.* fit the frame equally well.* \(\d{2,} of"):
        fit("bank", [twisting(tips=(1,))], "rig", Physics(bank=bank), timing=TRUSTED)


@pytest.mark.parametrize(
    ("part", "first", "said"),
    [
        (slice(0, 297), 270, r"no frame can be adapted on: no grip at the right .* \(27 of 27 frames\)"),
        (slice(0, 140), 140, r"the recordings have no frame of the part to adapt on"),
        (slice(40, 140), 100, r"the recordings have no frame of the part to adapt on"),
    ],
    ids=["released again", "at the end", "gripped at its beginning"],
)
def test_frames_before_the_part_to_adapt_on_are_not_its_cause(part, first, said, motion_calibration):
    """Frames before it are usable, and others there have no grip."""
    recording = twisting(seed=7, peak_nm=0.08).between(part.start, part.stop)
    with pytest.raises(CalibrationError, match=said):
        adapt(motion_calibration, [recording], "x", first_frames=[first])
