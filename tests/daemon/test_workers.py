"""The same tasks in turn, in processes, and on a real Dask cluster of two workers, one of which may be killed."""

import json
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, nullcontext
from multiprocessing import active_children, get_context, resource_tracker
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeAlias, cast
from unittest.mock import AsyncMock

import numpy as np
import pytest

import daemon.workers
from daemon.cli import main
from daemon.cli.interruption import interrupts_heard
from daemon.errors import UserError
from daemon.workers import Cluster, InTurn, Processes, workers
from tests.daemon.test_bank_config import BANK, FINGERTIP

# Every worker imports this module for its tasks: what takes long to import is imported by the test that needs it.
ROOT = Path(__file__).parents[2]
STARTED_S = 90
# From a signal and what it interrupts to the process in which a task was.
Interrupted: TypeAlias = Callable[[signal.Signals, Callable[[], object]], int]


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Start a scheduler and two workers, all processes of their own, and return the address."""
    from distributed import Client
    from distributed.utils import _offload_executor

    # Spawned processes have a tracker of resources, and Dask has a thread for large messages: both stay for good.
    resource_tracker.ensure_running()
    _offload_executor.submit(int).result()
    folder = tmp_path_factory.mktemp("dask")
    found, log = folder / "scheduler.json", folder / "log"
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "OPENBLAS_NUM_THREADS": "1",
        # A worker is forked, also the one that takes a killed one's place, instead of importing everything anew.
        "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver",
        "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    }
    common = ["--scheduler-file", str(found), "--no-dashboard"]
    two = ["--nworkers", "2", "--nthreads", "1", "--local-directory", str(folder)]
    commands = [
        ["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", *common],
        ["distributed.cli.dask_worker", *two, *common],
    ]
    processes: list[subprocess.Popen[bytes]] = []
    with ExitStack() as stack:
        output = stack.enter_context(log.open("wb"))
        try:
            processes += [
                subprocess.Popen(
                    [sys.executable, "-m", *command], cwd=ROOT, env=environment, stdout=output, stderr=output
                )
                for command in commands
            ]
            with Client(scheduler_file=str(found), timeout=STARTED_S) as client:
                client.wait_for_workers(2, timeout=STARTED_S)
                address = str(client.scheduler.address)
            yield address
        finally:
            # The workers first: without their scheduler they would wait for it.
            for process in reversed(processes):
                process.terminate()
                process.wait(STARTED_S)


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


def test_the_numbers_are_the_same_wherever_they_are_computed(scheduler: str) -> None:
    items, shared = list(range(12)), {"factor": 0.37}
    alone = dict(InTurn().map(square, shared, items))
    assert dict(Processes(2).map(square, shared, items)) == alone
    with workers(scheduler) as cluster:
        assert dict(cluster.map(square, shared, items)) == alone


def test_what_a_task_raises_is_raised_here(scheduler: str) -> None:
    with workers(scheduler) as cluster, pytest.raises(UserError, match="item 2 is wrong"):
        list(cluster.map(fails, None, range(4)))


def test_a_worker_killed_in_the_middle_costs_only_its_tasks(scheduler: str, tmp_path: Path) -> None:
    with workers(scheduler) as cluster:
        results = dict(cluster.map(dies_once, str(tmp_path), range(12)))
    assert results == {item: item * item for item in range(12)}
    assert (tmp_path / "killed").exists()
    runs = [int(line) for line in (tmp_path / "runs").read_text().split()]
    # Twice ran the task that it died of, and what it had done but not yet handed over; all else once.
    assert runs.count(4) == 2
    assert len(runs) < 2 * 12 - 3


def test_results_that_nobody_goes_on_with_are_let_go_after_the_end_of_the_cluster(scheduler: str) -> None:
    """So ends what is interrupted where a result is used; a traceback told of it after the sentence."""
    with workers(scheduler) as cluster:
        found = cluster.map(square, {"factor": 0.37}, range(3))
        next(found)
    # Python throws the iterator away here; what fails in it then is a warning, and so an error.
    del found


def interrupts_blocked(tell: Any) -> None:
    """Tell whether this process hears of Ctrl-C."""
    tell.send(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))


@pytest.mark.usefixtures("scheduler")
def test_a_local_cluster_is_quiet_and_ctrl_c_reaches_none_of_its_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal interrupts all processes: each worker printed a traceback before the one sentence."""
    told: dict[str, Any] = {}
    begun: list[str] = []
    ours, its = get_context("spawn").Pipe(duplex=False)

    class Local:
        """Begins a process as the real one does: in a thread of its own."""

        def __init__(self, **options: Any) -> None:
            begun.append("cluster")
            told.update(options)
            process = get_context("spawn").Process(target=interrupts_blocked, args=(its,))
            thread = threading.Thread(target=process.start)
            thread.start()
            thread.join()
            process.join(STARTED_S)

        def sync(self, *_: object) -> None:
            """Nobody works here."""

        def __enter__(self) -> "Local":
            return self

        def __exit__(self, *_: object) -> None:
            told["closed"] = True

    # Were it begun with the first process, it would let interrupts in again there; here it runs since `scheduler`.
    monkeypatch.setattr(resource_tracker, "ensure_running", lambda: begun.append("tracker"))
    monkeypatch.setattr("distributed.LocalCluster", Local)
    monkeypatch.setattr("distributed.Client", nullcontext)
    with workers("local", 2):
        assert ours.recv()
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    assert begun[:2] == ["tracker", "cluster"]
    assert told["closed"]
    assert told["silence_logs"] == logging.CRITICAL
    ours.close()
    its.close()


