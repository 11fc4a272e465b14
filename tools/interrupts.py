"""Ctrl-C and the processes that a command starts: the terminal sends it to all of them."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Block Ctrl-C in this thread, and in the processes that it starts, until they let it through.

    A process that is interrupted while it loads its modules prints a traceback.
    """
    with _masked(signal.SIG_BLOCK):
        yield


@contextmanager
def interrupts_let_through() -> Iterator[None]:
    """Let Ctrl-C through, also in a process that was started with Ctrl-C blocked."""
    with _masked(signal.SIG_UNBLOCK):
        yield


@contextmanager
def _masked(how: int) -> Iterator[None]:
    before = signal.pthread_sigmask(how, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
