import json

import pytest

from shearloop.daemon.cli import main


@pytest.fixture
def grips(shared, tmp_path):
    """Two recorded grips of one cylinder, whose gains differ by a third."""
    folder = shared / "recordings" / "streams" / "cylinders"
    for number in (1, 2):
        files = [str(folder / f"30mm_{number}_{name}.mat") for name in ("right", "truth")]
        assert main(["import", "mat", *files, "--out", str(tmp_path / f"{number}.mcap")]) == 0
    known = ["--load-cell-delay-s", "0"]
    assert main(["calibrate", str(tmp_path / "1.mcap"), *known, "--out", str(tmp_path / "1.cal")]) == 0
    return tmp_path


def loaded(calibration, recording, capsys):
    capsys.readouterr()
    assert main(["evaluate", str(calibration), str(recording), "--time-range", "0.38:1", "--json"]) == 0
    return json.loads(capsys.readouterr().out)["loaded"]


def test_two_twists_of_a_grip_correct_the_calibration_of_another(grips, capsys):
    recording, new = grips / "2.mcap", grips / "new.cal"
    before = loaded(grips / "1.cal", recording, capsys)
    arguments = ["adapt", str(grips / "1.cal"), str(recording), "--time-range", "0:0.38", "--out", str(new), "--json"]
    assert main(arguments) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["gains"]["right"]["gain"] == pytest.approx(1.4, abs=0.15)
    assert said["twists"] == 2
    after = loaded(new, recording, capsys)
    assert before["gain"] < 0.8
    assert 0.9 < after["gain"] < 1.1
    assert after["rmse_nm"] < 0.6 * before["rmse_nm"]
    assert min(before["coverage_95"], after["coverage_95"]) >= 0.9
    assert after["winkler_nm"] < before["winkler_nm"]


def test_what_cannot_be_adapted_is_refused(grips, slices_folder, capsys):
    out = ["--out", str(grips / "new.cal")]
    assert main(["adapt", str(grips / "1.cal"), str(grips / "2.mcap"), "--time-range", "0:0.15", *out]) == 2
    assert "twist" in capsys.readouterr().err
    assert main(["calibrate", str(slices_folder), "--estimator", "regression", "--out", str(grips / "s.cal")]) == 0
    assert main(["adapt", str(grips / "s.cal"), str(grips / "2.mcap"), *out]) == 2
    assert "raw" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("tool", "others"), [("20mm_1", "10mm_1 30mm_1 30mm_2 40mm_1"), ("40mm_1", "10mm_1 20mm_1 30mm_1 30mm_2")]
)
def test_other_diameters_and_two_twists_estimate_the_torque_on_a_tool(shared, tmp_path, capsys, tool, others):
    folder = shared / "recordings" / "streams" / "cylinders"
    for name in [tool, *others.split()]:
        files = [str(folder / f"{name}_{what}.mat") for what in ("right", "truth")]
        assert main(["import", "mat", *files, "--out", str(tmp_path / f"{name}.mcap")]) == 0
    recordings = [str(tmp_path / f"{name}.mcap") for name in others.split()]
    out, new, tested = (str(tmp_path / name) for name in ("tools.cal", "new.cal", f"{tool}.mcap"))
    assert main(["calibrate", *recordings, "--load-cell-delay-s", "0", "--out", out]) == 0
    assert "The tools' diameters are 10 to " in capsys.readouterr().out
    before = loaded(out, tested, capsys)
    assert before["coverage_95"] > 0.9, "a tool that was not calibrated"
    assert main(["adapt", out, tested, "--time-range", "0:0.28", "--out", new]) == 0
    capsys.readouterr()
    assert main(["evaluate", new, tested, "--time-range", "0.28:1", "--json"]) == 0
    after = json.loads(capsys.readouterr().out)
    # A plateau is nearly the loaded frames' root mean square.
    assert after["rmse_nm"] < 0.2 * after["loaded"]["zero_rmse_nm"]
    assert after["coverage_95"] >= 0.9
    assert after["frames"] * after["valid_fraction"] > 40
