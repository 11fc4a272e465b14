"""A grip much stronger or weaker than those of the calibration has no estimate, because its gain is unknown."""

import re
from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import Calibration, Session, TactileFrame, fit
from shearloop.estimation.grip_strength import STRONGEST_RATIO, WEAKEST_RATIO, CalibratedStrength, strength_reasons
from tests.estimation.conftest import elastic, follow, tip

UP = np.linspace(0, 1, 21)
# Frames of a held grip until its median strength is its own.
HELD = 100
CURE = "times as strong as in the calibration; grip with {} force, or calibrate at this grip"
TOO_STRONG = re.compile(r"the grip at the .* fingertip is too strong: (\d\.\d)(?: and \d\.\d)? " + CURE.format("less"))
TOO_WEAK = re.compile(r"the grip at the .* fingertip is too weak: (0\.\d\d)(?: and 0\.\d\d)? " + CURE.format("more"))


@pytest.fixture
def frames(motion_calibration):
    """Return what gives frames of these strengths in turn, as multiples of the calibrated grip at each side."""
    guards = motion_calibration.validators
    idle, gripped = (np.array([getattr(guard, name) for guard in guards]) for name in ("idle", "gripped"))

    def played(shares, sides=(1.0, 1.0), begin=0):
        moved = np.array(sides)[:, None] * (gripped - idle)
        # No two frames are the same to the last digit.
        return [TactileFrame.of(0.5 * i, idle + one * moved + 1e-13 * i) for i, one in enumerate(shares, begin)]

    return played


@pytest.fixture
def grip(motion_calibration, frames):
    """Return what grips as strongly as given by side, as multiples of the calibrated grip, and the last estimate."""

    def play(strengths, calibration=motion_calibration):
        session = Session(calibration)
        estimates = [session.estimate(frame) for frame in frames([*np.zeros(12), *UP, *np.ones(HELD)], strengths)]
        return session, estimates[-1]

    return play


@pytest.mark.parametrize("strengths", [(2.8, 2.8), (2.8, 1.0), (1.0, 3.0)])
def test_a_grip_much_stronger_than_the_calibrated_one_has_no_estimate(grip, strengths):
    _, estimate = grip(strengths)
    assert not estimate.valid
    (reason,) = estimate.reasons
    assert float(TOO_STRONG.fullmatch(reason)[1]) == pytest.approx(max(strengths), abs=0.15)


@pytest.mark.parametrize("strengths", [(0.2, 0.2), (0.2, 1.0)])
def test_a_grip_much_weaker_than_the_calibrated_one_has_no_estimate(grip, strengths):
    _, estimate = grip(strengths)
    assert not estimate.valid
    (reason,) = estimate.reasons
    assert float(TOO_WEAK.fullmatch(reason)[1]) == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("strength", [0.4, 1.0, 1.9])
def test_a_grip_as_strong_as_those_that_a_calibration_carries_over_to_has_an_estimate(grip, strength):
    _, estimate = grip((strength, strength))
    assert estimate.valid


def test_each_reason_names_its_fingertips():
    strong, weak = strength_reasons({"right": 2.8, "left": 0.1})
    assert "right fingertip is too strong: 2.8 times" in strong
    assert "left fingertip is too weak: 0.10 times" in weak
    (both,) = strength_reasons({"right": 2.8, "left": 3.0})
    assert "right and left fingertip is too strong: 2.8 and 3.0 times as strong" in both
    assert strength_reasons({"right": STRONGEST_RATIO, "left": WEAKEST_RATIO}) == ()


def test_twists_of_known_torque_do_not_cure_another_strength(grip):
    session, _ = grip((2.8, 2.8))
    with pytest.raises(CalibrationError, match=r"too strong: 2\.8 and 2\.8 times as strong as in the calibration"):
        session.adapt(np.zeros(len(session.grip_t_s)))


def test_the_next_grip_is_judged_by_itself(frames, grip):
    session, estimate = grip((2.8, 2.8))
    assert not estimate.valid
    shares = [*2.8 * UP[::-1], *np.zeros(12), *UP, *np.ones(HELD)]
    assert [session.estimate(frame) for frame in frames(shares, begin=12 + len(UP) + HELD)][-1].valid


def test_a_short_squeeze_leaves_a_grip_valid(motion_calibration, frames):
    """A twist may move the score for some seconds: the median over 120 frames decides."""
    session, squeeze = Session(motion_calibration), [*np.linspace(1, 2.8, 15), *[2.8] * 5, *np.linspace(2.8, 1, 15)]
    held, then = [*np.zeros(12), *UP, *np.ones(HELD)], [*squeeze, *np.ones(HELD)]
    assert [session.estimate(frame) for frame in frames(held)][-1].valid, "or there is no grip to squeeze"
    estimates = [session.estimate(frame) for frame in frames(then, begin=len(held))]
    assert not any("no grip" in why or "too strong" in why for one in estimates for why in one.reasons)
    assert max(session.grip_strengths.values()) < 1.1
    assert estimates[-1].valid


def test_grips_of_several_strengths_widen_the_range():
    """Grips of 0.5 and of 1: the stronger one is the limit of stronger grips, the weaker one of weaker grips."""
    loose = elastic(4, seed=1)
    idle = np.array([tip(number).idle for number in (1, 2)])
    grips = np.array([tip(number).grip for number in (1, 2)])
    held = np.abs(loose.channels - idle).mean(axis=(1, 2)) > 0.5 * np.abs(grips).mean()
    loose = replace(loose, channels=loose.channels - 0.5 * held[:, None, None] * grips)
    both, firm = fit("motion_regression", [elastic(4), loose], "two"), fit("motion_regression", [elastic(4)], "one")
    for each, one in zip(both.validators, firm.validators, strict=True):
        wide, narrow = each.strength, one.strength
        assert wide.strongest / wide.weakest == pytest.approx(2.0, rel=0.1)
        assert narrow.strongest == narrow.weakest
    known = CalibratedStrength(np.ones(1), 0.5, 1.0)
    assert [known.ratio(one) for one in (0.25, 0.5, 0.7, 1.0, 2.0)] == [0.5, 1.0, 1.0, 1.0, 2.0]


def test_a_file_without_the_strength_loads_and_says_that_it_is_not_checked(motion_calibration, grip, tmp_path):
    """Files of version 0.3.0 lack these keys."""
    unknown = [replace(one, strength=None) for one in motion_calibration.validators]
    older = replace(motion_calibration, validators=tuple(unknown))
    older.save(tmp_path / "older.cal")
    loaded = Calibration.load(tmp_path / "older.cal")
    _, estimate = grip((2.8, 2.8), loaded)
    assert estimate.valid
    assert "every grip is about as strong as in the calibration" in loaded.assumption_text
    motion_calibration.save(tmp_path / "new.cal")
    assert "strong" not in Calibration.load(tmp_path / "new.cal").assumption_text


def test_the_check_changes_no_estimate_of_the_calibrated_grip(motion_calibration, recorded):
    unknown = [replace(one, strength=None) for one in motion_calibration.validators]
    older = replace(motion_calibration, validators=tuple(unknown))
    assert follow(motion_calibration, recorded) == follow(older, recorded)
