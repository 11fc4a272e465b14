"""The files that the daemon has read at its start, and whether they have changed since."""

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from shearloop.daemon.config import DaemonConfig
from shearloop.drivers.errors import system_reason

# Of a larger file, such as a bank, only the time and the size tell that it has changed.
_MAX_HASHED_BYTES = 32 << 20
# The package, and its rooms that the daemon loads modules from.
PACKAGE = Path(__file__).parents[1]
_ROOMS = ("bank", "estimation", "drivers", "daemon")


def code_of(package: Path) -> Iterator[Path]:
    """Yield the modules that the daemon loads, also the ones that it loads with a later request."""
    yield from package.glob("*.py")
    for room in _ROOMS:
        # The room may be a link, into which no search goes.
        yield from (package / room).resolve().rglob("*.py")


class FileStamp(NamedTuple):
    """What the file system says of a file's content."""

    changed_ns: int
    size: int
    number: int

    @classmethod
    def of(cls, path: Path) -> "FileStamp":
        """Return the stamp; raises OSError."""
        status = path.stat()
        return cls(status.st_mtime_ns, status.st_size, status.st_ino)


class _Loaded(NamedTuple):
    """A file as it was read; `digest` is None of a large one."""

    stamp: FileStamp
    digest: bytes | None


class LoadedFiles:
    """The configuration, the files that it names, and the daemon's code, as they were when the daemon began.

    The daemon reads them once. A limit that is lowered in one of them later does not hold until a restart. Some modules
    of the code are loaded with the first experiment. After an upgrade in place they would be of another version.
    """

    def __init__(self, paths: Iterable[Path]) -> None:
        """Look at these files; special files, and files that cannot be read, are left out."""
        self._loaded: dict[Path, _Loaded] = {}
        for path in paths:
            with suppress(OSError):
                if path.is_file():
                    stamp = FileStamp.of(path)
                    self._loaded[path] = _Loaded(stamp, _digest(path, stamp))

    @classmethod
    def of(cls, config: DaemonConfig, package: Path = PACKAGE) -> "LoadedFiles":
        """Look at a configuration's own file, at all that it names but the experiment, and at the package's code.

        Of a rehearsal these are the files of the real configuration, which a person changes.
        """
        real = config.real
        files = [path for key, path in real.walk() if isinstance(path, Path) and key != "experiment"]
        if real.file is not None:
            files.append(real.file)
        return cls([*files, *code_of(package)])

    def why_outdated(self) -> str:
        """Return which file has changed since the daemon's start; empty if none has. It reads the files that may have.

        A file that is gone, or cannot be read, may have changed.
        """
        for path, loaded in self._loaded.items():
            try:
                stamp = FileStamp.of(path)
                same = stamp == loaded.stamp or (loaded.digest is not None and _digest(path, stamp) == loaded.digest)
            except OSError as error:
                return (
                    f"{path} cannot be read ({system_reason(error)}), and may have changed since the daemon began; "
                    "restore the file, or restart the daemon"
                )
            if not same:
                return (
                    f"{path} has changed since the daemon began, and the daemon goes on with what it read then; "
                    "restart the daemon, or restore the file"
                )
        return ""


def _digest(path: Path, stamp: FileStamp) -> bytes | None:
    """Return the hash of a file's content, None of a large one; raises OSError."""
    if stamp.size > _MAX_HASHED_BYTES:
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()
