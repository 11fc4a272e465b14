import json
import shutil
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from scipy.io import savemat

from shearloop.studies.charts import bank_figures
from shearloop.studies.reproduce import report
from shearloop.studies.reproduce.report import PAPER_MODEL_SCORES
from shearloop.tools import banks

pytestmark = pytest.mark.usefixtures("small_grids")

KEYS = [
    "torque_sigma_r_focused",
    "torque_sigma_r_wide",
    "torque_sigma_r_clustered",
    "diameter_k_r_single",
    "diameter_k_r_accumulated",
    "diameter_k_r_running_sum",
    "model_scores",
    "torque_rmse_nm_cross_validated",
    "torque_regression_r_share",
    "torque_regression_channels_for_80_percent_of_r2",
    "bank_valid_cells",
    "paper_region_agreement",
]
OF_ANY = {"figure_4_models", "figure_6_bank"}
FIGURES = OF_ANY | {"figure_3_dataset", "figure_5_models", "figure_7_heatmap", "figure_8_torque", "figure_9_diameter"}


def test_numbers_and_figures_are_made(make_recordings, coarse_fingertip, tmp_path, ran, monkeypatch):
    # A few of a bank's signals show what all would.
    monkeypatch.setattr(bank_figures, "_PANELS", 3)
    out = tmp_path / "out"
    command = ["reproduce", str(make_recordings()), "--out", str(out), "--mesh", str(coarse_fingertip), "--jobs", "1"]
    said = ran(*command, "--json")
    found = json.loads(said.out)
    assert list(found) == KEYS
    assert json.loads((out / "reproduce.json").read_text()) == found
    assert f"mesh: {coarse_fingertip}" in said.err
    assert found["torque_sigma_r_focused"] < -0.99
    assert found["torque_sigma_r_clustered"] < -0.99
    assert found["diameter_k_r_accumulated"] < -0.95
    assert found["diameter_k_r_running_sum"] < -0.95
    # All σ are above 0.6 and all cells are valid; of seven k one is above 3.5.
    assert found["paper_region_agreement"] == {"or": 1.0, "and": pytest.approx(1 / 7)}
    assert 0 < found["torque_rmse_nm_cross_validated"] < 0.01
    assert set(found["model_scores"]) == set(PAPER_MODEL_SCORES)
    assert found["bank_valid_cells"] == 56
    for name in FIGURES:
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "</svg>" in (out / f"{name}.svg").read_text()
    (focused,) = (out / "banks").glob("focused-*.bank")

    # A second run finds the banks and says the same as a table; a damaged bank is built anew.
    before = focused.stat().st_mtime_ns
    (wide,) = (out / "banks").glob("wide-*.bank")
    wide.write_bytes(wide.read_bytes()[:-100])
    monkeypatch.setattr("shearloop.studies.reproduce.report.draw_all", lambda *_: [])  # they take most of the time
    said = ran(*command)
    assert focused.stat().st_mtime_ns == before
    assert "truncated" in said.err
    assert f"{found['torque_sigma_r_focused']:.5f}" in said.out
    assert "0.6552" in said.out
    assert "grouped by place in 3 repeated series" in said.out
    assert "The ranking depends on the envelope's settings: by 25 pairs" in said.out
    assert f"{tmp_path / 'site' / 'recordings' / 'streams'} has no recording of twists" in said.out


@pytest.mark.parametrize("present", ["torque", "diameter"])
def test_one_kind_of_slice_is_enough(make_recordings, coarse_fingertip, tmp_path, ran, monkeypatch, present):
    # The figures are made and named, and not rendered: the test before has looked at the files.
    monkeypatch.setattr(report, "lay_out", lambda _: None)
    monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: path.touch())
    recordings = make_recordings(torque=present == "torque", diameter=present == "diameter", raw=False)
    out = tmp_path / "out"
    printed = ran("reproduce", recordings, "--out", out, "--mesh", coarse_fingertip, "--jobs", "1").out
    found = json.loads((out / "reproduce.json").read_text())
    absent = "diameter" if present == "torque" else "torque"
    assert found[f"{present}_{'sigma_r_wide' if present == 'torque' else 'k_r_single'}"] < -0.9
    assert all(value is None for key, value in found.items() if key.startswith(absent))
    assert (found["model_scores"]["step"] is None) == (present == "diameter")
    assert f"nothing about {absent}" in printed
    assert ("needs TorqueSlice.mat and TorqueSliceHom.mat" in printed) == (present == "torque")
    drawn = {path.stem for path in out.glob("*.png")}
    assert drawn == (OF_ANY | {"figure_9_diameter"} if present == "diameter" else FIGURES - {"figure_9_diameter"})


def test_the_papers_mesh_is_taken_where_it_is_beside_the_recordings(make_recordings, shared):
    recordings = make_recordings(diameter=False)
    assert banks.choose_mesh(recordings, None)[1] == f"our own grid for {banks.OWN_FINGERTIP}"
    beside = recordings.parent / "reference" / "fingertip_mesh.npz"
    beside.parent.mkdir()
    shutil.copy(shared / "reference" / "fingertip_mesh.npz", beside)
    mesh, origin = banks.choose_mesh(recordings, None)
    assert origin == f"{beside} (the paper's)"
    assert len(mesh.triangles) == 4882


def test_mistakes_end_in_one_sentence(make_recordings, tmp_path, mistake):
    def refused(recordings: Path, *options: str) -> str:
        said = mistake("reproduce", recordings, "--out", tmp_path / "out", *options)
        assert said.count("\n") == 1
        return said

    assert "has neither a folder torque_slices nor a folder diameter_slices" in refused(tmp_path)
    recordings = make_recordings(diameter=False)
    assert "absent.npz" in refused(recordings, "--mesh", str(tmp_path / "absent.npz"))
    assert "--jobs 0 is not a whole number above 0" in refused(recordings, "--jobs", "0")
    folder = recordings / "torque_slices"
    for path in sorted(folder.glob("Data_Slice_*.mat"))[2:]:
        path.unlink()
    assert f"{folder} has 2 slices; a correlation needs at least 3" in refused(recordings)
    savemat(folder / "Data_Slice_99.mat", {"data_diff": [[1.0, 2.0]], "torque_value": 1.0})
    assert "Data_Slice_99.mat: expected 1 × 896 values, found 1 × 2" in refused(recordings)
    (folder / "Data_Slice_99.mat").write_bytes(b"MATLAB 5.0 cut")
    assert "Data_Slice_99.mat: the recording is truncated or damaged" in refused(recordings)
    (tmp_path / "file").write_text("")
    mistake("reproduce", recordings, "--out", tmp_path / "file" / "out")
