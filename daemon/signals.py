"""Signals that end a process: Ctrl-C, SIGTERM, and SIGHUP of a closed terminal."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

# Compiled code has usually returned after this time.
RETRY_S = 0.05


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return SIGINT, SIGTERM, and SIGHUP unless it is ignored (`nohup`); none outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return ()
    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hangs_up else ()))


class TerminationInterrupt(KeyboardInterrupt):
    """SIGTERM or SIGHUP, raised like Ctrl-C so that the same clean-up runs."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def raise_ending_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt for every ending signal, in the main thread.

    Python drops an exception that is raised in a callback from compiled code; the signal is then sent again.
    """
    if not ending_signals():
        yield
        return
    retries: list[threading.Timer] = []
    previous_hook = sys.unraisablehook

    def hook(dropped: "sys.UnraisableHookArgs") -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            previous_hook(dropped)
            return
        # Later: raised in this hook, it would be dropped again.
        retries.append(threading.Timer(RETRY_S, os.kill, (os.getpid(), _number(dropped.exc_value))))
        retries[-1].start()

    sys.unraisablehook = hook
    handlers = {number: signal.signal(number, _raise) for number in ending_signals() if number != signal.SIGINT}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        sys.unraisablehook = previous_hook
        for timer in retries:
            timer.cancel()
            timer.join()


def report_interrupt(sentence: str, interrupt: KeyboardInterrupt) -> int:
    """Print what an interrupted command left behind, and return its exit status."""
    # A closed terminal accepts no output.
    with suppress(OSError):
        print(sentence, file=sys.stderr)
    return interrupt_status(interrupt)


def interrupt_status(interrupt: KeyboardInterrupt) -> int:
    """Return the exit status that shells use: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP."""
    return 128 + _number(interrupt)


def _raise(number: int, _: FrameType | None) -> NoReturn:
    raise TerminationInterrupt(number)


def _number(interrupt: BaseException | None) -> int:
    return interrupt.number if isinstance(interrupt, TerminationInterrupt) else signal.SIGINT
