"""How far long work is, on a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def progress_bar(name: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show a bar while the work lasts; the function takes how much is done in all. Nothing where no terminal is."""
    from tqdm import tqdm

    # tqdm's own watch on slow bars is a thread that outlives them.
    tqdm.monitor_interval = 0
    options: dict[str, Any] = {"unit_scale": True} if unit == "B" else {}
    with tqdm(total=total, unit=unit, desc=name, disable=None, leave=False, **options) as bar:

        def advance(done: int) -> None:
            bar.update(done - bar.n)

        yield advance
