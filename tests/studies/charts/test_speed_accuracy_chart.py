"""The charts on small synthetic recordings, and the errors of their command."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.text import Annotation, Text

from shearloop.bank.channels import PAPER_TABLE
from shearloop.cli.chart import NAMES
from shearloop.estimation import FrameSeries, Physics
from shearloop.studies.charts import scene
from shearloop.studies.charts.chart_data import Split, fitted, own_fingertip, splits, synthetic_stream
from shearloop.studies.charts.forward_methods import converged, direct, error_of, forward_methods
from shearloop.studies.charts.simulated_loop import tracking_errors
from shearloop.studies.charts.speed_accuracy import (
    MeasuredMethod,
    TorqueMethod,
    _draw_methods,
    _short,
    compare_methods,
    estimators,
    loaded_truth,
    measure,
    often_valid,
    write,
)
from shearloop.studies.slices.series import SliceSeries
from shearloop.tools.drawing import figure, frontier, lay_out, plain_log, write_names
from shearloop.tools.estimate_tracks import estimate_series, values_of
from shearloop.tools.parallel import SerialExecutor


def test_the_frontier_is_what_nothing_beats_in_both():
    assert frontier([1.0, 2.0, 3.0, 4.0, 2.5], [9.0, 5.0, 6.0, 1.0, 5.0]) == [0, 1, 3]
    assert frontier([1.0, 1.0], [2.0, 1.0]) == [1], "of equally fast ones the more accurate"


def test_a_method_with_few_valid_frames_is_not_on_the_frontier(slices):
    methods = [
        MeasuredMethod(name, name, cost, cost, cost, error, valid)
        for name, cost, error, valid in (
            ("rare", 1.0, 0.001, 0.32),
            ("often", 2.0, 0.01, 0.60),
            ("most", 3.0, 0.005, 0.65),
        )
    ]
    axes = figure(5, 5).add_subplot()
    _draw_methods(axes, slices, methods)
    filled = [mark.lines[0].get_markerfacecolor() != "white" for mark in axes.containers]
    assert filled == [False, True, True]
    assert [_short(one, i in often_valid(methods)) for i, one in enumerate(methods)] == [
        "rare (32% valid)",
        "often",
        "most",
    ]


def test_frames_without_load_do_not_flatter_a_method_that_says_0():
    t, torque_nm = np.arange(100.0), np.where(np.arange(100) < 4, 0.1, 0.001)
    series = FrameSeries(("right",), t, np.zeros((100, 1, 896)), t, torque_nm, np.full(100, np.nan))
    estimated = np.where(np.arange(100) == 0, np.nan, 0.0)
    (found,) = measure([TorqueMethod("zero", "any", lambda: (estimated, np.ones(100)))], loaded_truth(series), 1)
    assert (found.rmse_nm, found.valid_fraction) == (pytest.approx(0.1), 0.75)


def test_a_recording_of_a_known_tool_is_judged_and_one_without_torques_is_named(scratch, stream, monkeypatch, capsys):
    known = replace(stream.whole, diameter_mm=np.full(len(stream.whole.t_s), 20.0))
    empty = replace(stream.whole, torque_t_s=np.zeros(0), torque_nm=np.zeros(0))
    recorded = {"known.mcap": [known], "empty.mcap": [empty]}
    monkeypatch.setattr("shearloop.studies.charts.chart_data.read_series", lambda path: recorded[str(path)])
    [split] = splits([Path(name) for name in recorded], 0.6, scratch)
    assert split.title.startswith("known.mcap, stream")
    assert capsys.readouterr().out == "empty.mcap is left out: it holds no torques of a load cell\n"


def test_an_estimator_has_seen_the_grip_begin_before_the_later_frames(stream, bank, coarse_mesh):
    """`evaluate` reads a recording from its beginning too."""
    later = len(stream.future.t_s)
    method = next(estimators(stream, Physics(bank, coarse_mesh), stream.past.sides))
    torque_nm, latency_ms = method.run()
    assert len(torque_nm) == len(latency_ms) == later
    (calibration, *_) = fitted(stream, [method.name.partition(",")[0]], Physics(bank, coarse_mesh), stream.past.sides)
    whole_nm = values_of(estimate_series(calibration, stream.whole, bank).estimates)[0]
    np.testing.assert_array_equal(torque_nm, whole_nm[-later:])


def test_synthetic_frames_are_split_in_time_and_the_same_each_time(scratch, slices, stream):
    assert slices.past.t_s[-1] < slices.future.t_s[0]
    assert len(slices.past.t_s) + len(slices.future.t_s) == 49
    # The judged part of a stream begins with frames that only fill the memory.
    assert stream.future.t_s[0] < stream.past.t_s[-1]
    again = synthetic_stream(scratch)
    np.testing.assert_array_equal(again.channels[: len(stream.past.t_s)], stream.past.channels)


def test_errors_fall_with_the_mesh_size_towards_the_extrapolated_signals():
    meshes = [own_fingertip(size).mesh() for size in (0.2, 0.1, 0.05)]
    truth = converged(meshes[1], meshes[2], 2.0)
    errors = [error_of(direct(mesh)(), truth) for mesh in meshes]
    assert errors[0] > 1.5 * errors[1] > 2.0 * errors[2] > 0


@pytest.mark.usefixtures("fonts")
def test_the_speed_accuracy_chart_holds_every_method_with_its_ratio(parts, bank, coarse_mesh, tmp_path):
    compared = [(split, compare_methods(split, bank, coarse_mesh, 1)) for split in parts]
    solved, loop = forward_methods(1, None, (0.4, 0.2), (0.2, 0.1)), tracking_errors((0.004,), 1, (1, 3))
    written = write(compared, solved, loop, bank, tmp_path)
    assert [path.suffix for path in written] == [".json", ".svg", ".png"]
    assert all(path.stat().st_size > 1000 for path in written)
    content = json.loads(written[0].read_text())
    slices, stream = content["methods"].values()
    by_name = {row["name"]: row for row in slices}
    paper, fast = by_name["paper: all lags, reference"], by_name["all lags, fast and exact"]
    # The same maximum: the same torques.
    assert fast["rmse_nm"] == paper["rmse_nm"]
    assert fast["latency_ratio"] == fast["latency_ms"] / paper["latency_ms"]
    assert {"rank 8", "zero lag, float16", "64 channels", "motion_regression"} <= set(by_name)
    assert {"motion_regression, right", "motion_regression, both"} <= {row["name"] for row in stream}
    errors = {row["name"]: row["error"] for row in content["forward"]}
    assert errors["direct, 0.4 cm"] > errors["direct, 0.2 cm"] > 0
    assert errors["batch, 0.2 cm"] == pytest.approx(errors["direct, 0.2 cm"], rel=1e-6)
    compensated, late = (
        next(run["rms_nm"] for run in content["loop"]["runs"] if run["loop"] == name and run["frames"] == 1)
        for name in ("twist controller", "no delay compensator")
    )
    assert 0 < compensated < 0.02 > late > 0


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--split", "0.95"], "--split 0.95 is not a number from 0.1 to 0.9"),
        (["--rounds", "0"], "--rounds 0 is not a whole number above 0"),
        (["no-such.mcap"], "no-such.mcap"),
    ],
)
@pytest.mark.parametrize("name", NAMES)
def test_a_mistake_is_one_sentence(name, arguments, complaint, tmp_path, mistake):
    said = mistake("chart", name, *arguments, "--out", tmp_path / "some" / "out")
    assert complaint in said
    assert said.count("\n") == 1


def test_an_unwritable_folder_is_reported_before_anything_is_measured(monkeypatch, mistake):
    # Were anything read, it would be what fails.
    monkeypatch.setattr("shearloop.studies.charts.chart_data.splits", None)
    for name in NAMES:
        said = mistake("chart", name, "--out", "/dev/null")
        assert said == "shearloop chart: /dev/null: the chart cannot be written: File exists; choose another --out\n"


def test_doubts_about_a_design_are_printed_with_its_chart(monkeypatch, tmp_path, capsys):
    t_s, frames = np.arange(12.0), np.random.default_rng(1).normal(0.0, 0.01, (12, 1, PAPER_TABLE.n_channels))
    series = SliceSeries(("right",), t_s, frames, t_s, t_s, np.full(12, np.nan))
    parts = [Split(f"{name}, slices, first 60%", series, series, series) for name in ("good", "bad")]
    # One design per recording, with the attributes that the doubts need; no other is looked at.
    found = iter(
        SimpleNamespace(models=[SimpleNamespace(penalised=penalised)], relative_noise=noise, largest_torque_nm=None)
        for penalised, noise in ((0.6, 0.16), (0.9, 0.5))
    )
    monkeypatch.setattr(scene, "design_bank", lambda *_: next(found, None))
    monkeypatch.setattr(scene, "simulated_frames", lambda *_: None)
    monkeypatch.setattr(scene, "write", lambda title, _, out: [out / title])
    titles = ["good", "bad", *(f"{one} {name}, simulated" for name in ("long", "round") for one in ("good", "bad"))]
    assert scene.chart(parts, tmp_path, SerialExecutor()) == [tmp_path / title for title in titles]
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("shearloop chart: bad: even the best model leaves 90.0% of a frame unexplained")
    assert second.startswith("shearloop chart: bad: the noise is 50.0% of a difference frame")


def test_the_error_of_eidors_is_that_of_the_paper_s_mesh(monkeypatch):
    rows = forward_methods(1, None, (0.4,), (0.2, 0.1))
    assert [(row.name, row.error) for row in rows if row.cited] == [
        ("EIDORS 3.10 (cited)", None),
        ("pyEIT (cited)", None),
    ]
    triangles = "shearloop.studies.charts.forward_methods.PAPER_TRIANGLES"
    monkeypatch.setattr(triangles, rows[0].triangles)
    again = forward_methods(1, None, (0.4,), (0.2, 0.1))
    assert [row.error for row in again if row.cited] == [rows[0].error, None]


CROWD = [(1.0, 1.0, "one"), (1.05, 1.0, "another"), (1.0, 1.04, "a third"), (1.1, 1.0, "a fourth")]
# Side by side, like methods with the same error.
ROW = [(each, 1.0, f"some method,\n{number} triangles") for number, each in enumerate((0.75, 0.79, 0.9, 1.34, 1.4))]


@pytest.mark.usefixtures("fonts")
@pytest.mark.parametrize("points", [CROWD, ROW])
def test_names_of_points_that_crowd_cover_neither_each_other_nor_a_mark(points):
    made = figure(6, 4)
    axes = made.subplots()
    plain_log(axes)
    axes.plot(*zip(*[point[:2] for point in points], strict=True), "o")
    axes.set(xlim=(0.5, 2), ylim=(0.5, 2))
    lay_out(made)
    write_names(axes, points)
    made.draw_without_rendering()
    # Names closer together read as one. The extent is of the text, without its line.
    boxes = [Text.get_window_extent(note).padded(1.9) for note in axes.texts]
    assert sorted(note.get_text() for note in axes.texts) == sorted(name for *_, name in points)
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert not any(box.contains(*axes.transData.transform(point[:2])) for point in points)
        assert axes.get_window_extent().containsx(box.x0)
        assert axes.get_window_extent().containsx(box.x1)
    # A name away from its point has a line to it.
    led = [isinstance(note, Annotation) and note.arrow_patch is not None for note in axes.texts]
    assert led == [max(map(abs, note.get_position())) > 7 for note in axes.texts]
    assert any(led) == (points is ROW)
