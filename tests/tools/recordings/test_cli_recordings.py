import re
from dataclasses import dataclass, replace
from shutil import copytree

import numpy as np
import pytest

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.cli import main
from shearloop.cli.calibrate.recording import sentences_of
from shearloop.cli.evaluate import _lines
from shearloop.estimation import Calibration, Estimate, FrameSeries
from shearloop.estimation.estimator import Estimator, OutputModel, Reading, Regression
from shearloop.estimation.estimator_names import ESTIMATORS
from shearloop.estimation.interval_fit import fit_interval_regressor
from shearloop.estimation.load_delay import LoadDelay, LoadTiming
from shearloop.estimation.ridge import Ridge
from shearloop.estimation.values import Measured
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.evaluate import draw_slices
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.series import SliceSeries
from shearloop.tools.calibrate import CalibrationResult
from shearloop.tools.estimate_tracks import EstimateTrack
from shearloop.tools.evaluate import InvalidReason, invalid_reasons, why_nothing_judged
from shearloop.tools.evaluation_figure import draw_stream, draw_tracks
from shearloop.tools.figures import figures_of

pytestmark = pytest.mark.usefixtures("unjudged")
KEYS = {"r", "rmse_nm", "bias_nm", "coverage_95", "interval_nm", "valid_fraction", "frames"}
KEYS |= {"latency_ms_p50", "latency_ms_p99", "winkler_nm", "baseline_zero_rmse_nm", "loaded", "unloaded"}


@pytest.mark.usefixtures("fonts")
def test_calibrate_twice_is_one_file_and_evaluate_judges_it(slices_folder, tmp_path, ran, result_of):
    first, second = tmp_path / "a.cal", tmp_path / "b.cal"
    calibrate = ["calibrate", slices_folder, "--time-range", "0:0.6", "--out"]
    ran(*calibrate, first)
    result = result_of(*calibrate, second)
    assert first.read_bytes() == second.read_bytes()
    assert (result["path"], result["estimator"]) == (str(second), "motion_regression")
    assert result["quantities"] == ["torque", "diameter"]
    figures = result_of("evaluate", first, slices_folder, "--time-range", "0.6:1", "--plot")
    assert set(figures) == KEYS | {"diameter_rmse_mm", "diameter_coverage_95", "diameter_interval_mm"}
    assert 0 < figures["interval_nm"] < 0.1
    assert 0 < figures["diameter_interval_mm"] < 40
    assert figures["r"] > 0.97
    assert figures["rmse_nm"] < 0.01
    assert figures["diameter_rmse_mm"] < 3
    assert figures["frames"] == 20 + 6
    assert figures["loaded"]["n"] + figures["unloaded"]["n"] == 20 + 6
    assert figures["winkler_nm"] >= figures["interval_nm"] / 2
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    ran("evaluate", first, slices_folder, "--out", tmp_path / "named.svg")
    assert (tmp_path / "named.svg").read_text().count(f"<!-- {slices_folder.name}, right") == 2
    assert "learned from" not in ran("evaluate", first, slices_folder, "--time-range", "0.6:1").err
    text, warned = ran("evaluate", first, slices_folder / "torque_slices")
    learned = r"Warning: the calibration has learned from \d+ of \d+ judged frames of \S+torque_slices; errors"
    assert re.search(learned, warned)
    assert re.search(r"^figure +loaded +unloaded +all +meaning$", text, re.MULTILINE)
    assert re.search(r"^interval_nm +0\.\d+ .* 0\.\d+ +median width of these intervals", text, re.MULTILINE)
    assert "diameter" not in text


