"""Opens closed recordings of this version and reads their messages; refuses other files with one sentence.

A file is read twice: first all of its bytes, which shows a cut or damaged file before its first message is used, then
by its index.
"""

import shlex
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader

from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.daemon.recorder import schema
from shearloop.errors import UserError
from shearloop.files import near_name, open_file
from shearloop.tools.recordings.being_written import is_being_written
from shearloop.tools.recordings.intact_records import (
    LARGEST_RECORD_BYTES,
    NOTHING_INTACT,
    IntactRecords,
    Progress,
    check_magic,
    check_size,
    intact_index,
)
from shearloop.tools.recordings.message_content import check_time, read_content
from shearloop.tools.recordings.monotonic_times import Messages, has_one_offset, in_monotonic_order
from shearloop.tools.recordings.recorded_columns import (
    ContentError,
    MissingKeyError,
    SchemaError,
    TopicColumns,
    recorded_topic,
)

_OTHER_PROGRAM = "another program made or changed this recording: record or import it again"


class OpenRecording:
    """An open recording: its topics with their numbers of messages, metadata, channels, attachments and messages."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
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
        is_last = not file.read(1)
        if not is_last or list(map(type, ends)) != [DataEnd, Footer]:
            raise McapError("it has no index at its end")
        # The mcap library does not check the checksum of the index.
        found = intact_index(file, file.tell())
        if found is None:
            raise McapError("its index is missing, or does not match its checksum")
        summary, _ = found
        if summary.statistics is None:
            raise McapError("its index counts no messages")
        file.seek(0)
        self._reader = make_reader(file, validate_crcs=True)
        counts = summary.statistics.channel_message_counts
        self.counts = {channel.topic: counts.get(channel.id, 0) for channel in summary.channels.values()}
        # By the records' names.
        self.metadata = {record.name: dict(record.metadata) for record in self._reader.iter_metadata()}
        self.identity, self.table = _checked_identity(path, self.metadata.get(schema.METADATA))
        # By topic, the schemas of its channels.
        self._schemas: dict[str, list[Schema | None]] = {}
        for channel in summary.channels.values():
            self._schemas.setdefault(channel.topic, []).append(summary.schemas.get(channel.schema_id))
        self._columns: dict[str, TopicColumns] = {}
        # By topic, whether its messages have no source.
        self._imported: dict[str, bool] = {}

    def attachments(self) -> dict[str, bytes]:
        """Return the attached files by name."""
        return {attachment.name: attachment.data for attachment in self._reader.iter_attachments()}

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

    def columns(self, topic: str) -> TopicColumns:
        """Return the columns of a topic by its schema in the file; raises SchemaError."""
        if topic not in self._columns:
            schemas = self._schemas.get(topic, [None])
            texts = {one.data if one else None for one in schemas}
            if len(texts) > 1:
                raise SchemaError(f"{topic}: it has several schemas")
            try:
                self._columns[topic] = recorded_topic(topic, schemas[0])
            except SchemaError as error:
                raise SchemaError(f"{topic}: {error}") from error
        return self._columns[topic]

    def content(self, channel: Channel, message: Message) -> dict[str, Any]:
        """Return a message's content by the names of its topic; raises ContentError."""
        columns = self.columns(channel.topic)
        try:
            content = read_content(channel.topic, message.data, columns)
            check_time("its log time", message.log_time)
            check_time("its publish time", message.publish_time)
            imported = "source" not in content
            if imported != self._imported.setdefault(channel.topic, imported):
                raise ContentError("it has other keys than the first one")
            if "timestamp" in content and not has_one_offset(self.identity):
                known = columns.known(content)
                times = schema.unix_times(columns.name or channel.topic, known, message.log_time)
                content |= {key: time for key, time in times.items() if known[key] is not None}
                if known.get(schema.ARRIVAL) is not None:
                    check_time(schema.ARRIVAL, content[schema.ARRIVAL])
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
        why = f"{error.strerror or error}{near_name(path)}"
        raise UserError(f"{path}: the recording cannot be read: {why}") from error
    except Exception as error:
        detail = str(error) if isinstance(error, McapError | ValueError) and str(error) else repr(error)
        records = IntactRecords(path)
        intact = sum(isinstance(record, Message) for record in records)
        if not isinstance(error, McapError | CRCValidationError) and not records.is_damaged:
            raise UserError(
                f"{path}: the recording is whole, and its content cannot be used: {detail}; another program wrote or "
                "changed it, so make it again there"
            ) from error
        if is_being_written(path):
            raise UserError(
                f"{path}: the recording is being written; end the run, and its writer finishes it"
            ) from error
        cure = (
            f"`shearloop recording repair {shlex.quote(str(path))}` saves the intact part" if intact else NOTHING_INTACT
        )
        raise UserError(f"{path}: the recording was not closed, or is damaged ({detail}); {cure}") from error


@contextmanager
def open_recording(path: Path) -> Iterator[OpenRecording]:
    """Open a closed recording of this version; raises UserError, also for errors while it is read in the block."""
    with reading(path), open_file(path) as file:
        check_magic(path, file)
        recording = OpenRecording(path, file)
        wrote = f"version {recording.identity.get('software', 'unknown')} wrote this recording"
        try:
            yield recording
        except MissingKeyError as error:
            raise UserError(f"{path}: {error}; {wrote}; it can be exported as csv, parquet or mat") from error
        except SchemaError as error:
            raise UserError(f"{path}: a schema cannot be used: {error}; {_OTHER_PROGRAM}") from error
        except ContentError as error:
            raise UserError(f"{path}: a message cannot be used: {error}; {_OTHER_PROGRAM}") from error


@contextmanager
def refusing_content(path: Path, topic: str) -> Iterator[None]:
    """Turn a ContentError of one message of a topic into a UserError."""
    try:
        yield
    except ContentError as error:
        raise UserError(f"{path}: a message cannot be used: {topic}: {error}; {_OTHER_PROGRAM}") from error


def columns_of_topics(path: Path, topics: Iterable[str]) -> dict[str, TopicColumns]:
    """Return the columns of topics by their schemas in a recording; raises UserError."""
    with open_recording(path) as recording:
        return {topic: recording.columns(topic) for topic in topics}


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
        raise unusable(path, "it is an MCAP file, but not a recording of shearloop")
    if (version := identity.get("format_version")) != schema.FORMAT_VERSION:
        reason = f"it has format version {version}, expected {schema.FORMAT_VERSION}"
        if version and version.isdecimal() and int(version) > int(schema.FORMAT_VERSION):
            software = identity.get("software", "unknown")
            raise UserError(f"{path}: this recording is newer: {reason}; use shearloop {software} or later")
        raise unusable(path, reason)
    electrodes = int(identity.get("electrodes", PAPER_TABLE.n_electrodes))
    injection: Any = identity.get("injection", PAPER_TABLE.injection)
    table = ChannelTable(electrodes, injection)
    if (found := str(identity.get("channel_table_hash"))) != table.digest:
        raise unusable(path, f"it has the channel table {found[:12]}…, expected {table.digest[:12]}…")
    return identity, table


def unusable(path: Path, reason: str) -> UserError:
    """Return the refusal of a recording of another format or version."""
    return UserError(
        f"{path}: this recording cannot be used: {reason}; record it again, or import it again with "
        "`shearloop recording import`"
    )
