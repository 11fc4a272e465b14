"""Sweeps of faults: their first level is no fault, they know what breaks silently, and the fix of the hops holds."""

import json
from dataclasses import replace

import numpy as np
import pytest

from shearloop.errors import UserError
from shearloop.estimation import Estimate, Physics, Session
from shearloop.studies.charts import fault_sweeps, stability
from shearloop.studies.charts.chart_data import Split, fitted
from shearloop.studies.slices.evaluate import estimate_slices
from shearloop.studies.slices.fitting import fit_slices
from shearloop.tools.figures import figures_of
from shearloop.tools.parallel import SerialExecutor


def estimate(torque: float, half: float = 0.01) -> Estimate:
    return Estimate(valid=True, torque_nm=torque, torque_low_nm=torque - half, torque_high_nm=torque + half)


def test_figures_count_what_is_valid_and_wrong():
    truth = np.array([0.1, 0.1, 0.1, 0.1, np.nan])
    found = fault_sweeps.judge_level(
        [estimate(0.105), estimate(0.145), Estimate(valid=False), estimate(0.1), estimate(9.0)], truth, 2.0
    )
    assert found.valid == 0.75
    assert found.false_valid == 0.25
    assert found.bias_nm == pytest.approx(0.05 / 3)
    curve = fault_sweeps.fault_curve("fault", "unit", "motion_regression", [fault_sweeps.FaultLevel(0.0), found])
    assert curve.breaks_at == 2.0


@pytest.mark.parametrize(
    ("levels", "expected"), [((-0.5, -0.2, 0.0, 0.1, 0.5), 0.1), ((0.6, 0.4, 0.2), 0.6), ((1.0, 2.0), 1.0)]
)
def test_an_estimator_breaks_at_the_mildest_level_in_either_direction(levels, expected):
    wrong = [fault_sweeps.FaultLevel(level, 0.0, 0.0, 1.0, 0.5 if level else 0.0) for level in levels]
    assert fault_sweeps.fault_curve("fault", "unit", "motion_regression", wrong).breaks_at == expected


def test_a_stream_is_judged_by_as_many_loaded_frames_as_free_ones():
    truth = np.r_[np.zeros(90), np.full(10, 0.1)]
    kept = fault_sweeps.balanced(truth)
    assert np.isfinite(kept).sum() == 20
    assert np.isfinite(kept[90:]).all()


@pytest.mark.parametrize("fault", fault_sweeps.FAULTS, ids=lambda fault: fault.name)
@pytest.mark.parametrize("kind", ["slices", "stream"])
def test_every_sweep_begins_with_no_fault_and_then_changes_the_frames(fault, kind, bank, request):
    scene = fault_sweeps.scene_for(request.getfixturevalue(kind), bank)
    none, most = (fault.apply(scene, one, np.random.default_rng(1))[0] for one in (fault.levels[0], fault.levels[-1]))
    np.testing.assert_array_equal(none.channels, scene.series.channels)
    assert not np.array_equal(most.channels, scene.series.channels)
    if kind == "slices":
        assert (most.channels >= 0).all()


def test_an_electrode_touches_its_own_injections_and_pairs():
    assert 28 * 2 < fault_sweeps.lost_channels(np.array([3])).sum() < 28 * 5


def test_unreported_lost_electrodes_never_pass_silently(stream, bank):
    (calibration,) = fitted(stream, ("regression",), Physics(bank, None))
    scene = fault_sweeps.scene_for(stream, bank)
    lost = next(fault for fault in fault_sweeps.FAULTS if fault.name == "lost electrodes, unreported")
    found = fault_sweeps.sweep(Session(calibration, bank), scene, lost)
    assert found.levels[0].valid > 0.7
    assert found.breaks_at is None
    assert found.levels[-1].valid == 0.0


@pytest.mark.usefixtures("fonts")
def test_the_mean_of_similar_cells_does_not_hop_and_the_rims_are_swept(slices, bank, scratch):
    calibrations = fitted(slices, ("bank", "motion_regression"), Physics(bank, None))
    found = stability.walks(slices, bank, calibrations)
    paper, alone, mean = (one.largest_hop_nm for one in found[:3])
    assert mean < 0.5 * min(paper, alone)
    rims = list(stability.sweep_rims(calibrations, bank, scratch))
    assert {one.estimator for one in rims} == {"bank", "motion_regression"}
    assert all(one.levels[0].valid > 0.5 for one in rims)
    for figure in (stability.sweeps_figure("rims", rims), stability.continuity_figure("slices", found)):
        assert len(figure.axes) >= 2
    assert json.dumps([one.hops for one in found])


def test_a_calibration_on_shifted_times_is_named_as_shifted_by_the_chart(slices, monkeypatch):
    titles = []
    monkeypatch.setattr(fault_sweeps, "fitted", lambda split, *_: titles.append(split.title) or [])
    [curve] = fault_sweeps.misaligned(slices, ["motion_regression"], None, (-0.27, 0.54))
    assert [title.removeprefix(slices.title) for title in titles] == [
        ", torques that this chart shifted by -0.27 s",
        ", torques that this chart shifted by +0.54 s",
    ]
    assert [level.valid for level in curve.levels] == [0.0, 0.0]


