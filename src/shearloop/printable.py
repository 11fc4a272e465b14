"""Text for a terminal: characters that would control it, or that it cannot show, are written as \\uXXXX.

Names, reasons and labels come from files, boards and other computers. JSON escapes characters in the same way, so a
line of JSON stays one.
"""

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast

# Control characters but tab and line feed, marks and overrides of the writing direction, other line ends, and bytes
# of a file's name that are no character.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Return a text without characters that control a terminal."""
    return _CONTROL.sub(lambda found: _escaped(found[0]), text)


def encodable(text: str, encoding: str | None) -> str:
    """Return a text without characters that an encoding lacks."""
    try:
        text.encode(encoding or "utf-8")
    except UnicodeEncodeError:
        return "".join(character if _fits(character, encoding) else _escaped(character) for character in text)
    return text


def _fits(character: str, encoding: str | None) -> bool:
    try:
        character.encode(encoding or "utf-8")
    except UnicodeEncodeError:
        return False
    return True


def _escaped(text: str) -> str:
    units = text.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i] << 8 | units[i + 1]:04x}" for i in range(0, len(units), 2))


class OutputError(OSError):
    """Standard output or standard error cannot be written, for another reason than a reader that is gone."""


class PrintableStream:
    """A stream of text that a terminal can show; `own` takes the program's control characters as they are."""

    def __init__(self, stream: TextIO, *, controls: bool = False) -> None:
        self._stream = stream
        self._controls = controls

    @property
    def own(self) -> "PrintableStream":
        """The same stream for control characters of the program itself: a status line, colours, a progress bar."""
        return PrintableStream(self._stream, controls=True)

    def write(self, text: str) -> int:
        """Write a text; return its length; raises BrokenPipeError and OutputError."""
        shown = text if self._controls else printable(text)
        with _output_errors():
            self._stream.write(encodable(shown, self._stream.encoding))
        return len(text)

    def flush(self) -> None:
        """Write what is buffered; raises BrokenPipeError and OutputError."""
        with _output_errors():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        """Return what else the stream has."""
        return getattr(self._stream, name)


@contextmanager
def _output_errors() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(error.errno, error.strerror) from error


def own_stream(stream: TextIO) -> TextIO:
    """Return a stream for control characters of the program itself, which can show every text."""
    own = stream.own if isinstance(stream, PrintableStream) else PrintableStream(stream, controls=True)
    return cast(TextIO, own)


def open_closed_streams() -> None:
    """Open the null device for each standard stream that is closed.

    Otherwise the next file would get its number, and the texts of libraries, which print by number.
    """
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            # The lowest free number is the stream's.
            os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, os.fdopen(number, mode, closefd=False, encoding="utf-8"))


def silence(stream: TextIO) -> None:
    """Redirect a stream that cannot be written to the null device, so that its buffer does not fail again."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


@contextmanager
def printable_output() -> Iterator[None]:
    """Make standard output and standard error printable in the context."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (cast(TextIO, PrintableStream(stream)) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
