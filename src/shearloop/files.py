"""Files that are replaced whole: a reader sees the old content or the new, never half of it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replace_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a file `PATH.tmp` that replaces `path` once it is on the disk, and is removed on failure.

    Raises OSError where it cannot be written; `path` is then unchanged.
    """
    if path.exists() and not path.is_file():
        # A pipe or /dev/stdout is written to, not replaced; a folder raises OSError.
        with path.open("wb") as there:
            yield there
        return
    # The target of a link is replaced, and the link stays.
    path = path.resolve()
    # A fixed name: the next writer reuses the file of one that was killed.
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        sync_directory(path.parent)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def sync_directory(directory: Path) -> None:
    """Flush a directory's entries to the disk, so that a rename in it survives a loss of power."""
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
