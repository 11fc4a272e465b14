"""Repairs recordings: copies the intact part into a new file with an index.

The index is written when a file is closed, so a kill or a power loss leaves a file without it.
"""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.records import Attachment, Channel, Message, Metadata
from mcap.writer import Writer

from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.writer import PARTIAL, new_writer
from shearloop.errors import UserError
from shearloop.files import replace_file
from shearloop.tools.outputs import check_new
from shearloop.tools.recordings.being_written import is_being_written
from shearloop.tools.recordings.intact_records import NOTHING_INTACT, IntactRecords, Progress

# The metadata record of a copy that is repaired: its first source, the numbers of lost messages by topic, as JSON, and
# of incomplete bytes at the end.
REPAIRED_METADATA = "shearloop.repaired"


@dataclass(frozen=True, slots=True)
class RepairResult:
    """The repaired file, its number of messages, and the losses; the keys of `recording repair --json`."""

    path: Path
    messages: int
    torn_bytes: int
    damaged_chunks: int
    damaged_attachments: int
    damaged_index: bool
    # Whether a part is damaged that is no chunk, no attachment and no index, such as the header or metadata.
    damaged_elsewhere: bool
    # Lost messages by topic, as far as the file shows them.
    lost: dict[str, int]
    # Whether a program was writing the source: the copy has the content of that moment.
    being_written: bool
    # Whether a part of the source, or its index, was missing or damaged.
    was_damaged: bool


def repair(source: Path, out: Path | None = None, progress: Progress = lambda _: None) -> RepairResult:
    """Copy the intact records into a new file with an index; the source is not changed.

    The copy is `out`, or the source without `.partial`, or NAME.repaired.mcap. Raises UserError if the copy exists or
    cannot be written, if the source has no intact message, and for a source that is being written without `out`: its
    writer gives it that name.
    """
    being_written = is_being_written(source)
    if out is None and being_written:
        raise UserError(
            f"{source} is being written, and its writer finishes it: end the run, or name a copy with --out"
        )
    if out is None:
        name = source.name.removesuffix(PARTIAL)
        out = source.with_name(name if name != source.name else f"{source.stem}.repaired.mcap")
    check_new(out)
    records = IntactRecords(source, progress)
    try:
        with replace_file(out) as file:
            messages = _copy(records, source, file)
            if not messages:
                raise UserError(f"{source}: {NOTHING_INTACT}")
    except OSError as error:
        raise UserError(f"{out}: the repaired recording cannot be written: {error.strerror}") from error
    return RepairResult(
        out,
        messages,
        records.torn_bytes,
        records.damaged_chunks,
        records.damaged_attachments,
        records.damaged_index,
        records.damaged_elsewhere,
        records.lost,
        being_written,
        records.is_damaged,
    )


def _copy(records: IntactRecords, source: Path, file: BinaryIO) -> int:
    """Write the intact records, with a header and an index of the copy's own; return the number of messages."""
    writer = new_writer(file)
    schemas: dict[str, int] = {}
    channels: dict[int, int] = {}
    identity: dict[str, str] = {}
    lost: Counter[str] = Counter()
    # What a copy that is copied again says of its own repair.
    earlier: dict[str, str] = {}
    messages = 0
    for record in records:
        match record:
            case Message():
                channel = records.channels[record.channel_id]
                if channel.id not in channels:
                    channels[channel.id] = _registered(writer, channel, records, schemas)
                copied = channels[channel.id], record.log_time, record.data, record.publish_time
                writer.add_message(*copied, record.sequence)
                messages += 1
            case Metadata(name=name) if name == REPAIRED_METADATA:
                earlier = dict(record.metadata)
                lost.update(lost_in_repair(earlier))
            case Metadata(name=schema.METADATA):
                identity = record.metadata
            case Metadata():
                writer.add_metadata(record.name, record.metadata)
            case Attachment():
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
    # The record has no checksum; the chunks have one.
    identity = records.identity or identity
    if identity:
        writer.add_metadata(schema.METADATA, identity)
    if records.is_indexed:
        lost += Counter(records.lost)
    else:
        # Without an index, only gaps in the messages' numbers show a loss, and they show an earlier one again.
        lost |= Counter(records.lost)
    if records.is_damaged or earlier:
        first = {"source": earlier.get("source", str(source)), "lost": json.dumps(lost)}
        torn_bytes = records.torn_bytes + torn_in_repair(earlier)
        writer.add_metadata(REPAIRED_METADATA, {**first, "torn_bytes": str(torn_bytes)})
    writer.finish()  # type: ignore[no-untyped-call]  # mcap has no return annotation here
    return messages


def lost_in_repair(metadata: Mapping[str, str]) -> dict[str, int]:
    """Return the numbers of lost messages by topic that the metadata of a repaired copy name, if it is one."""
    try:
        return {topic: int(count) for topic, count in json.loads(metadata.get("lost", "{}")).items()}
    except (ValueError, TypeError, AttributeError):
        # Another program has changed them.
        return {}


def torn_in_repair(metadata: Mapping[str, str]) -> int:
    """Return the number of incomplete bytes at the end of its source that the metadata of a repaired copy name."""
    text = metadata.get("torn_bytes", "0")
    return int(text) if text.isdecimal() else 0


def _registered(writer: Writer, channel: Channel, records: IntactRecords, schemas: dict[str, int]) -> int:
    """Register a channel, and its schema once for all channels that have it; return the channel's number."""
    known = records.schemas.get(channel.schema_id)
    if known is not None and known.name not in schemas:
        schemas[known.name] = writer.register_schema(known.name, known.encoding, known.data)
    schema_id = schemas[known.name] if known is not None else 0
    return writer.register_channel(channel.topic, channel.message_encoding, schema_id, channel.metadata)
