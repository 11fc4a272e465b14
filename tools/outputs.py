"""Files that a person names for a result, and the progress of the command that writes them."""

import codecs
import contextlib
import errno
import io
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from shearloop.errors import UserError
from shearloop.files import open_file
from shearloop.printable import own_stream, printable

# Longer than the 124 characters of text at the start of a MATLAB file.
_HEAD_BYTES = 512
# How a YAML file with keys begins, after comments; the comments may be longer than the head. A table does not.
YAML_KEYS = re.compile(
    rb"(?:\xef\xbb\xbf)?(?:[ \t\r]*(?:#[^\n]*|---[^\n]*)?\n)*[ \t]*(?:[\w\"'-]+[ \t]*:|(?:#[^\n]*)?\Z)"
)


@contextlib.contextmanager
def writing(out: Path, what: str) -> Iterator[None]:
    """Raise UserError where writing `out` raises OSError."""
    try:
        yield
    except OSError as error:
        file, reason = error.filename or out, error.strerror or error
        raise UserError(f"{file}: {what} cannot be written: {reason}; choose another path") from error


def check_apart(option: str, out: Path, others: Iterable[tuple[str, Path]]) -> None:
    """Raise UserError if `out`, which `option` names, is one of the other files or folders of a command, each named.

    Writing it would destroy what the command reads, or writes elsewhere.
    """
    for name, other in others:
        if is_same_file(out, other):
            raise UserError(
                f"{option} {out} and {name} are the same file or folder: nothing was changed; choose another {option}"
            )


def check_link(option: str, out: Path) -> None:
    """Raise UserError if `out`, which `option` names, is a link to nothing.

    A link is written through to its target. Without a target, the file would appear in an unexpected place.
    """
    try:
        out.stat()
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ELOOP) and out.is_symlink():
            raise UserError(
                f"{out} is a link to {out.readlink()}, which leads to no file: nothing was changed; remove the link, "
                f"or choose another {option}"
            ) from None


def is_same_file(one: Path, other: Path) -> bool:
    """Return whether both paths lead to one file or folder, over links too, or would once it is written."""
    try:
        return one.samefile(other)
    except OSError:
        # One of them is missing, or cannot be looked at.
        return os.path.realpath(one) == os.path.realpath(other)


def check_place(out: Path) -> None:
    """Raise UserError if no file can be made at `out`: it is a folder, or its own folder is missing or not writable.

    A command asks this before it works for long.
    """
    if os.path.isdir(out):
        raise UserError(f"{out} is a folder; give the name of a file in it")
    if not os.path.isdir(out.parent):
        raise UserError(f"{out}: there is no folder {out.parent}; make it, or choose another path")
    if os.path.isfile(out) or not os.path.lexists(out):
        # A new file replaces the one that is there, over a link too.
        folder = os.path.dirname(os.path.realpath(out))
        if not os.access(folder, os.W_OK | os.X_OK):
            raise UserError(f"{out}: you may not write in the folder {folder}; choose another path")


def check_overwrite(out: Path, kind: str, begins: bytes | re.Pattern[bytes] | None = None) -> None:
    """Raise UserError if `out` is a file of another kind: one that does not begin with `begins`, or is no text.

    A missing word in `calibrate --out recordings/*.mcap` would otherwise overwrite a recording. Errors of reading are
    left to the code that writes the file. A link to nothing is refused too, and a place where no file can be made.
    """
    check_link("--out", out)
    check_place(out)
    if not out.is_file():
        return
    try:
        with open_file(out) as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return
    if head and not _is_of_kind(head, begins):
        raise UserError(f"{out} exists and is not {kind}: it was not changed; choose another --out")


def check_new(out: Path) -> None:
    """Raise UserError if `out` exists, or no file can be made there: for a file that cannot be made again."""
    check_link("--out", out)
    if out.exists():
        raise UserError(f"{out} exists already; move it away, or name another file with --out")
    check_place(out)


def _is_of_kind(head: bytes, begins: bytes | re.Pattern[bytes] | None) -> bool:
    if isinstance(begins, bytes):
        return head.startswith(begins)
    return _is_text(head) and (begins is None or begins.match(head) is not None)


def _is_text(head: bytes) -> bool:
    try:
        # The incremental decoder accepts a character that is cut off at the end.
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return False
    return b"\0" not in head


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; remove the ones that are empty, if they are new and the block fails.

    Raises OSError where it cannot be made.
    """
    for one in (folder, *folder.parents):
        if one.is_symlink() and not one.exists():
            raise FileNotFoundError(
                errno.ENOENT, f"it is a link to {one.readlink()}, which leads to no folder", str(one)
            )
    new = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for one in new:
            with contextlib.suppress(OSError):
                one.rmdir()
        raise


@contextlib.contextmanager
def lent_file(file: BinaryIO) -> Iterator["LentFile"]:
    """Lend a file to a library that may write once more after the block, where an interrupt left its writer open."""
    lent = LentFile(file)
    try:
        yield lent
    finally:
        lent.take_back()


class LentFile(io.RawIOBase):
    """Writes to a file until that is taken back, and then nowhere; it never closes the file."""

    def __init__(self, file: BinaryIO) -> None:
        super().__init__()
        self._file: BinaryIO | None = file
        self._written = 0

    def take_back(self) -> None:
        """Ignore further writes."""
        self._file = None

    def writable(self) -> bool:
        """Return that it takes bytes."""
        return True

    def write(self, data: Any) -> int:
        """Write bytes and return their number; raises OSError of the file."""
        if self._file is not None:
            self._file.write(data)
        self._written += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of written bytes."""
        return self._written


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
