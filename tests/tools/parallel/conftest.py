"""A real Dask cluster of two workers, for tests of where heavy tasks run."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
STARTED_S = 90


@pytest.fixture(scope="module", autouse=True)
def lasting() -> None:
    """Have what stays for good: spawned processes have a tracker of resources, Dask a thread for large messages."""
    from distributed.utils import _offload_executor

    resource_tracker.ensure_running()
    _offload_executor.submit(int).result()


@pytest.fixture(scope="module", autouse=True)
def importable_tests(tmp_path_factory) -> Iterator[str]:
    """Let worker processes import the tasks of these tests as `tests.…`, and nothing else of the repository."""
    folder = tmp_path_factory.mktemp("path")
    (folder / "tests").symlink_to(ROOT / "tests")
    sys.path.insert(0, str(folder))
    yield str(folder)
    sys.path.remove(str(folder))


@contextmanager
def dask(folder: Path, *workers: str, path: str = "") -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Start a scheduler and, with these options, workers, as processes; yield the address and the processes."""
    from distributed import Client

    found = folder / "scheduler.json"
    environment = os.environ | {
        "PYTHONPATH": path,
        "OPENBLAS_NUM_THREADS": "1",
        # A worker is forked, also the one that takes a killed one's place, instead of importing everything anew.
        "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver",
        "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    }
    common = ["--scheduler-file", str(found), "--no-dashboard"]
    commands = [["distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", *common]]
    if workers:
        commands.append(["distributed.cli.dask_worker", *workers, "--local-directory", str(folder), *common])
    processes = []
    with (folder / "log").open("wb") as log:
        try:
            for command in commands:
                words = [sys.executable, "-m", *command]
                processes.append(subprocess.Popen(words, cwd=ROOT, env=environment, stdout=log, stderr=log))
            with Client(scheduler_file=str(found), timeout=STARTED_S) as client:
                if workers:
                    client.wait_for_workers(2, timeout=STARTED_S)
                address = str(client.scheduler.address)
            yield address, processes
        finally:
            # The workers first: without their scheduler they would wait for it.
            for process in reversed(processes):
                process.terminate()
                process.wait(STARTED_S)


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory, importable_tests) -> Iterator[str]:
    """Start a scheduler and two workers, all processes of their own, and return the address."""
    with dask(tmp_path_factory.mktemp("dask"), "--nworkers", "2", "--nthreads", "1", path=importable_tests) as found:
        yield found[0]
