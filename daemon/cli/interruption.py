"""What ends a command before it is done: Ctrl-C, SIGTERM, and SIGHUP of a terminal that is closed, all in one way."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

from shearloop.daemon.process import ending_signals

# After which compiled code has mostly gone on; where it has not, the same is done once more.
AGAIN_S = 0.05


class Ended(KeyboardInterrupt):
    """SIGTERM or SIGHUP, raised as Ctrl-C is: what puts things in order after the one does so after the others."""

    def __init__(self, number: int) -> None:
        """Keep which signal it was."""
        super().__init__(number)
        self.number = number


@contextmanager
def interrupts_heard() -> Iterator[None]:
    """Raise signals that end a command, in its main thread; a command may have handlers of its own for them.

    One that comes in what compiled code calls is sent again: that cannot pass it on, and it would be lost. In another
    thread nothing is heard.
    """
    if not ending_signals():
        yield
        return
    again: list[threading.Timer] = []
    before = sys.unraisablehook

    def ignored(told: "sys.UnraisableHookArgs") -> None:
        if not issubclass(told.exc_type, KeyboardInterrupt):
            before(told)
            return
        # Not at once: it would be raised in here, where it is lost as well.
        again.append(threading.Timer(AGAIN_S, os.kill, (os.getpid(), _number(told.exc_value))))
        again[-1].start()

    sys.unraisablehook = ignored
    handlers = {number: signal.signal(number, _end) for number in ending_signals() if number != signal.SIGINT}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        sys.unraisablehook = before
        for timer in again:
            timer.cancel()
            timer.join()


def ended(sentence: str, by: KeyboardInterrupt) -> int:
    """Say what was left when a command was interrupted, and return its exit status."""
    # A terminal that is closed takes no sentence.
    with suppress(OSError):
        print(sentence, file=sys.stderr)
    return status_of(by)


def status_of(interrupt: KeyboardInterrupt) -> int:
    """Return the exit status, as a shell has it for what a signal has ended: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + _number(interrupt)


def _end(number: int, _: FrameType | None) -> NoReturn:
    raise Ended(number)


def _number(interrupt: BaseException | None) -> int:
    return interrupt.number if isinstance(interrupt, Ended) else signal.SIGINT
