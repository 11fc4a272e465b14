"""Reads the intact part of a recording, closed or not: damage loses only the records that it hits.

Chunks and attachments have a checksum each, and everything before the index has one. If a record's own length is
damaged, reading continues at the next place that the index names, or at the next bytes that have the form of a chunk.
"""

import mmap
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from shearloop.errors import UserError
from shearloop.files import near_name, open_file

Progress = Callable[[int], None]
_JOINED = (
    "it holds several recordings, joined by `cat` for instance, and their messages would be mixed; use the files that "
    "it was made of"
)
NOTHING_INTACT = "it holds no intact message, so nothing can be saved"
# A recorder makes chunks of 16 MB and attaches files of up to 32 MB.
LARGEST_RECORD_BYTES = 64 << 20

# A record is an opcode, the length of its content as 64 bits, and the content.
_HEAD_BYTES = 9
_KINDS: Mapping[int, Any] = MappingProxyType(
    {
        Opcode.HEADER: Header,
        Opcode.FOOTER: Footer,
        Opcode.SCHEMA: Schema,
        Opcode.CHANNEL: Channel,
        Opcode.CHUNK: Chunk,
        Opcode.MESSAGE_INDEX: MessageIndex,
        Opcode.ATTACHMENT: Attachment,
        Opcode.METADATA: Metadata,
        Opcode.DATA_END: DataEnd,
        Opcode.CHUNK_INDEX: ChunkIndex,
        Opcode.ATTACHMENT_INDEX: AttachmentIndex,
        Opcode.METADATA_INDEX: MetadataIndex,
        Opcode.STATISTICS: Statistics,
        Opcode.SUMMARY_OFFSET: SummaryOffset,
    }
)
# The name of a chunk's compression, with its length, and its place in the record.
_COMPRESSIONS, _COMPRESSION_AT = (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4"), 37
_BLOCK_BYTES = 1 << 20
_FIRST_PRIVATE_KIND = b"\x80"
# If this number of records follow each other, they count as written by the file's writer.
_RECORDS_IN_A_ROW = 3


@dataclass(slots=True)
class _MessageCounts:
    """Numbers of messages by channel: intact ones, ones in damaged chunks, and all of the file if known."""

    intact: Counter[int] = field(default_factory=Counter)
    damaged: Counter[int] = field(default_factory=Counter)
    # The highest number of an intact message; recorders number the messages of a topic from 0.
    highest: dict[int, int] = field(default_factory=dict)
    written: dict[int, int] | None = None

    def add(self, message: Message) -> None:
        self.intact[message.channel_id] += 1
        self.highest[message.channel_id] = max(message.sequence, self.highest.get(message.channel_id, -1))

    def lost(self, channel: int) -> int:
        intact = self.intact[channel]
        if self.written is not None:
            return max(self.written.get(channel, 0) - intact, 0)
        return max(self.highest.get(channel, -1) + 1 - intact, self.damaged[channel], 0)


class IntactRecords:
    """The messages, metadata and attachments of a file, up to its end or to where nothing intact follows.

    While it is iterated, it counts the damage; `channels` and `schemas` cover the messages so far.
    `progress` receives the bytes read.
    """

    def __init__(self, path: Path, progress: Progress = lambda _: None) -> None:
        self._path = path
        self._progress = progress
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.closed = self.is_indexed = False
        self.size = self.damaged_chunks = self.damaged_attachments = self._intact_bytes = 0
        # Whether a record of another kind cannot be read.
        self._has_unreadable_record = False
        # Whether the data match their common checksum, or None while that is not known.
        self._matches_checksum: bool | None = None
        self._counts = _MessageCounts()

    @property
    def torn_bytes(self) -> int:
        """Bytes after the last intact record."""
        return 0 if self.closed else self.size - self._intact_bytes

    @property
    def identity(self) -> dict[str, str]:
        """What each intact chunk says of the recording, or nothing where its writer did not repeat that."""
        return next(
            (dict(channel.metadata) for channel in self.channels.values() if "format_version" in channel.metadata), {}
        )

    @property
    def is_damaged(self) -> bool:
        """Whether a part of the file, or its index, is missing or damaged."""
        damaged = self.damaged_chunks or self.damaged_attachments or self.damaged_elsewhere or self.lost
        return bool(damaged) or not self.closed or not self.is_indexed

    @property
    def damaged_index(self) -> bool:
        """Whether the file was closed and its index is damaged."""
        return self.closed and not self.is_indexed

    @property
    def damaged_elsewhere(self) -> bool:
        """Whether a part is damaged that is no chunk, no attachment and no index, such as the header or metadata."""
        unexplained = self._matches_checksum is False and not self.damaged_chunks and not self.damaged_attachments
        return self._has_unreadable_record or unexplained

    @property
    def lost(self) -> dict[str, int]:
        """The number of lost messages by topic, as far as the file shows it; the rest of a torn end is not known."""
        found: Counter[str] = Counter()
        for number, channel in self.channels.items():
            found[channel.topic] += self._counts.lost(number)
        return {topic: count for topic, count in sorted(found.items()) if count}

    def __iter__(self) -> Iterator[Message | Metadata | Attachment]:
        """Read the file; raises UserError if it is missing, not MCAP, or of several recordings."""
        try:
            with open_file(self._path) as file:
                self.size = os.fstat(file.fileno()).st_size
                check_magic(self._path, file)
                if _begins_again(file):
                    raise UserError(f"{self._path}: {_JOINED}")
                yield from self._records(file)
        except OSError as error:
            why = f"{error.strerror or error}{near_name(self._path)}"
            raise UserError(f"{self._path}: the recording cannot be read: {why}") from error

    def _records(self, file: BinaryIO) -> Iterator[Message | Metadata | Attachment]:
        places = self._use_index(file)
        at, in_damaged_chunk = len(MCAP0_MAGIC), False
        self._intact_bytes = at
        checksum = zlib.crc32(MCAP0_MAGIC)
        while not self.closed and at < self.size:
            found = self._record_at(file, at)
            if found is None:
                next_at = self._next_place(file, at, places)
                if next_at is None:
                    return
                if _was_chunk(file, at):
                    self.damaged_chunks += 1
                elif not _is_private(file, at):
                    self._has_unreadable_record = True
                checksum = _checksum(file, at, next_at, checksum)
                at, in_damaged_chunk = next_at, False
                continue
            record, end = found
            if isinstance(record, DataEnd) and record.data_section_crc:
                self._matches_checksum = record.data_section_crc == checksum
            checksum = _checksum(file, at, end, checksum)
            at = self._intact_bytes = end
            self._progress(at)
            match record:
                case Chunk():
                    inside = _opened(record)
                    in_damaged_chunk = inside is None
                    self.damaged_chunks += in_damaged_chunk
                    for inner_record in inside or ():
                        yield from self._usable(inner_record)
                case MessageIndex() if in_damaged_chunk:
                    self._counts.damaged[record.channel_id] += len(record.records)
                case Footer():
                    self.closed = True
                case None:
                    self.damaged_attachments += 1
                # What a chunk says of them has a checksum. A damaged index repeats them.
                case Schema():
                    self.schemas.setdefault(record.id, record)
                case Channel():
                    self.channels.setdefault(record.id, record)
                case _:
                    yield from self._usable(record)

    def _use_index(self, file: BinaryIO) -> list[int]:
        """Take channels and numbers from the index of a closed file; return the places of its records, rising."""
        summary = intact_index(file, self.size)
        if summary is None:
            return []
        index, begins = summary
        self.is_indexed = True
        self.channels.update(index.channels)
        self.schemas.update(index.schemas)
        if index.statistics is not None:
            self._counts.written = dict(index.statistics.channel_message_counts)
        chunks = [chunk.chunk_start_offset for chunk in index.chunk_indexes]
        attachments = [attachment.offset for attachment in index.attachment_indexes]
        metadata = [entry.offset for entry in index.metadata_indexes]
        return sorted([*chunks, *attachments, *metadata, begins])

    def _usable(self, record: McapRecord) -> Iterator[Message | Metadata | Attachment]:
        match record:
            case Schema():
                self.schemas[record.id] = record
            case Channel():
                self.channels[record.id] = record
            case Message() if record.channel_id in self.channels:
                self._counts.add(record)
                yield record
            case Metadata() | Attachment():
                yield record

    def _record_at(self, file: BinaryIO, at: int) -> tuple[McapRecord | None, int] | None:
        """Return the record and its end, no record for a damaged attachment, or None where no record can be."""
        file.seek(at)
        head = file.read(_HEAD_BYTES)
        if len(head) < _HEAD_BYTES:
            return None
        opcode, length = struct.unpack("<BQ", head)
        end = at + _HEAD_BYTES + length
        if length > LARGEST_RECORD_BYTES or end > self.size:
            return None
        content = file.read(length)
        if opcode == Opcode.FOOTER and file.read(len(MCAP0_MAGIC) + 1) != MCAP0_MAGIC:
            return None
        record = _parsed(opcode, content)
        if isinstance(record, Attachment):
            checksum = int.from_bytes(content[-4:], "little")
            return (record if checksum in (0, zlib.crc32(content[:-4])) else None), end
        return None if record is None else (record, end)

    def _continues(self, file: BinaryIO, at: int) -> bool:
        """Return whether records follow one another from `at`: bytes within a record may look like one alone."""
        if at >= self.size:
            return False
        for _ in range(_RECORDS_IN_A_ROW):
            found = self._record_at(file, at)
            if found is None:
                return False
            record, at = found
            if isinstance(record, Footer) or at == self.size:
                return True
        return True

    def _next_place(self, file: BinaryIO, at: int, places: list[int]) -> int | None:
        """Return where the next record begins after a damaged one at `at`, or None."""
        file.seek(at + 1)
        stated = at + _HEAD_BYTES + int.from_bytes(file.read(_HEAD_BYTES - 1), "little")
        if self._continues(file, stated):
            return stated
        if places:
            return next((place for place in places if place > at), None)
        longest = max(map(len, _COMPRESSIONS))
        begin = at + 1 + _COMPRESSION_AT
        while begin < self.size:
            file.seek(begin)
            searched = file.read(_BLOCK_BYTES + longest - 1)
            hits = sorted(hit for kind in _COMPRESSIONS for hit in _hits(searched, kind))
            for hit in hits:
                place = begin + hit - _COMPRESSION_AT
                if isinstance((self._record_at(file, place) or (None,))[0], Chunk):
                    return place
            begin += _BLOCK_BYTES
        return None


def _checksum(file: BinaryIO, begin: int, end: int, checksum: int) -> int:
    """Continue a checksum with the bytes of a file from `begin` to `end`."""
    file.seek(begin)
    for at in range(begin, end, _BLOCK_BYTES):
        checksum = zlib.crc32(file.read(min(_BLOCK_BYTES, end - at)), checksum)
    return checksum


def check_magic(path: Path, file: BinaryIO) -> None:
    """Raise UserError for a file that is not MCAP; leaves it after the magic bytes."""
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise UserError(f"{path}: this is not an MCAP file, or is empty; there is nothing to read")


def _begins_again(file: BinaryIO) -> bool:
    """Return whether another recording begins within the file: numbers of channels and places are a recording's own."""
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(MCAP0_MAGIC + bytes([Opcode.HEADER]), 1) >= 0


def check_size(chunk: Chunk) -> None:
    """Raise ValueError for a chunk that would fill the memory, or has an unknown compression."""
    size = chunk.uncompressed_size
    match chunk.compression:
        case "" | "zstd":
            size = max(size, zstandard.frame_content_size(chunk.data) if chunk.compression else 0)
        case "lz4":
            size = max(size, _lz4_size(chunk.data))
        case unknown:
            raise ValueError(f"a chunk is packed by {unknown[:20]!r}, which is neither zstd nor lz4")
    if size > LARGEST_RECORD_BYTES:
        raise ValueError(f"a chunk of {size >> 20} MB, packed by {chunk.compression or 'nothing'}")


def _lz4_size(data: bytes) -> int:
    """Return the unpacked size: as the frame states it, else by unpacking no more than is allowed."""
    stated = int(lz4.frame.get_frame_info(data)["content_size"])
    return stated or len(lz4.frame.LZ4FrameDecompressor().decompress(data, LARGEST_RECORD_BYTES + 1))


def _was_chunk(file: BinaryIO, at: int) -> bool:
    """Return whether the damaged record at `at` has the kind of a chunk, or the name of a compression in its place."""
    file.seek(at)
    head = file.read(_COMPRESSION_AT + max(map(len, _COMPRESSIONS)))
    return head[0] == Opcode.CHUNK or head[_COMPRESSION_AT:].startswith(_COMPRESSIONS)


def _is_private(file: BinaryIO, at: int) -> bool:
    """Return whether the record at `at` has a kind that MCAP leaves to other programs."""
    file.seek(at)
    return file.read(1) >= _FIRST_PRIVATE_KIND


def intact_index(file: BinaryIO, size: int) -> tuple[Summary, int] | None:
    """Return the index of a closed file and its place, or None where it is missing or damaged."""
    footer_bytes = _HEAD_BYTES + 20
    footer_at = size - len(MCAP0_MAGIC) - footer_bytes
    if footer_at < len(MCAP0_MAGIC):
        return None
    file.seek(footer_at)
    tail = file.read()
    opcode, length, begins, _, checksum = struct.unpack("<BQQQI", tail[:footer_bytes])
    if tail[footer_bytes:] != MCAP0_MAGIC or (opcode, length) != (Opcode.FOOTER, 20) or not 0 < begins <= footer_at:
        return None
    file.seek(begins)
    if checksum and zlib.crc32(file.read(footer_at + footer_bytes - 4 - begins)) != checksum:
        return None
    file.seek(0)
    try:
        summary = make_reader(file).get_summary()
    # The library raises many types of exceptions for a damaged record.
    except Exception:  # noqa: BLE001
        return None
    return None if summary is None else (summary, begins)


class _Content(BytesIO):
    """A record's content: reading beyond its end is an error, and not just short."""

    def read(self, size: int | None = -1) -> bytes:
        found = super().read(size)
        if size is not None and len(found) < size:
            raise EOFError
        return found


def _parsed(opcode: int, content: bytes) -> McapRecord | None:
    """Return the record if its form fits the content from its first to its last byte, else None."""
    if opcode not in _KINDS and opcode != Opcode.MESSAGE:
        return None
    stream = ReadDataStream(_Content(content))
    try:
        record: McapRecord
        record = Message.read(stream, len(content)) if opcode == Opcode.MESSAGE else _KINDS[opcode].read(stream)
    # The library raises many types of exceptions for a damaged record.
    except Exception:  # noqa: BLE001
        return None
    return record if stream.count == len(content) else None


def _opened(chunk: Chunk) -> list[McapRecord] | None:
    """Return the records of a chunk, or None if it does not match its checksum."""
    try:
        check_size(chunk)
        return breakup_chunk(chunk, validate_crc=True)
    # The libraries raise many types of exceptions, zstandard a plain subclass of Exception.
    except Exception:  # noqa: BLE001
        return None


def _hits(searched: bytes, what: bytes) -> Iterator[int]:
    at = searched.find(what)
    while at >= 0:
        yield at
        at = searched.find(what, at + 1)