def test_a_part_of_the_slices_has_the_rows_of_the_whole(slices_folder, tmp_path, ran, result_of):
    slices, whole, judged = str(slices_folder / "torque_slices"), tmp_path / "all.cal", []
    for out, part in ((whole, []), (tmp_path / "part.cal", ["--time-range", "0:1"])):
        ran("calibrate", slices, "--estimator", "regression", "--out", out, *part)
    assert whole.read_bytes() == (tmp_path / "part.cal").read_bytes()
    table = tmp_path / "estimates.csv"
    for part in ([], ["--time-range", "0:1"], ["--time-range", "0.6:1"], ["--loaded-nm", "9"]):
        found = result_of("evaluate", whole, slices, *part, "--estimates", table)
        judged.append((table.read_text(), found))
    (rows, figures), (same_rows, same), (later, _), (_, unloaded) = judged
    assert same_rows == rows
    assert same["loaded"] == figures["loaded"]
    assert later.splitlines()[1:] == rows.splitlines()[-20:]
    assert (unloaded["loaded"]["n"], unloaded["unloaded"]["n"]) == (0, 49)


@dataclass(frozen=True, eq=False)
class BandMeans(Estimator):
    """A toy: a ridge on the means of bands of channels."""

    name = "bands"

    bands: int = 8

    def features(self, reading: Reading) -> FloatArray:
        return reading.frame.difference.reshape(self.bands, -1).mean(axis=1)


def test_an_estimator_is_one_class_and_one_line(slices_folder, tmp_path, ran, monkeypatch, result_of):
    monkeypatch.setitem(ESTIMATORS, "bands", f"{__name__}:BandMeans")
    calibration, slices = str(tmp_path / "a.cal"), str(slices_folder / "torque_slices")
    calibrate = ["calibrate", slices, "--estimator", "bands", "--time-range", "0:0.6", "--out", calibration]
    assert "Estimator bands, torque from" in ran(*calibrate).out
    assert SliceCalibration.load(calibration).estimator.bands == 8
    assert result_of("evaluate", calibration, slices)["r"] > 0.9
    monkeypatch.undo()
    with pytest.raises(CalibrationError, match="the estimator is 'bands', which this version does not know"):
        SliceCalibration.load(calibration)


@pytest.mark.parametrize("misses_loads", [True, False])
def test_calibrate_says_where_loads_are_not_seen(misses_loads):
    ramp = np.linspace(0.01, 0.14, 20)
    regressor = replace(fit_interval_regressor(ramp[:, None], ramp, Ridge.fit), misses_loads=misses_loads)
    model = OutputModel(regressor, np.zeros(0))
    calibration = Calibration(Regression(np.ones((1, 896))), ("right",), "ramp", "", torque=model)
    result = CalibrationResult(calibration, 20)
    printed = " ".join(sentences_of(result))
    assert ("It does not see the load: " in printed) == misses_loads
    useless = "every interval spans all calibrated torques, 0.01 to 0.14 N·m, and the torque is useless"
    assert (useless in printed) == misses_loads
    cure = "Calibrate with --estimator motion_regression or on both fingertips, or record a grip in which the tool"
    assert (cure in printed) == misses_loads
    assert result.figures()["sees_loads"] is not misses_loads


@pytest.mark.long
@pytest.mark.parametrize("slices_folder", [0.5], indirect=True)
def test_calibrate_says_which_torques_may_be_of_something_beyond(slices_folder, tmp_path, ran, monkeypatch, result_of):
    fitted = []
    monkeypatch.setattr(
        "shearloop.studies.slices.calibrate.fit_slices",
        lambda *a, **options: fitted.append(fit_slices(*a, **options)) or fitted[-1],
    )
    calibrate = ["calibrate", str(slices_folder / "torque_slices"), "--out", str(tmp_path / "a.cal")]
    printed = ran(*calibrate).out
    span = fitted[-1].torque.regressor.range
    assert np.isinf(span.low_end)
    ends = (
        f"So intervals of estimates above {span.high_end:.3g} N·m reach to {span.highest:.3g} N·m at least. Calibrate"
    )
    assert ends in printed
    assert result_of(*calibrate)["reads_beyond"] is False
    evaluate = ["evaluate", tmp_path / "a.cal", slices_folder / "torque_slices"]
    assert "assumes that" not in ran(*evaluate).err
    assert "beyond" not in ran(*calibrate, "--assume-full-range").out
    assert np.isinf(fitted[-1].torque.regressor.range.high_end)
    assert "a.cal assumes that no torque exceeds" in ran(*evaluate).err
    assert result_of(*calibrate, "--assume-full-range")["assumptions"] == ["full range"]


