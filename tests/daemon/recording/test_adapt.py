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
