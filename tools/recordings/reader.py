"""Reads recordings: closed ones by their index, others record by record up to the first damaged one.

`open_recording` and `read_recording` refuse foreign, damaged and outdated files with one sentence. `summarise` and
`repair` also read files that were not closed. A kill or a power loss leaves such a file, and MCAP readers need the
index that is written when a file is closed.
"""

import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import MCAP0_MAGIC, Writer
from numpy.typing import NDArray
from pydantic_core import from_json

from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.daemon.clock import ClockReading, ClockStep
from shearloop.daemon.control.fingertip_diameters import tool_from_bytes
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.writer import PARTIAL, new_writer
from shearloop.drivers.serial_sensor import InputKind
from shearloop.errors import UserError
from shearloop.estimation import Measured
from shearloop.files import open_file, replace_file
from shearloop.tools.recordings.intact_records import (
    LARGEST_RECORD_BYTES,
    IntactRecords,
    Progress,
    check_magic,
    check_size,
)
from shearloop.tools.recordings.message_content import ContentError, OtherKeysError, check_time, read_content
from shearloop.tools.recordings.monotonic_times import Messages, MonotonicTimes, has_one_offset, in_monotonic_order

_NOTHING_INTACT = "it holds no intact message, so nothing can be saved"
_OTHER_PROGRAM = "another program made or changed this recording: record or import it again"
# Metadata of every recording; the other keys are notes of this one.
_IDENTITY_KEYS = (
    "format_version",
    "channel_table_hash",
    "electrodes",
    "injection",
    "software",
    "code_sha256",
    schema.CLOCK_OFFSET,
)


