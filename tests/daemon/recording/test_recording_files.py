import os
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from scipy.io import savemat

from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.daemon.analysis.frame_series import part_of, read_series, series_of
from shearloop.daemon.config import RecordingConfig, load_daemon_config
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording import schema
from shearloop.daemon.recording.matlab_import import import_mat
from shearloop.daemon.recording.reader import read_messages, read_recording
from shearloop.daemon.recording.recorder import daemon_identity
from shearloop.daemon.recording.replay import RecordedRun
from shearloop.daemon.recording.schema import LOAD_DOUBT_NOTE
from shearloop.daemon.recording.tables import RecordedTopics
from shearloop.daemon.recording.writer import RecordingWriter
from tests.daemon.recording.conftest import START_DATENUM


def written(path, n=4):
    rng = np.random.default_rng(0)
    frames = PAPER_TABLE.line_of_channels(np.round(rng.uniform(0, 1, (n, 896)), 4))
    with RecordingWriter(path, "a bench", {"tool": "driver"}) as writer:
        for i, line in enumerate(frames):
            writer.add_frame("right", 1_700_000_000_000_000_000 + i * 540_000_000, 1_700_000_000_300_000_000 + i, line)
            writer.add_torque(1_700_000_000_100_000_000 + i, 0.01 * i)
    return frames


def test_a_recording_round_trips(tmp_path):
    frames = written(tmp_path / "a.mcap")
    found = read_recording(tmp_path / "a.mcap")
    assert found.source == "a bench"
    assert found.notes == {"tool": "driver"}
    np.testing.assert_array_equal(found.sides["right"].lines, frames)
    np.testing.assert_array_equal(np.diff(found.sides["right"].t_mid_ns), 540_000_000)
    arrivals = [content["arrival_unix_ns"] for _, content, _ in read_messages(found.path, ["eit.frame.right"])]
    np.testing.assert_array_equal(np.array(arrivals) - 1_700_000_000_300_000_000, np.arange(4))
    np.testing.assert_allclose(found.torque_nm, 0.01 * np.arange(4))
    assert list(tmp_path.iterdir()) == [tmp_path / "a.mcap"]


