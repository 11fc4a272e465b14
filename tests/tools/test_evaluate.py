import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.errors import UserError
from shearloop.estimation import TRUSTED, Estimate, FrameSeries, fit
from shearloop.estimation.session import FINGERS_MOVED
from shearloop.tools.estimate_tracks import EstimateTrack, estimate_series
from shearloop.tools.evaluate import evaluate_recordings, write_estimates
from shearloop.tools.figures import figures_by_load, figures_of
from shearloop.tools.parallel import SerialExecutor
from tests.estimation.conftest import twisting

torques = st.floats(-0.2, 0.2).map(lambda one: round(one, 4))
frames = st.tuples(torques, st.none() | st.tuples(torques, st.floats(0, 0.1), st.floats(0, 0.1)))
COLUMNS = "recording,frame,t_s,truth_nm,torque_nm,torque_low_nm,torque_high_nm,diameter_mm,diameter_low_mm"
COLUMNS += ",diameter_high_mm,valid,reason"


def track_of(rows):
    estimates = [
        Estimate(False, ("no grip", "dead")) if found is None else
        Estimate(True, (), found[0], found[0] - found[1], found[0] + found[2])
        for _, found in rows
    ]  # fmt: skip
    t = np.arange(float(len(rows)))
    truth = np.array([one for one, _ in rows])
    series = FrameSeries(("right",), t, np.zeros((len(rows), 1, 896)), t, truth, np.full(len(rows), np.nan))
    return EstimateTrack(series, tuple(estimates), np.ones(len(rows)))


def winkler_by_hand(truth, low, high):
    score = high - low
    if truth < low:
        score += 2 / 0.05 * (low - truth)
    if truth > high:
        score += 2 / 0.05 * (truth - high)
    return score


def test_an_evaluation_judges_no_frame_that_saw_the_fingers_move():
    calibration, series = fit("motion_regression", [twisting()], "rig"), twisting(seed=5)
    moved = np.zeros((len(series.t_s), 2), dtype=np.bool_)
    moved[70, 1] = True
    plain, track = (estimate_series(calibration, replace(series, fingers_moved=one)) for one in (None, moved))
    assert plain.estimates[70].valid
    assert track.estimates[70].reasons == (FINGERS_MOVED,)
    assert sum(one.valid for one in track.estimates) == sum(one.valid for one in plain.estimates) - 1


def test_a_track_may_be_given_alone_and_none_has_no_figures():
    track = track_of([(0.1, (0.1, 0.02, 0.02))] * 3)
    assert figures_by_load(track) == figures_by_load([track])
    assert figures_of(track) == figures_of([track])
    for judge in (figures_by_load, figures_of):
        with pytest.raises(UserError, match="there is no track to judge; `estimate_series` makes one"):
            judge([])


@given(st.lists(frames, min_size=1, max_size=12), st.floats(0.0, 0.1))
def test_figures_are_those_of_a_slow_loop(rows, loaded_nm):
    tracks = [track_of(rows[:5]), track_of(rows[5:])]
    by_load, whole = figures_by_load(tracks, loaded_nm), figures_of(tracks)
    assert (whole["latency_ms_p50"], whole["frames"]) == (1.0, len(rows))
    assert "diameter_rmse_mm" not in whole
    strata = {
        "loaded": [row for row in rows if abs(row[0]) >= loaded_nm],
        "unloaded": [row for row in rows if abs(row[0]) < loaded_nm],
        "all": rows,
    }
    for name, chosen in strata.items():
        figures = by_load.get(name, whole)
        judged = [(truth, *found) for truth, found in chosen if found is not None]
        n = len(judged)
        if chosen:
            assert figures["valid_fraction"] == pytest.approx(n / len(chosen))
        assert figures.get("n", len(chosen)) == len(chosen)
        if n < 2:
            assert figures["rmse_nm"] is figures["winkler_nm"] is figures["baseline_zero_rmse_nm"] is None
            continue
        if name == "all" and min(np.ptp(judged, axis=0)[:2]) > 0:
            assert figures["r"] == pytest.approx(np.corrcoef(*np.array(judged)[:, :2].T)[0, 1])
        ends = [(truth, value - below, value + above) for truth, value, below, above in judged]
        assert figures["rmse_nm"] == pytest.approx(math.sqrt(sum((one[1] - one[0]) ** 2 for one in judged) / n))
        assert figures["baseline_zero_rmse_nm"] == pytest.approx(math.sqrt(sum(one[0] ** 2 for one in judged) / n))
        assert figures["bias_nm"] == pytest.approx(sum(one[1] - one[0] for one in judged) / n, abs=1e-12)
        assert figures["coverage_95"] == pytest.approx(sum(low <= truth <= high for truth, low, high in ends) / n)
        assert figures["interval_nm"] == pytest.approx(np.median([high - low for _, low, high in ends]), abs=1e-12)
        assert figures["winkler_nm"] == pytest.approx(sum(winkler_by_hand(*one) for one in ends) / n, abs=1e-12)


