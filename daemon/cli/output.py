"""Output of commands: results as text or JSON, and progress bars."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager


def print_result(result: Mapping[str, object], sentences: Iterable[str], *, as_json: bool) -> None:
    """Print a result as one line of JSON for a script, or as sentences for a person."""
    if as_json:
        print(json.dumps(result, ensure_ascii=False), flush=True)
    else:
        print(*sentences, sep="\n", flush=True)


@contextmanager
def progress_bar(name: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show a progress bar if stderr is a terminal; the yielded function takes the amount done so far."""
    from tqdm import tqdm

    # tqdm would start a monitoring thread that outlives the bars.
    tqdm.monitor_interval = 0
    with tqdm(total=total, unit=unit, desc=name, disable=None, leave=False, unit_scale=unit == "B") as bar:

        def show(done: int) -> None:
            bar.update(done - bar.n)

        yield show
