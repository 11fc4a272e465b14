"""Fingertips of other kinds, from their YAML alone: from the bank to a torque in the daemon."""

from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
import yaml

from shearloop.bank.bank_file import Bank
from shearloop.bank.build import build_bank
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.emulators.boards import EitKitBoard, format_line
from shearloop.estimation import fit
from shearloop.estimation.estimator import Physics
from shearloop.studies.emulated_calibration import write_recordings
from shearloop.tools.bank_config import load_bank_plan
from shearloop.tools.frame_series import read_series
from shearloop.tools.recordings.frames import read_recording
from tests.fixtures.daemons import collector, running_daemon
from tests.running import running

SPEED = 50


@pytest.fixture(scope="module", params=["round", "long"])
def bank(request, tmp_path_factory) -> Path:
    """Build a bank of a fingertip from its YAML."""
    folder = tmp_path_factory.mktemp(request.param)
    grid = {"low": 2.9, "high": 4.1, "count": 9}
    content = {
        "fingertip": str(Path(f"config/fingertips/{request.param}.yaml").resolve()),
        "mesh_size_cm": 0.3,
        "model": "gaussian_derivative",
        "k": grid,
        "sigma": {"low": 0.9, "high": 2.3, "count": 15},
    }
    (folder / "bank.yaml").write_text(yaml.safe_dump(content))
    plan = load_bank_plan(folder / "bank.yaml")
    build_bank(plan.mesh, plan.definition, folder / f"{request.param}.bank")
    return folder / f"{request.param}.bank"


@pytest.fixture(scope="module")
def twists(bank) -> Path:
    """Record twists of an emulated rig with this fingertip on both sides."""
    (path,) = write_recordings(bank, bank.parent, (20.0,), 3)
    return path


@pytest.mark.parametrize("estimator", ["motion_regression", "bank"])
async def test_a_fingertip_of_another_kind_gives_its_torque(estimator, bank, twists, config, tmp_path):
    table = Bank.open(bank).table
    assert table.n_channels == {"round.bank": 208, "long.bank": 896}[bank.name]
    (series,) = read_series(twists, ("right",))
    calibration = tmp_path / "right.cal"
    fit(estimator, [series], "emulated twists", Physics(bank=Bank.open(bank))).save(calibration)
    lines = list(read_recording(twists).sides["right"].lines)
    right = {"bank": str(bank), "calibration": str(calibration), "frame_period_s": FRAME_PERIOD_S / SPEED}
    path = config(right=right, emulated=True)
    board = EitKitBoard(map(format_line, cycle(lines)), period_s=FRAME_PERIOD_S / SPEED, link=tmp_path / "eit-right")
    truth_nm, errors_nm, places = series.torque_at_frames(), [], []
    async with running(board.run()), running_daemon(path) as daemon:
        estimates = collector(daemon, "eit.estimate")
        for _ in range(len(lines)):
            estimate = await estimates.get()
            # On a busy computer, a frame that waited behind newer ones is not looked up in the bank.
            if estimate["k"] is not None:
                places.append(estimate["k"])
            if estimate["torque_nm"] is not None:
                errors_nm.append(estimate["torque_nm"] - truth_nm[estimate["seq"] % len(lines)])
    assert len(errors_nm) > 100
    assert places
    assert all(2.9 <= place <= 4.1 for place in places)
    assert np.std(errors_nm) < 0.3 * np.nanstd(truth_nm)
