import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.daemon.recording.matlab_import import import_mat

PERIOD_S = 0.5408
# 2024-12-03 16:09 as MATLAB counts days.
START_DATENUM = 739589.673


def datenum(t_s):
    return START_DATENUM + np.asarray(t_s) / 86400.0


def lines(n: int, seed: int = 0) -> np.ndarray:
    return PAPER_TABLE.line_of_channels(np.round(np.random.default_rng(seed).uniform(0.01, 0.5, (n, 896)), 4))


@pytest.fixture
def mat_folder(tmp_path) -> Callable[..., Path]:
    """Writes the streams of a recording as the paper's scripts did: by default two sides and a load of its own pace."""

    def write(name="streams", *, late=(), one_loop=False, glitches=(), sides=("Right_Data", "Left_Data")) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        arrival = PERIOD_S * np.arange(1, 61)
        for i, delay in late:
            arrival[i] += delay
        for j, side in enumerate(sides):
            stamps = arrival + 0.05 * j
            savemat(folder / f"device{j}.mat", {side: np.column_stack([datenum(stamps), lines(60, j)])})
        load_t = arrival if one_loop else np.arange(0.5, 33.0, 0.0916)
        load = 0.05 * np.sin(0.3 * np.arange(len(load_t)))
        for i in glitches:
            load[i] = 3.84e7
        savemat(folder / "load.mat", {"Load_Data": np.column_stack([datenum(load_t), load])})
        return folder

    return write


@pytest.fixture
def imported(mat_folder, tmp_path) -> Path:
    """The recording of two sides and a load, imported."""
    import_mat([mat_folder()], tmp_path / "imported.mcap")
    return tmp_path / "imported.mcap"


@pytest.fixture
def slices_folder(request, tmp_path) -> Path:
    """49 torque slices and 16 of cylinders, made of smooth shapes, a drift and noise.

    The parameter is the share of the largest torque above which the frame no longer changes.
    """
    rng = np.random.default_rng(3)
    base, slope, drift, cylinder = (np.abs(rng.normal(0, s, 896)) for s in (6e-3, 1.2e-3, 4e-4, 3e-3))
    folder = tmp_path / "slices"
    for name in ("torque_slices", "diameter_slices"):
        (folder / name).mkdir(parents=True)
    for n in range(49):
        z = (n % 10) / 4.5 - 1
        frame = np.abs(
            base + min(z, getattr(request, "param", 1.0)) * slope + n / 49 * drift + rng.normal(0, 5e-4, 896)
        )
        path = folder / "torque_slices" / f"Data_Slice_{n + 1}.mat"
        savemat(path, {"data_diff": frame[None], "torque_value": 0.075 + 0.065 * z})
    for n in range(16):
        diameter = 10 * (n % 4 + 1)
        frame = np.abs(0.5 * base + diameter / 25 * cylinder + rng.normal(0, 4e-4, 896))
        path = folder / "diameter_slices" / f"{diameter}mm_Data_{n // 4 + 1}.mat"
        savemat(path, {"data_diff": frame[None], "mean_torque": 0.1})
    return folder


@pytest.fixture
def small_disk(request, tmp_path) -> Iterator[Path]:
    """A file system of the size in the test's parameter."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={request.param}", "tmpfs", folder]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("only root can mount a file system, and not in every container")
    yield folder
    subprocess.run(["umount", folder], check=True)


@pytest.fixture(scope="session")
def rerun_runtime(tmp_path_factory) -> None:
    """Start the threads and files of the Rerun SDK, which stay until the process ends."""
    rerun = pytest.importorskip("rerun", reason="needs the extra `rerun`")
    path = tmp_path_factory.mktemp("rerun") / "a.rrd"
    stream = rerun.RecordingStream("test")
    stream.save(path)
    stream.disconnect()
    list(pytest.importorskip("rerun.chunk").RrdReader(path).stream())
