"""The gel's creep: its fit, and `calibrate creep` from recordings of held twists to the configuration's line."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from shearloop.daemon.config import CreepConfig
from shearloop.daemon.control.creep import Creep
from shearloop.emulators.scene import Twin, TwinSettings
from shearloop.errors import UserError
from shearloop.estimation import Estimate, FrameSeries
from shearloop.estimation.learned_frames import LearnedFrames
from shearloop.tools.creep import Stretch, fit_creep, grips_of
from shearloop.tools.estimate_tracks import EstimateTrack

PERIOD_S = 0.5412


def twisted(for_s: float, noise_nm: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, shears and torques of the rig's gel, twisted for 40 s of each minute."""
    twin = Twin(TwinSettings(hysteresis_rad=0.0))
    times = np.arange(0.0, for_s, PERIOD_S)
    states = [twin.step(PERIOD_S, 0.15 if t_s % 60 < 40 else 0.0, 60.0) for t_s in times]
    noise = np.random.default_rng(0).normal(0.0, noise_nm, times.size)
    shears = np.array([state.shear_torque_nm for state in states]) + noise
    return times, shears, np.array([state.torque_nm for state in states])


def test_without_noise_the_torque_of_the_rigs_gel_comes_back_from_its_shear():
    times, shears, torques = twisted(120.0)
    creep = Creep(0.08, 20.0)
    found = [creep.torque_nm(shear, round(t_s * 1e9)) for t_s, shear in zip(times, shears, strict=True)]
    assert np.abs(shears - torques).max() > 0.006
    np.testing.assert_allclose(found, torques, atol=4e-4)


@pytest.mark.long
def test_noise_shifts_neither_the_time_nor_the_scale_but_widens_what_is_found():
    """Fitted the other way round, torque to readings, 12 mN·m of noise make 20 s 50 s and the scale 0.95."""
    times, shears, torques = twisted(900.0)
    random = np.random.default_rng(5)
    found = [fit_creep([Stretch(times, shears + random.normal(0, 0.012, times.size), torques)]) for _ in range(8)]
    assert np.median([one.creep.time_s for one in found]) == pytest.approx(20.0, rel=0.3)
    assert np.mean([one.creep.share for one in found]) == pytest.approx(0.08, abs=0.02)
    assert np.mean([one.scale for one in found]) == pytest.approx(1.0, abs=0.015)


def test_a_wrong_scale_of_the_estimator_is_not_taken_for_creep():
    times, shears, torques = twisted(600.0)
    found = fit_creep([Stretch(times, 1.1 * shears, torques)])
    assert found.creep.share == pytest.approx(0.08, abs=0.005)
    assert found.creep.time_s == pytest.approx(20.0, rel=0.1)
    assert (found.scale, found.offset_nm) == (pytest.approx(1 / 1.1, rel=0.01), pytest.approx(0.0, abs=1e-4))
    # The error is that of the scaled estimates, in N·m of torque.
    noise = np.random.default_rng(5).normal(0, 0.01, times.size)
    once, twice = (fit_creep([Stretch(times, factor * (shears + noise), torques)]) for factor in (1.0, 2.0))
    assert twice.after_nm == pytest.approx(once.after_nm, rel=1e-6)
    assert twice.before_nm == pytest.approx(once.before_nm, rel=1e-6)
    assert once.after_nm == pytest.approx(0.01, rel=0.1)
    # Taken as right, it looks like a creep that is faster than any gel's.
    with pytest.raises(UserError, match="by 2 s or less, and a gel creeps for longer"):
        fit_creep([Stretch(times, 1.1 * shears, torques)], scale_is_right=True)


@pytest.mark.long
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_the_interval_of_the_time_constant_holds_the_true_one(correlation):
    """Also where an estimator's error is slow, so that neighbouring frames say nearly the same."""
    times, shears, torques = twisted(300.0)
    random = np.random.default_rng(1)
    held, intervals = 0, []
    for _ in range(40):
        noise = random.normal(0, 0.002, times.size)
        for index in range(1, times.size):
            noise[index] = correlation * noise[index - 1] + np.sqrt(1 - correlation**2) * noise[index]
        try:
            low_s, high_s = fit_creep([Stretch(times, shears + noise, torques)]).time_range_s
        except UserError:
            # The interval had no end.
            continue
        held += low_s <= 20.0 <= high_s
        intervals.append(high_s / low_s)
    assert len(intervals) >= 20
    assert held >= 0.85 * len(intervals)
    assert np.median(intervals) < (5.0 if correlation else 2.0)


def test_holds_that_do_not_tell_the_time_constant_are_refused():
    """A creep of 60 s in holds of 10 s looks like any other that is slow."""
    twin = Twin(TwinSettings(hysteresis_rad=0.0, relaxation_s=60.0))
    times = np.arange(0.0, 100.0, PERIOD_S)
    states = [twin.step(PERIOD_S, 0.15 if t_s % 20 < 10 else 0.0, 60.0) for t_s in times]
    shears = np.array([state.shear_torque_nm for state in states])
    torques = np.array([state.torque_nm for state in states])
    noise = np.random.default_rng(4).normal(0, 0.003, times.size)
    with pytest.raises(UserError, match=r"do not tell how fast the gel creeps: time constants from \d+ s to \d+ s"):
        fit_creep([Stretch(times, shears + noise, torques)])


