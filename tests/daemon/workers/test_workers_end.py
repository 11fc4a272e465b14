"""Workers end with the command that they work for, whatever ends it, and quietly."""

import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from multiprocessing import active_children, get_context, resource_tracker
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeAlias, cast
from unittest.mock import AsyncMock

import pytest

from shearloop.daemon import workers as daemon_workers
from shearloop.daemon.cli.interruption import interrupts_heard
from shearloop.daemon.workers import Processes, workers
from tests.daemon.workers.conftest import STARTED_S

# From a signal and what it interrupts to the process in which a task was.
Interrupted: TypeAlias = Callable[[signal.Signals, Callable[[], object]], int]


def interrupts_blocked(tell: Any) -> None:
    """Tell whether this process hears of Ctrl-C."""
    tell.send(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))


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

    # Were it begun with the first process, it would let interrupts in again there; here it runs since `lasting`.
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


def waits(shared: tuple[str, str], _: int) -> None:
    """Tell that this runs, and for whom the process works; be in the middle of a task then."""
    Path(shared[0]).write_text(str(os.getpid()))
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
@pytest.mark.parametrize("more", ["", "x" * (1 << 20)], ids=["small", "large"])
def test_processes_end_when_this_one_is_interrupted(
    number: signal.Signals, more: str, interrupted_once_it_works: Interrupted, tmp_path: Path
) -> None:
    """They were waited for until their tasks were done; of SIGTERM they did not hear, and stayed.

    Tasks that no pipe holds were waited for as well, for ever and deaf to more signals (Python 3.11.2, Debian 12).
    """
    shared = str(tmp_path / "told"), more
    process = interrupted_once_it_works(number, lambda: list(Processes(1).map(waits, shared, [0, 1, 2])))
    assert active_children() == []
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_local_cluster_ends_when_it_is_interrupted_and_again_while_it_ends(
    number: signal.Signals, interrupted_once_it_works: Interrupted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Closing that was interrupted was waited for at exit, for 10 s, and left a worker in the middle of a task."""
    end_workers = daemon_workers._end_workers
    ended: list[Any] = []

    async def again(local: Any) -> None:
        os.kill(os.getpid(), number)
        await end_workers(local)
        ended.append(local)

    def work() -> None:
        with workers("local", 1) as cluster:
            next(cluster.map(waits, (str(tmp_path / "told"), ""), [0]))

    monkeypatch.setattr("shearloop.daemon.workers._end_workers", again)
    worker = interrupted_once_it_works(number, work)
    assert ended[0].status.name == "closed"
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


def test_what_fails_because_everything_is_ended_is_told_as_that() -> None:
    """As workers that were to begin, where a whole group of processes is sent SIGTERM: it was a traceback."""

    def fails(number: signal.Signals | None) -> None:
        with interrupts_heard(), daemon_workers._interrupted_later():
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
    await daemon_workers._end_workers(cast(Any, SimpleNamespace(workers=dict(enumerate(nannies)))))
    for nanny in nannies:
        nanny.close.assert_awaited_once_with(timeout=daemon_workers.WORKERS_END_S)


def test_of_signals_that_were_held_back_the_one_that_is_not_ignored_ends_the_command() -> None:
    """A script's background ignores Ctrl-C: that one came first, and SIGTERM after it was lost."""

    def hears_both() -> None:
        with interrupts_heard(), daemon_workers._interrupted_later():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGTERM)

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(KeyboardInterrupt):
            hears_both()
    finally:
        signal.signal(signal.SIGINT, before)
