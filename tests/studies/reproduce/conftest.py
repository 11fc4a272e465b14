"""A tiny reproduction: a coarse fingertip, banks of a few cells, and slices made from them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import savemat

from shearloop.bank.bank_file import BankDefinition
from shearloop.bank.build import RowSolver
from shearloop.bank.mesh import Mesh
from shearloop.tools import banks
from shearloop.tools.bank_config import load_geometry
from shearloop.tools.banks import Grid

K, SIGMA = np.linspace(2.6, 3.6, 7), np.linspace(1.0, 2.0, 8)


@pytest.fixture(scope="session", autouse=True)
def _drawing(fonts) -> None:
    """Have the fonts open for all tests here."""


@pytest.fixture(scope="session")
def coarse_fingertip(tmp_path_factory) -> Path:
    text = banks.OWN_FINGERTIP.read_text()
    assert "mesh_size_cm: 0.07" in text
    path = tmp_path_factory.mktemp("fingertip") / "coarse.yaml"
    path.write_text(text.replace("mesh_size_cm: 0.07", "mesh_size_cm: 0.6"))
    return path


@pytest.fixture(scope="session")
def coarse_mesh(coarse_fingertip) -> Mesh:
    return load_geometry(coarse_fingertip).mesh


@pytest.fixture(scope="session")
def signals(coarse_mesh) -> NDArray[np.float32]:
    """(7, 8, 896) signals over K and SIGMA, as a bank has them."""
    solver = RowSolver(coarse_mesh, BankDefinition(coarse_mesh.digest, banks.MODEL, K, SIGMA))
    return np.stack([solver.solve(row).signals for row in range(len(K))])


@pytest.fixture
def small_grids(monkeypatch) -> None:
    for name in banks.GRIDS:
        monkeypatch.setitem(banks.GRIDS, name, Grid(K, SIGMA))


MakeRecordings = Callable[..., Path]


@pytest.fixture
def make_recordings(tmp_path, signals) -> MakeRecordings:
    """Return a function that writes slices: of three series, sigma falls with torque; k falls with diameter."""

    def make(torque: bool = True, diameter: bool = True, raw: bool = True) -> Path:
        noise = np.random.default_rng(5)
        folder = tmp_path / "site" / "recordings"
        if torque:
            (folder / "torque_slices").mkdir(parents=True)
            for number in range(21):
                level = number % 7
                slice_ = np.abs(signals[3, 7 - level]) + noise.uniform(0, 2e-4, 896)
                savemat(
                    folder / "torque_slices" / f"Data_Slice_{number + 4}.mat",
                    {"data_diff": slice_[None], "torque_value": 0.02 * level + noise.uniform(0, 1e-3)},
                )
        if torque and raw:
            line = np.zeros((2, 1024))
            line[:, 3:] = noise.uniform(0.1, 0.3, (2, 1021))
            savemat(folder / "torque_slices" / "TorqueSlice.mat", {"clipped_data": line[:1]})
            savemat(folder / "torque_slices" / "TorqueSliceHom.mat", {"clipped_data_hom": line[1:]})
        if diameter:
            (folder / "diameter_slices").mkdir(parents=True)
            for index, millimetres in enumerate((10, 20, 30)):
                for repeat in (1, 2):
                    savemat(
                        folder / "diameter_slices" / f"{millimetres}mm_Data_{repeat}.mat",
                        {"data_diff": np.abs(signals[5 - 2 * index, 4])[None], "mean_torque": 0.1},
                    )
        return folder

    return make
