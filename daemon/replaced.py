"""Writing a file so that what was there before is whole until the new one is."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """Yield a file under a temporary name beside `path`; flushed and renamed to it at the end, removed on failure.

    Raises OSError where it cannot be written.
    """
    if path.exists() and not path.is_file():
        # A pipe or /dev/stdout is written to, and not replaced; a folder says that it is one.
        with path.open("wb") as there:
            yield there
        return
    # What a link points to is replaced, and the link stays.
    path = path.resolve()
    with tempfile.NamedTemporaryFile("wb", dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
        try:
            yield file  # type: ignore[misc]
            file.flush()
            os.fsync(file.fileno())
            # As a file that was opened for writing would be; a temporary one is its owner's alone.
            umask = os.umask(0)
            os.umask(umask)
            os.fchmod(file.fileno(), 0o666 & ~umask)
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise
