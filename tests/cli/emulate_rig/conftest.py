from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.emulate_rig.rig import PACE, RigProcess, write_rig_bank


@pytest.fixture(scope="session")
def bank(tmp_path_factory) -> Path:
    """A bank whose signals grow with σ along a known pattern."""
    return write_rig_bank(tmp_path_factory.mktemp("bank") / "rig.bank")


@pytest.fixture
def rig(bank, tmp_path) -> Iterator[RigProcess]:
    run_dir = tmp_path / "run"
    process = RigProcess("rig", "--bank", str(bank), "--run-dir", str(run_dir), *PACE, module=2, ready="rig ready")
    process.run_dir = run_dir
    yield process
    assert process.close() == 0, "it ends when its input does"
    assert not list(run_dir.iterdir()), "and leaves no port behind"
