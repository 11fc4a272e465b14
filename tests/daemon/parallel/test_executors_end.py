"""Worker processes end with the command, even when it is interrupted."""

import os
import signal
import threading
from multiprocessing import active_children
from pathlib import Path

import pytest

from shearloop.daemon.parallel import ProcessExecutor
from shearloop.daemon.process import raise_ending_signals


def waits(shared: tuple[str, str], _: int) -> None:
    """Tell that this runs, and for whom the process works; be in the middle of a task then."""
    Path(shared[0]).write_text(str(os.getpid()))
    threading.Event().wait(600)


def ignored_signals(_: None, __: int) -> set[int]:
    """Return which of a terminal's signals this process ignores."""
    return {number for number in (signal.SIGINT, signal.SIGHUP) if signal.getsignal(number) is signal.SIG_IGN}


def test_worker_processes_ignore_the_terminals_signals():
    assert list(ProcessExecutor(1).map(ignored_signals, None, [0])) == [{signal.SIGINT, signal.SIGHUP}]


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
        list(ProcessExecutor(1).map(waits, (str(tmp_path / "pids"), more), [0, 1, 2]))
    thread.join()
    assert active_children() == []
    with pytest.raises(ProcessLookupError):
        os.kill(running[0], 0)