@dataclass(frozen=True, slots=True, eq=False)
class SideFrames:
    """One side's frames by rising time: t_mid_ns (n,) in Unix nanoseconds, lines (n, v) in volts."""

    t_mid_ns: NDArray[np.int64]
    lines: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Frames by side, and torque_nm (p,) in N·m at torque_t_ns (p,) in Unix nanoseconds; each may be empty."""

    path: Path
    source: str
    notes: dict[str, str]
    sides: dict[str, SideFrames]
    torque_t_ns: NDArray[np.int64]
    torque_nm: NDArray[np.float64]
    # The tools that a calibrated gripper held: since when (Unix ns), and the diameter or None for no tool.
    tools: tuple[tuple[int, Measured | None], ...] = ()
    table: ChannelTable = PAPER_TABLE
    # Whether a daemon recorded it: frames and torques are then stamped on arrival by one clock.
    live: bool = False


class OpenRecording:
    """An open recording: its topics with their numbers of messages, metadata, channels, attachments and messages."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        """Check that the file was closed, matches its checksums and is usable; raises many types of errors."""
        file.seek(0)
        ends: list[McapRecord] = []
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=LARGEST_RECORD_BYTES)
        # A file that was cut off ends anywhere.
        with suppress(EndOfFile, struct.error):
            for record in reader.records:
                match record:
                    case Chunk():
                        check_size(record)
                    # Names of files that an export makes.
                    case Channel(topic=name) if not name.isprintable() or "/" in name:
                        raise ValueError(f"it has the topic {name[:40]!r}")
                    case Attachment(name=name) if not name.isprintable():
                        raise ValueError(f"it has the attachment {name[:40]!r}")
                    case DataEnd() | Footer():
                        ends.append(record)
        match ends:
            case DataEnd(), Footer() as footer if not file.read(1):
                _check_index(file, footer)
            case _:
                raise McapError("it has no index at its end")
        file.seek(0)
        self._reader = make_reader(file, validate_crcs=True)
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise McapError("it has no index")
        counts = summary.statistics.channel_message_counts
        self.counts = {channel.topic: counts.get(channel.id, 0) for channel in summary.channels.values()}
        # By the records' names.
        self.metadata = {record.name: dict(record.metadata) for record in self._reader.iter_metadata()}
        self.identity, self.table = _checked_identity(path, self.metadata.get(schema.METADATA))
        # By topic, whether its messages have no source.
        self._imported: dict[str, bool] = {}

    def attachments(self) -> dict[str, bytes]:
        """Return the attached files by name."""
        return {one.name: one.data for one in self._reader.iter_attachments()}

    def messages(self, topics: Iterable[str] | None = None, *, by_time: bool = True) -> Messages:
        """Return the messages of some topics or of all, by time or in the order of the file.

        By time, log times come from the monotonic stamps, so that a wall clock that was set changes nothing.
        """
        wanted = None if topics is None else [*topics]
        if by_time and self.counts.get(schema.CLOCK_TOPIC) and not has_one_offset(self.identity):
            first = next(self._found([schema.CLOCK_TOPIC], by_log_time=False))
            return in_monotonic_order(first, lambda: self._found(wanted, by_log_time=False))
        return self._found(wanted, by_log_time=by_time)

    def _found(self, topics: list[str] | None, *, by_log_time: bool) -> Messages:
        messages = self._reader.iter_messages(topics, log_time_order=by_log_time)
        return ((channel, message) for _, channel, message in messages)

    def content(self, channel: Channel, message: Message) -> dict[str, Any]:
        """Return a message's content by the names of its topic; raises ContentError and UnknownTopicError."""
        try:
            content = read_content(channel.topic, message.data)
            check_time("its log time", message.log_time)
            check_time("its publish time", message.publish_time)
            imported = "source" not in content
            if imported != self._imported.setdefault(channel.topic, imported):
                raise ContentError("it has other keys than the first one")
            if "timestamp" in content and not has_one_offset(self.identity):
                content |= schema.unix_times(schema.schema_name(channel.topic), content, message.log_time)
                check_time(schema.ARRIVAL, content.get(schema.ARRIVAL) or 0)
        except ContentError as error:
            raise type(error)(f"{channel.topic}, number {message.sequence}: {error}") from error
        return content


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn each error of the block into a UserError: a damaged file raises many types of exceptions."""
    try:
        yield
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path}: the recording cannot be read: {error.strerror or error}") from error
    except Exception as error:
        detail = str(error) if isinstance(error, McapError | ValueError) and str(error) else repr(error)
        records = IntactRecords(path)
        intact = sum(isinstance(record, Message) for record in records)
        if not isinstance(error, McapError | CRCValidationError) and not records.is_damaged:
            raise UserError(
                f"{path}: the recording is whole, and its content cannot be used: {detail}; another program wrote or "
                "changed it, so make it again there"
            ) from error
        cure = f"`shearloop recording repair {path}` saves the intact part" if intact else _NOTHING_INTACT
        raise UserError(f"{path}: the recording was not closed, or is damaged ({detail}); {cure}") from error


@contextmanager
def open_recording(path: Path) -> Iterator[OpenRecording]:
    """Open a closed recording of this version; raises UserError, also for errors while it is read in the block."""
    with reading(path), open_file(path) as file:
        check_magic(path, file)
        recording = OpenRecording(path, file)
        other = f"version {recording.identity.get('software', 'unknown')} wrote this recording: read it with that "
        other += "version, or export other topics"
        try:
            yield recording
        except schema.UnknownTopicError as error:
            raise UserError(
                f"{path}: shearloop {schema.software_version()} has no topic {str(error)!r}; {other}"
            ) from error
        except ContentError as error:
            ours = recording.identity.get("code_sha256") == schema.code_digest()
            cure = other if isinstance(error, OtherKeysError) and not ours else _OTHER_PROGRAM
            raise UserError(f"{path}: a message cannot be used: {error}; {cure}") from error


@contextmanager
def refusing_content(path: Path, topic: str) -> Iterator[None]:
    """Turn a ContentError of one message of a topic into a UserError."""
    try:
        yield
    except ContentError as error:
        raise UserError(f"{path}: a message cannot be used: {topic}: {error}; {_OTHER_PROGRAM}") from error


def read_messages(
    path: Path, topics: Iterable[str], progress: Progress = lambda _: None
) -> Iterator[tuple[str, dict[str, Any], Message]]:
    """Yield topic, content and message by time, None for keys without a value; raises UserError.

    `progress` receives the number of messages so far.
    """
    with open_recording(path) as recording:
        for number, (channel, message) in enumerate(recording.messages(topics), start=1):
            yield channel.topic, recording.content(channel, message), message
            progress(number)


def _checked_identity(path: Path, identity: dict[str, str] | None) -> tuple[dict[str, str], ChannelTable]:
    """Return a recording's identity and channels, the paper's if it names none; UserError for other files."""
    if identity is None:
        raise _unusable(path, "it is an MCAP file, but not a recording of shearloop")
    if (version := identity.get("format_version")) != schema.FORMAT_VERSION:
        raise _unusable(path, f"it has format version {version}, expected {schema.FORMAT_VERSION}")
    electrodes = int(identity.get("electrodes", PAPER_TABLE.n_electrodes))
    injection: Any = identity.get("injection", PAPER_TABLE.injection)
    table = ChannelTable(electrodes, injection)
    if (found := str(identity.get("channel_table_hash"))) != table.digest:
        raise _unusable(path, f"it has the channel table {found[:12]}…, expected {table.digest[:12]}…")
    return identity, table


def read_recording(path: str | Path) -> Recording:
    """Read the frames, torques and tools of a recording; raises UserError for a file that cannot be used."""
    path = Path(path)
    frames: dict[str, list[tuple[int, list[float]]]] = {}
    torques: list[tuple[int, float]] = []
    tools: list[tuple[int, Measured | None]] = []
    with open_recording(path) as recording:
        identity, table, metadata = recording.identity, recording.table, recording.metadata
        prefix = f"{schema.FRAME_TOPIC}."
        sides = {topic: topic.removeprefix(prefix) for topic in recording.counts if topic.startswith(prefix)}
        inputs = [schema.input_topic(side) for side in sides.values()]
        live = bool(inputs) and recording.counts.keys() >= {*inputs}
        for channel, message in recording.messages([schema.LOAD_TOPIC, *sides, *inputs]):
            topic, t_ns = channel.topic, message.log_time
            try:
                content = dict(from_json(message.data))
                if topic == schema.LOAD_TOPIC:
                    if "torque_nm" in content and content.get("valid", True):
                        torques.append((t_ns, float(content["torque_nm"])))
                elif topic in sides:
                    line = content["line"]
                    if len(line) != table.n_line_values:
                        raise ValueError(f"a line of {len(line)} values")
                    rows = frames.setdefault(sides[topic], [])
                    # The board repeated an old frame.
                    if not rows or rows[-1][1] != line:
                        rows.append((t_ns, line))
                elif content["kind"] == InputKind.TOOL.value:
                    tools.append((t_ns, tool_from_bytes(schema.input_event(content).data)[1]))
            except (KeyError, TypeError, ValueError) as error:
                raise _unusable(path, f"a message on {topic} does not match its schema ({error!r})") from error
    with reading(path):
        side_frames = {side: _side_frames(rows) for side, rows in frames.items()}
    notes = {key: value for key, value in identity.items() if key not in _IDENTITY_KEYS}
    experiment = metadata.get(schema.EXPERIMENT_METADATA, {})
    if schema.DIAMETER_NOTE in experiment:
        notes[schema.DIAMETER_NOTE] = experiment[schema.DIAMETER_NOTE]
    return Recording(
        path,
        notes.pop("source", ""),
        notes,
        side_frames,
        np.array([t for t, _ in torques], dtype=np.int64),
        np.array([torque for _, torque in torques], dtype=np.float64),
        tuple(tools),
        table,
        live,
    )


def _side_frames(rows: list[tuple[int, list[float]]]) -> SideFrames:
    t_mid_ns, lines = zip(*rows, strict=True)
    return SideFrames(np.array(t_mid_ns, np.int64), np.array(lines, np.float64))


def _check_index(file: IO[bytes], footer: Footer) -> None:
    """Raise McapError for an index that does not match its checksum, which the mcap library does not check."""
    # The checksum covers the footer up to itself, four bytes before the magic ones.
    index_end = file.tell() - len(MCAP0_MAGIC) - 4
    file.seek(footer.summary_start)
    if footer.summary_crc and zlib.crc32(file.read(index_end - footer.summary_start)) != footer.summary_crc:
        raise McapError("its index does not match its checksum")


def _unusable(path: Path, reason: str) -> UserError:
    return UserError(
        f"{path}: this recording cannot be used: {reason}; record it again, or import it again with "
        "`shearloop recording import`"
    )


@dataclass(slots=True)
class TopicSummary:
    """One topic; fewer than two messages have no mean rate."""

    messages: int = 0
    rate_hz: float | None = None


@dataclass(frozen=True, slots=True)
class RecordedStep(ClockStep):
    """A step of the clock, and how long after the first message the daemon noticed it."""

    after_s: float


@dataclass(frozen=True, slots=True)
class ListedRecording:
    """One recording of a folder, times in Unix ns; the keys of `recording list --json`."""

    path: str
    size_bytes: int
    closed: bool
    first_unix_ns: int | None = None
    duration_s: float | None = None
    experiments: tuple[str, ...] = ()
    # Why its index cannot be read; empty where it can, or was never written.
    unreadable: str = ""


def list_recordings(folder: Path) -> list[ListedRecording]:
    """Return the recordings in a folder and below it, by their beginning; recordings without one come last.

    Reads the indices only, except in recordings with log times of a wall clock: these are read whole. Raises UserError
    for a path that is no folder.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder; `shearloop recording info FILE` shows one recording")
    paths = [path for path in folder.rglob("*") if path.name.endswith((".mcap", f".mcap{PARTIAL}")) and path.is_file()]
    return sorted(map(_listed, paths), key=lambda one: (one.first_unix_ns is None, one.first_unix_ns or 0, one.path))


