"""Executors for heavy tasks: this process, a pool of processes, or the workers of a Dask cluster.

All run the same functions with the same values, so the numbers are the same.
"""

import asyncio
import logging
import os
import shlex
import signal
import socket
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from shearloop.errors import UserError
from shearloop.extras import missing
from shearloop.tools.interrupts import interrupts_held

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
S = TypeVar("S")
R = TypeVar("R")

# `--cluster` without an address: processes of this computer.
LOCAL = "local"
CONNECT_S = 20
# A worker takes some seconds to start.
FIRST_WORKER_S = 30


class SerialExecutor:
    """Runs tasks in this process."""

    def map(self, function: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """Yield function(shared, item) of each item in turn, as soon as it is known, as every executor does.

        The function must be importable. Raises what the function raises.
        """
        return (function(shared, item) for item in items)


class ProcessExecutor:
    """Runs tasks in spawned processes, which inherit no files, threads or locks."""

    def __init__(self, count: int) -> None:
        self.count = count

    def map(self, function: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """Yield the results; end the processes at once if they are no longer wanted."""
        others, wanted = active_children(), True
        count = min(self.count, max(len(items), 1))
        # Each process gets the shared value once, as it starts, and not with each item. Before Python 3.11.5 a pool
        # hangs that ends while it sends an item that is larger than a pipe.
        pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=_begin, initargs=(shared,))
        try:
            with interrupts_held():
                tasks = deque(pool.submit(_with_shared, function, item) for item in items)
            while tasks:
                yield tasks.popleft().result()
            wanted = False
        except BrokenProcessPool as error:
            raise UserError("a process was killed, perhaps for lack of memory; run again with fewer --jobs") from error
        finally:
            # No task is cancelled: before Python 3.12 the pool's own thread fails where it meets a cancelled task as
            # its process dies.
            if wanted:
                for process in active_children():
                    if process not in others:
                        process.terminate()
            pool.shutdown(wait=True)


# What all tasks of this process share.
_shared: list[Any] = []


def _begin(shared: object) -> None:
    """Keep what all tasks of this process share, and leave Ctrl-C and a closed terminal to the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    _shared.append(shared)


def _with_shared(function: Callable[[Any, T], R], item: T) -> R:
    """Return function(shared, item)."""
    return function(_shared[0], item)


class DaskExecutor:
    """Runs tasks on the workers of a Dask cluster; a dead worker's tasks go to the others."""

    def __init__(self, client: "Client") -> None:
        self._client = client

    def map(self, function: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """Yield the results."""
        from dask import config
        from distributed import CancelledError, KilledWorker

        # Dask warns about large tasks and suggests scatter; scattered data is lost with its worker.
        with config.set({"distributed.admin.large-graph-warning-threshold": sys.maxsize}):
            # A task's result: Dask computes it again if its workers die.
            sent = self._client.submit(_identity, shared, pure=False)
            tasks = [self._client.submit(function, sent, item, pure=False) for item in items]
        try:
            for task in tasks:
                yield task.result()
        except KilledWorker as error:
            cure = "give the workers more memory, or run without --cluster"
            raise UserError(f"one task killed several workers, perhaps for lack of memory; {cure}") from error
        except CancelledError as error:
            # We cancel no task that we wait for, so the scheduler is gone.
            cure = "start it and its workers, and run the same command again"
            raise UserError(f"the connection to the Dask scheduler was lost; {cure}") from error
        finally:
            # The generator may be closed after its client.
            if self._client.status == "running":
                self._client.cancel(tasks)


def _identity(shared: S) -> S:
    return shared


Executor: TypeAlias = SerialExecutor | ProcessExecutor | DaskExecutor


@contextmanager
def open_executor(cluster: str | None, jobs: int | None = None) -> Iterator[Executor]:
    """Open the executor for a `--cluster` option: None, `local`, or the address of a Dask scheduler.

    `jobs` is the number of processes; the default is 1 without a cluster, and one per processor for `local`.
    Raises UserError if no scheduler with workers answers, or if Dask is not installed.
    """
    if cluster is None or cluster == LOCAL:
        count = jobs or (1 if cluster is None else len(os.sched_getaffinity(0)))
        yield SerialExecutor() if count == 1 else ProcessExecutor(count)
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise missing(error.name, "cluster", "--cluster") from error
    # It logs a traceback for each lost connection; DaskExecutor reports them in one sentence.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    _check_scheduler(cluster)
    with Client(cluster, timeout=CONNECT_S) as client:
        try:
            client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError as error:
            raise UserError(
                f"the Dask scheduler at {cluster} has no worker; start some with `dask worker {shlex.quote(cluster)}`"
            ) from error
        yield DaskExecutor(client)


def _check_scheduler(address: str) -> None:
    """Raise UserError unless a scheduler answers; a Dask client waits forever for any other server."""
    from distributed.comm import connect, get_address_host_port
    from distributed.security import Security

    async def greet() -> None:
        arguments = Security().get_connection_args("client")
        connection = await asyncio.wait_for(connect(address, timeout=CONNECT_S, **arguments), CONNECT_S)
        connection.abort()

    try:
        # A refused connection fails here at once; Dask retries until its timeout.
        with socket.create_connection(get_address_host_port(address), timeout=CONNECT_S):
            pass
        asyncio.run(greet())
    except TimeoutError as error:
        raise UserError(
            f"no Dask scheduler answers at {address} within {CONNECT_S} s; start one with `dask scheduler`"
        ) from error
    except (OSError, TypeError, ValueError) as error:
        raise UserError(f"no Dask scheduler answers at {address}: {error}; start one with `dask scheduler`") from error


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))
