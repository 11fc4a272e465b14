"""An MCAP file that is whole at every moment: what was flushed survives a kill, and a full disk spoils nothing."""

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from shearloop.daemon.recording.schema import PROFILE, schema_of, schemas
from shearloop.files import sync_directory

PARTIAL = ".partial"
# Far above what comes between two flushes: chunks end where a flush ends them.
_CHUNK_BYTES = 1 << 24


class _Stream:
    """Keeps what the disk has not taken, so that a later flush can write it, and tells offsets as a file would."""

    def __init__(self, file: io.FileIO) -> None:
        self.file = file
        self.pending = bytearray()
        self.written = 0

    def write(self, data: bytes) -> int:
        self.pending += data
        return len(data)

    def tell(self) -> int:
        return self.written + len(self.pending)

    def flush(self) -> None:
        """Write all; raises OSError where that is not possible, and then nothing of it is in the file."""
        with memoryview(self.pending) as data:
            done = 0
            try:
                while done < len(data):
                    done += self.file.write(data[done:])
            except OSError:
                # A torn record would end a reader's way.
                self.file.truncate(self.written)
                self.file.seek(self.written)
                raise
        self.written += done
        self.pending.clear()


class McapFile:
    """Writes PATH.partial, and gives it its name when it is closed as complete.

    `flush` puts all that was added so far on the disk as one chunk. Where that fails (OSError), nothing is lost: the
    file is cut back to its last whole record, and the next flush tries again. Not for two threads at once.
    """

    def __init__(self, path: Path, file: io.FileIO | None = None) -> None:
        """Create PATH.partial, or write to an open `file`; raises OSError, FileExistsError where there is one."""
        self.path = path
        self.partial = path.with_name(path.name + PARTIAL)
        self._file = file if file is not None else io.FileIO(self.partial, "xb")
        self._stream = _Stream(self._file)
        # Write, tell and flush are all that is needed of it.
        self._writer = Writer(cast(IO[bytes], self._stream), _CHUNK_BYTES, CompressionType.ZSTD)
        self._writer.start(profile=PROFILE, library="shearloop")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}
        self.messages = 0

    @property
    def bytes_written(self) -> int:
        """Size of what is safe on the disk."""
        return self._stream.written

    @property
    def bytes_waiting(self) -> int:
        """Size of what a flush could not yet write."""
        return len(self._stream.pending)

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
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves its return type out

    def close(self, complete: bool = True) -> Path:
        """Write the index, and return the file's path: its name where it is complete, else NAME.partial.

        Raises OSError where there is no room for it; all that was flushed stays readable as NAME.partial.
        """
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves its return type out
            self._stream.flush()
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