def waits(told: str, _: int) -> None:
    """Tell that this runs, and for whom the process works; be in the middle of a task then."""
    Path(told).write_text(str(os.getpid()))
    threading.Event().wait(600)


def terminal_signals_blocked(_: None, __: int) -> set[int]:
    """Return which of a terminal's signals this process does not hear of."""
    return {signal.SIGINT, signal.SIGHUP} & set(signal.pthread_sigmask(signal.SIG_BLOCK, []))


def test_processes_beside_this_one_hear_nothing_of_the_terminal() -> None:
    """At Ctrl-C each of them failed in its task, and began another."""
    assert list(Processes(1).map(terminal_signals_blocked, None, [0])) == [(0, {signal.SIGINT, signal.SIGHUP})]
    assert terminal_signals_blocked(None, 0) == set()


@pytest.fixture
def interrupted_once_it_works(tmp_path: Path) -> Iterator[Interrupted]:
    """Interrupts this process as soon as a task `waits`, and returns the process that the task was in."""
    os.mkfifo(tmp_path / "told")
    running: list[int] = []

    def interrupt(number: signal.Signals) -> None:
        running.append(int((tmp_path / "told").read_text()))
        os.kill(os.getpid(), number)

    def during(number: signal.Signals, work: Callable[[], object]) -> int:
        thread = threading.Thread(target=interrupt, args=(number,))
        thread.start()
        with pytest.raises(KeyboardInterrupt), interrupts_heard():
            work()
        thread.join()
        return running[0]

    # A test process may have been told to ignore it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield during
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_processes_end_when_this_one_is_interrupted(
    number: signal.Signals, interrupted_once_it_works: Interrupted, tmp_path: Path
) -> None:
    """They were waited for until their tasks were done; of SIGTERM they did not hear, and stayed."""
    process = interrupted_once_it_works(
        number, lambda: list(Processes(1).map(waits, str(tmp_path / "told"), [0, 1, 2]))
    )
    assert active_children() == []
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