def test_a_frame_that_is_valid_without_a_torque_has_no_estimate_of_it_anywhere():
    track = track_of([(0.1, (0.1, 0.02, 0.02)), (0.1, (0.1, 0.02, 0.02)), (0.0, None), (0.0, None)])
    without_torque = Estimate(True, (), diameter_mm=30.0, diameter_low_mm=29.0, diameter_high_mm=31.0)
    track = replace(track, estimates=(*track.estimates[:2], without_torque, without_torque))
    by_load = figures_by_load(track)
    assert [by_load[name]["valid_fraction"] for name in ("loaded", "unloaded")] == [1.0, 0.0]
    assert figures_of(track)["valid_fraction"] == 0.5
    diameters = replace(track, series=replace(track.series, torque_nm=np.full(4, np.nan), diameter_mm=np.full(4, 30.0)))
    assert figures_of(diameters)["valid_fraction"] == 0.5


def test_a_table_that_cannot_be_written_whole_leaves_the_earlier_one(tmp_path):
    path, track = tmp_path / "e.csv", track_of([(0.1, (0.08, 0.01, 0.02))])
    path.write_text("earlier")
    with pytest.raises(ValueError, match="zip"):
        write_estimates([track, track], ["a.mcap"], path)
    assert [one.name for one in tmp_path.iterdir()] == ["e.csv"]
    assert path.read_text() == "earlier"


def test_the_gain_is_along_the_truth():
    rows = [(0.1, (0.08, 0.0, 0.0)), (-0.1, (-0.08, 0.0, 0.0)), (0.0, (0.03, 0.0, 0.0)), (0.2, None)]
    assert figures_by_load([track_of(rows)])["loaded"]["gain"] == pytest.approx(0.8)
    assert figures_by_load([track_of(rows[2:])])["loaded"]["gain"] is None


def test_the_table_of_estimates_has_every_frame_by_its_number_in_the_recording(tmp_path):
    rows = [(0.1, (0.08, 0.01, 0.02)), (math.nan, (0.05, 0.0, 0.0)), (0.2, None), (0.3, None)]
    track = track_of(rows)
    part = EstimateTrack(track.series.between(1, 4), track.estimates[1:], track.latency_ms[1:])
    write_estimates([track, part], ["a.mcap", "b.mcap"], tmp_path / "e.csv")
    with (tmp_path / "e.csv").open(newline="") as file:
        assert file.readline().strip() == COLUMNS
        file.seek(0)
        table = list(csv.DictReader(file))
    assert [(one["recording"], int(one["frame"]), float(one["t_s"])) for one in table] == [
        *(("a.mcap", i, float(i)) for i in range(4)),
        *(("b.mcap", i, float(i)) for i in range(1, 4)),
    ]
    first, unknown, refused = table[:3]
    assert [float(first[name]) for name in COLUMNS.split(",")[3:7]] == pytest.approx([0.1, 0.08, 0.07, 0.1])
    assert (first["diameter_mm"], first["valid"], first["reason"]) == ("", "True", "")
    assert (unknown["truth_nm"], unknown["torque_nm"]) == ("", "0.05")
    assert [refused[name] for name in COLUMNS.split(",")[4:]] == [*[""] * 6, "False", "no grip; dead"]


def test_the_table_of_estimates_says_why_a_valid_frame_has_no_torque(tmp_path):
    track = track_of([(0.1, (0.08, 0.01, 0.02)), (0.2, None)])
    of_diameter = Estimate(True, (), None, None, None, 12.0, 11.0, 13.0)
    told = replace(track, estimates=(of_diameter, track.estimates[1]), why_no_torque="the tool has 10 mm")
    write_estimates([told], ["a.mcap"], tmp_path / "e.csv")
    with (tmp_path / "e.csv").open(newline="") as file:
        assert [row["reason"] for row in csv.DictReader(file)] == ["the tool has 10 mm", "no grip; dead"]


def test_recordings_of_emulated_devices_are_named():
    recorded = twisting(cycles=1)
    calibration = fit("motion_regression", [recorded], "twists", timing=TRUSTED)
    real, emulated = twisting(cycles=1, seed=2), replace(twisting(cycles=1, seed=3), emulated=True)
    named = [(Path("real.mcap"), real), (Path("emulated.mcap"), emulated)]
    assert evaluate_recordings(calibration, named, None, (0.0, 1.0), SerialExecutor()).emulated == ["emulated.mcap"]
    assert not calibration.emulated
    assert fit("motion_regression", [emulated], "twists", timing=TRUSTED).emulated


@pytest.mark.parametrize(("calibrated_mm", "named"), [(20.0, ["unnamed.mcap"]), (math.nan, [])])
def test_a_recording_whose_tool_is_not_known_is_named_where_the_calibration_holds_for_one(calibrated_mm, named):
    fitted = fit("motion_regression", [twisting(cycles=1)], "twists", timing=TRUSTED)
    unnamed, judged = twisting(cycles=1, seed=2), twisting(cycles=1, seed=3)
    judged = replace(judged, diameter_mm=np.full(len(judged.t_s), 20.0))
    recordings = [(Path("unnamed.mcap"), unnamed), (Path("named.mcap"), judged)]
    calibration = replace(fitted, tool_mm=calibrated_mm)
    doubts = evaluate_recordings(calibration, recordings, None, (0.0, 1.0), SerialExecutor()).doubts
    assert [doubt.split(":")[0] for doubt in doubts if "the tool's diameter is not known" in doubt] == named
