import numpy as np
import pytest
from numpy.typing import NDArray

from shearloop.bank.eit.matching import Match, best_match
from shearloop.bank.estimation import Calibration
from shearloop.daemon.sensing.estimators import Baseline, Estimator
from shearloop.drivers.eit_kit import Frame

K_GRID, SIGMA_GRID = np.linspace(3.0, 4.0, 11), np.linspace(1.0, 2.0, 11)
RANDOM = np.random.default_rng(4)
HOMOGENEOUS = RANDOM.uniform(0.05, 0.3, 896)
PATTERN = RANDOM.normal(0.0, 0.01, 896)


class OneCell:
    """A matcher that always finds the same cell, and keeps what it was asked."""

    k_grid, sigma_grid = K_GRID, SIGMA_GRID

    def __init__(self, cell: tuple[int, int] = (5, 5)) -> None:
        self.cell = cell
        self.asked: list[NDArray[np.float64]] = []

    def match(self, difference: NDArray[np.float64]) -> Match:
        self.asked.append(difference)
        return best_match(self.heatmap(difference), K_GRID, SIGMA_GRID)

    def heatmap(self, difference: NDArray[np.float64]) -> NDArray[np.float64]:  # noqa: ARG002 - always the same
        scores = np.full((11, 11), 0.2)
        scores[self.cell] = 0.9
        return scores


def calibration() -> Calibration:
    sigma = np.linspace(1.2, 1.9, 20)
    k = np.linspace(3.2, 3.8, 20)
    return Calibration.fit("bank", "synthetic", torque=(sigma, 0.4 - 0.2 * sigma), diameter=(k, 100.0 - 20.0 * k))


def frame(number: int, channels: NDArray[np.float64], **flags: NDArray[np.bool_] | bool) -> Frame:
    none = np.zeros(896, bool)
    given = {"saturated": none, "dead": none, "repeated": False, **flags}
    return Frame(
        channels=channels,
        raw=np.zeros(1024),
        line=b"",
        t_mid_ns=number * 541_000_000,
        t_arrival_ns=number * 541_000_000 + 270_000_000,
        seq=number,
        unusable=int(np.count_nonzero(given["saturated"] | given["dead"])),
        **given,  # type: ignore[arg-type]
    )


def noisy(signal: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
    return HOMOGENEOUS + signal + RANDOM.normal(0.0, 0.002, 896)


def estimator(matcher: OneCell, *, calibrated: Calibration | None = None, average: int = 1) -> Estimator:
    made = Estimator(matcher, calibrated or calibration(), baseline_frames=10, average_frames=average)
    for number in range(10):
        reading = made.update(frame(number, noisy()))
        assert reading.why == (f"taking the homogeneous frame, {number + 1} of 10",)
    return made


def test_the_baseline_is_the_mean_of_its_frames_and_knows_their_noise() -> None:
    baseline = Baseline(400)
    for _ in range(400):
        baseline.add(noisy())
    assert baseline.complete
    np.testing.assert_allclose(baseline.homogeneous, HOMOGENEOUS, atol=6 * 0.002 / 20)
    assert np.median(baseline.noise) == pytest.approx(0.002, rel=0.02)


def test_channels_that_do_not_move_still_have_the_converters_noise() -> None:
    baseline = Baseline(2)
    baseline.add(HOMOGENEOUS)
    baseline.add(HOMOGENEOUS)
    np.testing.assert_allclose(baseline.noise, 0.00215 / np.sqrt(12))


def test_a_signal_becomes_torque_and_diameter_with_their_intervals() -> None:
    matcher = OneCell()
    reading = estimator(matcher).update(frame(10, noisy(PATTERN)))
    assert reading.valid
    assert reading.torque_nm is not None
    assert reading.diameter_mm is not None
    assert reading.torque_nm.value == pytest.approx(0.4 - 0.2 * 1.5)
    assert reading.diameter_mm.value == pytest.approx(100 - 20 * 3.5)
    np.testing.assert_allclose(matcher.asked[0], PATTERN, atol=0.02)


def test_a_frame_like_the_homogeneous_one_gives_no_estimate_and_says_so() -> None:
    matcher = OneCell()
    reading = estimator(matcher).update(frame(10, noisy()))
    assert "no signal above the noise" in reading.why[0]
    assert (reading.torque_nm, reading.match, matcher.asked) == (None, None, [])


def test_what_lies_outside_of_the_calibration_is_no_estimate_but_shows_its_place() -> None:
    reading = estimator(OneCell((0, 0))).update(frame(10, noisy(PATTERN)))
    assert reading.torque_nm is None
    assert reading.match is not None
    assert len(reading.why) == 2, "both k and sigma lie outside"


def test_a_calibration_without_torques_gives_none() -> None:
    only_k = Calibration.fit("bank", "synthetic", diameter=(np.linspace(3, 4, 9), np.linspace(40, 10, 9)))
    reading = estimator(OneCell(), calibrated=only_k).update(frame(10, noisy(PATTERN)))
    assert reading.why == ("the calibration was made without torques: sigma has no torque",)


def test_a_repeated_frame_is_not_passed_off_as_new() -> None:
    reading = estimator(OneCell()).update(frame(10, noisy(PATTERN), repeated=True))
    assert reading.why == ("the board sent the same frame again",)


def test_too_many_unusable_channels_give_no_estimate() -> None:
    bad = np.arange(896) < 90
    reading = estimator(OneCell()).update(frame(10, noisy(PATTERN), saturated=bad))
    assert reading.why[0].startswith("90 of 896 channels are saturated or dead; look at the ribbon cable")
    assert estimator(OneCell()).update(frame(10, noisy(PATTERN), dead=np.arange(896) < 89)).valid


def test_the_latest_frames_are_averaged_and_a_tare_forgets_them() -> None:
    matcher = OneCell()
    made = estimator(matcher, average=3)
    for number, scale in enumerate((1.0, 2.0, 3.0, 4.0), start=10):
        made.update(frame(number, HOMOGENEOUS + scale * PATTERN))
    offset = matcher.asked[0] - PATTERN
    np.testing.assert_allclose(matcher.asked[-1] - offset, 3.0 * PATTERN, atol=1e-12)
    made.tare()
    assert made.update(frame(20, noisy(PATTERN))).why == ("taking the homogeneous frame, 1 of 10",)


def test_frames_from_before_an_outage_are_not_averaged_with_those_after_it() -> None:
    matcher = OneCell()
    made = estimator(matcher, average=2)
    made.update(frame(10, noisy(PATTERN)))
    after = noisy(-PATTERN)
    reading = made.update(frame(5000, after))
    alone = matcher.asked[-1] + made._baseline.homogeneous
    np.testing.assert_allclose(alone, after, atol=1e-12)
    assert reading.lag_ns == 0