@pytest.mark.usefixtures("scheduler")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_local_cluster_ends_when_it_is_interrupted_and_again_while_it_ends(
    number: signal.Signals, interrupted_once_it_works: Interrupted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Closing that was interrupted was waited for at exit, for 10 s, and left a worker in the middle of a task."""
    end_workers = daemon.workers._end_workers
    ended: list[Any] = []

    async def again(local: Any) -> None:
        os.kill(os.getpid(), number)
        await end_workers(local)
        ended.append(local)

    def work() -> None:
        with workers("local", 1) as cluster:
            next(cluster.map(waits, str(tmp_path / "told"), [0]))

    monkeypatch.setattr("daemon.workers._end_workers", again)
    worker = interrupted_once_it_works(number, work)
    assert ended[0].status.name == "closed"
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


def test_what_fails_because_everything_is_ended_is_told_as_that() -> None:
    """As workers that were to begin, where a whole group of processes is sent SIGTERM: it was a traceback."""

    def fails(number: signal.Signals | None) -> None:
        with interrupts_heard(), daemon.workers._interrupted_later():
            if number is not None:
                signal.raise_signal(number)
            raise RuntimeError

    with pytest.raises(KeyboardInterrupt):
        fails(signal.SIGTERM)
    with pytest.raises(RuntimeError):
        fails(None)


async def test_workers_are_given_little_time_to_end_each_though_another_fails() -> None:
    """One in the middle of a task had 4 s."""
    nannies = [SimpleNamespace(close=AsyncMock(side_effect=TimeoutError)) for _ in range(2)]
    await daemon.workers._end_workers(cast(Any, SimpleNamespace(workers=dict(enumerate(nannies)))))
    for nanny in nannies:
        nanny.close.assert_awaited_once_with(timeout=daemon.workers.WORKERS_END_S)


def size(_: None, item: Any) -> int:
    """Return the number of values."""
    return int(item.size)


def test_a_large_recording_is_sent_to_a_cluster_without_a_warning(scheduler: str) -> None:
    """Dask warned of what is over 10 MB, in six lines; warnings are errors here."""
    with workers(scheduler) as cluster:
        assert list(cluster.map(size, None, [np.zeros(1_500_000)])) == [(0, 1_500_000)]


@pytest.fixture(scope="module")
def banks(scheduler: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a bank built here, and the same one built on the cluster; before any test is watched (tqdm's thread)."""
    folder = tmp_path_factory.mktemp("banks")
    (folder / "tip.yaml").write_text(FINGERTIP)
    (folder / "bank.yaml").write_text(BANK)
    built = []
    for name, options in (("here", ["--jobs", "1"]), ("there", ["--cluster", scheduler])):
        built.append(folder / f"{name}.bank")
        command = ["bank", "build", "--config", str(folder / "bank.yaml"), "--out", str(built[-1]), *options]
        assert main(command) == 0
    return built[0], built[1]


def test_a_bank_has_the_same_bytes_from_a_cluster(banks: tuple[Path, Path]) -> None:
    assert banks[0].read_bytes() == banks[1].read_bytes()


@pytest.fixture(scope="module")
def varied(banks: tuple[Path, Path], scheduler: str) -> tuple[Path, Path]:
    """Return folders of banks over tilt and amplitude, built here and on the cluster."""
    folder = banks[0].parent
    over = "over: {tilt_deg: {low: -5, high: 5, count: 2}, amplitude: {low: 0.5, high: 1, count: 2}}"
    (folder / "over.yaml").write_text(f"{BANK}{over}\n")
    for name, options in (("over-here", ["--jobs", "1"]), ("over-there", ["--cluster", scheduler])):
        command = ["bank", "build", "--config", str(folder / "over.yaml"), "--out", str(folder / name), *options]
        assert main(command) == 0
    return folder / "over-here", folder / "over-there"


def test_banks_over_more_parameters_have_the_same_bytes_from_a_cluster(varied: tuple[Path, Path]) -> None:
    here, there = ({path.name: path.read_bytes() for path in folder.iterdir()} for folder in varied)
    assert len(set(here.values())) == 4
    assert here == there


def test_recordings_are_evaluated_to_the_same_figures_on_a_cluster_that_a_worker_is_killed_of(
    scheduler: str, shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], killed: list[int]
) -> None:
    slices, cylinders = (str(shared / "recordings" / name) for name in ("torque_slices", "diameter_slices"))
    calibration = str(tmp_path / "slices.cal")
    assert main(["calibrate", slices, "--estimator", "regression", "--part", "0:0.6", "--out", calibration]) == 0
    figures = []
    for options in ([], ["--cluster", scheduler]):
        capsys.readouterr()
        assert main(["evaluate", calibration, slices, cylinders, "--part", "0.6:1", "--json", *options]) == 0
        found = json.loads(capsys.readouterr().out)
        figures.append({name: value for name, value in found.items() if not name.startswith("latency")})
    assert killed
    assert figures[0] == figures[1]


