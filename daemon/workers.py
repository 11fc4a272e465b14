"""Where heavy tasks run: in this process, in processes beside it, or on the workers of a Dask cluster.

The tasks are the same functions of the same values everywhere, so the numbers are the same. A task that a worker took
with it when it died is given to another one; only where tasks kill one worker after the other is it given up.
"""

import asyncio
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing import active_children, get_context, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Protocol, TypeVar

from shearloop.daemon.ending_signals import ending_signals
from shearloop.daemon.errors import UserError

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

T = TypeVar("T")
S = TypeVar("S")
R = TypeVar("R")

# What `--cluster` alone means: a cluster of this machine's own.
LOCAL = "local"
CONNECT_S = 20
# A worker takes some seconds to start.
FIRST_WORKER_S = 30
# Four fifths of it to end by itself, then it is killed.
WORKERS_END_S = 0.5


class Workers(Protocol):
    """Runs a function of what is shared and of each item."""

    def map(self, function: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield (number of the item, function(shared, item)) as they are finished, in any order.

        The function must be found by its name in a module; what is shared is sent once. Raises what it raises.
        """


class SerialExecutor:
    """One after the other, in this process."""

    def map(self, function: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield the results in order."""
        for number, item in enumerate(items):
            yield number, function(shared, item)


class Processes:
    """Processes beside this one; spawned, so that none inherits our files, threads or locks."""

    def __init__(self, count: int) -> None:
        self._count = count

    def map(self, function: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield results as they are finished."""
        others = active_children()
        tasks: dict[Future[R], int] = {}
        with ExitStack() as closed:
            with _uninterrupted():
                pool = ProcessPoolExecutor(min(self._count, max(len(items), 1)), get_context("spawn"))
                closed.callback(_end_pool, pool, tasks, others)
                tasks |= {pool.submit(function, shared, item): number for number, item in enumerate(items)}
            try:
                for task in as_completed(list(tasks)):
                    yield tasks.pop(task), task.result()
            except BrokenProcessPool as error:
                raise UserError(
                    "a process was killed, perhaps for want of memory; run again with fewer --jobs"
                ) from error


def _end_pool(pool: ProcessPoolExecutor, unfinished: Collection[object], others: Collection[BaseProcess]) -> None:
    """End a pool, and its processes at once where nobody wants what they have not finished: they may have long to go.

    `others` are our children that are none of its processes.
    """
    with _interrupted_later():
        if unfinished:
            _let_go_of_the_queue(pool)
            for process in active_children():
                if process not in others:
                    process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)


def _let_go_of_the_queue(pool: ProcessPoolExecutor) -> None:
    """Let the thread that hands out tasks see that nobody takes them: Pythons before 3.11.5 wait for it for ever.

    A task larger than a pipe holds (64 kB) is written while it is read, and an end to read from is ours. The cure is
    that of later Pythons (CPython issue 94777), which may be closing it themselves.
    """
    if sys.version_info < (3, 11, 5):
        reader: Connection = vars(vars(pool)["_call_queue"])["_reader"]
        reader.close()


class Cluster:
    """The workers of a Dask cluster."""

    def __init__(self, client: "Client") -> None:
        self._client = client

    def map(self, function: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[tuple[int, R]]:
        """Yield results as they are finished; the tasks of a worker that dies go to the others."""
        from dask import config
        from distributed import CancelledError, KilledWorker, as_completed

        # Dask warns of large tasks, such as one with a recording. Each is sent once; what is scattered instead is
        # lost with the worker that has it, and made anew by nobody.
        with config.set({"distributed.admin.large-graph-warning-threshold": sys.maxsize}):
            # The result of a task, which is made anew where the workers that had it are gone.
            kept = self._client.submit(_itself, shared, pure=False)
            tasks = {self._client.submit(function, kept, item, pure=False): i for i, item in enumerate(items)}
        try:
            for task in as_completed(list(tasks)):
                yield tasks[task], task.result()
        except KilledWorker as error:
            raise UserError(
                "one task killed one worker after the other, perhaps for want of memory; give the workers more, or "
                "run without --cluster"
            ) from error
        except CancelledError as error:
            # Nobody here cancels what is still waited for: the scheduler is gone, and with it all that it knew.
            raise UserError(
                "the connection to the Dask scheduler was lost; start it and its workers, and run the same command "
                "again"
            ) from error
        finally:
            # An iterator that was interrupted where its results are used ends when it is thrown away: maybe later.
            if self._client.status == "running":
                self._client.cancel(list(tasks))


def _itself(shared: S) -> S:
    return shared


def in_order(found: Iterable[tuple[int, R]]) -> list[R]:
    """Return what a map yields as its tasks are finished, in the order of their items."""
    return [result for _, result in sorted(found, key=lambda pair: pair[0])]


@contextmanager
def workers(cluster: str | None, jobs: int | None = None) -> "Iterator[Workers]":
    """Return where tasks run: on the cluster at an address, on a local one, or in `jobs` processes without.

    Where `jobs` is not said, a local cluster has a worker for each processor; without a cluster tasks run in turn.
    A local cluster needs the extra `cluster`; without it, processes do the same. Raises UserError for an address at
    which no scheduler answers, and for one that is given without the extra.
    """
    if cluster is None:
        yield SerialExecutor() if jobs in (None, 1) else Processes(jobs)
        return
    n_local = len(os.sched_getaffinity(0)) if jobs is None else jobs
    try:
        from distributed import Client
    except ImportError as error:
        if cluster == LOCAL:
            yield Processes(n_local)
            return
        raise UserError(f"--cluster needs {error.name}: `pip install 'shearloop[cluster]'`") from error
    # It logs each connection that it lost with a traceback; what that means for us, `Cluster.map` says.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    if cluster == LOCAL:
        with _local_client(n_local) as client:
            yield Cluster(client)
        return
    _reach(cluster)
    with Client(cluster, timeout=CONNECT_S) as client:
        _wait_for_a_worker(client, cluster)
        yield Cluster(client)


@contextmanager
def _local_client(jobs: int) -> "Iterator[Client]":
    """Begin a cluster of this machine's own, and end it quickly: by then its results are here, or nobody wants them."""
    from distributed import Client, LocalCluster

    # Port 8787, which it would take for a page that nobody opens, may be another cluster's.
    anywhere = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    closed = ExitStack()
    try:
        with _uninterrupted():
            local = closed.enter_context(
                LocalCluster(
                    n_workers=jobs,
                    threads_per_worker=1,
                    scheduler_kwargs=anywhere,
                    # Tasks that an end calls off are no news either.
                    silence_logs=logging.CRITICAL,
                )
            )
            closed.callback(local.sync, _end_workers, local)
            client = closed.enter_context(Client(local))
        yield client
    finally:
        # Dask's closing does not survive an interrupt: at the end of the process it is waited for, for 10 s.
        with _interrupted_later():
            closed.close()


async def _end_workers(local: "LocalCluster") -> None:
    """End the workers at once: one in the middle of a task would be given 4 s to finish it."""
    nannies = list(local.workers.values())
    # One that is not gone in time even so has been killed, and is left to the system.
    await asyncio.gather(*(nanny.close(timeout=WORKERS_END_S) for nanny in nannies), return_exceptions=True)


@contextmanager
def _interrupted_later() -> Iterator[None]:
    """Hear of Ctrl-C, or whatever ends us, only after what is done here, in whichever thread the system tells of it."""
    heard: list[int] = []
    before = {number: signal.signal(number, lambda told, _: heard.append(told)) for number in ending_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        # Also where it failed: processes that are begun here may have been ended with us. The first one raises, unless
        # it is ignored (SIGINT, in a script's background) and the next one is not.
        for told in heard:
            signal.raise_signal(told)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Keep what a terminal tells all of its processes from those that are begun here, and from us until it is done.

    At Ctrl-C each worker would print where it was, and at the terminal's end the tracker would die before its time.
    """
    with _interrupted_later():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})
        try:
            # Its process is spawned with the first other one, in a thread that lets Ctrl-C in again then.
            resource_tracker.ensure_running()
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _reach(address: str) -> None:
    """Raise UserError unless a scheduler greets at an address: for what listens and is none a client waits for ever."""
    from distributed.comm import get_address_host_port

    try:
        # A refusal is told at once here; dask asks again until the time is over.
        with socket.create_connection(get_address_host_port(address), timeout=CONNECT_S):
            pass
        asyncio.run(_greet(address))
    except TimeoutError as error:
        raise UserError(
            f"no Dask scheduler answers at {address} within {CONNECT_S} s; start one with `dask scheduler`"
        ) from error
    except (OSError, TypeError, ValueError) as error:
        raise UserError(f"no Dask scheduler answers at {address}: {error}; start one with `dask scheduler`") from error


async def _greet(address: str) -> None:
    from distributed.comm import connect
    from distributed.security import Security

    arguments = Security().get_connection_args("client")
    greeted = await asyncio.wait_for(connect(address, timeout=CONNECT_S, **arguments), CONNECT_S)
    greeted.abort()


def _wait_for_a_worker(client: "Client", address: str) -> None:
    """Raise UserError where a scheduler has no worker: tasks would wait for one without a word."""
    try:
        client.wait_for_workers(1, timeout=FIRST_WORKER_S)
    except TimeoutError as error:
        raise UserError(
            f"the Dask scheduler at {address} has no worker; start some with `dask worker {address}`"
        ) from error
