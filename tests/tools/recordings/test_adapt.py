import asyncio
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from shearloop.daemon.config import load_daemon_config
from shearloop.estimation import Calibration
from shearloop.estimation.learned_frames import UNKNOWN_FRAMES
from tests.tools.recordings.test_replay import replayed

pytestmark = pytest.mark.usefixtures("unjudged")


@pytest.fixture
def cylinder(shared, tmp_path, ran):
    """Return a function that imports the recorded grip of a cylinder, and returns its path."""

    def imported(name):
        path, folder = tmp_path / f"{name}.mcap", shared / "recordings" / "streams" / "cylinders"
        if not path.exists():
            files = [folder / f"{name}_{what}.mat" for what in ("right", "truth")]
            ran("recording", "import", "mat", *files, "--out", path)
        return path

    return imported


@pytest.fixture
def calibration(cylinder, tmp_path, ran):
    """A calibration on a grip of one cylinder; the gain of the other recorded grip differs by a third."""
    ran("calibrate", cylinder("30mm_1"), "--load-cell-delay-s", "0", "--out", tmp_path / "1.cal")
    return tmp_path / "1.cal"


@pytest.fixture
def loaded(result_of):
    """Return a function that evaluates a calibration on the later part of a recording, where it is loaded."""
    return lambda calibration, recording: result_of("evaluate", calibration, recording, "--time-range", "0.38:1")[
        "loaded"
    ]


def test_two_twists_of_a_grip_correct_the_calibration_of_another(calibration, cylinder, loaded, tmp_path, result_of):
    recording, new = cylinder("30mm_2"), tmp_path / "new.cal"
    before = loaded(calibration, recording)
    said = result_of("adapt", calibration, recording, "--time-range", "0:0.38", "--out", new)
    assert said["gains"]["right"]["gain"] == pytest.approx(1.4, abs=0.15)
    assert said["twists"] == 2
    after = loaded(new, recording)
    assert before["gain"] < 0.8
    assert 0.9 < after["gain"] < 1.1
    assert after["rmse_nm"] < 0.6 * before["rmse_nm"]
    assert min(before["coverage_95"], after["coverage_95"]) >= 0.9
    assert after["winkler_nm"] < before["winkler_nm"]


def test_a_deviation_within_chance_decides_nothing(calibration, cylinder, tmp_path, ran, result_of):
    """Twists of a recording by a calibration on its own earlier ones: the gain is right already."""
    recording, own = cylinder("30mm_1"), tmp_path / "own.cal"
    ran("calibrate", recording, "--time-range", "0:0.5", "--load-cell-delay-s", "0", "--out", own)
    later = [recording, "--time-range", "0.5:0.7", "--out", tmp_path / "new.cal"]
    out = ran("adapt", own, *later).out
    assert "right: torque times 1.00 " in out
    assert "The deviation may be chance; the gain is unchanged." in out
    assert "decided" not in out
    assert result_of("adapt", own, *later)["gain_is_unchanged"] is True
    twists = [cylinder("30mm_2"), "--time-range", "0:0.38", "--out", tmp_path / "other.cal"]
    assert "2 twists of known torque decided." in ran("adapt", calibration, *twists).out


def test_twists_count_once_under_any_name_and_range(calibration, cylinder, tmp_path, ran, mistake):
    first, recording, new = cylinder("30mm_1"), cylinder("30mm_2"), tmp_path / "new.cal"
    again, renamed = ["--out", tmp_path / "again.cal"], tmp_path / "renamed.mcap"
    fitted = mistake("adapt", calibration, first, *again)
    assert re.search(rf"has used (\d+) of \1 gripped frames of {first} already", fitted)
    ran("adapt", calibration, recording, "--time-range", "0:0.38", "--out", new)
    renamed.write_bytes(recording.read_bytes())
    for twists in (
        [recording, "--time-range", "0:0.38"],
        [renamed, "--time-range", "0:0.38"],
        [recording, "--time-range", "0.3:0.5"],
        [recording, "--time-range", "0:0.38", "--load-cell-delay-s", "0.1"],
    ):
        said = mistake("adapt", new, *twists, *again)
        assert re.search(rf"has used \d+ of \d+ gripped frames of {twists[0]} already", said)
    ran("adapt", new, recording, "--time-range", "0.38:0.6", *again)


