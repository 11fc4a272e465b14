"""`calibrate creep`: from recordings of held twists to the line of the configuration."""

from types import SimpleNamespace

import numpy as np
import pytest

from shearloop.bank.estimation import Estimate, FrameSeries
from shearloop.daemon.analysis.creep import grips_of
from shearloop.daemon.analysis.evaluate import EstimateTrack
from shearloop.daemon.config import CreepConfig
from tests.daemon.analysis.test_creep import twisted


def track(valid: np.ndarray | None = None) -> EstimateTrack:
    """Return estimates that see the shear of the rig's gel, beside its torque."""
    times, shears, torques = twisted(600.0, 0.002)
    valid = np.ones(times.size, bool) if valid is None else valid
    nothing = np.full(times.size, np.nan)
    series = FrameSeries("raw", ("right",), times, np.zeros((times.size, 1, 896)), times, torques, nothing)
    estimates = [
        Estimate(valid=True, torque_nm=float(shear), torque_low_nm=shear - 0.01, torque_high_nm=shear + 0.01)
        if good
        else Estimate(valid=False)
        for shear, good in zip(shears, valid, strict=True)
    ]
    return EstimateTrack(series, tuple(estimates), np.zeros(times.size))


def test_a_grip_is_a_stretch_of_torques_and_single_frames_do_not_end_it():
    valid = np.ones(1109, bool)
    valid[[3, 500]] = False
    valid[200:230] = valid[:2] = False
    first, second = grips_of(track(valid))
    assert (first.t_s.size, second.t_s.size) == (200 - 3, 1109 - 230 - 1)
    assert np.isfinite(first.shear_nm).all()
    np.testing.assert_array_equal(first.t_s[:2], track().series.t_s[[2, 4]])


def played(monkeypatch: pytest.MonkeyPatch, found: EstimateTrack) -> None:
    """Have every recording and every calibration give these estimates."""
    loaded = SimpleNamespace(sides=("right",), kind="raw")
    monkeypatch.setattr("shearloop.bank.estimation.Calibration.load", lambda _: loaded)
    monkeypatch.setattr("shearloop.daemon.analysis.frame_series.read_series", lambda *_: [found.series])
    monkeypatch.setattr("shearloop.daemon.analysis.evaluate.estimate_series", lambda *_: found)


def test_it_prints_the_line_of_the_configuration(monkeypatch, ran, tmp_path, result_of):
    found = track()
    played(monkeypatch, found)
    arguments = ["calibrate", "creep", str(tmp_path / "held.mcap"), "--calibration", "right.cal"]
    result = result_of(*arguments)
    assert result["share"] == pytest.approx(0.08, abs=0.02)
    assert (result["grips"], result["frames"]) == (1, 1109)
    assert result["time_s"] == pytest.approx(20.0, rel=0.5)
    assert result["error_after_nm"] == pytest.approx(0.002, rel=0.15)
    assert result["error_before_nm"] > 1.1 * result["error_after_nm"]
    line, followed, beside = ran(*arguments).out.splitlines()
    assert f"scaled by {result['scale']:.3f} and shifted by {1e3 * result['offset_nm']:+.1f} mN·m, follow" in followed
    assert "does not correct scale and zero" in beside
    assert line == f"creep: {{share: {result['share']:g}, time_s: {result['time_s']:g}}}"
    CreepConfig(share=result["share"], time_s=result["time_s"])


def test_a_recording_without_held_twists_is_refused(monkeypatch, mistake):
    found = track(np.arange(1109) < 10)
    played(monkeypatch, found)
    said = mistake("calibrate", "creep", "held.mcap", "--calibration", "right.cal")
    assert "too few readings for a fit: 10; hold a twist for a minute" in said


def test_twists_that_are_given_twice_are_refused(monkeypatch, mistake):
    played(monkeypatch, track())
    refusals = {"held.mcap": "is given twice; name it once", "copy.mcap": "equals held.mcap"}
    for copy, refusal in refusals.items():
        assert f"{copy} {refusal}" in mistake("calibrate", "creep", "held.mcap", copy, "--calibration", "right.cal")