def _listed(path: Path) -> ListedRecording:
    size = path.stat().st_size
    if path.suffix == PARTIAL:
        return ListedRecording(str(path), size, closed=False)
    try:
        with reading(path), open_file(path) as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None:
                return ListedRecording(str(path), size, closed=False)
            counts = summary.statistics
            experiments = [one for one in reader.iter_metadata() if one.name == schema.EXPERIMENT_METADATA]
            follows_wall_clock = any(
                channel.topic == schema.CLOCK_TOPIC and not has_one_offset(channel.metadata)
                for channel in summary.channels.values()
            )
            whole = summarise(path) if follows_wall_clock else None
    except UserError as error:
        return ListedRecording(str(path), size, closed=True, unreadable=str(error))
    first_ns = counts.message_start_time if counts.message_count else None
    duration_s = (counts.message_end_time - counts.message_start_time) / 1e9
    if whole is not None:
        first_ns, duration_s = whole.first_unix_ns, whole.duration_s
    names = tuple(one.metadata.get("name", "") for one in experiments)
    return ListedRecording(
        str(path), size, closed=True, first_unix_ns=first_ns, duration_s=duration_s, experiments=names
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FileCondition:
    """Whether a file was closed, its size, and how much of it is damaged."""

    path: str
    size_bytes: int
    closed: bool
    torn_bytes: int
    damaged_chunks: int
    damaged_attachments: int
    # Lost messages by topic, as far as the file shows them.
    lost: dict[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSummary(FileCondition):
    """The content of a recording in numbers, times in Unix ns; the keys of `recording info --json`."""

    dropped: int | None
    first_unix_ns: int | None
    duration_s: float
    # Whether the same code made it, so that a replay must be equal bit for bit.
    same_code: bool
    experiments: list[str]
    # The tool's diameter in mm as the recording names it.
    tool_mm: str | None
    metadata: dict[str, str]
    attachments: list[str]
    topics: dict[str, TopicSummary]
    # Where the wall clock was set or the computer was suspended; no time of a recording depends on it.
    clock_steps: list[RecordedStep]


def summarise(path: Path, progress: Progress = lambda _: None) -> RecordingSummary:
    """Return the summary of a recording, closed or not; raises UserError for another file."""
    records = IntactRecords(path, progress)
    topics: dict[str, TopicSummary] = {}
    spans: dict[str, tuple[int, int]] = {}
    named: dict[str, list[dict[str, str]]] = {}
    attachments = []
    clock, readings = MonotonicTimes(), list[tuple[int, ClockReading]]()
    for record in records:
        match record:
            case Message():
                channel = records.channels[record.channel_id]
                name, t_ns = channel.topic, clock.time_ns(channel, record)
                if name == schema.CLOCK_TOPIC and (reading_now := _clock_reading(record)) is not None:
                    readings.append((t_ns, reading_now))
                topic = topics.setdefault(name, TopicSummary())
                topic.messages += 1
                first_ns, last_ns = spans.get(name, (t_ns, t_ns))
                spans[name] = min(first_ns, t_ns), max(last_ns, t_ns)
            case Metadata():
                named.setdefault(record.name, []).append(dict(record.metadata))
            case Attachment():
                attachments.append(record.name)
    for name, (first_ns, last_ns) in spans.items():
        if last_ns > first_ns:
            topics[name].rate_hz = (topics[name].messages - 1) / ((last_ns - first_ns) / 1e9)
    first_unix_ns = min((first_ns for first_ns, _ in spans.values()), default=None)
    ends = named.get(schema.END_METADATA, [])
    with reading(path):
        dropped = int(ends[-1].get("dropped", "0")) if ends else None
    metadata = records.identity or named.get(schema.METADATA, [{}])[-1]
    experiments = named.get(schema.EXPERIMENT_METADATA, [])
    return RecordingSummary(
        path=str(path),
        size_bytes=records.size,
        closed=records.closed,
        torn_bytes=records.torn_bytes,
        damaged_chunks=records.damaged_chunks,
        damaged_attachments=records.damaged_attachments,
        lost=records.lost,
        dropped=dropped,
        first_unix_ns=first_unix_ns,
        duration_s=0.0 if first_unix_ns is None else (max(last for _, last in spans.values()) - first_unix_ns) / 1e9,
        same_code=metadata.get("code_sha256") == schema.code_digest(),
        experiments=[one.get("name", "") for one in experiments],
        tool_mm=(experiments or [metadata])[-1].get(schema.DIAMETER_NOTE),
        metadata=metadata,
        attachments=attachments,
        topics=dict(sorted(topics.items())),
        clock_steps=[
            RecordedStep(step.set_s, step.suspended_s, (t_ns - (first_unix_ns or 0)) / 1e9)
            for (_, before), (t_ns, after) in pairwise(readings)
            if (step := ClockStep.between(before, after)) is not None
        ],
    )


def _clock_reading(message: Message) -> ClockReading | None:
    """Return the reading of an entry of `input.clock`, or None for one that another program changed."""
    try:
        content = read_content(schema.CLOCK_TOPIC, message.data)
    except ContentError:
        return None
    return ClockReading(content["offset_ns"], content[schema.SUSPENDED] or 0)


@dataclass(frozen=True, slots=True)
class RepairResult:
    """The repaired file, its number of messages, and the losses; the keys of `recording repair --json`."""

    path: Path
    messages: int
    torn_bytes: int
    damaged_chunks: int
    damaged_attachments: int
    # Lost messages by topic, as far as the file shows them.
    lost: dict[str, int]


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
    records = IntactRecords(source, progress)
    schemas: dict[str, int] = {}
    channels: dict[int, int] = {}
    identity: dict[str, str] = {}
    messages = 0
    try:
        with replace_file(out) as file:
            writer = new_writer(file)
            for record in records:
                # The copy has its own header and index.
                match record:
                    case Message():
                        channel = records.channels[record.channel_id]
                        if channel.id not in channels:
                            channels[channel.id] = _registered(writer, channel, records, schemas)
                        copied = channels[channel.id], record.log_time, record.data, record.publish_time
                        writer.add_message(*copied, record.sequence)
                        messages += 1
                    case Metadata(name=schema.METADATA):
                        identity = record.metadata
                    case Metadata():
                        writer.add_metadata(record.name, record.metadata)
                    case Attachment():
                        writer.add_attachment(
                            record.create_time, record.log_time, record.name, record.media_type, record.data
                        )
            # The record has no checksum; the chunks have one.
            identity = records.identity or identity
            if identity:
                writer.add_metadata(schema.METADATA, identity)
            writer.finish()  # type: ignore[no-untyped-call]  # mcap has no return annotation here
            if not messages:
                raise UserError(f"{source}: {_NOTHING_INTACT}")
    except OSError as error:
        raise UserError(f"{out}: the repaired recording cannot be written: {error.strerror}") from error
    return RepairResult(
        out, messages, records.torn_bytes, records.damaged_chunks, records.damaged_attachments, records.lost
    )


def _registered(writer: Writer, channel: Channel, records: IntactRecords, schemas: dict[str, int]) -> int:
    """Register a channel, and its schema once for all channels that have it; return the channel's number."""
    known = records.schemas.get(channel.schema_id)
    if known is not None and known.name not in schemas:
        schemas[known.name] = writer.register_schema(known.name, known.encoding, known.data)
    schema_id = schemas[known.name] if known is not None else 0
    return writer.register_channel(channel.topic, channel.message_encoding, schema_id, channel.metadata)
