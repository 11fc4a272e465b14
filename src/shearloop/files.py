"""Files that are replaced whole, so that a reader never sees half of one, and files of unknown content."""

import errno
import fcntl
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

_LONGEST_DETAIL = 300
# Of Linux, in bytes.
_LONGEST_NAME, _LONGEST_PATH = 255, 4096
# What file systems answer that cannot flush a folder, and what a folder answers that may be written and not read.
_NO_FLUSH = (errno.EINVAL, errno.ENOTSUP, errno.EACCES)
# What file systems answer that have no locks.
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)
_OTHER_WRITER = "another program is writing it"
# A variable as shells write it. Other signs after a `$` are part of a file's name.
_VARIABLE = re.compile(r"\$(?:([A-Za-z_]\w*)|\{([A-Za-z_]\w*)\})", re.ASCII)


def expanded_path(written: str | Path) -> Path:
    """Return a path with `~`, `~user` and variables such as `$HOME` replaced, as a shell does it.

    Raises ValueError for a variable that is not set and for an unknown user.
    """

    def value_of(variable: re.Match[str]) -> str:
        name = variable[1] or variable[2]
        if name not in os.environ:
            raise ValueError(f"has the variable ${name}, which is not set here; set it, or write the folder's name")
        return os.environ[name]

    # The home folder first: a shell takes no `~` from a variable.
    try:
        home = Path(written).expanduser()
    except RuntimeError as error:
        name = Path(written).parts[0]
        raise ValueError(
            f"begins with {name}, the home of an unknown user; write the whole path of a file of this name"
        ) from error
    return Path(_VARIABLE.sub(value_of, str(home)))


@contextmanager
def replace_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a file `PATH.tmp` that replaces `path` once it is on the disk, and is removed on failure.

    Raises OSError where it cannot be written; `path` is then unchanged, but for a folder that the disk cannot flush.
    """
    if path.exists() and not path.is_file():
        # A pipe or /dev/stdout is written to, not replaced; a folder raises OSError.
        with path.open("wb") as file:
            yield file
        return
    given = path
    # The target of a link is replaced, and the link stays.
    path = path.resolve()
    # A fixed name: the next writer reuses the file of one that was killed.
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        with sole_writer(temporary):
            try:
                with temporary.open("wb") as file:
                    yield file
                with temporary.open("rb") as written:
                    os.fsync(written.fileno())
                temporary.replace(path)
                sync_directory(path.parent)
            except BaseException:
                with suppress(OSError):
                    temporary.unlink()
                raise
    except OSError as error:
        if error.filename in (temporary, str(temporary)):
            # A person knows the file by the name that they gave.
            error.filename = str(given)
        raise


@contextmanager
def sole_writer(path: Path) -> Iterator[None]:
    """Lock a temporary file, made if it is missing, against a second program that writes the same one.

    Two writers would mix their bytes, and each would name the result its own. The lock ends with the program. Raises
    OSError where another program holds it, and where the file cannot be made.
    """
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        lock(handle, path)
        # The one who had the lock may have given the file its name.
        if not (path.exists() and os.path.samestat(os.fstat(handle), path.stat())):
            raise OSError(errno.EBUSY, _OTHER_WRITER, str(path))
        yield
    finally:
        os.close(handle)


def lock(handle: int, path: Path) -> None:
    """Lock an open file until it is closed, as one that is being written; raises OSError where another program did."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OSError(errno.EBUSY, _OTHER_WRITER, str(path)) from None
    except OSError as error:
        # Some network shares have no locks.
        if error.errno not in _NO_LOCKS:
            raise


def is_possible(path: Path) -> bool:
    """Return whether a file of Linux can have a path."""
    try:
        written, names = os.fsencode(path), [os.fsencode(part) for part in path.parts]
    except UnicodeEncodeError:
        return False
    if b"\0" in written or len(written) >= _LONGEST_PATH:
        return False
    return all(len(name) <= _LONGEST_NAME for name in names)


def near_name(path: Path) -> str:
    """Return which file was probably meant by a path of none: one beside it with the same ending; empty without one."""
    from difflib import get_close_matches

    try:
        names = [] if path.exists() else [one.name for one in path.parent.iterdir() if one.suffix == path.suffix]
    except OSError:
        return ""
    near = get_close_matches(path.name, names, 1)
    return f"; did you mean {path.with_name(near[0])}?" if near else ""


def is_missing(error: OSError) -> bool:
    """Return whether there is no file at a path that could not be opened: only then a new one can be made there."""
    return isinstance(error, FileNotFoundError | NotADirectoryError)


@contextmanager
def refusing_damage(path: Path, raises: type[Exception], what: str, damage: str, missing: str = "") -> Iterator[None]:
    """Turn every error of the block into `raises`: a foreign or damaged file raises many types of exceptions.

    `what` names the file where it cannot be read, and `missing` ends the message where there is none; `damage` says the
    rest, with {} for the detail.
    """
    try:
        yield
    except raises:
        raise
    except OSError as error:
        cure = near_name(path) or missing if is_missing(error) else ""
        raise raises(f"{path}: {what} cannot be read: {error.strerror or error}{cure}") from error
    except Exception as error:
        detail = " ".join((repr(error) if isinstance(error, KeyError) else str(error) or repr(error)).split())
        raise raises(f"{path}: {damage.replace('{}', detail[:_LONGEST_DETAIL])}") from error


def open_file(path: Path) -> BinaryIO:
    """Open a file to read; raises OSError, also for a folder, and for a device or a pipe, which may have no end.

    A file without a size is read as an empty one. This includes the kernel's files, because some of them never end,
    such as /proc/kmsg.
    """
    # Opening a device can already change something.
    _refuse_other_than_file(path.stat())
    # It may be another file by now, and the opening of a pipe waits for a writer.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        status = os.fstat(handle)
        _refuse_other_than_file(status)
        if stat.S_ISREG(status.st_mode) and not status.st_size:
            os.close(handle)
            handle = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)
        return os.fdopen(handle, "rb")
    except OSError:
        os.close(handle)
        raise


def _refuse_other_than_file(status: os.stat_result) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder; name a file in it")
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "it is a device or a pipe; name a file")


def read_file(path: Path, most_bytes: int) -> bytes:
    """Return a whole file that is expected to be small; raises OSError, also for a larger one or a device."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most_bytes:
            raise OSError(errno.EFBIG, f"it is larger than {most_bytes >> 10} kB; is it another file?")
        return file.read(size)


def sync_directory(directory: Path) -> None:
    """Flush a directory's entries to the disk, so that a rename in it survives a loss of power.

    A folder that cannot be flushed, such as a network share's, is left as it is. Raises OSError for a failing disk.
    """
    try:
        handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno not in _NO_FLUSH:
            detail = f"{error.strerror} for its folder: the file is written, and a loss of power may undo that"
            raise OSError(error.errno, detail) from error
