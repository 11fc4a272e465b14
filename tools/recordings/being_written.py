"""Whether a recording is being written, by the lock that its writer holds."""

import fcntl
from pathlib import Path

from shearloop.files import open_file


def is_being_written(path: Path) -> bool:
    """Return whether a program of this computer writes the file; False where nothing says so.

    A file system without locks says nothing, and neither does a file that cannot be opened.
    """
    try:
        with open_file(path) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
