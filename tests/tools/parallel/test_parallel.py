"""Tasks and commands in turn, in processes, and on a real Dask cluster of two workers, one of which may be killed."""

import os
import signal
import socket
import sys
import threading
from multiprocessing import active_children
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shearloop.cli import main
from shearloop.daemon.process import raise_ending_signals
from shearloop.errors import UserError
from shearloop.tools.parallel import LOCAL, ProcessExecutor, SerialExecutor, open_executor
from tests.tools.parallel.conftest import dask
from tests.tools.test_bank_config import write_bank_config

# Every worker imports this module for its tasks: what takes long to import is imported by the test that needs it.


def square(shared: dict[str, float], item: int) -> float:
    """Return what every kind of worker has to return alike."""
    return float(np.sin(shared["factor"] * item) ** 2)


def fails(_: None, item: int) -> int:
    """Fail for one item."""
    if item == 2:
        raise UserError("item 2 is wrong")
    return item


def dies_once(folder: str, item: int) -> int:
    """Leave a line for every run; item 4 kills its worker the first time."""
    with (Path(folder) / "runs").open("a") as file:
        file.write(f"{item}\n")
    first = Path(folder) / "killed"
    if item == 4 and not first.exists():
        first.write_text(str(os.getpid()))
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item


@pytest.mark.long
def test_all_executors_give_the_same_numbers(scheduler):
    items, shared = list(range(12)), {"factor": 0.37}
    alone = list(SerialExecutor().map(square, shared, items))
    assert list(ProcessExecutor(2).map(square, shared, items)) == alone
    with open_executor(scheduler) as cluster:
        assert list(cluster.map(square, shared, items)) == alone


@pytest.mark.parametrize("cluster", [None, LOCAL])
@pytest.mark.parametrize("jobs", [None, 1, 5])
def test_without_an_address_tasks_run_in_processes_of_this_computer(cluster, jobs):
    count = jobs or {None: 1, LOCAL: len(os.sched_getaffinity(0))}[cluster]
    with open_executor(cluster, jobs) as executor:
        if count == 1:
            assert isinstance(executor, SerialExecutor)
        else:
            assert isinstance(executor, ProcessExecutor)
            assert executor.count == count


def waits(shared: tuple[str, str], _: int) -> None:
    """Tell that this runs, and for whom the process works; be in the middle of a task then."""
    Path(shared[0]).write_text(str(os.getpid()))
    threading.Event().wait(600)


def ignored_signals(_: None, __: int) -> set[int]:
    """Return which of a terminal's signals this process ignores."""
    return {number for number in (signal.SIGINT, signal.SIGHUP) if signal.getsignal(number) is signal.SIG_IGN}


def test_worker_processes_ignore_the_terminals_signals():
    assert list(ProcessExecutor(1).map(ignored_signals, None, [0])) == [{signal.SIGINT, signal.SIGHUP}]


def held_signals(_: None, __: int) -> set[int]:
    """Return which signals this process holds back, also while it was loaded."""
    return signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_ctrl_c_does_not_reach_a_worker_process_that_loads():
    assert list(ProcessExecutor(1).map(held_signals, None, [0])) == [{signal.SIGINT}]
    assert signal.SIGINT not in held_signals(None, 0)


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("more", ["", "x" * (1 << 20)], ids=["small", "large"])
def test_worker_processes_end_on_an_interrupt(number, more, tmp_path):
    os.mkfifo(tmp_path / "pids")
    running: list[int] = []

    def interrupt() -> None:
        """Interrupt this process as soon as a task waits."""
        running.append(int((tmp_path / "pids").read_text()))
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt), raise_ending_signals():
        list(ProcessExecutor(1).map(waits, (str(tmp_path / "pids"), more), range(30)))
    thread.join()
    assert active_children() == []
    with pytest.raises(ProcessLookupError):
        os.kill(running[0], 0)


@pytest.mark.usefixtures("default_signals")
def test_an_interrupt_ends_quietly_where_processes_die_before_anything_else_is_told(tmp_path, monkeypatch):
    # As on a busy computer: the pool's own thread finds its dead process while it knows nothing of the interrupt.
    terminate = SpawnProcess.terminate
    monkeypatch.setattr(SpawnProcess, "terminate", lambda process: (terminate(process), wait([process.sentinel])))
    os.mkfifo(tmp_path / "pids")

    def interrupt() -> None:
        """Interrupt this process as soon as a task waits."""
        (tmp_path / "pids").read_text()
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt), raise_ending_signals():
        list(ProcessExecutor(1).map(waits, (str(tmp_path / "pids"), ""), range(30)))
    thread.join()
    assert active_children() == []


def test_a_tasks_error_is_raised(scheduler):
    with open_executor(scheduler) as cluster, pytest.raises(UserError, match="item 2 is wrong"):
        list(cluster.map(fails, None, range(4)))


def test_a_killed_worker_costs_only_its_own_tasks(scheduler, tmp_path):
    with open_executor(scheduler) as cluster:
        results = list(cluster.map(dies_once, str(tmp_path), range(12)))
    assert results == [item * item for item in range(12)]
    assert (tmp_path / "killed").exists()
    runs = [int(line) for line in (tmp_path / "runs").read_text().split()]
    # Twice ran the task that it died of, and what it had done but not yet handed over; all else once.
    assert runs.count(4) == 2
    assert len(runs) < 2 * 12 - 3


