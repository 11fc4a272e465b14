"""Keeps Python's garbage collector from stopping the control loop."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager


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
