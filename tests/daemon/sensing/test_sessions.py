"""Sessions as the configuration opens them, on frames of boards."""

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from structlog.testing import capture_logs

from shearloop.bank.bank_file import Bank, BankDefinition, write_bank
from shearloop.bank.channels import ChannelTable
from shearloop.bank.errors import BankError
from shearloop.daemon.config import CombinedConfig, DaemonConfig, FingertipConfig
from shearloop.daemon.recorder.recorder import daemon_identity
from shearloop.daemon.sensing.fingertip_task import estimate_frames
from shearloop.daemon.sensing.sessions import open_combined, open_session, refuse_emulated_calibrations
from shearloop.daemon.sensors import log_assumptions, open_sessions
from shearloop.drivers.eit_kit import Frame
from shearloop.errors import UserError
from shearloop.estimation import Calibration, Estimate, FrameSeries, Session, fit
from shearloop.tools.check import _torque
from tests.estimation.conftest import IDLE_S, PERIOD_S, twisting

NO_CHANNEL = np.zeros(896, bool)
NAME = "motion_regression"


@pytest.fixture(scope="module")
def recorded() -> FrameSeries:
    return twisting()


@pytest.fixture(scope="module")
def calibration(recorded) -> Calibration:
    return fit(NAME, [recorded], "rig")


@pytest.fixture(scope="module")
def files(recorded, calibration, tmp_path_factory) -> dict[str, Path]:
    """Save a calibration of both sides and one of the right alone."""
    folder = tmp_path_factory.mktemp("calibrations")
    calibration.save(folder / "combined.cal")
    fit(NAME, [recorded.select_sides(("right",))], "rig").save(folder / "right.cal")
    return {"combined": folder / "combined.cal", "right": folder / "right.cal"}


def fingertip(**changes: object) -> FingertipConfig:
    return FingertipConfig.model_validate({"device": {"path": "eit"}, **changes})


def bank_of_16_electrodes(tiny_bank: Path, path: Path) -> Path:
    whole, table = Bank.open(tiny_bank), ChannelTable(16, "adjacent")
    definition = BankDefinition(whole.geometry_hash, whole.model, whole.k_grid, whole.sigma_grid, table)
    signals = np.ascontiguousarray(whole.signals[..., : table.n_channels])
    homogeneous = np.ascontiguousarray(whole.homogeneous[: table.n_channels])
    write_bank(path, definition, homogeneous, whole.min_conductivity, whole.valid, signals)
    return path


def test_a_bank_of_another_kind_of_fingertip_is_refused_beside_a_calibration(files, tiny_bank, tmp_path):
    other = bank_of_16_electrodes(tiny_bank, tmp_path / "round.bank")
    with pytest.raises(BankError, match=r"round\.bank is the bank of another kind of fingertip: it has 208 channels"):
        open_session(fingertip(bank=other, calibration=files["right"]), "right")


def test_the_geometry_of_a_bank_is_logged_at_the_start(tiny_bank):
    config = DaemonConfig.model_validate({"fingertips": {"right": {"device": {"path": "eit"}, "bank": tiny_bank}}})
    with capture_logs() as logs:
        open_sessions(config)
    (entry,) = [log for log in logs if log["event"] == "the bank of right"]
    assert entry["geometry"] == Bank.open(tiny_bank).geometry_hash[:12]
    assert entry["channels"].startswith("896 channels of 32 electrodes")


def test_a_start_opens_the_bank_of_a_fingertip_once(tiny_bank, monkeypatch):
    config = DaemonConfig.model_validate({"fingertips": {"right": {"device": {"path": "eit"}, "bank": tiny_bank}}})
    opened, opens = [], Bank.open

    def counted(path: Path, *args: bool) -> Bank:
        opened.append(path)
        return opens(path, *args)

    monkeypatch.setattr(Bank, "open", counted)
    identity = daemon_identity(config, open_sessions(config).fingertips)
    assert opened == [tiny_bank]
    assert identity.metadata["bank_right"] == opens(tiny_bank).identity