def test_unfinished_results_are_dropped_quietly(scheduler):
    with open_executor(scheduler) as cluster:
        found = cluster.map(square, {"factor": 0.37}, range(3))
        next(found)
    # Python throws the iterator away here; what fails in it then is a warning, and so an error.
    del found


def size(_: None, item: Any) -> int:
    """Return the number of values."""
    return int(item.size)


def test_a_large_recording_is_sent_to_a_cluster_without_a_warning(scheduler):
    with open_executor(scheduler) as cluster:
        assert list(cluster.map(size, None, [np.zeros(1_500_000)])) == [1_500_000]


def test_a_missing_scheduler_is_one_sentence(tmp_path, mistake):
    command = ["bank", "build", "--config", write_bank_config(tmp_path), "--out", tmp_path / "a.bank"]
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in mistake(*command, "--cluster", "tcp://127.0.0.1:9")


def test_a_server_that_is_no_scheduler_times_out(monkeypatch):
    monkeypatch.setattr("shearloop.tools.parallel.CONNECT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        address = f"tcp://127.0.0.1:{deaf.getsockname()[1]}"
        refusal = f"no Dask scheduler answers at {address} within 0.5 s"
        with pytest.raises(UserError, match=refusal), open_executor(address):
            pass


def test_a_scheduler_without_workers_or_a_lost_one_is_one_sentence(tmp_path, monkeypatch):
    import distributed

    with dask(tmp_path) as (address, (process,)):
        monkeypatch.setattr("shearloop.tools.parallel.FIRST_WORKER_S", 0.5)
        lonely = f"at {address} has no worker; start some with `dask worker"
        with pytest.raises(UserError, match=lonely), open_executor(address):
            pass
        monkeypatch.setattr(distributed.Client, "wait_for_workers", lambda *_, **__: None)
        # As soon as a task is waited for.
        begun = distributed.Future.result
        monkeypatch.setattr(distributed.Future, "result", lambda task: (process.kill(), begun(task))[1])
        lost = "the connection to the Dask scheduler was lost"
        with open_executor(address) as cluster, pytest.raises(UserError, match=lost):
            list(cluster.map(square, {"factor": 1.0}, range(3)))


def test_a_cluster_address_needs_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UserError, match=r"pip install 'shearloop\[cluster\]'"), open_executor("tcp://127.0.0.1:9"):
        pass


@pytest.fixture(scope="module")
def bank(tmp_path_factory) -> Path:
    """Return a bank built here, before any test is watched (tqdm's thread)."""
    folder = tmp_path_factory.mktemp("banks")
    command = ["bank", "build", "--config", str(write_bank_config(folder)), "--out", str(folder / "here.bank")]
    assert main([*command, "--jobs", "1"]) == 0
    return folder / "here.bank"


@pytest.mark.long
def test_evaluate_gives_the_same_figures_on_a_cluster(scheduler, shared, tmp_path, ran, result_of):
    slices, cylinders = (str(shared / "recordings" / name) for name in ("torque_slices", "diameter_slices"))
    calibration = str(tmp_path / "slices.cal")
    ran("calibrate", slices, "--estimator", "regression", "--time-range", "0:0.6", "--out", calibration)
    figures = []
    for options in ([], ["--cluster", scheduler]):
        found = result_of("evaluate", calibration, slices, cylinders, "--time-range", "0.6:1", *options)
        figures.append({name: value for name, value in found.items() if not name.startswith("latency")})
    assert figures[0] == figures[1]


@pytest.mark.long
def test_a_bank_of_a_cluster_has_the_same_bytes(bank, scheduler):
    again, config = bank.with_name("there.bank"), str(bank.with_name("bank.yaml"))
    assert main(["bank", "build", "--config", config, "--out", str(again), "--cluster", scheduler]) == 0
    assert again.read_bytes() == bank.read_bytes()


@pytest.mark.long
def test_a_chart_of_a_cluster_has_the_same_numbers(scheduler, tmp_path):
    from shearloop.estimation import Physics
    from shearloop.studies.charts.chart_data import Split, own_fingertip, synthetic_slices
    from shearloop.studies.charts.fault_sweeps import FAULTS, sweeps
    from shearloop.tools.banks import Grid, cached_bank

    grid = Grid(np.linspace(3.0, 3.6, 5), np.linspace(1.0, 2.1, 8))
    bank = cached_bank("chart", grid, own_fingertip(0.4).mesh(), tmp_path)
    slices = synthetic_slices(tmp_path)
    # Few frames are judged at each level of each fault.
    split = Split("slices", slices.between(0, 29), slices.between(29, 31), slices)
    # The quickest one, twice: a task each.
    names = ("regression", "regression")
    with open_executor(scheduler) as cluster:
        there = sweeps(split, names, Physics(bank, None), bank, cluster)
    assert there == sweeps(split, names[:1], Physics(bank, None), bank, SerialExecutor()) * 2
    assert len(there) == 2 * len(FAULTS)
