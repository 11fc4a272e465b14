"""Opens a recording that was closed, and refuses in one sentence what is damaged: of half of it the library asks no
checksum, and what it raises on the other half has a dozen types.
"""

import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from shearloop.daemon.errors import UserError

# The end of an MCAP file: the footer's opcode and length, where summary and its offsets begin, their checksum, and the
# magic bytes once more (https://mcap.dev/spec#footer-op0x02).
_END = struct.Struct("<BQQQI8s")
_FOOTER_OPCODE, _FOOTER_BYTES = 0x02, 20
# The checksum covers the footer itself as far as it goes before it.
_AFTER_CHECKSUM = 4 + len(MCAP0_MAGIC)
# Before the content of each record: its opcode and length.
_RECORD_HEAD_BYTES = 9


@contextmanager
def damaged(path: Path) -> Iterator[None]:
    """Make one UserError of whatever reading a damaged recording raises: read within, and do nothing else there."""
    try:
        yield
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path}: the recording cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise UserError(
            f"{path}: the recording was not closed, or is damaged ({_what(error)}); "
            f"`shearloop recording repair {path}` saves what is sound"
        ) from error


class OpenRecording:
    """A recording while its file is open: what is in it, and its messages."""

    def __init__(self, file: IO[bytes]) -> None:
        """Check that it was closed, and that its index is what was written; raises McapError or ValueError."""
        _check_end(file)
        self._file = file
        file.seek(0)
        self._reader = make_reader(file, validate_crcs=True)
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise McapError("it has no index")
        self.summary: Summary = summary

    @property
    def counts(self) -> dict[str, int]:
        """The topics, and how many messages each has."""
        counts = self.summary.statistics.channel_message_counts if self.summary.statistics is not None else {}
        return {channel.topic: counts.get(channel.id, 0) for channel in self.summary.channels.values()}

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the metadata records by name."""
        return {record.name: dict(record.metadata) for record in self._reader.iter_metadata()}

    def attachments(self) -> dict[str, bytes]:
        """Return the attached files by name; raises ValueError for one that is not what was attached."""
        for index in self.summary.attachment_indexes:
            self._file.seek(index.offset + _RECORD_HEAD_BYTES)
            content = self._file.read(index.length - _RECORD_HEAD_BYTES)
            checksum = int.from_bytes(content[-4:], "little")
            if checksum and zlib.crc32(content[:-4]) != checksum:
                raise ValueError(f"{index.name}, which is attached, is not what its checksum says")
        return {one.name: one.data for one in self._reader.iter_attachments()}

    def messages(
        self, topics: Iterable[str] | None = None, *, in_order_of_time: bool = True
    ) -> Iterator[tuple[Channel, Message]]:
        """Yield the messages of some topics, or of all."""
        for _, channel, message in self._reader.iter_messages(topics, log_time_order=in_order_of_time):
            yield channel, message


@contextmanager
def opened(path: Path) -> Iterator[OpenRecording]:
    """Give a recording that was closed; raises UserError, as whatever is read of it within does."""
    with damaged(path), path.open("rb") as file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise UserError(f"{path}: this is not an MCAP file, or is empty, so there is nothing in it to read")
        yield OpenRecording(file)


def _check_end(file: IO[bytes]) -> None:
    size = file.seek(0, 2)
    if size < len(MCAP0_MAGIC) + _END.size:
        raise McapError(f"it ends after {size} bytes")
    file.seek(size - _END.size)
    opcode, length, summary_start, _, checksum, magic = _END.unpack(file.read(_END.size))
    if (opcode, length, magic) != (_FOOTER_OPCODE, _FOOTER_BYTES, MCAP0_MAGIC):
        raise McapError("it has no index at its end")
    if summary_start and checksum:
        file.seek(summary_start)
        if zlib.crc32(file.read(max(0, size - _AFTER_CHECKSUM - summary_start))) != checksum:
            raise ValueError("its index is not what its checksum says")


def _what(error: Exception) -> str:
    """Return what is the matter in the library's words, or its kind where it has none."""
    return str(error) if isinstance(error, McapError | ValueError) and str(error) else repr(error)
