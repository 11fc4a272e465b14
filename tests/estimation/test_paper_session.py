"""The paper's method in a session: idle frame, average, match, curves."""

import numpy as np
import pytest
from numpy.typing import NDArray

from shearloop.bank.matching import Match, best_match
from shearloop.estimation import Calibration, Estimate, Session, TactileFrame
from shearloop.estimation.bank_match import PaperMatcher
from shearloop.estimation.paper_session import PaperSession, UntouchedFrames
from shearloop.estimation.session import FINGERS_MOVED
from tests.paper_curve import paper_curve

K_GRID, SIGMA_GRID = np.linspace(3.0, 4.0, 11), np.linspace(1.0, 2.0, 11)
RANDOM = np.random.default_rng(4)
HOMOGENEOUS = RANDOM.uniform(0.05, 0.3, 896)
PATTERN = RANDOM.normal(0.0, 0.01, 896)
SIGMA, K = np.linspace(1.3, 1.9, 20), np.linspace(3.3, 3.8, 20)
TORQUE, DIAMETER = (SIGMA, 0.4 - 0.2 * SIGMA), (K, 100.0 - 20.0 * K)


class OneCell:
    """A matcher that always finds the same cell, and keeps its inputs."""

    def __init__(self, cell: tuple[int, int] = (5, 5)) -> None:
        self.cell = cell
        self.asked: list[NDArray[np.float64]] = []

    def match(self, difference: NDArray[np.float64]) -> Match:
        self.asked.append(difference)
        scores = np.full((11, 11), 0.2)
        scores[self.cell] = 0.9
        return best_match(scores, K_GRID, SIGMA_GRID)