@pytest.fixture
def killed(scheduler: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Kill a worker as soon as the first result of anything is here, and give the numbers of those killed.

    Its nanny starts another one, which is waited for at the end.
    """
    from distributed import Client

    found: list[int] = []
    whole = Cluster.map

    def interrupted(self: Cluster, function: Any, shared: Any, items: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        for number, result in whole(self, function, shared, items):
            if not found:
                found.append(next(iter(self._client.run(os.getpid).values())))
                os.kill(found[0], signal.SIGKILL)
            yield number, result

    monkeypatch.setattr(Cluster, "map", interrupted)
    yield found
    with Client(scheduler, timeout=STARTED_S) as client:
        client.wait_for_workers(2, timeout=STARTED_S)


def test_a_bank_that_a_worker_is_killed_under_has_the_same_bytes(
    banks: tuple[Path, Path], scheduler: str, killed: list[int]
) -> None:
    again = banks[0].with_name("killed.bank")
    config = str(banks[0].with_name("bank.yaml"))
    assert main(["bank", "build", "--config", config, "--out", str(again), "--cluster", scheduler]) == 0
    assert killed
    assert again.read_bytes() == banks[0].read_bytes()


def test_a_chart_has_the_same_numbers_from_a_cluster_that_a_worker_is_killed_of(
    scheduler: str, killed: list[int], tmp_path: Path
) -> None:
    from bank.estimators import Name, Physics
    from bench.charts.faults import FAULTS
    from bench.charts.sources import Split, bank_of, own_fingertip, synthetic_slices
    from bench.charts.stability import sweeps
    from daemon.reproduce.banks import Grid

    bank = bank_of(None, own_fingertip(0.4).mesh(), tmp_path, Grid(np.linspace(3.0, 3.6, 5), np.linspace(1.0, 2.1, 8)))
    slices = synthetic_slices(tmp_path)
    # Few frames are judged at each level of each fault.
    split = Split("slices", slices.between(0, 29), slices.between(29, 34), slices)
    # The quickest one, twice: a task each.
    names: tuple[Name, ...] = ("regression", "regression")
    with workers(scheduler) as cluster:
        there = sweeps(split, names, Physics(bank, None), bank, cluster)
    assert killed
    assert there == sweeps(split, names, Physics(bank, None), bank, InTurn())
    assert len(there) == 2 * len(FAULTS)


def test_no_scheduler_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tip.yaml").write_text(FINGERTIP)
    (tmp_path / "bank.yaml").write_text(BANK)
    command = ["bank", "build", "--config", str(tmp_path / "bank.yaml"), "--out", str(tmp_path / "a.bank")]
    assert main([*command, "--cluster", "tcp://127.0.0.1:9"]) == 2
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in capsys.readouterr().err


def test_what_listens_and_is_no_scheduler_is_not_waited_for_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daemon.workers.CONNECT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        address = f"tcp://127.0.0.1:{deaf.getsockname()[1]}"
        with pytest.raises(UserError, match=f"no Dask scheduler answers at {address} within 0.5 s"), workers(address):
            pass


@pytest.fixture
def lonely(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Start a scheduler without workers, and return its process and its address."""
    from distributed import Client

    found = tmp_path / "scheduler.json"
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(found)]
    with (tmp_path / "log").open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_scheduler", *options], cwd=ROOT, stdout=output, stderr=output
        )
    try:
        with Client(scheduler_file=str(found), timeout=STARTED_S) as client:
            address = str(client.scheduler.address)
        yield process, address
    finally:
        process.kill()
        process.wait(STARTED_S)


def test_a_scheduler_without_workers_and_one_that_ends_are_one_sentence_each(
    lonely: tuple[subprocess.Popen[bytes], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import distributed

    process, address = lonely
    monkeypatch.setattr("daemon.workers.FIRST_WORKER_S", 0.5)
    with pytest.raises(UserError, match=f"at {address} has no worker; start some with `dask worker"), workers(address):
        pass
    monkeypatch.setattr("daemon.workers._wait_for_a_worker", lambda *_: None)
    # As soon as the tasks are waited for.
    begun = distributed.as_completed
    monkeypatch.setattr(distributed, "as_completed", lambda tasks: (process.kill(), begun(tasks))[1])
    with workers(address) as cluster, pytest.raises(UserError, match="the connection to the Dask scheduler was lost"):
        list(cluster.map(square, {"factor": 1.0}, range(3)))


def test_without_the_extra_an_address_is_refused_and_a_local_cluster_is_processes(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with workers("local", 2) as pool:
        assert isinstance(pool, Processes)
    with pytest.raises(UserError, match=r"pip install 'shearloop\[cluster\]'"), workers("tcp://127.0.0.1:9"):
        pass
