"""Which signals end a process in order."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import partial

import pytest

from shearloop.daemon import process
from shearloop.daemon.cli import emulator_processes, main
from shearloop.daemon.process import ending_signals
from tests.daemon.conftest import DEADLINE_S


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


def test_commands_run_in_any_thread_without_signal_handlers(config, tmp_path, monkeypatch, capsys):
    ready = threading.Event()
    monkeypatch.setattr(process, "without_long_collections", lambda: nullcontext(ready.set))
    with ThreadPoolExecutor() as pool:
        assert pool.submit(ending_signals).result() == ()
        daemon = pool.submit(main, ["run", str(config())])
        assert ready.wait(DEADLINE_S)
        assert main(["command", "stop", "--connect", f"ipc://{tmp_path}/commands"]) == 0
        assert daemon.result(DEADLINE_S) == 0
    assert "stop: done" in capsys.readouterr().out