def noisy(signal: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
    return HOMOGENEOUS + signal + RANDOM.normal(0.0, 0.002, 896)


def estimated(
    session: Session, number: int, channels: NDArray[np.float64], unusable: int = 0, *, fingers_moved: bool = False
) -> Estimate:
    usable = np.arange(896)[None] >= unusable
    return session.estimate(TactileFrame.of(0.541 * number, channels[None], usable, fingers_moved=fingers_moved))


def tared(matcher: OneCell, calibration: Calibration | None = None, average: int = 1) -> Session:
    """Return a session that has its idle frame."""
    session = PaperSession(
        calibration or paper_curve("bank", torque=TORQUE, diameter=DIAMETER),
        PaperMatcher(matcher),
        average_frames=average,
    )
    for number in range(10):
        assert session.taring
        reasons = estimated(session, number, noisy()).reasons
        assert reasons == (f"taking the idle frame, {number + 1} of 10",)
    return session


def uncalibrated(baseline_frames: int, **options: int) -> PaperSession:
    matcher = PaperMatcher(OneCell())
    return PaperSession(Calibration.uncalibrated("bank"), matcher, baseline_frames=baseline_frames, **options)


def test_a_tare_that_is_given_up_gives_no_torque_until_the_next():
    session = tared(OneCell())
    session.tare()
    estimated(session, 10, noisy())
    session.give_up_tare()
    assert not session.taring
    for number in range(11, 25):
        given_up = estimated(session, number, noisy(PATTERN))
        assert (given_up.valid, given_up.torque_nm) == (False, None)
        assert "tare again with nothing gripped" in given_up.reasons[0]
    session.tare()
    assert session.taring


def test_the_baseline_is_the_mean_of_its_frames_and_has_their_noise():
    untouched = UntouchedFrames(400)
    untouched.frames.extend(noisy() for _ in range(400))
    assert not untouched.missing
    np.testing.assert_allclose(untouched.idle_frame, HOMOGENEOUS, atol=6 * 0.002 / 20)
    assert np.median(untouched.noise) == pytest.approx(0.002, rel=0.02)


def test_channels_that_do_not_move_have_the_converters_noise():
    untouched = UntouchedFrames(2)
    untouched.frames.extend([HOMOGENEOUS, HOMOGENEOUS])
    np.testing.assert_allclose(untouched.noise, 0.00215 / np.sqrt(12))


def test_a_channel_that_reads_0_in_some_frames_disturbs_neither_idle_frame_nor_average():
    state, silent = uncalibrated(10, average_frames=4), np.arange(896) < 56
    for number in range(30):
        channels = np.where(silent & (number % 3 == 2), 0.0, noisy(PATTERN if number > 9 else 0.0))
        processed = state.process(TactileFrame.of(float(number), channels[None]))
        assert processed.usable[0].tolist() == (channels != 0).tolist()
        if number > 13:
            np.testing.assert_allclose(processed.difference[0], PATTERN, atol=0.01)


def test_a_channel_that_read_0_when_the_tare_began_stays_out_until_the_next_tare():
    state, silent = uncalibrated(3), np.arange(896) < 56
    for number in range(6):
        channels = np.where(silent & (number == 0), 0.0, noisy(PATTERN if number > 2 else 0.0))
        processed = state.process(TactileFrame.of(float(number), channels[None]))
        assert processed.usable[0].tolist() == (~silent).tolist()
    assert not processed.difference[0, silent].any()


def test_a_signal_becomes_torque_and_diameter_with_their_intervals():
    matcher = OneCell()
    estimate = estimated(tared(matcher), 10, noisy(PATTERN))
    assert estimate.valid
    assert estimate.torque_nm == pytest.approx(0.4 - 0.2 * 1.5, abs=1e-5)
    assert estimate.diameter_mm == pytest.approx(100 - 20 * 3.5)
    # At the least an interval is a thousandth of the calibrated range to either side.
    assert (estimate.torque_low_nm, estimate.torque_high_nm) == pytest.approx((0.09988, 0.10012), abs=1e-5)
    assert (estimate.diameter_low_mm, estimate.diameter_high_mm) == pytest.approx((29.99, 30.01))
    assert (estimate.k, estimate.sigma) == pytest.approx((3.5, 1.5))
    np.testing.assert_allclose(matcher.asked[0], PATTERN, atol=0.02)


def test_a_frame_like_the_homogeneous_one_gives_no_estimate():
    matcher = OneCell()
    estimate = estimated(tared(matcher), 10, noisy())
    assert "no signal above the noise" in estimate.reasons[0]
    assert (estimate.torque_nm, estimate.k, matcher.asked) == (None, None, [])


def test_a_match_outside_of_the_calibration_is_shown_without_an_estimate():
    estimate = estimated(tared(OneCell((0, 0))), 10, noisy(PATTERN))
    assert (estimate.valid, estimate.torque_nm, estimate.diameter_mm) == (False, None, None)
    assert estimate.k is not None
    assert len(estimate.reasons) == 2, "both k and sigma lie outside"


def test_without_a_calibration_the_match_alone_is_shown():
    estimate = estimated(tared(OneCell(), Calibration.uncalibrated("bank")), 10, noisy(PATTERN))
    assert estimate.reasons == ("no calibration is configured: k and sigma have no torque",)
    assert (estimate.valid, estimate.torque_nm, estimate.diameter_mm) == (False, None, None)
    assert estimate.sigma == pytest.approx(1.5)


def test_too_many_unusable_channels_give_no_estimate():
    estimate = estimated(tared(OneCell()), 10, noisy(PATTERN), unusable=90)
    assert estimate.reasons[0].startswith("90 of 896 channels are saturated or dead; check the ribbon cable")
    assert estimated(tared(OneCell()), 10, noisy(PATTERN), unusable=89).valid


def test_the_latest_frames_are_averaged_and_a_tare_forgets_them():
    matcher = OneCell()
    session = tared(matcher, average=3)
    for number, scale in enumerate((1.0, 2.0, 3.0, 4.0), start=10):
        estimate = estimated(session, number, HOMOGENEOUS + scale * PATTERN)
    offset = matcher.asked[0] - PATTERN
    np.testing.assert_allclose(matcher.asked[-1] - offset, 3.0 * PATTERN, atol=1e-12)
    assert estimate.lag_s == pytest.approx(0.541)
    session.tare()
    assert estimated(session, 20, noisy(PATTERN)).reasons == ("taking the idle frame, 1 of 10",)


def test_frames_before_a_motion_of_the_fingers_are_not_averaged_with_those_after_it():
    matcher = OneCell()
    session = tared(matcher, average=2)
    before, after = noisy(PATTERN), noisy(-PATTERN)
    estimated(session, 10, before)
    moved = estimated(session, 11, noisy(PATTERN), fingers_moved=True)
    assert (moved.valid, moved.torque_nm, moved.reasons) == (False, None, (FINGERS_MOVED,))
    estimate = estimated(session, 12, after)
    idle_frame = before - matcher.asked[0]
    np.testing.assert_allclose(matcher.asked[-1] + idle_frame, after, atol=1e-12)
    assert estimate.lag_s == 0


def test_an_idle_frame_has_frames_after_the_last_motion_of_the_fingers_only():
    session = tared(OneCell())
    session.tare()
    for number in range(10, 15):
        estimated(session, number, noisy())
    assert estimated(session, 15, noisy(PATTERN), fingers_moved=True).reasons == (FINGERS_MOVED,)
    assert estimated(session, 16, noisy()).reasons == ("taking the idle frame, 1 of 10",)
    assert session.taring


def test_frames_before_a_gap_are_not_averaged_with_those_after_it():
    matcher = OneCell()
    session = tared(matcher, average=2)
    before, after = noisy(PATTERN), noisy(-PATTERN)
    estimated(session, 10, before)
    estimate = estimated(session, 5000, after)
    idle_frame = before - matcher.asked[0]
    np.testing.assert_allclose(matcher.asked[-1] + idle_frame, after, atol=1e-12)
    assert estimate.lag_s == 0
