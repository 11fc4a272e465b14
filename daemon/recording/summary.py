"""What is in a recording, in numbers: `shearloop recording info`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Channel, Message, Metadata

from shearloop.daemon.recording.identity import code_digest
from shearloop.daemon.recording.repair import Progress, condition_of, records
from shearloop.daemon.recording.schema import DIAMETER_NOTE, END_METADATA, EXPERIMENT_METADATA, METADATA


@dataclass(slots=True)
class Topic:
    """One topic: how many messages, and from when to when (log times, Unix ns)."""

    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    json_bytes: int = 0

    @property
    def rate_hz(self) -> float | None:
        """Mean rate, None for fewer than two messages."""
        span_s = (self.last_ns - self.first_ns) / 1e9
        return (self.messages - 1) / span_s if self.messages > 1 and span_s > 0 else None

    def count(self, message: Message) -> None:
        """Take in a message."""
        if not self.messages:
            self.first_ns = self.last_ns = message.log_time
        self.messages += 1
        self.json_bytes += len(message.data)
        self.first_ns, self.last_ns = min(self.first_ns, message.log_time), max(self.last_ns, message.log_time)


@dataclass(slots=True)
class Summary:
    """All that `info` tells."""

    path: Path
    size: int
    closed: bool = False
    torn_bytes: int = 0
    damaged_chunks: int = 0
    dropped: int | None = None
    metadata: dict[str, str] = field(default_factory=dict)
    experiments: list[str] = field(default_factory=list)
    # The diameter of the tool in mm as the recording names it.
    tool_mm: str | None = None
    attachments: list[str] = field(default_factory=list)
    topics: dict[str, Topic] = field(default_factory=dict)

    @property
    def first_ns(self) -> int | None:
        """Log time of the first message."""
        return min((topic.first_ns for topic in self.topics.values()), default=None)

    @property
    def duration_s(self) -> float:
        """From the first message to the last."""
        last_ns = max((topic.last_ns for topic in self.topics.values()), default=0)
        return 0.0 if self.first_ns is None else (last_ns - self.first_ns) / 1e9

    @property
    def same_code(self) -> bool:
        """Whether it was made by the very code that runs here, so that a replay must give the same, bit for bit."""
        return self.metadata.get("code_sha256") == code_digest()

    def as_map(self) -> dict[str, Any]:
        """Return everything, for JSON."""
        return {
            "path": str(self.path),
            "size_bytes": self.size,
            "closed": self.closed,
            "torn_bytes": self.torn_bytes,
            "damaged_chunks": self.damaged_chunks,
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


def summarise(path: Path, progress: Progress = lambda _: None) -> Summary:
    """Read a recording through, closed or not; raises UserError for a file that is none."""
    condition = condition_of(path)
    found = Summary(path, condition.size)
    topics: dict[int, str] = {}
    for record in records(path, condition, progress):
        match record:
            case Channel():
                topics[record.id] = record.topic
            case Message() if record.channel_id in topics:
                found.topics.setdefault(topics[record.channel_id], Topic()).count(record)
            case Metadata(name=name) if name == METADATA:
                found.metadata = dict(record.metadata)
                found.tool_mm = record.metadata.get(DIAMETER_NOTE)
            case Metadata(name=name) if name == EXPERIMENT_METADATA:
                found.experiments.append(record.metadata.get("name", ""))
                found.tool_mm = record.metadata.get(DIAMETER_NOTE)
            case Metadata(name=name) if name == END_METADATA:
                found.dropped = int(record.metadata.get("dropped", "0"))
            case Attachment():
                found.attachments.append(record.name)
            case _:
                pass
    found.closed, found.torn_bytes = condition.closed, condition.torn_bytes
    found.damaged_chunks = condition.damaged_chunks
    return found
