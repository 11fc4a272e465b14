"""Torques beyond the calibrated ones: the parts to calibrate on, their results and the picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.estimation import FrameSeries, Physics, fit
from shearloop.daemon.analysis.charts import slice_stability
from shearloop.daemon.analysis.charts.fault_sweeps import FaultLevel, fault_curve
from shearloop.daemon.analysis.charts.slice_stability import (
    LARGER,
    SMALLER,
    Extrapolation,
    calibration_parts,
    extrapolate,
    select_rows,
)
from shearloop.daemon.analysis.charts.sources import Split, bank_of, own_fingertip, splits
from shearloop.daemon.analysis.charts.stability import extrapolation_figure
from shearloop.daemon.analysis.evaluate import estimate_series, figures_of
from shearloop.daemon.analysis.reproduce.banks import Grid
from shearloop.daemon.workers import SerialExecutor


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("extrapolation")


@pytest.fixture(scope="module")
def slices(scratch: Path) -> FrameSeries:
    return next(one.whole for one in splits([], 0.6, scratch) if one.past.kind == "difference")


@pytest.fixture(scope="module")
def bank(scratch: Path) -> Bank:
    return bank_of(
        None, own_fingertip(0.4).mesh(), scratch, Grid(np.linspace(3.0, 3.6, 5), np.linspace(1.0, 2.1, 8))
    )  # fmt: skip


def test_limits_are_quantiles_and_each_slice_is_either_calibrated_on_or_judged() -> None:
    torque_nm = np.random.default_rng(3).permutation(np.linspace(0.0, 0.1, 101))
    found = calibration_parts(torque_nm)
    assert [part.limit_nm for part in found[SMALLER]] == pytest.approx([0.08, 0.065, 0.05, 0.04, 0.03])
    assert [part.limit_nm for part in found[LARGER]] == pytest.approx([0.02, 0.035, 0.05, 0.06, 0.07])
    for which, sign in ((SMALLER, 1), (LARGER, -1)):
        for part in found[which]:
            assert sorted([*part.fitted, *part.others]) == list(range(101))
            assert (sign * torque_nm[part.fitted]).max() == sign * part.limit_nm
            assert (sign * torque_nm[part.others] > sign * part.limit_nm).all()


def test_of_few_torques_each_limit_is_there_once_and_none_leaves_nothing_to_judge() -> None:
    found = calibration_parts(np.repeat([0.02, 0.06, 0.1], [20, 2, 40]))
    assert [part.limit_nm for part in found[SMALLER]] == [0.02]
    assert [part.limit_nm for part in found[LARGER]] == [0.06, 0.1]


def test_chosen_slices_keep_their_own_torques(slices: FrameSeries) -> None:
    rows = np.array([1, 7, 8, 30])
    chosen = select_rows(slices, rows)
    np.testing.assert_array_equal(chosen.torque_at_frames(), slices.torque_at_frames()[rows])
    np.testing.assert_array_equal(chosen.channels, slices.channels[rows])


@pytest.mark.usefixtures("few_mixtures")
def test_an_estimator_is_calibrated_on_some_torques_and_judged_on_the_others(
    slices: FrameSeries, bank: Bank, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # A twentieth is too few for an estimator.
    monkeypatch.setattr(slice_stability, "CALIBRATED_SHARES", (0.5, 0.05))
    some = slices.between(0, 40)
    # A slice of unknown torque is in neither part.
    torque_nm = some.torque_nm.copy()
    torque_nm[3] = np.nan
    whole = replace(some, torque_nm=torque_nm)
    split = Split("slices", whole.between(0, 30), whole.between(30, 40), whole)
    found = extrapolate(split, ("regression",), bank, None, SerialExecutor())
    assert [one.curve.fault for one in found] == [SMALLER, LARGER]
    assert capsys.readouterr().out.count("is left out") == 2
    known = np.delete(np.arange(40), 3)
    torque_nm = whole.torque_nm[known]
    for one in found:
        limit = one.curve.levels[1].level
        inside = (torque_nm <= limit) if one.curve.fault == SMALLER else (torque_nm >= limit)
        assert limit == pytest.approx(np.median(torque_nm), abs=0.001)
        assert one.slices[:2] == (29, inside.sum())
        for level, width_nm, past, future in (
            (one.curve.levels[0], one.width_nm[0], known[:29], known[29:]),
            (one.curve.levels[1], one.width_nm[1], known[inside], known[~inside]),
        ):
            track = estimate_series(
                fit("regression", [select_rows(slices, past)], "", Physics()), select_rows(slices, future)
            )
            figures = figures_of([track])
            assert level.valid == figures["valid_fraction"]
            assert level.bias_nm == pytest.approx(figures["bias_nm"])
            assert level.false_valid == pytest.approx(level.valid * (1 - figures["coverage_95"]))
            widths = [each.torque_high_nm - each.torque_low_nm for each in track.estimates if each.valid]
            assert width_nm == pytest.approx(np.median(widths))
        assert one.times_good[:2] == (1.0, one.width_nm[1] / one.width_nm[0])
        assert one.curve.levels[2] == FaultLevel(one.curve.levels[2].level, None, None, 0.0, 0.0)
        assert one.width_nm[2] is one.times_good[2] is None


@pytest.mark.usefixtures("fonts")
def test_the_picture_marks_what_breaks_and_writes_how_many_slices_were_calibrated_on() -> None:
    levels = [FaultLevel(limit, 0.0, 0.01, 1.0, missed) for limit, missed in ((0.14, 0.0), (0.08, 0.1), (0.05, 0.9))]
    found = [
        Extrapolation(fault_curve(which, "N·m", name, levels), (29, 24, 14), (0.08, 0.04, None))
        for which in (SMALLER, LARGER)
        for name in ("motion_regression", "bank")
    ]
    made = extrapolation_figure("slices", found)
    assert len(made.axes) == 8
    for false, widths in zip(made.axes[2::4], made.axes[3::4], strict=True):
        crosses = [line for line in false.lines if line.get_marker() == "x"]
        assert [line.get_ydata()[0] for line in crosses] == [0.9, 0.9]
        drawn = [line.get_ydata() for line in widths.lines if len(line.get_ydata()) == 3]
        np.testing.assert_array_equal(drawn, [[1.0, 0.5, np.nan]] * 2)
        assert [tick.get_text() for tick in widths.get_xticklabels()] == ["all\n29", "0.080\n24", "0.050\n14"]
