"""`bank design` on recorded slices: what it prints is what `bank build` takes."""

from pathlib import Path

import numpy as np
import pytest

from bank.bank_file import Bank
from daemon.bank_config import load_bank_plan
from daemon.cli import main


@pytest.fixture(scope="session")
def built(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a design and the bank built by it, before any test is watched: tqdm keeps a thread."""
    folder = tmp_path_factory.mktemp("design")
    config = folder / "design.yaml"
    assert main(["bank", "design", str(shared / "recordings" / "torque_slices"), "--out", str(config)]) == 0
    assert main(["bank", "build", "--config", str(config), "--out", str(folder / "scene.bank"), "--jobs", "1"]) == 0
    return folder


def test_a_design_is_a_configuration_that_builds(built: Path) -> None:
    config = built / "design.yaml"
    text = config.read_text()
    assert "of a difference frame" in text
    assert "injections" in text
    plan = load_bank_plan(config)
    assert plan.k_grid[0] < 3.3 < plan.k_grid[-1]
    bank = Bank.open(built / "scene.bank")
    np.testing.assert_array_equal(bank.k_grid, plan.k_grid)
    assert bank.valid.any()


def test_a_recording_that_is_none_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bank", "design", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
