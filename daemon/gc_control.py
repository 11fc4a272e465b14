"""When Python's garbage collector looks at what: never through all that a daemon keeps as long as it lives.

Modules, banks and calibrations are some hundred thousand objects. To look through them, as the collector does now and
then, takes 20 to 100 ms, in which no frame is read and the loop stands still.
"""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def kept_from_lasting_objects() -> Iterator[Callable[[], None]]:
    """Collect nothing until what is yielded is called, and from then on only among what is made after that.

    What is made before and becomes garbage in a cycle of references stays in memory until the block is left.
    """
    was_enabled = gc.isenabled()
    gc.disable()

    def collect_what_comes() -> None:
        gc.freeze()
        if was_enabled:
            gc.enable()

    try:
        yield collect_what_comes
    finally:
        gc.unfreeze()
        if was_enabled:
            gc.enable()
