import numpy as np
import pytest
from scipy.io import savemat

from shearloop.bank.eit.channels import N_LINE_VALUES
from shearloop.daemon.analysis.series import part_of, read_series, series_of
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.matlab import import_mat
from shearloop.daemon.recording.reader import read_recording
from shearloop.daemon.recording.writer import RecordingWriter

PERIOD_S = 0.5408


def test_late_frames_get_the_middle_of_their_acquisition(mat_folder, tmp_path):
    late = [(20, 0.3), (21, 0.12), (40, 1.4), (41, 0.9), (42, 0.35)]
    import_mat([mat_folder(late=late)], tmp_path / "a.mcap")
    frames = read_recording(tmp_path / "a.mcap").sides["right"]
    expected = PERIOD_S * (np.arange(60) + 0.5)
    found = (frames.t_mid_ns - frames.arrival_ns[0]) / 1e9 + PERIOD_S
    np.testing.assert_allclose(found, expected, atol=0.01)


def test_a_load_read_once_per_frame_gets_its_own_period(mat_folder, tmp_path):
    imported = import_mat([mat_folder(one_loop=True)], tmp_path / "a.mcap")
    assert "read once per frame" in imported.remarks[0]
    found = read_recording(tmp_path / "a.mcap")
    np.testing.assert_allclose(np.diff(found.torque_t_ns) / 1e9, 0.0916, atol=1e-6)
    assert "read once per frame" in found.notes["remarks"]


def test_damaged_load_values_are_counted_and_left_out(mat_folder, tmp_path):
    imported = import_mat([mat_folder(glitches=(0, 8))], tmp_path / "a.mcap")
    found = read_recording(tmp_path / "a.mcap")
    assert imported.torques == len(found.torque_nm) == 353
    assert np.abs(found.torque_nm).max() < 0.06
    assert "2 load values beyond 20 N·m" in imported.remarks[0]


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


@pytest.mark.parametrize("decimals", [4, 6, 7, 17])
def test_lines_are_rounded_number_by_number(tmp_path, decimals):
    line = np.round(np.random.default_rng(decimals).uniform(-1, 1, N_LINE_VALUES), decimals)
    with RecordingWriter(tmp_path / "a.mcap", "a test") as writer:
        writer.add_frame("right", 1, 2, line)
    found = read_recording(tmp_path / "a.mcap").sides["right"].lines[0]
    assert found.tolist() == [round(value, 6) for value in line.tolist()]
