"""The process: its ending signals, and its garbage collection."""

import gc
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return SIGINT, SIGTERM, and SIGHUP unless it is ignored (`nohup`); none outside of the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return ()
    hangs_up = signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN
    return (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hangs_up else ()))


@contextmanager
def without_long_collections() -> Iterator[Callable[[], None]]:
    """Disable garbage collection until the yielded function is called; then exempt all objects made so far.

    Modules, banks and calibrations are some 100 000 objects. A collection through them stops the loop for 20 to 100 ms.
    """
    was_enabled = gc.isenabled()
    gc.disable()

    def on_ready() -> None:
        gc.freeze()
        if was_enabled:
            gc.enable()

    try:
        yield on_ready
    finally:
        gc.unfreeze()
        if was_enabled:
            gc.enable()
