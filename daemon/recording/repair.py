"""Reads recordings that were not closed or are damaged: `shearloop recording info` and `repair`.

It reads record by record up to the first damaged one. Without it, a user who loses power loses the recording: MCAP
readers need the index that is written when a file is closed.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.identity import code_digest
from shearloop.daemon.recording.reader import check_magic
from shearloop.daemon.recording.schema import DIAMETER_NOTE, END_METADATA, EXPERIMENT_METADATA, METADATA
from shearloop.daemon.recording.writer import PARTIAL, new_writer
from shearloop.files import replace_file

_LARGEST_RECORD_BYTES = 1 << 30
Progress = Callable[[int], None]


@dataclass(slots=True)
class FileCondition:
    """Whether a file was closed, how many bytes of it are intact, and how many chunks are damaged."""

    size: int
    closed: bool = False
    intact_bytes: int = 0
    damaged_chunks: int = 0

    @classmethod
    def of_file(cls, path: Path) -> "FileCondition":
        """Return the condition of an unread file; raises UserError if it does not exist."""
        try:
            return cls(path.stat().st_size)
        except OSError as error:
            raise UserError(f"{path}: the recording cannot be read: {error.strerror}") from error

    @property
    def torn_bytes(self) -> int:
        """Bytes after the last intact record."""
        return 0 if self.closed else self.size - self.intact_bytes


@dataclass(frozen=True, slots=True)
class RepairResult:
    """The repaired file, its number of messages, and the condition of the source."""

    path: Path
    messages: int
    condition: FileCondition


@dataclass(slots=True)
class TopicSummary:
    """One topic: its number of messages, their log times (Unix ns) and size."""

    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    json_bytes: int = 0

    @property
    def rate_hz(self) -> float | None:
        """Mean rate, None for fewer than two messages."""
        span_s = (self.last_ns - self.first_ns) / 1e9
        return (self.messages - 1) / span_s if self.messages > 1 and span_s > 0 else None

    def add(self, message: Message) -> None:
        """Count a message."""
        if not self.messages:
            self.first_ns = self.last_ns = message.log_time
        self.messages += 1
        self.json_bytes += len(message.data)
        self.first_ns, self.last_ns = min(self.first_ns, message.log_time), max(self.last_ns, message.log_time)


@dataclass(slots=True)
class RecordingSummary:
    """The content of a recording in numbers."""

    path: Path
    condition: FileCondition
    dropped: int | None = None
    metadata: dict[str, str] = field(default_factory=dict)
    experiments: list[str] = field(default_factory=list)
    # The tool's diameter in mm as the recording names it.
    tool_mm: str | None = None
    attachments: list[str] = field(default_factory=list)
    topics: dict[str, TopicSummary] = field(default_factory=dict)

    @property
    def first_ns(self) -> int | None:
        """Log time of the first message."""
        return min((topic.first_ns for topic in self.topics.values()), default=None)

    @property
    def duration_s(self) -> float:
        """Time from the first message to the last."""
        last_ns = max((topic.last_ns for topic in self.topics.values()), default=0)
        return 0.0 if self.first_ns is None else (last_ns - self.first_ns) / 1e9

    @property
    def same_code(self) -> bool:
        """Whether the same code made it, so that a replay must be equal bit for bit."""
        return self.metadata.get("code_sha256") == code_digest()

    def as_map(self) -> dict[str, Any]:
        """Return everything for JSON."""
        return {
            "path": str(self.path),
            "size_bytes": self.condition.size,
            "closed": self.condition.closed,
            "torn_bytes": self.condition.torn_bytes,
            "damaged_chunks": self.condition.damaged_chunks,
            "dropped": self.dropped,
            "first_unix_ns": self.first_ns,
            "duration_s": self.duration_s,
            "same_code": self.same_code,
            "experiments": self.experiments,
            "tool_mm": self.tool_mm,
            "metadata": self.metadata,
            "attachments": self.attachments,
            "topics": {
                name: {"messages": topic.messages, "rate_hz": topic.rate_hz, "json_bytes": topic.json_bytes}
                for name, topic in sorted(self.topics.items())
            },
        }


def summarise(path: Path, progress: Progress = lambda _: None) -> RecordingSummary:
    """Return the summary of a recording, closed or not; raises UserError for another file."""
    summary = RecordingSummary(path, FileCondition.of_file(path))
    topics: dict[int, str] = {}
    for record in intact_records(path, summary.condition, progress):
        match record:
            case Channel():
                topics[record.id] = record.topic
            case Message() if record.channel_id in topics:
                summary.topics.setdefault(topics[record.channel_id], TopicSummary()).add(record)
            case Metadata(name=name) if name == METADATA:
                summary.metadata = dict(record.metadata)
                summary.tool_mm = record.metadata.get(DIAMETER_NOTE)
            case Metadata(name=name) if name == EXPERIMENT_METADATA:
                summary.experiments.append(record.metadata.get("name", ""))
                summary.tool_mm = record.metadata.get(DIAMETER_NOTE)
            case Metadata(name=name) if name == END_METADATA:
                summary.dropped = int(record.metadata.get("dropped", "0"))
            case Attachment():
                summary.attachments.append(record.name)
    return summary


def repair(source: Path, out: Path | None = None, progress: Progress = lambda _: None) -> RepairResult:
    """Copy the intact records into a new file with an index; the source is not changed.

    The copy is `out`, or the source without `.partial`, or NAME.repaired.mcap. Raises UserError if the copy exists or
    cannot be written, and if the source has no intact message.
    """
    if out is None:
        name = source.name.removesuffix(PARTIAL)
        out = source.with_name(name if name != source.name else f"{source.stem}.repaired.mcap")
    if out.exists():
        raise UserError(f"{out} exists already; move it away, or name another file with --out")
    condition = FileCondition.of_file(source)
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    messages = 0
    try:
        with replace_file(out) as file:
            writer = new_writer(file)
            for record in intact_records(source, condition, progress):
                # The copy has its own header and index.
                match record:
                    case Schema() if record.id not in schemas:
                        schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                    case Channel() if record.id not in channels and record.schema_id in {0, *schemas}:
                        channels[record.id] = writer.register_channel(
                            record.topic, record.message_encoding, schemas.get(record.schema_id, 0), record.metadata
                        )
                    case Message() if record.channel_id in channels:
                        writer.add_message(
                            channels[record.channel_id],
                            record.log_time,
                            record.data,
                            record.publish_time,
                            record.sequence,
                        )
                        messages += 1
                    case Metadata():
                        writer.add_metadata(record.name, record.metadata)
                    case Attachment():
                        writer.add_attachment(
                            record.create_time, record.log_time, record.name, record.media_type, record.data
                        )
            writer.finish()  # type: ignore[no-untyped-call]  # mcap has no return annotation here
            if not messages:
                raise UserError(f"{source}: it holds no intact message, so nothing can be saved")
    except OSError as error:
        raise UserError(f"{out}: the repaired recording cannot be written: {error.strerror}") from error
    return RepairResult(out, messages, condition)


def intact_records(path: Path, condition: FileCondition, progress: Progress = lambda _: None) -> Iterator[McapRecord]:
    """Yield the records of a file, chunks opened, up to its end or its first damaged record; updates `condition`.

    `progress` receives the number of bytes read. Raises UserError for a file that is not MCAP.
    """
    try:
        with path.open("rb") as file:
            check_magic(path, file)
            file.seek(0)
            yield from _intact_records(file, condition, progress)
    except OSError as error:
        raise UserError(f"{path}: the recording cannot be read: {error.strerror}") from error


def _intact_records(file: IO[bytes], condition: FileCondition, progress: Progress) -> Iterator[McapRecord]:
    reader = StreamReader(file, emit_chunks=True, record_size_limit=_LARGEST_RECORD_BYTES).records
    while True:
        try:
            record = next(reader)
            inside = _chunk_records(record, condition) if isinstance(record, Chunk) else [record]
        except OSError:
            raise
        # The library raises many types of exceptions for a damaged record.
        except Exception:  # noqa: BLE001
            return
        condition.intact_bytes = file.tell()
        progress(condition.intact_bytes)
        if isinstance(record, Footer):
            condition.closed = True
            return
        yield from inside


def _chunk_records(chunk: Chunk, condition: FileCondition) -> list[McapRecord]:
    """Return the records of a chunk, or nothing if it does not match its checksum."""
    try:
        return breakup_chunk(chunk, validate_crc=True)
    # zstandard raises a plain subclass of Exception.
    except Exception:  # noqa: BLE001
        condition.damaged_chunks += 1
        return []
