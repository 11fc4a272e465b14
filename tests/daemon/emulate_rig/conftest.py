import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from shearloop.bank.eit.bank_file import BankDefinition, write_bank
from tests.daemon.emulate_rig.rig import HOMOGENEOUS, PACE, PATTERN, RigProcess


@pytest.fixture(scope="session")
def bank(tmp_path_factory) -> Path:
    """A bank whose signals grow with σ along a known pattern."""
    path = tmp_path_factory.mktemp("bank") / "rig.bank"
    sigma = np.array([0.9, 2.3])
    definition = BankDefinition("0" * 64, "gaussian_derivative", np.array([3.0, 4.0]), sigma)
    signals = np.broadcast_to(sigma[None, :, None] * PATTERN, (2, 2, 896)).astype(np.float32)
    write_bank(path, definition, HOMOGENEOUS, np.full((2, 2), 0.5), np.ones((2, 2), bool), signals)
    return path


@pytest.fixture(scope="module")
def rig_process(bank, tmp_path_factory) -> Iterator[RigProcess]:
    run_dir = tmp_path_factory.mktemp("run")
    process = RigProcess("rig", "--bank", str(bank), "--run-dir", str(run_dir), *PACE, module=2, ready="rig ready")
    process.run_dir = run_dir
    yield process
    assert process.close() == 0, "it ends when its input does"
    assert not list(run_dir.iterdir()), "and leaves no port behind"


@pytest.fixture
def rig(rig_process) -> Iterator[RigProcess]:
    """The module's rig, without faults after the test."""
    yield rig_process
    asyncio.run(rig_process.fault("normal"))