def test_a_calibration_without_its_frames_cannot_tell(calibration, cylinder, tmp_path, ran):
    older, recording, new = tmp_path / "older.cal", cylinder("30mm_2"), tmp_path / "new.cal"
    replace(Calibration.load(calibration), learned=UNKNOWN_FRAMES).save(older)
    unknown = "Warning: the calibration's file does not list the frames of its fit"
    assert unknown in ran("adapt", older, recording, "--time-range", "0:0.38", "--out", new).err
    assert unknown in ran("evaluate", older, recording).err
    assert "which frames" not in ran("evaluate", calibration, recording).err


def test_what_cannot_be_adapted_is_refused(calibration, cylinder, slices_folder, tmp_path, ran, mistake):
    recording, out, of_slices = cylinder("30mm_2"), ["--out", tmp_path / "new.cal"], tmp_path / "s.cal"
    assert "twist" in mistake("adapt", calibration, recording, "--time-range", "0:0.15", *out)
    ran("calibrate", slices_folder / "torque_slices", "--estimator", "regression", "--out", of_slices)
    assert "calibration of slices" in mistake("adapt", of_slices, recording, *out)
    several = mistake("adapt", calibration, recording, cylinder("10mm_1"), "--tool-mm", "10", *out)
    assert "the recordings are of several tools; adapt to one at a time" in several
    copy = tmp_path / "another name.mcap"
    copy.write_bytes(Path(recording).read_bytes())
    assert "give one of the two: a frame that counts twice" in mistake("adapt", calibration, recording, copy, *out)
    before = calibration.read_bytes()
    said = mistake("adapt", calibration, recording, "--time-range", "0:0.38", "--out", calibration)
    assert "are the same file or folder: nothing was changed; choose another --out" in said
    assert calibration.read_bytes() == before


def test_a_replay_of_an_import_knows_the_tool_and_counts_each_topics_messages(calibration, cylinder, config):
    fingertip = {"calibration": str(calibration), "bank": None, "frame_period_s": 0.5412}
    loaded = load_daemon_config(config(right=fingertip, load_cell={"device": {"serial_number": "a"}}))
    for name, why in (("30mm_2", ""), ("40mm_1", "the tool has 40 mm, and the calibration was made with a tool of 30")):
        sent, _ = asyncio.run(replayed(Path(cylinder(name)), math.inf, loaded))
        estimates = [content for topic, content in sent if topic == "eit.estimate"]
        assert any(one["valid"] for one in estimates) == (not why)
        assert any(why in one["reason"] for one in estimates)
        loads = [content["seq"] for topic, content in sent if topic == "load.torque"]
        assert loads == list(range(len(loads)))


@pytest.mark.parametrize(
    ("tool", "others"),
    [
        ("20mm_1", "10mm_1 30mm_1 30mm_2 40mm_1"),
        ("20mm_1", "10mm_1 30mm_1 40mm_1"),
        ("40mm_1", "10mm_1 20mm_1 30mm_1 30mm_2"),
        ("40mm_1", "10mm_1 20mm_1 30mm_1"),
    ],
)
def test_other_diameters_and_two_twists_estimate_the_torque_on_a_tool(
    tool, others, cylinder, loaded, tmp_path, ran, result_of
):
    tested, recordings = cylinder(tool), map(cylinder, others.split())
    out, new = tmp_path / "tools.cal", tmp_path / "new.cal"
    printed = ran("calibrate", *recordings, "--load-cell-delay-s", "0", "--out", out).out
    assert "The tools' diameters are 10 to " in printed
    assert "off by a factor of " in printed
    before = loaded(out, tested)
    assert before["coverage_95"] > 0.9, "a tool that was not calibrated"
    ran("adapt", out, tested, "--time-range", "0:0.28", "--out", new)
    after = result_of("evaluate", new, tested, "--time-range", "0.28:1")
    # A plateau is nearly the loaded frames' root mean square.
    assert after["rmse_nm"] < 0.2 * after["loaded"]["baseline_zero_rmse_nm"]
    assert after["coverage_95"] >= 0.9
    assert after["frames"] * after["valid_fraction"] > 40