def test_a_stream_is_imported_and_cannot_be_judged_by_slices(mat_folder, slices_folder, tmp_path, ran, mistake):
    recording, calibration = tmp_path / "a.mcap", tmp_path / "a.cal"
    printed = ran("recording", "import", "mat", mat_folder(), "--out", recording).out
    assert "60 frames of the right side, 60 frames of the left side, 355 torques" in printed
    first, second = (ran("calibrate", slices_folder / "torque_slices", "--out", calibration).out for _ in range(2))
    assert f"Written to {calibration}.\n" in first
    assert f"Written to {calibration}, in place of an earlier file.\n" in second
    assert "made from slices, and cannot judge raw frames" in mistake("evaluate", calibration, recording)
    assert "--assume-full-range is for slices" in mistake(
        "calibrate", recording, "--assume-full-range", "--out", calibration
    )
    assert "made from slices, and cannot judge raw frames" in mistake(
        "calibrate", "creep", recording, "--calibration", calibration
    )


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_files_of_an_earlier_export_are_named(form, mat_folder, tmp_path, ran):
    if form == "parquet":
        pytest.importorskip("pyarrow", reason="needs the extra `export`")
    for name, sides in (("both", ("Right_Data", "Left_Data")), ("one", ("Right_Data",))):
        ran("recording", "import", "mat", mat_folder(name, sides=sides), "--out", tmp_path / f"{name}.mcap")
    exported = [
        ran("recording", "export", tmp_path / f"{name}.mcap", "--format", form, "--out", tmp_path / "x").err
        for name in ("both", "both", "one")
    ]
    left = tmp_path / "x" / f"eit.frame.left.{form}"
    assert exported == ["", "", f"Not of this export, and there before: {left}.\n"]


def test_reasons_that_differ_only_in_numbers_are_counted_under_one_real_example():
    said = [
        "outside the calibration: the Q residual is 2.1 (at most 1.5)",
        "right fingertip: 7 % of the channels jumped since the last frame; it was touched",
        *("right fingertip: 17.5 % of the channels jumped since the last frame; it was touched",) * 2,
        "right fingertip: 31.5 % of the channels are dead or saturated; check the ribbon cable",
        *("the torque would be -0.2 N·m", "the torque would be 0.2 N·m"),
        "outside the calibration: the frame lies 3.0 standard deviations from the calibrated ones",
    ]
    nothing = np.full(8, np.nan)
    series = FrameSeries(("right",), np.arange(8.0), np.zeros((8, 1, 896)), nothing[:0], nothing[:0], nothing)
    track = EstimateTrack(series, tuple(Estimate(valid=False, reasons=(why,)) for why in said), np.zeros(8))
    assert invalid_reasons([track]) == [
        InvalidReason(3, said[2], differ=True),
        InvalidReason(2, said[5], differ=True),
        *(InvalidReason(1, said[row], differ=False) for row in (0, 4, 7)),
    ]


def test_a_frame_of_two_reasons_counts_once():
    nothing, channels = np.full(4, np.nan), np.zeros((4, 1, 896))
    series = FrameSeries(("right",), np.arange(4.0), channels, nothing[:0], nothing[:0], nothing)
    said = (("too far: 2 mm", "too fast: 3 mm/s"), ("too far: 2 mm", "too fast: 4 mm/s"), ("too far: 1 mm",), ())
    estimates = tuple(Estimate(valid=not reasons, reasons=reasons) for reasons in said)
    found = invalid_reasons([EstimateTrack(series, estimates, np.zeros(4))])
    assert sum(one.frames for one in found) == 3
    assert found == [
        InvalidReason(2, "too far: 2 mm; too fast: 3 mm/s", differ=True),
        InvalidReason(1, "too far: 1 mm", differ=False),
    ]


def test_a_judgement_of_nothing_is_no_success(slices_folder, tmp_path, ran):
    calibration = tmp_path / "a.cal"
    ran("calibrate", slices_folder / "torque_slices", "--out", calibration)
    said = ran("evaluate", calibration, slices_folder / "diameter_slices", status=1).err
    assert "Nothing was judged: no frame has an estimate: outside the calibration: the Q residual is" in said