def test_a_recording_that_no_estimator_can_be_calibrated_on_is_one_sentence(
    slices, bank, coarse_mesh, tmp_path, capsys
):
    one = replace(slices, past=slices.past.between(0, 1))
    with pytest.raises(UserError, match="no estimator can be calibrated on it"):
        stability.chart([one], bank, coarse_mesh, tmp_path, tmp_path, SerialExecutor())
    assert "motion_regression is left out" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("torque_nm", "smaller_nm", "larger_nm"),
    [
        (np.random.default_rng(3).permutation(np.linspace(0.0, 0.1, 101)), [8, 6.5, 5, 4, 3], [2, 3.5, 5, 6, 7]),
        # Of few torques each limit is there once, and none leaves nothing to judge.
        (np.repeat([0.02, 0.06, 0.1], [20, 2, 40]), [2], [6, 10]),
    ],
)
def test_limits_are_quantiles_and_each_slice_is_either_calibrated_on_or_judged(torque_nm, smaller_nm, larger_nm):
    found = stability.calibration_parts(torque_nm)
    for which, sign, expected in ((stability.SMALLER, 1, smaller_nm), (stability.LARGER, -1, larger_nm)):
        assert [100 * limit_nm for limit_nm, _ in found[which]] == pytest.approx(expected)
        for limit_nm, judged in found[which]:
            assert (sign * torque_nm[~judged]).max() == sign * limit_nm
            assert (sign * torque_nm[judged] > sign * limit_nm).all()


def test_an_estimator_is_calibrated_on_some_torques_and_judged_on_the_others(slices, bank, monkeypatch, capsys):
    # A twentieth is too few for an estimator.
    monkeypatch.setattr(stability, "CALIBRATED_FRACTIONS", (0.5, 0.05))
    some = slices.whole.between(0, 40)
    # A slice of unknown torque is in neither part.
    torque_nm = some.torque_nm.copy()
    torque_nm[3] = np.nan
    whole = replace(some, torque_nm=torque_nm)
    split = Split("slices", whole.between(0, 30), whole.between(30, 40), whole)
    found = stability.extrapolate(split, ("regression",), bank, None, SerialExecutor())
    assert [one.curve.fault for one in found] == [stability.SMALLER, stability.LARGER]
    assert capsys.readouterr().out.count("is left out") == 2
    known = np.delete(np.arange(40), 3)
    torque_nm = whole.torque_nm[known]
    for one in found:
        limit = one.curve.levels[1].level
        inside = (torque_nm <= limit) if one.curve.fault == stability.SMALLER else (torque_nm >= limit)
        assert limit == pytest.approx(np.median(torque_nm), abs=0.001)
        assert one.slices[:2] == (29, inside.sum())
        for level, width_nm, past, future in (
            (one.curve.levels[0], one.width_nm[0], known[:29], known[29:]),
            (one.curve.levels[1], one.width_nm[1], known[inside], known[~inside]),
        ):
            track = estimate_slices(
                fit_slices("regression", [stability.select_rows(some, past)], "", Physics()),
                stability.select_rows(some, future),
            )
            figures = figures_of([track])
            assert level.valid == figures["valid_fraction"]
            assert level.bias_nm == pytest.approx(figures["bias_nm"])
            assert level.false_valid == pytest.approx(level.valid * (1 - figures["coverage_95"]))
            widths = [each.torque_high_nm - each.torque_low_nm for each in track.estimates if each.valid]
            assert width_nm == pytest.approx(np.median(widths))
        assert one.times_good[:2] == (1.0, one.width_nm[1] / one.width_nm[0])
        assert one.curve.levels[2] == fault_sweeps.FaultLevel(one.curve.levels[2].level)
        assert one.width_nm[2] is one.times_good[2] is None


@pytest.mark.usefixtures("fonts")
def test_the_picture_marks_what_breaks_and_writes_how_many_slices_were_calibrated_on():
    levels = [
        fault_sweeps.FaultLevel(limit, 0.0, 0.01, 1.0, missed)
        for limit, missed in ((0.14, 0.0), (0.08, 0.1), (0.05, 0.9))
    ]
    found = [
        stability.Extrapolation(fault_sweeps.fault_curve(which, "N·m", name, levels), (29, 24, 14), (0.08, 0.04, None))
        for which in (stability.SMALLER, stability.LARGER)
        for name in ("motion_regression", "bank")
    ]
    made = stability.extrapolation_figure("slices", found)
    assert len(made.axes) == 8
    for false, widths in zip(made.axes[2::4], made.axes[3::4], strict=True):
        crosses = [line for line in false.lines if line.get_marker() == "x"]
        assert [line.get_ydata()[0] for line in crosses] == [0.9, 0.9]
        drawn = [line.get_ydata() for line in widths.lines if len(line.get_ydata()) == 3]
        np.testing.assert_array_equal(drawn, [[1.0, 0.5, np.nan]] * 2)
        assert [tick.get_text() for tick in widths.get_xticklabels()] == ["all\n29", "0.080\n24", "0.050\n14"]