@pytest.mark.parametrize(("fingertip_nm", "load_cell_nm"), [(0.02, 0.0), (0.0, 0.005)])
def test_several_grips_give_the_same_creep_and_a_wrong_zero_hardly_changes_it(fingertip_nm, load_cell_nm):
    """The load cell's zero was taken when the recording began; a fingertip's may be far off."""
    times, shears, torques = twisted(300.0)
    found = fit_creep([Stretch(t_s, shears + fingertip_nm, torques + load_cell_nm) for t_s in (times, times + 1e4)])
    # What a gel would have crept under the zero's own torque is in it.
    assert found.offset_nm == pytest.approx(load_cell_nm - fingertip_nm, rel=0.08)
    assert found.creep.share == pytest.approx(0.08, abs=0.005)
    assert found.creep.time_s == pytest.approx(20.0, rel=0.1)


def test_a_new_grip_finds_the_gel_at_rest():
    creep = Creep(0.1, 5.0)
    for second in range(60):
        creep.torque_nm(0.1, second * 10**9)
    assert creep.torque_nm(0.0, 60 * 10**9) < -0.008
    creep.reset()
    assert creep.torque_nm(0.05, 61 * 10**9) == 0.05


def test_what_is_no_creep_is_refused():
    times, shears, torques = twisted(120.0)
    with pytest.raises(UserError, match="does not fall behind"):
        fit_creep([Stretch(times, torques, shears)])
    noise = np.random.default_rng(3).normal(0.0, 2.0 * torques.std(), times.size)
    with pytest.raises(UserError, match="the calibration does not fit these recordings"):
        fit_creep([Stretch(times, shears + noise, torques)])
    with pytest.raises(UserError, match="at the end of the recording"):
        fit_creep([Stretch(times, shears, shears - 0.01 * np.cumsum(shears) / shears.size)])


def track(valid: np.ndarray | None = None) -> EstimateTrack:
    """Return estimates that see the shear of the rig's gel, beside its torque."""
    times, shears, torques = twisted(600.0, 0.002)
    valid = np.ones(times.size, bool) if valid is None else valid
    nothing = np.full(times.size, np.nan)
    series = FrameSeries(("right",), times, np.zeros((times.size, 1, 896)), times, torques, nothing)
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


def played(monkeypatch: pytest.MonkeyPatch, found: EstimateTrack, *, learned: bool = False) -> None:
    """Have every recording and calibration give these estimates; `learned`: the calibration is of their frames."""
    loaded = SimpleNamespace(sides=("right",), learned=LearnedFrames.of([found.series.channels] if learned else []))
    monkeypatch.setattr("shearloop.cli.calibrate.creep.judges_slices", lambda *_: False)
    monkeypatch.setattr("shearloop.estimation.Calibration.load", lambda _: loaded)
    monkeypatch.setattr("shearloop.tools.frame_series.read_series", lambda *_: [found.series])
    monkeypatch.setattr("shearloop.tools.estimate_tracks.estimate_series", lambda *_: found)


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
    line, between, followed, beside = ran(*arguments).out.splitlines()
    low_s, high_s = result["time_range_s"]
    assert low_s < result["time_s"] < high_s < 2.0 * low_s
    assert between == f"The time constant lies between {low_s} s and {high_s} s (95 % interval)."
    assert f"scaled by {result['scale']:.3f} and shifted by {1e3 * result['offset_nm']:+.1f} mN·m, follow" in followed
    assert "does not correct scale and zero" in beside
    assert line == f"creep: {{share: {result['share']:g}, time_s: {result['time_s']:g}}}"
    CreepConfig(share=result["share"], time_s=result["time_s"])


def test_frames_that_the_calibration_has_learned_from_are_named(monkeypatch, ran):
    played(monkeypatch, track(), learned=True)
    said = ran("calibrate", "creep", "held.mcap", "--calibration", "right.cal").out
    assert "the calibration has learned from 1109 of 1109 judged frames of held.mcap" in said


def test_a_recording_without_held_twists_is_refused(monkeypatch, mistake):
    found = track(np.arange(1109) < 10)
    played(monkeypatch, found)
    said = mistake("calibrate", "creep", "held.mcap", "--calibration", "right.cal")
    assert "too few readings for a fit: 10; hold a twist for a minute" in said


def test_another_tool_is_named_instead_of_too_few_readings(monkeypatch, mistake):
    nothing = replace(track(np.zeros(1109, bool)), why_no_torque="the tool has 40 mm, and the calibration 30 mm")
    played(monkeypatch, nothing)
    said = mistake("calibrate", "creep", "held.mcap", "--calibration", "right.cal")
    assert "creep: no frame has an estimate: the tool has 40 mm, and the calibration 30 mm; give recordings" in said


def test_twists_that_are_given_twice_are_refused(monkeypatch, mistake):
    played(monkeypatch, track())
    refusals = {"held.mcap": "held.mcap is given twice; name it once", "copy.mcap": "of copy.mcap are in held.mcap too"}
    for copy, refusal in refusals.items():
        assert refusal in mistake("calibrate", "creep", "held.mcap", copy, "--calibration", "right.cal")