def frame(
    number: int, channels: NDArray[np.float64], *, dead: NDArray[np.bool_] = NO_CHANNEL, repeated: bool = False
) -> Frame:
    t_ns = round(number * PERIOD_S * 1e9)
    return Frame(
        channels=channels, raw=np.zeros(1024), t_begin_ns=t_ns - 270_000_000, t_mid_ns=t_ns,
        t_arrival_ns=t_ns + 270_000_000,
        seq=number, saturated=NO_CHANNEL, dead=dead, repeated=repeated,
    )  # fmt: skip


def estimated(session: Session, *frames: Frame) -> Estimate:
    """Return the estimate of frames of one time."""
    return asyncio.run(estimate_frames(session, frames))


def torques(session: Session, played: FrameSeries, **flags: NDArray[np.bool_]) -> list[float | None]:
    """Return the torque of every pair, None where there is none."""
    found = []
    for number, pair in enumerate(played.channels):
        estimate = estimated(session, *(frame(number, channels, **flags) for channels in pair))
        assert estimate.valid == (estimate.torque_nm is not None)
        found.append(estimate.torque_nm)
    return found


def test_both_fingertips_together_follow_another_session(calibration):
    played = twisting(seed=3)
    found = torques(Session(calibration), played)
    truth = played.torque_at_frames()
    errors = [value - true for value, true in zip(found, truth, strict=True) if value is not None]
    assert len(errors) > 0.6 * len(found)
    assert np.sqrt(np.mean(np.square(errors))) < 0.005
    assert np.nanmax(truth) > 0.05


def test_a_tare_averages_the_frames_that_follow(calibration):
    played = twisting(seed=3)
    session = Session(calibration, baseline_frames=5)
    session.tare()
    for number in range(5):
        assert session.taring
        estimate = estimated(session, *(frame(number, channels) for channels in played.channels[number]))
        assert estimate.reasons == (f"taking the idle frame, {number + 1} of 5",)
    assert not session.taring
    assert any(value is not None for value in torques(session, played.between(5, len(played.t_s))))


def test_dead_channels_leave_the_rest_at_work_and_a_repeated_frame_is_refused(calibration):
    played = twisting(seed=4)
    dead = np.random.default_rng(0).uniform(size=896) < 0.1
    found = torques(Session(calibration), played, dead=dead)
    assert np.count_nonzero([value is not None for value in found]) > 0.6 * len(found)
    elsewhere = replace(played, channels=np.where(dead, 0.3, played.channels))
    again = torques(Session(calibration), elsewhere, dead=dead)
    assert again == found, "the values of dead channels do not matter"
    pair = [frame(0, channels, repeated=True) for channels in played.channels[0]]
    estimate = estimated(Session(calibration), *pair)
    assert estimate.reasons == ("the board sent the same frame again",)


def test_a_bank_adds_k_sigma_and_heatmaps(files, tiny_bank):
    tips = {side: fingertip(bank=str(tiny_bank), matching="zero_lag") for side in ("right", "left")}
    session = open_combined(CombinedConfig(calibration=files["combined"]), tips)
    played = twisting(seed=3)
    gripped = int((IDLE_S + 12.0) / PERIOD_S)
    for number in range(gripped):
        estimate = estimated(session, *(frame(number, channels) for channels in played.channels[number]))
    assert estimate.valid
    heatmap = session.heatmap()
    assert estimate.score == pytest.approx(np.nanmax(heatmap), abs=1e-6)


def test_a_frame_that_waited_behind_a_newer_one_has_a_torque_and_no_position(files, tiny_bank):
    """After a standstill the search of each old frame's position would delay the newest torque."""
    tips = {side: fingertip(bank=str(tiny_bank), matching="zero_lag") for side in ("right", "left")}
    prompt, late = (open_combined(CombinedConfig(calibration=files["combined"]), tips) for _ in range(2))
    played = twisting(seed=3)
    last = int((IDLE_S + 12.0) / PERIOD_S)
    read_ns = frame(last, NO_CHANNEL).t_arrival_ns
    for number in range(last - 7):
        for session in (prompt, late):
            estimated(session, *(frame(number, channels) for channels in played.channels[number]))
    for number in range(last - 7, last + 1):
        pair = [frame(number, channels) for channels in played.channels[number]]
        at_once = estimated(prompt, *pair)
        waited = estimated(late, *(replace(one, t_arrival_ns=read_ns) for one in pair))
        assert at_once.valid
        assert replace(waited, k=None, sigma=None, score=None, runner_up=None) == replace(
            at_once, k=None, sigma=None, score=None, runner_up=None
        )
        assert waited.k == (at_once.k if number == last else None)
    assert waited.k is not None


