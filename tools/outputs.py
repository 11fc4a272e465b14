"""Files that a person names for a result, and the progress of the command that writes them."""

import codecs
import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from shearloop.errors import UserError
from shearloop.files import open_file
from shearloop.printable import own_stream, printable

# Longer than the 124 characters of text at the start of a MATLAB file.
_HEAD_BYTES = 512


@contextlib.contextmanager
def writing(out: Path, what: str) -> Iterator[None]:
    """Raise UserError where writing `out` raises OSError."""
    try:
        yield
    except OSError as error:
        file, reason = error.filename or out, error.strerror or error
        raise UserError(f"{file}: {what} cannot be written: {reason}; choose another path") from error


def check_overwrite(out: Path, kind: str, begins: bytes | None = None) -> None:
    """Raise UserError if `out` is a file of another kind: one that does not begin with `begins`, or is no text.

    A missing word in `calibrate --out recordings/*.mcap` would otherwise overwrite a recording. Errors of reading are
    left to the code that writes the file.
    """
    if not out.is_file():
        return
    try:
        with open_file(out) as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return
    if head and not (_is_text(head) if begins is None else head.startswith(begins)):
        raise UserError(f"{out} exists and is not {kind}: it was not changed; choose another --out")


def _is_text(head: bytes) -> bool:
    try:
        # The incremental decoder accepts a character that is cut off at the end.
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return False
    return b"\0" not in head


@contextlib.contextmanager
def progress_bar(name: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show a progress bar if stderr is a terminal; the yielded function takes the amount done so far."""
    from tqdm import tqdm

    # tqdm would start a monitoring thread that outlives the bars.
    tqdm.monitor_interval = 0
    shown: dict[str, Any] = {"disable": None, "leave": False, "file": own_stream(sys.stderr)}
    with tqdm(total=total, unit=unit, desc=printable(name), unit_scale=unit == "B", **shown) as bar:

        def show(done: int) -> None:
            bar.update(done - bar.n)

        yield show
