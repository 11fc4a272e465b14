"""What stored files have in common: written whole or not at all, and looked at before anything of them is believed."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from shearloop.bank.errors import CalibrationError


@contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """Yield a file `PATH.tmp`, which takes the place of `path` when it is on the disk, and is removed on failure.

    What was there before is whole until then. Raises OSError where it cannot be written.
    """
    if path.exists() and not path.is_file():
        # A pipe or /dev/stdout is written to, and not replaced; a folder says that it is one.
        with path.open("wb") as there:
            yield there
        return
    # What a link points to is replaced, and the link stays.
    path = path.resolve()
    # A fixed name, so that what was left by a writer that was killed is used up by the next one.
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
    """Flush a directory's entries to the disk, so that a rename in it outlives a loss of power."""
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def check_version(path: Path, header: Mapping[str, Any], version: int) -> None:
    """Raise CalibrationError, naming the file, for a header of another format version."""
    if header.get("format_version") != version:
        raise CalibrationError(
            f"{path}: the calibration has format version {header.get('format_version')}, expected {version}; "
            "calibrate again"
        )


def check_made_with(path: Path, header: Mapping[str, Any], identities: Mapping[str, str]) -> None:
    """Raise CalibrationError, naming the file, for a header that has other identities under these keys."""
    for key, wanted in identities.items():
        if header.get(key) != wanted:
            what = key.removesuffix("_hash").removesuffix("_identity").replace("_", " ")
            raise CalibrationError(
                f"{path}: the calibration was made with the {what} {str(header.get(key))[:12]}…, expected "
                f"{wanted[:12]}…; calibrate again"
            )
