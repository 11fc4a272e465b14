"""Reads a recording record by record from its beginning, as far as it is sound: what was not closed has no index."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.mcap_file import PARTIAL
from shearloop.daemon.recording.schema import PROFILE
from shearloop.files import replace_file

_LARGEST_RECORD_BYTES = 1 << 30
Progress = Callable[[int], None]


@dataclass(slots=True)
class Condition:
    """How a file was found: whether it was closed, where it stopped being readable, and which chunks were damaged."""

    size: int
    closed: bool = False
    sound_bytes: int = 0
    damaged_chunks: int = 0

    @property
    def torn_bytes(self) -> int:
        """What is left behind the last whole record."""
        return 0 if self.closed else self.size - self.sound_bytes


@dataclass(frozen=True, slots=True)
class Repaired:
    """What a repair brought to safety."""

    path: Path
    messages: int
    condition: Condition


@dataclass(slots=True)
class _Copied:
    """Numbers that schemas and channels have in the copy."""

    schemas: dict[int, int] = field(default_factory=dict)
    channels: dict[int, int] = field(default_factory=dict)
    messages: int = 0


def records(path: Path, condition: Condition, progress: Progress = lambda _: None) -> Iterator[McapRecord]:
    """Yield what a file holds, chunks opened, up to its end or to where it is torn; `condition` is filled in.

    `progress` hears how many bytes have been read. Raises UserError for a file that is no recording at all.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise UserError(f"{path}: this is not an MCAP file, or is empty, so there is nothing in it to read")
            file.seek(0)
            yield from _sound_records(file, condition, progress)
    except OSError as error:
        raise UserError(f"{path}: the recording cannot be read: {error.strerror}") from error


def condition_of(path: Path) -> Condition:
    """Return a condition to be filled in by `records`; raises UserError where there is no file."""
    try:
        return Condition(path.stat().st_size)
    except OSError as error:
        raise UserError(f"{path}: the recording cannot be read: {error.strerror}") from error


def repair(source: Path, out: Path | None = None, progress: Progress = lambda _: None) -> Repaired:
    """Copy all that is sound into a file with an index; the source stays as it is.

    The copy is `out`, else the source's name without `.partial`, else NAME.repaired.mcap. Raises UserError where there
    is such a file already, where nothing is sound, and where the copy cannot be written.
    """
    out = out or _name_for(source)
    if out.exists():
        raise UserError(f"{out} is there already; move it away, or name another file with --out")
    condition = condition_of(source)
    try:
        with replace_file(out) as file:
            writer = Writer(file, compression=CompressionType.ZSTD)
            writer.start(profile=PROFILE, library="shearloop")
            copied = _Copied()
            for record in records(source, condition, progress):
                _copy(writer, record, copied)
            writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves its return type out
            if not copied.messages:
                raise UserError(f"{source}: there is no whole message in it, so nothing can be saved")
    except OSError as error:
        raise UserError(f"{out}: the repaired recording cannot be written: {error.strerror}") from error
    return Repaired(out, copied.messages, condition)


def _name_for(source: Path) -> Path:
    if source.name.endswith(PARTIAL):
        return source.with_name(source.name.removesuffix(PARTIAL))
    return source.with_name(f"{source.stem}.repaired.mcap")


def _sound_records(file: IO[bytes], condition: Condition, progress: Progress) -> Iterator[McapRecord]:
    reader = StreamReader(file, emit_chunks=True, record_size_limit=_LARGEST_RECORD_BYTES).records
    while True:
        try:
            record = next(reader, None)
            inside = _opened(record, condition) if isinstance(record, Chunk) else [record]
        # What a torn or damaged record makes the library raise, whose own errors are only some of these.
        except (McapError, ValueError, EOFError, ArithmeticError, LookupError, TypeError, struct.error, MemoryError):
            return
        if record is None:
            return
        condition.sound_bytes = file.tell()
        progress(condition.sound_bytes)
        if isinstance(record, Footer):
            condition.closed = True
            return
        yield from (one for one in inside if one is not None)


def _opened(chunk: Chunk, condition: Condition) -> list[McapRecord]:
    """Return what is in a chunk; nothing where its content is not what its checksum says."""
    try:
        return breakup_chunk(chunk, validate_crc=True)
    # zstandard has an error of its own, which is an Exception and no more.
    except Exception:  # noqa: BLE001
        condition.damaged_chunks += 1
        return []


def _copy(writer: Writer, record: McapRecord, copied: _Copied) -> None:
    match record:
        case Schema():
            if record.id not in copied.schemas:
                copied.schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        case Channel():
            if record.id not in copied.channels and (record.schema_id in copied.schemas or record.schema_id == 0):
                copied.channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, copied.schemas.get(record.schema_id, 0), record.metadata
                )
        case Message():
            if record.channel_id in copied.channels:
                channel = copied.channels[record.channel_id]
                writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
                copied.messages += 1
        case Metadata():
            writer.add_metadata(record.name, record.metadata)
        case Attachment():
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        case _:
            # Header, indexes and the end are the copy's own.
            pass
