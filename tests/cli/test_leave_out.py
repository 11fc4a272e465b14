"""`evaluate --leave-out`, and what `calibrate` says at its end, from the command line."""

import re

import pytest

from shearloop.cli import main
from shearloop.estimation import Calibration
from shearloop.tools.recordings.matlab_import import import_mat


def test_a_recipe_is_judged_from_the_command_line(shared, tmp_path, result_of, ran, mistake, monkeypatch):
    out, table = tmp_path / "30mm.mcap", tmp_path / "e.csv"
    import_mat(sorted((shared / "recordings/streams/cylinders").glob("30mm_1_*.mat")), out)
    recipe = ["--load-cell-delay-s", "0"]
    judged = result_of("evaluate", "--leave-out", "twists", out, *recipe, "--estimates", table)
    assert judged["left_out"] == "twists"
    assert {"r", "rmse_nm", "coverage_95", "winkler_nm", "valid_fraction", "loaded", "unloaded"} <= {*judged}
    assert judged["loaded"]["baseline_ratio"] > 0
    assert len(judged["blocks"]) > 2
    assert table.read_text().startswith("recording,frame,t_s,truth_nm,torque_nm")
    # However busy the computer is.
    monkeypatch.setattr("shearloop.cli.calibrate.recording.LEFT_OUT_WITHIN_S", 1e6)
    assert "Twists left out in turn" in ran("calibrate", out, *recipe, "--out", tmp_path / "a.cal").out
    assert "there is one tool, of 30 mm" in mistake("evaluate", "--leave-out", "tools", out, *recipe)


@pytest.mark.parametrize("limit_s", [0.0, 1e6])
def test_calibrate_judges_or_names_the_command(limit_s, slices_folder, tmp_path, result_of, monkeypatch):
    monkeypatch.setattr("shearloop.cli.calibrate.recording.LEFT_OUT_WITHIN_S", limit_s)
    recipe = ["--estimator", "regression", "--time-range", "0:0.5"]
    result = result_of("calibrate", slices_folder / "torque_slices", *recipe, "--out", tmp_path / "a.cal")
    if limit_s:
        assert result["left_out"]["left_out"] == "levels"
    else:
        assert result["on_fitted"]["baseline_profile_rmse_nm"] is not None
        assert result["left_out"] is None
        command = result["left_out_command"].split()
        assert command[:4] == ["shearloop", "evaluate", "--leave-out", "levels"]
        assert command[-4:] == recipe


def of_the_stream(name, shared, tmp_path):
    out = tmp_path / f"{name}.mcap"
    import_mat([shared / "recordings/streams" / name], out)
    return [out]


def of_three_tools(shared, tmp_path):
    found = []
    for name in ("10mm_1", "20mm_1", "40mm_1"):
        found.append(tmp_path / f"{name}.mcap")
        import_mat(sorted((shared / "recordings/streams/cylinders").glob(f"{name}_*.mat")), found[-1])
    return [*found, "--load-cell-delay-s", "0"]


@pytest.mark.parametrize(
    ("recipe", "why", "advice"),
    [
        (
            lambda shared, _: [shared / "recordings/torque_slices", "--time-range", "0:0.592"],
            "Not judged by levels left out: without slices of 74.7 mN·m",
            "Judge it on another recording: `shearloop evaluate CAL REC`.",
        ),
        (
            lambda shared, tmp_path: of_the_stream("20241202_153632", shared, tmp_path),
            "Not judged by twists left out: there is one twist",
            "Judge it on another recording: `shearloop evaluate CAL REC`.",
        ),
        (of_three_tools, "Not judged by tools left out: without the tool of 40 mm", "3 tools only: record four"),
    ],
    ids=["slices", "one twist", "three tools"],
)
def test_calibrate_ends_with_figures_and_advice_where_nothing_can_be_left_out(
    recipe, why, advice, shared, tmp_path, ran, result_of, monkeypatch
):
    monkeypatch.setattr("shearloop.cli.calibrate.recording.LEFT_OUT_WITHIN_S", 1e6)
    arguments = ["calibrate", *recipe(shared, tmp_path), "--out", tmp_path / "a.cal"]
    *_, refused, width, advised, _written = ran(*arguments).out.splitlines()
    assert refused.startswith(why)
    assert "intervals of " in width
    assert "mN·m for always 0" in width
    assert "unknown" not in width
    assert advised.startswith(advice)
    figures = result_of(*arguments)
    assert figures["left_out"] is None
    assert figures["advice"] == advised
    assert all(figures["on_fitted"].values())


def test_calibrate_on_diameters_ends_with_advice(slices_folder, tmp_path, ran, result_of):
    arguments = [
        "calibrate",
        slices_folder / "diameter_slices",
        "--estimator",
        "regression",
        "--out",
        tmp_path / "a.cal",
    ]
    *_, why, advice, _written = ran(*arguments).out.splitlines()
    assert why == "Not judged: blocks are left out for torques, and this calibration has diameters only."
    assert result_of(*arguments)["advice"] == advice == "Judge it on another recording: `shearloop evaluate CAL REC`."


def test_an_interrupted_trial_says_that_the_calibration_is_written(shared, tmp_path, capsys, monkeypatch):
    recording = tmp_path / "30mm.mcap"
    import_mat(sorted((shared / "recordings/streams/cylinders").glob("30mm_1_*.mat")), recording)

    def interrupted(*_args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("shearloop.tools.leave_out.plan_left_out", interrupted)
    out = tmp_path / "a.cal"
    assert main(["calibrate", str(recording), "--load-cell-delay-s", "0", "--out", str(out)]) == 130
    assert f"{out} is written and whole; its trial with twists left out has not ended" in capsys.readouterr().err
    assert Calibration.load(out).measures_torque


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("a.cal", "name recordings after the calibration"),
        ("a.cal b.mcap --sides right", "--sides is for --leave-out"),
        ("--leave-out grips a.mcap --plot", "leave them out with --leave-out"),
        ("--leave-out grips a.mcap a.mcap", "given twice"),
        ("--leave-out grips nowhere.mcap", "cannot be read"),
        ("a.cal b.mcap --adapt-twists 1", "--adapt-twists is for --leave-out"),
        ("--leave-out levels a.mcap --adapt-twists 1", "slices have no gain to adapt"),
        ("a.cal b.mcap --nested", "--nested is for --leave-out"),
        ("--leave-out twists a.mcap --nested --estimator regression", "--nested is for recordings and the estimator"),
    ],
)
def test_a_mistake_ends_in_one_sentence(arguments, said, mistake):
    assert said in mistake("evaluate", *arguments.split())


GIVEN = {
    "--estimator": ["paper"],
    "--mesh": ["a.npz"],
    "--sides": ["right"],
    "--load-cell-delay-s": ["0"],
    "--tool-mm": ["20"],
    "--assume-full-range": [],
    "--nested": [],
    "--adapt-twists": ["1"],
}


def test_the_help_lists_what_needs_leave_out(mistake, capsys):
    with pytest.raises(SystemExit):
        main(["evaluate", "--help"])
    _, _, described = capsys.readouterr().out.partition("only with --leave-out")
    group, _, _ = described.partition("\n\n")
    assert set(re.findall(r"^ +(--[a-z-]+)", group, re.MULTILINE)) == set(GIVEN)
    for option, values in GIVEN.items():
        assert f"{option} is for --leave-out" in mistake("evaluate", "a.cal", "b.mcap", option, *values)
