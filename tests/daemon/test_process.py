"""The process: which signals end it in order, what the garbage collector looks through, its priority."""

import asyncio
import gc
import os
import signal
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import partial

import pytest

from shearloop.cli import emulator_processes, main
from shearloop.daemon import app, process
from shearloop.daemon.process import (
    NICENESS,
    ending_signals,
    interrupt_status,
    raise_ending_signals,
    raise_priority,
    without_long_collections,
)
from tests.fixtures.daemons import DEADLINE_S


@pytest.mark.usefixtures("default_signals")
def test_sighup_ends_a_process_unless_it_is_ignored():
    assert ending_signals() == (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    # As `nohup` leaves it.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert ending_signals() == (signal.SIGINT, signal.SIGTERM)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_does_not_kill_the_daemon(number, config, monkeypatch):
    came = []

    @contextmanager
    def emulators(*_: object) -> Iterator[Callable[..., None]]:
        yield lambda *_: None
        assert signal.getsignal(number) is not signal.SIG_DFL, "this process would be killed"
        signal.raise_signal(number)
        came.append("again")

    monkeypatch.setattr(emulator_processes, "EmulatedDevices", emulators)
    monkeypatch.setattr(process, "without_long_collections", lambda: nullcontext(partial(os.kill, os.getpid(), number)))
    assert main(["run", str(config())]) == 0
    assert came == ["again"]
    assert signal.getsignal(number) is signal.SIG_DFL, "as before the command"


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("number", ending_signals())
def test_under_asyncio_each_ending_signal_cancels_the_main_task(number):
    """Raised amid the loop's own work, an exception would lose what the task waits for."""
    seen = []

    async def interrupted() -> None:
        try:
            signal.raise_signal(number)
            seen.append("goes on to its next wait")
            await asyncio.sleep(DEADLINE_S)
        except asyncio.CancelledError:
            seen.append("cancelled")
            raise

    with pytest.raises(KeyboardInterrupt) as caught, raise_ending_signals():
        asyncio.run(interrupted())
    assert seen == ["goes on to its next wait", "cancelled"]
    assert interrupt_status(caught.value) == 128 + number


def test_commands_run_in_any_thread_without_signal_handlers(config, tmp_path, monkeypatch):
    ready = threading.Event()
    monkeypatch.setattr(process, "without_long_collections", lambda: nullcontext(ready.set))
    with ThreadPoolExecutor() as pool:
        assert pool.submit(ending_signals).result() == ()
        daemon = pool.submit(main, ["run", str(config())])
        assert ready.wait(DEADLINE_S)
        assert main(["command", "stop", "--connect", f"ipc://{tmp_path}/commands"]) == 0
        assert daemon.result(DEADLINE_S) == 0, "the stop ended it"


class Cycle:
    """An object that only the collector can free."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def unfrozen() -> Iterator[None]:
    gc.unfreeze()
    yield
    gc.unfreeze()
    gc.enable()


def forgotten() -> weakref.ref[Cycle]:
    """Return a reference to an object that nobody else has one to."""
    return weakref.ref(Cycle())


@pytest.mark.usefixtures("unfrozen")
def test_the_collector_starts_when_the_program_is_ready_and_skips_objects_from_before():
    # A collection of Python 3.12 freezes what lives as long as the program.
    gc.collect()
    frozen = gc.get_freeze_count()
    with without_long_collections() as collect_what_comes:
        assert not gc.isenabled()
        before = forgotten()
        collect_what_comes()
        assert gc.isenabled()
        after = forgotten()
        gc.collect()
        assert before() is not None
        assert after() is None
    gc.collect()
    assert before() is None
    assert gc.isenabled()
    assert gc.get_freeze_count() == frozen


@pytest.mark.usefixtures("unfrozen")
def test_what_ends_before_it_is_ready_leaves_the_collector_as_it_was():
    with pytest.raises(SystemExit), without_long_collections():
        raise SystemExit
    assert gc.isenabled()


@pytest.mark.usefixtures("unfrozen")
def test_daemon_of_the_command_line_is_collected_from_when_it_is_ready(config, monkeypatch):
    collected = []

    async def run_daemon(_config: object, _listeners: object, on_ready: Callable[[], None], _summary: object) -> bool:
        collected.append(gc.isenabled())
        on_ready()
        collected.append(gc.isenabled() and gc.get_freeze_count() > 0)
        return True

    monkeypatch.setattr(app, "run_daemon", run_daemon)
    assert main(["run", str(config())]) == 0
    assert collected == [False, True]


def test_a_priority_that_is_not_allowed_is_not_raised(monkeypatch):
    asked: list[int] = []

    def refuse(_kind: int, _who: int, niceness: int) -> None:
        asked.append(niceness)
        raise PermissionError

    monkeypatch.setattr(os, "setpriority", refuse)
    raise_priority()
    assert asked == [NICENESS]
