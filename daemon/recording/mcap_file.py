"""An MCAP file that is whole at every moment: what was flushed survives a kill, and a full disk spoils nothing."""

import json
import os
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from mcap.writer import CompressionType, Writer

from shearloop.bank.eit.stored import sync_directory
from shearloop.daemon.recording.schema import PROFILE, schema_of, schemas

PARTIAL = ".partial"
# Far above what comes between two flushes: chunks end where a flush ends them.
_CHUNK_BYTES = 1 << 24


class RawFile(Protocol):
    """What is needed of an unbuffered file."""

    def write(self, data: memoryview, /) -> int | None:
        """Write as much as there is room for; OSError where there is none."""

    def seek(self, offset: int, /) -> int:
        """Go to an offset."""

    def truncate(self, size: int, /) -> int:
        """Cut the file off."""

    def fileno(self) -> int:
        """Return the descriptor."""

    def close(self) -> None:
        """Close it."""


class _Pending:
    """The writer's stream: keeps whole records until they are on the disk, and tells offsets as a file would."""

    def __init__(self) -> None:
        self.records: deque[bytes] = deque()
        self.waiting = 0
        self.written = 0

    def write(self, data: bytes) -> int:
        if data:
            self.records.append(data)
            self.waiting += len(data)
        return len(data)

    def tell(self) -> int:
        return self.written + self.waiting

    def flush(self) -> None:
        """Nothing is passed on here: that is `McapFile.flush`."""


class _ChunkEndingWriter(Writer):
    """The library's writer, whose chunks end when they are told to: it knows a limit in bytes alone."""

    def end_chunk(self) -> None:
        """Write the open chunk and its index, if there is anything in it."""
        self._Writer__finalize_chunk()  # type: ignore[attr-defined]


class McapFile:
    """Writes PATH.partial, and gives it its name when it is closed as complete.

    `flush` puts all that was added so far on the disk as one chunk. Where that fails (OSError), nothing is lost: the
    file is cut back to its last whole record, and the next flush tries again. Not for two threads at once.
    """

    def __init__(self, path: Path, file: RawFile | None = None) -> None:
        """Create PATH.partial, or write to an open `file`; raises OSError, FileExistsError where there is one."""
        self.path = path
        self.partial = path.with_name(path.name + PARTIAL)
        self._file: RawFile = file if file is not None else self.partial.open("xb", buffering=0)
        self._pending = _Pending()
        self._writer = _ChunkEndingWriter(
            self._pending,  # type: ignore[arg-type]  # write and tell are all it needs
            chunk_size=_CHUNK_BYTES,
            compression=CompressionType.ZSTD,
        )
        self._writer.start(profile=PROFILE, library="shearloop")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}
        self.messages = 0

    @property
    def bytes_written(self) -> int:
        """Size of what is safe on the disk."""
        return self._pending.written

    @property
    def bytes_waiting(self) -> int:
        """Size of what a flush could not yet write."""
        return self._pending.waiting

    def metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self._writer.add_metadata(name, dict(content))

    def attach(self, name: str, media_type: str, data: bytes, t_unix_ns: int) -> None:
        """Append an attachment, such as the configuration."""
        self._writer.add_attachment(t_unix_ns, t_unix_ns, name, media_type, data)

    def add(self, topic: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message to the open chunk; `data` is JSON of the topic's schema."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._registered(topic)
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        self._writer.add_message(channel, log_time=log_ns, publish_time=publish_ns, sequence=sequence, data=data)
        self.messages += 1

    def flush(self) -> None:
        """End the chunk and put it on the disk; raises OSError, after which a later flush tries again."""
        self._writer.end_chunk()
        self._drain()

    def close(self, complete: bool = True) -> Path:
        """Write the index, and return the file's path: its name where it is complete, else NAME.partial.

        Raises OSError where there is no room for it; all that was flushed stays readable as NAME.partial.
        """
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves its return type out
            self._drain()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()
        if not complete:
            return self.partial
        self.partial.replace(self.path)
        sync_directory(self.path.parent)
        return self.path

    def discard(self) -> None:
        """Take the file away."""
        self._file.close()
        self.partial.unlink(missing_ok=True)

    def _registered(self, topic: str) -> int:
        name = schema_of(topic)
        if name not in self._schemas:
            text = json.dumps(schemas()[name], sort_keys=True, ensure_ascii=False).encode()
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", text)
        return self._writer.register_channel(topic, "json", self._schemas[name])

    def _drain(self) -> None:
        pending = self._pending
        while pending.records:
            data = memoryview(pending.records[0])
            try:
                while data:
                    data = data[self._file.write(data) or 0 :]
            except OSError:
                # A torn record at the end would end a reader's way: back to the last whole one.
                self._file.truncate(pending.written)
                self._file.seek(pending.written)
                raise
            size = len(pending.records.popleft())
            pending.written += size
            pending.waiting -= size
