"""Ctrl-C and the processes that a command starts: the terminal sends it to all of them."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back meanwhile, and from processes that are started meanwhile until they let it through.

    A process that loads its modules prints a traceback where Ctrl-C reaches it.
    """
    with _masked(signal.SIG_BLOCK):
        yield


@contextmanager
def interrupts_let_through() -> Iterator[None]:
    """Let Ctrl-C through meanwhile, also where the process was started without it."""
    with _masked(signal.SIG_UNBLOCK):
        yield


@contextmanager
def _masked(how: int) -> Iterator[None]:
    before = signal.pthread_sigmask(how, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
