"""The content of one recording in numbers, closed or not; damaged parts are counted and left out."""

from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

from mcap.records import Attachment, Message, Metadata, Schema

from shearloop.daemon.clock import ClockReading, ClockStep
from shearloop.daemon.recorder import schema
from shearloop.tools.recordings.being_written import is_being_written
from shearloop.tools.recordings.intact_records import IntactRecords, Progress
from shearloop.tools.recordings.message_content import read_content
from shearloop.tools.recordings.monotonic_times import MonotonicTimes
from shearloop.tools.recordings.reader import reading
from shearloop.tools.recordings.recorded_columns import ContentError, TopicColumns, recorded_topic
from shearloop.tools.recordings.repair import REPAIRED_METADATA, lost_in_repair, torn_in_repair

# Fewer messages, or a shorter time, say nothing of a rate.
MIN_RATED_MESSAGES, MIN_RATED_S = 3, 1.0


@dataclass(slots=True)
class TopicSummary:
    """One topic. A few messages, or messages of a short time, have no mean rate."""

    messages: int = 0
    rate_hz: float | None = None
    # Whether this version has this topic.
    known: bool = True
    # The keys of this version that its schema lacks, and the keys that this version lacks.
    not_recorded: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    # The keys with another type or unit than this version's, and how they were recorded.
    differing: dict[str, str] = field(default_factory=dict)
    # Why its messages cannot be read, or empty.
    problem: str = ""


@dataclass(frozen=True, slots=True)
class RecordedStep(ClockStep):
    """A step of the clock, and how long after the first message the daemon noticed it."""

    after_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FileCondition:
    """Whether a file was closed, its size, and how much of it is damaged."""

    path: str
    size_bytes: int
    closed: bool
    torn_bytes: int
    damaged_chunks: int
    damaged_attachments: int
    damaged_index: bool
    # Whether a part is damaged that is no chunk, no attachment and no index, such as the header or metadata.
    damaged_elsewhere: bool
    # Whether a part of the file, or its index, is missing or damaged.
    is_damaged: bool
    # Lost messages by topic, as far as the file shows them.
    lost: dict[str, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSummary(FileCondition):
    """The content of a recording in numbers, times in Unix ns; the keys of `recording info --json`."""

    # Whether a program writes it now, as far as its lock says.
    being_written: bool
    dropped: int | None
    first_unix_ns: int | None
    # When the file was begun, by its name; None for another name. Messages of before it waited for it.
    named_unix_ns: int | None
    duration_s: float
    # Whether the same code made it, so that a replay must be equal bit for bit.
    same_code: bool
    experiments: list[str]
    # The file that a copy was repaired from, and the messages by topic that were lost there.
    repaired_from: str | None
    lost_in_repair: dict[str, int]
    # The incomplete bytes at its end, which may have held further ones.
    torn_bytes_in_repair: int
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
    columns: dict[str, TopicColumns | None] = {}
    spans: dict[str, tuple[int, int]] = {}
    named: dict[str, list[dict[str, str]]] = {}
    attachments = []
    clock, readings = MonotonicTimes(), list[tuple[int, ClockReading]]()
    for record in records:
        match record:
            case Message():
                channel = records.channels[record.channel_id]
                name, t_ns = channel.topic, clock.time_ns(channel, record)
                if name not in topics:
                    topics[name], columns[name] = _described(name, records.schemas.get(channel.schema_id))
                topics[name].messages += 1
                if name == schema.CLOCK_TOPIC and (reading_now := _clock_reading(record, columns[name])) is not None:
                    readings.append((t_ns, reading_now))
                first_ns, last_ns = spans.get(name, (t_ns, t_ns))
                spans[name] = min(first_ns, t_ns), max(last_ns, t_ns)
            case Metadata():
                named.setdefault(record.name, []).append(dict(record.metadata))
            case Attachment():
                attachments.append(record.name)
    for name, span in spans.items():
        topics[name].rate_hz = _rate_hz(topics[name].messages, *span)
    first_unix_ns = min((first_ns for first_ns, _ in spans.values()), default=None)
    ends = named.get(schema.END_METADATA, [])
    repaired = named.get(REPAIRED_METADATA, [{}])[-1]
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
        damaged_index=records.damaged_index,
        damaged_elsewhere=records.damaged_elsewhere,
        is_damaged=records.is_damaged,
        lost=records.lost,
        being_written=is_being_written(path),
        dropped=dropped,
        first_unix_ns=first_unix_ns,
        named_unix_ns=named_unix_ns(path),
        duration_s=0.0 if first_unix_ns is None else (max(last for _, last in spans.values()) - first_unix_ns) / 1e9,
        same_code=metadata.get("code_sha256") == schema.code_digest(),
        experiments=[experiment.get("name", "") for experiment in experiments],
        repaired_from=repaired.get("source"),
        lost_in_repair=lost_in_repair(repaired),
        torn_bytes_in_repair=torn_in_repair(repaired),
        tool_mm=(experiments or [metadata])[-1].get(schema.DIAMETER_NOTE),
        metadata=metadata,
        attachments=attachments,
        topics=dict(sorted(topics.items())),
        clock_steps=_clock_steps(readings, first_unix_ns or 0),
    )


def _clock_steps(readings: list[tuple[int, ClockReading]], first_unix_ns: int) -> list[RecordedStep]:
    return [
        RecordedStep(step.set_s, step.suspended_s, (t_ns - first_unix_ns) / 1e9)
        for (_, before), (t_ns, after) in pairwise(readings)
        if (step := ClockStep.between(before, after)) is not None
    ]


def _rate_hz(messages: int, first_ns: int, last_ns: int) -> float | None:
    """Return the rate of a topic, None where it has too few messages, or for too short a time."""
    lasts_s = (last_ns - first_ns) / 1e9
    return (messages - 1) / lasts_s if messages >= MIN_RATED_MESSAGES and lasts_s >= MIN_RATED_S else None


def named_unix_ns(path: Path) -> int | None:
    """Return the time in a recording's name, in Unix ns; None for a name that the daemon does not give."""
    # A further file of the same second has a number after the Z.
    name, zulu, _ = path.name.partition("Z")
    try:
        began = datetime.strptime(f"{name}{zulu}", schema.NAME_FORMAT).replace(tzinfo=UTC)
    except ValueError:
        return None
    return round(began.timestamp()) * 10**9


def _described(topic: str, written: Schema | None) -> tuple[TopicSummary, TopicColumns | None]:
    """Return the summary of a topic without a message yet, and its columns by its schema in the file."""
    try:
        columns = recorded_topic(topic, written)
    except ContentError as error:
        return TopicSummary(problem=str(error)), None
    if columns.name is None:
        return TopicSummary(known=False), columns
    differing = dict(columns.differing)
    return TopicSummary(not_recorded=columns.not_recorded, unknown=columns.unknown, differing=differing), columns


def _clock_reading(message: Message, columns: TopicColumns | None) -> ClockReading | None:
    """Return the reading of an entry of `input.clock`, or None for one that another program changed."""
    if columns is None:
        return None
    try:
        content = columns.known(read_content(schema.CLOCK_TOPIC, message.data, columns))
    except ContentError:
        return None
    offset_ns = content["offset_ns"]
    return None if offset_ns is None else ClockReading(offset_ns, content[schema.SUSPENDED] or 0)