def test_the_calibration_decides_the_estimator(files):
    assert open_session(fingertip(calibration=files["right"]), "right").calibration.estimator.name == NAME
    tips = {"right": fingertip(), "left": fingertip()}
    combined = open_combined(CombinedConfig(calibration=files["combined"]), tips)
    assert combined.calibration.sides == ("right", "left")
    assert combined.search is None


def test_check_shows_the_assumptions(calibration, files, tmp_path):
    path, tips = tmp_path / "combined.cal", {"right": fingertip(), "left": fingertip()}
    replace(calibration, assumptions=("load timing",)).save(path)
    one_way = "no torque is negative, because its recordings have positive torques alone"
    delay = "the load cell's delay is as given (--load-cell-delay-s)"
    for file, said in ((path, f"{delay} and {one_way}"), (files["combined"], one_way)):
        assert _torque(open_combined(CombinedConfig(calibration=file), tips).calibration) == (
            f"with torque, assuming that {said}"
        )


def test_a_calibration_on_emulated_devices_is_refused_in_a_rig_of_real_ones(calibration, tmp_path):
    path = tmp_path / "combined.cal"
    tips = {"right": {"device": {"path": "right"}}, "left": {"device": {"path": "left"}}}
    content = {"fingertips": tips, "combined": {"calibration": str(path)}}
    for emulated in (True, False):
        replace(calibration, emulated=emulated).save(path)
        refuse_emulated_calibrations(DaemonConfig(**content, emulated=True))
    refuse_emulated_calibrations(DaemonConfig(**content))
    replace(calibration, emulated=True).save(path)
    with pytest.raises(UserError, match=r"combined\.cal was made from recordings of emulated devices"):
        refuse_emulated_calibrations(DaemonConfig(**content))


def test_check_and_log_say_where_the_strength_of_a_grip_is_not_checked(calibration, tmp_path):
    """A calibration's file of version 0.3.0 does not hold it."""
    path, tips = tmp_path / "combined.cal", {"right": fingertip(), "left": fingertip()}
    replace(calibration, validators=tuple(replace(one, strength=None) for one in calibration.validators)).save(path)
    session = open_combined(CombinedConfig(calibration=path), tips)
    assumed = "assuming that every grip is about as strong as in the calibration, because the file does not hold"
    assert assumed in _torque(session.calibration)
    with capture_logs() as logs:
        log_assumptions({"combined": session})
    (line,) = logs
    assert line["log_level"] == "warning"
    assert "the calibration of combined assumes that every grip is about as strong" in line["event"]


@pytest.mark.parametrize(
    ("open_it", "sentence"),
    [
        (lambda f: open_session(fingertip(calibration=f["right"]), "left"), "fingertip, not of left"),
        (lambda f: open_session(fingertip(calibration=f["combined"]), "right"), "of both under `combined`"),
        (lambda f: open_session(fingertip(calibration=f["right"], estimator="bank"), "right"), f"estimator {NAME}"),
        (lambda _: open_session(fingertip(estimator=NAME), "right"), "none is configured"),
        (lambda _: open_session(fingertip(estimator=NAME, calibration="no.cal"), "right"), "no.cal does not"),
        (lambda _: open_session(fingertip(estimator=NAME, calibration="c" * 300), "right"), "ccc does not exist"),
        (lambda _: open_session(fingertip(calibration=__file__), "right"), "calibrate again"),
        (lambda _: open_session(fingertip(), "right"), "right has no calibration and no bank: add `calibration:` for"),
        (lambda _: open_session(fingertip(estimator="paper"), "right"), "needs a bank; add `bank:`"),
        (lambda f: open_combined(CombinedConfig(calibration=f["combined"]), {"right": fingertip()}), "of both, and"),
    ],
)  # fmt: skip
def test_a_configuration_that_does_not_fit_is_refused(open_it, sentence, files):
    with pytest.raises((UserError, BankError), match=sentence):
        open_it(files)
