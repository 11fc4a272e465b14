from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.pruned_matching import PrunedZeroLagMatcher
from shearloop.bank.estimation import Calibration, FrameSeries, fit
from shearloop.daemon.cli.check import _torque
from shearloop.daemon.config import CombinedConfig, FingertipConfig
from shearloop.daemon.doctor.files import both_finding, calibration_finding
from shearloop.daemon.errors import UserError
from shearloop.daemon.sensing.estimators import LiveEstimator, Scoring, open_combined, open_estimator
from shearloop.drivers.eit_kit import Frame
from tests.bank.estimators.conftest import IDLE_S, PERIOD_S, series

NO_CHANNEL = np.zeros(896, bool)


@pytest.fixture(scope="module")
def recorded() -> FrameSeries:
    return series()


@pytest.fixture(scope="module")
def calibration(recorded: FrameSeries) -> Calibration:
    return fit("fused", [recorded], "a played rig")


@pytest.fixture(scope="module")
def files(recorded: FrameSeries, calibration: Calibration, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Save a calibration of both sides and one of the right alone."""
    folder = tmp_path_factory.mktemp("calibrations")
    calibration.save(folder / "both.cal")
    fit("fused", [recorded.of_sides(("right",))], "a played rig").save(folder / "right.cal")
    return {"both": folder / "both.cal", "right": folder / "right.cal"}


def frame(
    number: int, channels: NDArray[np.float64], *, dead: NDArray[np.bool_] = NO_CHANNEL, repeated: bool = False
) -> Frame:
    t_ns = round(number * PERIOD_S * 1e9)
    return Frame(
        channels=channels, raw=np.zeros(1024), line=b"", t_mid_ns=t_ns, t_arrival_ns=t_ns + 270_000_000, seq=number,
        saturated=NO_CHANNEL, dead=dead, unusable=int(dead.sum()), repeated=repeated,
    )  # fmt: skip


def followed(estimator: LiveEstimator, played: FrameSeries, **flags: NDArray[np.bool_]) -> list[float | None]:
    """Return the torque of every pair, None where there is none."""
    found = []
    for number, pair in enumerate(played.channels):
        reading = estimator.update(*(frame(number, channels, **flags) for channels in pair))
        assert reading.valid == (reading.torque_nm is not None)
        found.append(reading.torque_nm.value if reading.torque_nm is not None else None)
    return found


def test_both_fingertips_together_follow_another_session(calibration: Calibration) -> None:
    played = series(seed=3)
    found = followed(LiveEstimator(calibration, None, None, baseline_frames=10), played)
    truth = played.torque_at_frames()
    errors = [value - true for value, true in zip(found, truth, strict=True) if value is not None]
    assert len(errors) > 0.6 * len(found)
    assert np.sqrt(np.mean(np.square(errors))) < 0.005
    assert np.nanmax(truth) > 0.05


def test_a_tare_takes_the_frames_that_follow_for_idle_ones(calibration: Calibration) -> None:
    played = series(seed=3)
    estimator = LiveEstimator(calibration, None, None, baseline_frames=5)
    estimator.tare()
    for number in range(5):
        assert not estimator.baseline_complete
        reading = estimator.update(*(frame(number, channels) for channels in played.channels[number]))
        assert reading.why == (f"taking the homogeneous frame, {number + 1} of 5",)
    assert estimator.baseline_complete
    assert any(value is not None for value in followed(estimator, played.between(5, len(played.t_s))))


def test_dead_channels_leave_the_rest_at_work_and_a_repeated_frame_says_nothing(calibration: Calibration) -> None:
    played = series(seed=4)
    dead = np.random.default_rng(0).uniform(size=896) < 0.1
    found = followed(LiveEstimator(calibration, None, None, baseline_frames=10), played, dead=dead)
    assert np.count_nonzero([value is not None for value in found]) > 0.6 * len(found)
    elsewhere = replace(played, channels=np.where(dead, 0.3, played.channels))
    again = followed(LiveEstimator(calibration, None, None, baseline_frames=10), elsewhere, dead=dead)
    assert again == found, "whatever dead channels read"
    estimator = LiveEstimator(calibration, None, None, baseline_frames=10)
    pair = [frame(0, channels, repeated=True) for channels in played.channels[0]]
    assert estimator.update(*pair).why == ("the board sent the same frame again",)


def test_a_bank_gives_k_sigma_and_heatmaps_beside(calibration: Calibration, tiny_bank: Path) -> None:
    bank = Bank.open(tiny_bank)
    estimator = LiveEstimator(
        calibration, bank, Scoring(PrunedZeroLagMatcher.from_bank(bank), bank.model), baseline_frames=10
    )
    played = series(seed=3)
    gripped = int((IDLE_S + 12.0) / PERIOD_S)
    for number in range(gripped):
        reading = estimator.update(*(frame(number, channels) for channels in played.channels[number]))
    assert reading.valid
    assert reading.match is not None
    heatmap = estimator.heatmap(reading)
    assert heatmap is not None
    assert reading.match.score == pytest.approx(np.nanmax(heatmap), abs=1e-6)


def test_readings_are_the_same_at_once_and_in_a_thread(calibration: Calibration, tiny_bank: Path) -> None:
    bank = Bank.open(tiny_bank)
    slow, quick = (
        LiveEstimator(calibration, bank, Scoring(PrunedZeroLagMatcher.from_bank(bank), bank.model), baseline_frames=10)
        for _ in range(2)
    )
    left_undone = 0
    for number, pair in enumerate(series(seed=3).channels[: int((IDLE_S + 14.0) / PERIOD_S)]):
        frames = [frame(number, channels) for channels in pair]
        found = quick.quickly(*frames)
        if found is None:
            left_undone += 1
            found = quick.update(*frames)
        expected = slow.update(*frames)
        assert (found.match, found.torque_nm, found.why) == (expected.match, expected.torque_nm, expected.why)
    assert left_undone > 0


@pytest.mark.parametrize(("name", "quick"), [("fused", True), ("reconstruction", False)])
def test_only_what_takes_a_millisecond_is_not_left_to_a_thread(name, quick, calibration: Calibration) -> None:
    estimator = LiveEstimator(replace(calibration, estimator=name), None, None, baseline_frames=10)
    found = estimator.quickly(*(frame(0, channels) for channels in series().channels[0]))
    assert (found is not None) == quick


def fingertip(**changes: object) -> FingertipConfig:
    return FingertipConfig.model_validate({"device": {"path": "eit"}, **changes})


def test_the_calibration_says_which_estimator_it_is(files: dict[str, Path]) -> None:
    opened = open_estimator(fingertip(calibration=files["right"]), "right")
    assert isinstance(opened, LiveEstimator)
    both = open_combined(CombinedConfig(calibration=files["both"]), {"right": fingertip(), "left": fingertip()})
    assert both.sides == ("right", "left")
    assert both.grids is None


def test_doctor_and_check_show_what_was_taken_on_somebodys_word(
    calibration: Calibration, files: dict[str, Path], tmp_path: Path
) -> None:
    path, tips = tmp_path / "both.cal", {"right": fingertip(), "left": fingertip()}
    alone = fingertip(calibration=files["right"])
    replace(calibration, vouched=("load times",)).save(path)
    vouched = both_finding(CombinedConfig(calibration=path), tips)
    assert vouched.state == "good"
    assert vouched.found.endswith(", on somebody's word for when its loads were measured (--load-late)")
    assert "with torque, on somebody's word for" in _torque(
        open_combined(CombinedConfig(calibration=path), tips), calibrated=True
    )
    for finding in (both_finding(CombinedConfig(calibration=files["both"]), tips), calibration_finding("right", alone)):
        assert finding.state == "good"
        assert "word" not in finding.found


@pytest.mark.parametrize(
    ("open_it", "sentence"),
    [
        (lambda f: open_estimator(fingertip(calibration=f["right"]), "left"), "fingertip, and not of left"),
        (lambda f: open_estimator(fingertip(calibration=f["both"]), "right"), "a calibration of both under `both`"),
        (lambda f: open_estimator(fingertip(calibration=f["right"], estimator="bank"), "right"), "the estimator fused"),
        (lambda _: open_estimator(fingertip(estimator="fused"), "right"), "needs a calibration that was fitted"),
        (lambda _: open_estimator(fingertip(estimator="fused", calibration="no.cal"), "right"), "no.cal does not"),
        (lambda _: open_estimator(fingertip(estimator="fused", calibration=__file__), "right"), "is another kind;"),
        (lambda _: open_estimator(fingertip(), "right"), "needs its bank; add `bank:`"),
        (lambda f: open_combined(CombinedConfig(calibration=f["both"]), {"right": fingertip()}), "of both, and name"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_a_sentence(
    open_it: Callable[[dict[str, Path]], object], sentence: str, files: dict[str, Path]
) -> None:
    with pytest.raises(UserError, match=sentence):
        open_it(files)