def test_messages_out_of_order_are_sorted(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap", "x") as writer:
        for t in (3, 1, 2):
            writer.add_torque(t, float(t))
    np.testing.assert_array_equal(read_recording(tmp_path / "a.mcap").torque_nm, [1, 2, 3])


def test_an_unfinished_recording_stays_partial(tmp_path):
    def interrupted():
        with RecordingWriter(tmp_path / "a.mcap", "x") as writer:
            writer.add_torque(1, 1.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.partial"]
    assert read_recording(tmp_path / "a.mcap.partial").torque_nm.tolist() == [1.0]


@pytest.mark.parametrize("read", [read_recording, RecordedRun, RecordedTopics])
def test_foreign_and_outdated_files_are_refused(tmp_path, monkeypatch, read):
    (tmp_path / "text.mcap").write_text("hello")
    with (tmp_path / "other.mcap").open("wb") as file:
        other = Writer(file)
        other.start()
        other.finish()
    # The digest is cached in the table once it is read.
    for name, owner, key, value in (("stale", PAPER_TABLE, "digest", "0" * 64), ("old", schema, "FORMAT_VERSION", "1")):
        with monkeypatch.context() as outdated:
            outdated.setitem(vars(owner), key, value)
            written(tmp_path / f"{name}.mcap")
    for name, why in (
        ("text", r"text\.mcap: this is not an MCAP file"),
        ("other", "not a recording of shearloop"),
        ("none", "No such file"),
        ("stale", "channel table 000000000000…"),
        ("old", "format version 1, expected 2; record it again, or import it again"),
    ):
        with pytest.raises(UserError, match=why):
            read(tmp_path / f"{name}.mcap")


def test_an_unwritable_recording_is_an_error(tmp_path):
    with pytest.raises(UserError, match="choose another --out"):
        RecordingWriter(tmp_path / "no" / "where.mcap", "x")


def test_a_side_that_no_file_has_is_not_to_be_imported(tmp_path):
    written(tmp_path / "a.mcap")
    for side, cure in (("left", "import those files as well"), ("up", "name a side that it has")):
        with pytest.raises(UserError, match=f"has frames of right, not of {side}; {cure}"):
            read_series(tmp_path / "a.mcap", (side,))


def test_a_folder_name_that_is_not_utf8_is_an_error(config):
    recorded = RecordingConfig(folder=Path(os.fsdecode(b"caf\xe9")))
    with pytest.raises(
        UserError, match=r"not UTF-8 \(the folder of the recordings is 'caf\\udce9'\); choose another name"
    ):
        daemon_identity(load_daemon_config(config()).model_copy(update={"recording": recorded}))


PERIOD_S = 0.5408


def test_late_frames_get_the_middle_of_their_acquisition(mat_folder, tmp_path):
    late = [(20, 0.3), (21, 0.12), (40, 1.4), (41, 0.9), (42, 0.35)]
    import_mat([mat_folder(late=late)], tmp_path / "a.mcap")
    frames = read_recording(tmp_path / "a.mcap").sides["right"]
    expected = (START_DATENUM - 719529) * 86400 + PERIOD_S * (np.arange(60) + 0.5)
    np.testing.assert_allclose(frames.t_mid_ns / 1e9, expected, rtol=0, atol=0.01)


def test_a_load_read_once_per_frame_gets_its_own_period(mat_folder, tmp_path):
    imported = import_mat([mat_folder(one_loop=True)], tmp_path / "a.mcap")
    assert "read once per frame" in imported.remarks[0]
    found = read_recording(tmp_path / "a.mcap")
    np.testing.assert_allclose(np.diff(found.torque_t_ns) / 1e9, 0.0916, atol=1e-6)
    assert "read once per frame" in found.notes["remarks"]


def test_a_loop_that_waits_for_its_load_gives_the_times_of_both(mat_folder, tmp_path):
    """A row is stamped, then waits for its frame and for its load value; the load cell begins late."""
    frame_s, load_s, stamps = 0.8 + PERIOD_S * np.arange(60), 2.6 + 0.0916 * np.arange(60), [0.0]
    for ends in zip(frame_s[:-1], load_s[:-1], strict=True):
        stamps.append(max(stamps[-1], *ends))
    late = list(enumerate(np.array(stamps) - PERIOD_S * np.arange(1, 61)))
    imported = import_mat([mat_folder(one_loop=True, late=late)], tmp_path / "a.mcap")
    found = read_recording(tmp_path / "a.mcap")
    start_ns = found.torque_t_ns[0] - 2.6e9
    np.testing.assert_allclose((found.torque_t_ns - start_ns) / 1e9, load_s, atol=1e-3)
    middle_s = (found.sides["right"].t_mid_ns - start_ns) / 1e9
    assert np.abs(frame_s - PERIOD_S / 2 - middle_s).max() <= PERIOD_S / 2 + 0.01
    assert "the load's times were moved by 2.33 ± 0.27 s against the frames" in imported.remarks[1]
    assert LOAD_DOUBT_NOTE not in found.notes
    import_mat([mat_folder("regular", one_loop=True)], tmp_path / "b.mcap")
    assert "times may be seconds off" in read_series(tmp_path / "b.mcap")[0].load_doubt


def test_damaged_load_values_are_counted_and_left_out(mat_folder, tmp_path):
    imported = import_mat([mat_folder(glitches=(0, 8))], tmp_path / "a.mcap")
    found = read_recording(tmp_path / "a.mcap")
    assert imported.torques == len(found.torque_nm) == 353
    assert np.abs(found.torque_nm).max() < 0.06
    assert "2 damaged load values beyond 20 N·m" in imported.remarks[0]


def test_the_diameter_in_the_files_names_is_noted(mat_folder, tmp_path):
    folder = mat_folder()
    for path in list(folder.iterdir()):
        path.rename(folder / f"12.5mm_1_{path.name}")
    import_mat([folder], tmp_path / "a.mcap")
    (series,) = read_series(tmp_path / "a.mcap")
    assert (series.diameter_mm == 12.5).all()
    one = next(folder.glob("*load*"))
    one.rename(folder / "20mm_1_load.mat")
    with pytest.raises(UserError, match=r"of cylinders of 12\.5 and 20 mm"):
        import_mat([folder], tmp_path / "b.mcap")


def test_two_sides_are_paired_by_time(mat_folder, tmp_path):
    import_mat([mat_folder()], tmp_path / "a.mcap")
    both = series_of(read_recording(tmp_path / "a.mcap"))
    assert both.sides == ("right", "left")
    assert both.channels.shape == (60, 2, 896)
    left = series_of(read_recording(tmp_path / "a.mcap"), ("left",))
    np.testing.assert_array_equal(left.channels[:, 0], both.channels[:, 1])
    # Times count from the first right frame; the left ones arrived 0.05 s later.
    np.testing.assert_allclose(left.t_s, PERIOD_S * np.arange(60) + 0.05, atol=1e-6)
    np.testing.assert_allclose(both.t_s, PERIOD_S * np.arange(60) + 0.025, atol=1e-6)
    import_mat([mat_folder("alone", sides=("Left_Data",))], tmp_path / "b.mcap")
    np.testing.assert_allclose(series_of(read_recording(tmp_path / "b.mcap")).t_s[0], 0.0, atol=1e-9)
    assert np.isfinite(both.torque_at_frames()[2:55]).all()
    early, later = part_of(both, 0, 0.25), part_of(both, 0.25, 1)
    assert (len(early.t_s), len(later.t_s)) == (15, 45)
    with pytest.raises(UserError, match=r"none of 60 frames lies between the shares 0 and 0\.001"):
        part_of(both, 0, 0.001)


def test_unusable_files_are_refused_by_name(mat_folder, tmp_path):
    (tmp_path / "empty").mkdir()
    savemat(tmp_path / "other.mat", {"x": np.zeros((2, 2))})
    folder = mat_folder()
    for sources, why in (
        ([tmp_path / "empty"], r"holds no \.mat files"),
        ([tmp_path / "other.mat"], r"other\.mat holds x, expected one of Right_Data"),
        ([folder, folder / "device0.mat"], "second stream of right"),
        ([folder / "load.mat"], "no frames"),
    ):
        with pytest.raises(UserError, match=why):
            import_mat(sources, tmp_path / "a.mcap")
    with pytest.raises(UserError, match="without slices"):
        read_series(tmp_path / "empty")