def test_a_part_without_a_grip_is_the_cause_that_nothing_was_judged():
    nothing, channels = np.full(3, np.nan), np.zeros((3, 1, 896))
    series = FrameSeries(("right",), np.arange(3.0), channels, nothing[:0], nothing[:0], nothing)
    idle = Estimate(valid=False, reasons=("nothing is gripped",))
    said = why_nothing_judged([EstimateTrack(series, (idle, idle, idle), np.zeros(3))])
    assert said.startswith("no frame has an estimate: nothing is gripped; give recordings, or a part")
    felt = Estimate(valid=True, torque_nm=0.1, torque_low_nm=0.0, torque_high_nm=0.2)
    said = why_nothing_judged([EstimateTrack(series, (felt, felt, idle), np.zeros(3))])
    assert said == "no frame has a known torque or diameter; give recordings with a load cell"
    known = replace(series, diameter_mm=np.full(3, 20.0))
    said = why_nothing_judged([EstimateTrack(known, (felt, felt, idle), np.zeros(3))])
    assert "there are estimates of torque, and known values of diameter; give recordings with a load" in said


def test_evaluate_says_of_an_example_that_it_is_one(monkeypatch, slices_folder, tmp_path, ran):
    calibration, slices = tmp_path / "a.cal", str(slices_folder / "torque_slices")
    assert main(["calibrate", slices, "--out", str(calibration)]) == 0
    reasons = [
        InvalidReason(12, "gripped too recently: 12 more frames are needed", differ=True),
        InvalidReason(1, "no grip", differ=False),
    ]
    monkeypatch.setattr("shearloop.tools.evaluate.invalid_reasons", lambda _: reasons)
    said = ran("evaluate", calibration, slices).out
    assert "12 frames not valid, e.g.: gripped too recently: 12 more frames are needed" in said
    assert "1 frame not valid: no grip" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["calibrate", "{slices}", "--time-range", "0.5", "--out", "x"],
            "--time-range 0.5 is not two fractions that rise",
        ),
        (
            ["calibrate", "{slices}", "--time-range", "0.9:0.5", "--out", "x"],
            "--time-range 0.9:0.5 is not two fractions that rise",
        ),
        (["calibrate", "{slices}", "--sides", "middle", "--out", "x"], "--sides middle is not right or left"),
        (["calibrate", "{slices}", "--estimator", "bank", "--out", "x"], "needs a bank"),
        (["calibrate", "{slices}", "--tool-mm", "0", "--out", "x"], "--tool-mm 0 is not a number from 1 to 140 mm"),
        (["calibrate", "{slices}", "--load-cell-delay-s", "0", "--out", "x"], "--load-cell-delay-s is for recordings"),
        (["calibrate", "{slices}", "--tool-mm", "20", "--out", "x"], "--tool-mm is for recordings: a calibration of"),
        (["calibrate", "{slices}", "--sides", "left", "--out", "x"], "--sides is for recordings: slices do not name"),
        (
            ["calibrate", "{slices}/diameter_slices", "--assume-full-range", "--out", "x"],
            "--assume-full-range is about torques, and these slices have diameters only; leave it out",
        ),
        (["calibrate", "nowhere.mcap", "--out", "x"], "nowhere.mcap: the recording cannot be read"),
        (["evaluate", "nowhere.cal", "{slices}"], "make one with `shearloop calibrate REC… --out nowhere.cal`"),
        (["evaluate", "nowhere.cal", "{slices}", "--out", "x.mcap"], "x.mcap is not the name of a figure"),
        (["evaluate", "nowhere.cal", "{slices}", "--loaded-nm", "-1"], "--loaded-nm -1 is not a number from 0 to"),
    ],
)
def test_mistakes_end_in_one_sentence(arguments, message, slices_folder, mistake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in mistake(*[one.format(slices=slices_folder) for one in arguments])
    assert not (tmp_path / "x").exists()


def test_what_is_given_twice_is_refused_by_its_name(slices_folder, mat_folder, tmp_path, ran, mistake):
    def refused(*paths):
        said = mistake("calibrate", *paths, "--out", tmp_path / "x.cal")
        assert not (tmp_path / "x.cal").exists()
        return said

    link, copy = tmp_path / "link", tmp_path / "copy"
    link.symlink_to(slices_folder)
    assert f"{slices_folder} is given twice; name it once" in refused(slices_folder, slices_folder)
    assert f"{link} is given twice, once as {slices_folder}; name it once" in refused(slices_folder, link)
    torque, cylinders = slices_folder / "torque_slices", slices_folder / "diameter_slices"
    copy.mkdir()
    (copy / "Data_Slice_3.mat").write_bytes((torque / "Data_Slice_7.mat").read_bytes())
    refusal = refused(torque, copy)
    assert f"{copy}: Data_Slice_3.mat equals {torque}: Data_Slice_7.mat; leave one of the two out" in refusal
    for number in (5, 6):
        (cylinders / f"20mm_Data_{number}.mat").write_bytes((cylinders / "20mm_Data_2.mat").read_bytes())
    refusal = refused(cylinders)
    assert "slice 5 of 20 mm equals" in refusal
    assert "slice 2 of 20 mm, and 1 more is such a copy; leave one of the two out" in refusal
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    ran("recording", "import", "mat", mat_folder(), "--out", first)
    second.write_bytes(first.read_bytes())
    assert f"frames of {second} are in {first} too; give one of the two" in refused(first, second)


def test_what_is_judged_twice_is_refused_as_what_is_fitted_twice_is(slices_folder, tmp_path, ran, mistake):
    slices, copy, calibration = slices_folder / "torque_slices", tmp_path / "copy", tmp_path / "a.cal"
    ran("calibrate", slices, "--estimator", "regression", "--out", calibration)
    copytree(slices, copy)
    refusal = f"shearloop evaluate: {slices} is given twice; name it once: a copy adds nothing\n"
    assert mistake("evaluate", calibration, slices, slices) == refusal
    refusal = mistake("evaluate", calibration, slices, copy, "--time-range", "0.6:1")
    assert f"{copy}: Data_Slice_30.mat equals {slices}: Data_Slice_30.mat, and 19 more are" in refusal


def test_known_diameters_have_figures_of_their_own():
    t, ends = np.arange(4.0), (15.0, 25.0)
    cylinders = [Estimate(True, (), diameter_mm=19.0, diameter_low_mm=ends[0], diameter_high_mm=ends[1] + n) for n in t]
    refused = [Estimate(False, ("no grip",))]
    nothing = np.zeros(0)
    series = SliceSeries(("right",), t, np.zeros((4, 1, 896)), nothing, nothing, np.full(4, 20.0))
    figures = figures_of([EstimateTrack(series, tuple(cylinders), np.ones(4))])
    assert figures["coverage_95"] == figures["diameter_coverage_95"] == figures["diameter_rmse_mm"] == 1.0
    assert figures["diameter_interval_mm"] == pytest.approx(11.5)
    without = figures_of([EstimateTrack(series, tuple(4 * refused), np.ones(4))])
    assert without["interval_nm"] is without["diameter_interval_mm"] is None
    assert not any(line.startswith("diameter_interval_mm") for line in _lines({"all": without}))


@pytest.mark.parametrize(("unsure_s", "delay_s", "when"), [(0.0, -0.16, "0.16 s before"), (0.4, 0.16, "0.16 s after")])
def test_a_time_that_could_not_be_checked_is_called_probable(unsure_s, delay_s, when):
    t = np.arange(4.0)
    series = FrameSeries(("right",), t, np.zeros((4, 1, 896)), t, np.zeros(4), np.full(4, np.nan))
    found = LoadDelay(delay_s=delay_s, error_s=0.2, explained=0.5)
    ramp = np.linspace(0.0, 1.0, 20)
    regressor = replace(fit_interval_regressor(ramp[:, None], ramp, Ridge.fit), timing_widening=1.9)
    model = OutputModel(regressor, np.zeros(0))
    calibration = Calibration(Regression(np.ones((1, 896))), ("right",), "ramp", "", torque=model)
    result = CalibrationResult(calibration, 4, LoadTiming([series], [found], [""], unsure_s))
    _, late, *sentences, _ = sentences_of(result)
    assert late == f"The load is {'probably ' if unsure_s else ''}stamped {when} the frames move."
    assert ("widening" in result.figures()) == bool(unsure_s) == bool(sentences)
    assert all("so the intervals of loaded frames are 1.9 times wider. Record more" in one for one in sentences)
    same = replace(calibration, torque=replace(model, regressor=replace(regressor, timing_widening=1.0)))
    said = " ".join(sentences_of(replace(result, calibration=same)))
    assert ("and the intervals of loaded frames do not allow for it. Record more" in said) == bool(unsure_s)
    other = "b.mcap: --tool-mm 30, because the recording names its tool, of 20 mm"
    mixed = replace(result, of_other_tools=[other])
    assert f"Left out: {other}." in sentences_of(mixed)
    assert mixed.figures()["tool_mm_left_out"] == [other]
    *_, common, few = sentences_of(replace(result, tools=[Measured(15.0, 0.0), Measured(30.0, 0.0)]))
    assert common == "The tools of 15 and 30 mm have the torque in common."
    assert few == "Diameters are not estimated: that takes recordings of three."


@pytest.mark.usefixtures("fonts")
@pytest.mark.parametrize(
    ("kind", "draw", "estimated_nm", "drawn"),
    [
        (FrameSeries, draw_stream, 0.1, "torque in N·m"),
        (FrameSeries, draw_stream, 0.0, "torque in N·m"),
        (SliceSeries, draw_slices, 0.1, "diameter in mm"),
    ],
)
def test_the_picture_of_a_stream_shows_torque_also_with_a_named_tool(kind, draw, estimated_nm, drawn, tmp_path):
    t, tool_mm = np.arange(4.0), np.full(4, 20.0)
    series = kind(("right",), t, np.zeros((4, 1, 896)), t, np.full(4, 0.1), tool_mm)
    estimates = tuple(
        Estimate(
            valid=True,
            reasons=(),
            torque_nm=estimated_nm,
            torque_low_nm=-0.2,
            torque_high_nm=0.15,
            diameter_mm=19.0,
            diameter_low_mm=15.0,
            diameter_high_mm=25.0,
        )
        for _ in t
    )
    draw_tracks([EstimateTrack(series, estimates, np.ones(4))], ["one"], "title", tmp_path / "a.svg", draw)
    picture = (tmp_path / "a.svg").read_text()
    assert f"<!-- {drawn} -->" in picture
    assert f"<!-- {'load cell' if kind is FrameSeries else 'known diameter'} -->" in picture
    # An interval that extends the other way is explained.
    assert ("<!-- no load on a load cell" in picture) == (estimated_nm == 0)
    judged = f"one; 4 loaded frames: RMSE {0.1 - estimated_nm:g} N·m (always saying 0: 0.1)"
    assert (f"<!-- {judged} -->" in picture) == (kind is FrameSeries)


def test_calibrate_says_that_most_frames_have_no_known_torque():
    ramp, t = np.linspace(0.0, 1.0, 20), np.arange(50.0)
    part = FrameSeries(("right",), t, np.zeros((50, 1, 896)), t, np.zeros(50), np.full(50, np.nan))
    model = OutputModel(fit_interval_regressor(ramp[:, None], ramp, Ridge.fit), np.zeros(0))
    calibration = Calibration(Regression(np.ones((1, 896))), ("right",), "ramp", "", torque=model)
    few = CalibrationResult(calibration, 3, parts=[part])
    assert "from 3 of 50 frames of the right side" in sentences_of(few)[0]
    assert sentences_of(few)[1].startswith("Warning: only 6% of the frames have a known torque or diameter")
    assert few.figures()["all_frames"] == 50
    assert "only" not in " ".join(sentences_of(replace(few, frames=40))[:2])
