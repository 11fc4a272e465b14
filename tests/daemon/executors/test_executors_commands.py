"""Banks, evaluations and charts from a real Dask cluster, a worker of which is killed, are the same as without."""

import json
import os
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shearloop.daemon.cli import main
from shearloop.daemon.executors import DaskExecutor, SerialExecutor, open_executor
from tests.daemon.executors.conftest import STARTED_S
from tests.daemon.test_bank_config import BANK, FINGERTIP


@pytest.fixture(scope="module")
def bank(tmp_path_factory) -> Path:
    """Return a bank built here, before any test is watched (tqdm's thread)."""
    folder = tmp_path_factory.mktemp("banks")
    (folder / "tip.yaml").write_text(FINGERTIP)
    (folder / "bank.yaml").write_text(BANK)
    command = ["bank", "build", "--config", str(folder / "bank.yaml"), "--out", str(folder / "here.bank")]
    assert main([*command, "--jobs", "1"]) == 0
    return folder / "here.bank"


@pytest.fixture(scope="module")
def varied(bank, scheduler) -> tuple[Path, Path]:
    """Return folders of banks over tilt and amplitude, built here and on the cluster."""
    folder = bank.parent
    over = "over: {tilt_deg: {low: -5, high: 5, count: 2}, amplitude: {low: 0.5, high: 1, count: 2}}"
    (folder / "over.yaml").write_text(f"{BANK}{over}\n")
    for name, options in (("over-here", ["--jobs", "1"]), ("over-there", ["--cluster", scheduler])):
        command = ["bank", "build", "--config", str(folder / "over.yaml"), "--out", str(folder / name), *options]
        assert main(command) == 0
    return folder / "over-here", folder / "over-there"


def test_banks_over_more_parameters_have_the_same_bytes_from_a_cluster(varied):
    here, there = ({path.name: path.read_bytes() for path in folder.iterdir()} for folder in varied)
    assert len(set(here.values())) == 4
    assert here == there


@pytest.fixture
def killed(scheduler, monkeypatch) -> Iterator[list[int]]:
    """Kill a worker as soon as the first result of anything is here, and give the numbers of those killed.

    Its nanny starts another one, which is waited for at the end.
    """
    from distributed import Client

    found: list[int] = []
    whole = DaskExecutor.map

    def interrupted(self: DaskExecutor, function: Any, shared: Any, items: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        for number, result in whole(self, function, shared, items):
            if not found:
                found.append(next(iter(self._client.run(os.getpid).values())))
                os.kill(found[0], signal.SIGKILL)
            yield number, result

    monkeypatch.setattr(DaskExecutor, "map", interrupted)
    yield found
    with Client(scheduler, timeout=STARTED_S) as client:
        client.wait_for_workers(2, timeout=STARTED_S)


def test_evaluate_gives_the_same_figures_on_a_cluster_with_a_killed_worker(scheduler, shared, tmp_path, capsys, killed):
    slices, cylinders = (str(shared / "recordings" / name) for name in ("torque_slices", "diameter_slices"))
    calibration = str(tmp_path / "slices.cal")
    assert main(["calibrate", slices, "--estimator", "regression", "--time-range", "0:0.6", "--out", calibration]) == 0
    figures = []
    for options in ([], ["--cluster", scheduler]):
        capsys.readouterr()
        assert main(["evaluate", calibration, slices, cylinders, "--time-range", "0.6:1", "--json", *options]) == 0
        found = json.loads(capsys.readouterr().out)
        figures.append({name: value for name, value in found.items() if not name.startswith("latency")})
    assert killed
    assert figures[0] == figures[1]


def test_a_bank_has_the_same_bytes_after_a_killed_worker(bank, scheduler, killed):
    again, config = bank.with_name("killed.bank"), str(bank.with_name("bank.yaml"))
    assert main(["bank", "build", "--config", config, "--out", str(again), "--cluster", scheduler]) == 0
    assert killed
    assert again.read_bytes() == bank.read_bytes()


@pytest.mark.usefixtures("few_mixtures")
def test_a_chart_has_the_same_numbers_after_a_killed_worker(scheduler, killed, tmp_path):
    from shearloop.bank.estimation import Physics
    from shearloop.daemon.analysis.charts.fault_sweeps import FAULTS, sweeps
    from shearloop.daemon.analysis.charts.sources import Split, bank_of, own_fingertip, synthetic_slices
    from shearloop.daemon.analysis.reproduce.banks import Grid

    bank = bank_of(None, own_fingertip(0.4).mesh(), tmp_path, Grid(np.linspace(3.0, 3.6, 5), np.linspace(1.0, 2.1, 8)))
    slices = synthetic_slices(tmp_path)
    # Few frames are judged at each level of each fault.
    split = Split("slices", slices.between(0, 29), slices.between(29, 31), slices)
    # The quickest one, twice: a task each.
    names = ("regression", "regression")
    with open_executor(scheduler) as cluster:
        there = sweeps(split, names, Physics(bank, None), bank, cluster)
    assert killed
    assert there == sweeps(split, names[:1], Physics(bank, None), bank, SerialExecutor()) * 2
    assert len(there) == 2 * len(FAULTS)
