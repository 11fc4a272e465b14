"""Writes MCAP files: each flush is safe against a kill, and a full disk does not damage the file."""

import errno
import io
import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from mcap._chunk_builder import ChunkBuilder
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.daemon.recorder import schema
from shearloop.errors import UserError
from shearloop.files import sole_writer, sync_directory

PARTIAL = ".partial"
# Larger than the data between two flushes, so that each flush writes one chunk.
_CHUNK_BYTES = 1 << 24
# Messages in a chunk of about a megabyte.
_FLUSH_EVERY = 128


class _WholeChunks(ChunkBuilder):
    """Builds chunks that define the channels and schemas of their own messages, so that none needs another one."""

    def __init__(self) -> None:
        super().__init__()
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}

    def add_channel(self, channel: Channel) -> None:
        self._channels[channel.id] = channel

    def add_schema(self, schema: Schema) -> None:
        self._schemas[schema.id] = schema

    def add_message(self, message: Message) -> None:
        if message.channel_id not in self.message_indices:
            channel = self._channels[message.channel_id]
            # The number 0 stands for no schema.
            if channel.schema_id:
                self._schemas[channel.schema_id].write(self.record_writer)
            channel.write(self.record_writer)
        super().add_message(message)


def new_writer(stream: IO[bytes]) -> Writer:
    """Return a started MCAP writer that stores checksums of all its data, and definitions in each chunk."""
    writer = Writer(stream, _CHUNK_BYTES, CompressionType.ZSTD, enable_data_crcs=True)
    # The library has no option for this.
    vars(writer)["_Writer__chunk_builder"] = _WholeChunks()
    writer.start(profile="shearloop", library="shearloop")
    return writer


class _RetryStream:
    """Keeps data that the disk did not take, so that a later flush can write it."""

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
        """Write all pending data; on OSError cut the file back to the last successful flush."""
        with memoryview(self.pending) as data:
            done = 0
            try:
                while done < len(data):
                    done += self.file.write(data[done:])
            except OSError:
                self.file.truncate(self.written)
                self.file.seek(self.written)
                raise
        self.written += done
        self.pending.clear()


class McapFile:
    """Writes an open file, NAME.mcap.partial, which `close` renames.

    `flush` writes the messages so far as one chunk. If that fails (OSError), no data is lost and the next flush tries
    again. Not thread-safe.
    """

    def __init__(self, file: io.FileIO) -> None:
        """Take over the file, which `close` and `discard` close."""
        self.partial = Path(os.fsdecode(file.name))
        self._file = file
        self._stream = _RetryStream(file)
        # The MCAP writer calls only `write`, `tell` and `flush`.
        self._writer = new_writer(cast(IO[bytes], self._stream))
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: Counter[str] = Counter()
        self._identity: dict[str, str] = {}

    @property
    def messages(self) -> int:
        """The number of messages."""
        return self._counts.total()

    @property
    def bytes_written(self) -> int:
        """Bytes on the disk."""
        return self._stream.written

    @property
    def bytes_waiting(self) -> int:
        """Bytes that the last flush could not write."""
        return len(self._stream.pending)

    def identify(self, identity: Mapping[str, str]) -> None:
        """Append the recording's identity, before its first message; each chunk repeats it with its channels."""
        self._identity = dict(identity)
        self.add_metadata(schema.METADATA, identity)

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self._writer.add_metadata(name, dict(content))

    def attach(self, name: str, media_type: str, data: bytes, t_unix_ns: int) -> None:
        """Append an attachment, such as the configuration."""
        self._writer.add_attachment(t_unix_ns, t_unix_ns, name, media_type, data)

    def add(self, topic: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Append a message to the open chunk; `data` is JSON of the topic's schema."""
        if topic not in self._channels:
            self._channels[topic] = self._register(topic)
        self._writer.add_message(self._channels[topic], log_ns, data, publish_ns, self._counts[topic])
        self._counts[topic] += 1

    def add_frame(self, side: str, t_mid_unix_ns: int, arrival_unix_ns: int, line: NDArray[np.float64]) -> None:
        """Append one imported frame: the (v,) values of its line in volts. Flushes at times; raises OSError."""
        # The board sends four decimals of a volt.
        content = {"arrival_unix_ns": arrival_unix_ns, "line": np.round(line, 6).tolist()}
        self._add_imported(schema.recorded_topic(schema.FRAME_TOPIC, side), t_mid_unix_ns, content)

    def add_torque(self, t_unix_ns: int, torque_nm: float) -> None:
        """Append one imported torque of the load cell in N·m, as `add_frame`."""
        self._add_imported(schema.LOAD_TOPIC, t_unix_ns, {"torque_nm": torque_nm})

    def flush(self) -> None:
        """End the chunk and write it to the disk; raises OSError, after which a later flush tries again."""
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap has no return annotation here

    def close(self, path: Path | None = None) -> None:
        """Write the index, and rename the file to `path` if it is given.

        Raises OSError if the disk is full, and the flushed data then stays readable under the old name; also if the
        file is removed.
        """
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap has no return annotation here
            self._stream.flush()
            os.fsync(self._file.fileno())
            if self.is_removed():
                raise FileNotFoundError(errno.ENOENT, "the file was removed while it was written")
        finally:
            self._file.close()
        if path is not None:
            self.partial.replace(path)
            sync_directory(path.parent)

    def is_removed(self) -> bool:
        """Return whether another program removed, moved or replaced the file: further writes are lost."""
        try:
            return not os.path.samestat(os.fstat(self._file.fileno()), self.partial.stat())
        except OSError:
            return True

    def free_if_deleted(self) -> None:
        """Give the room on the disk back if the file was deleted, before it is closed; raises OSError.

        A file that was only moved stays as it is.
        """
        if os.fstat(self._file.fileno()).st_nlink == 0:
            self._file.truncate(0)

    def discard(self) -> None:
        """Close the file, and delete it if it is still there."""
        removed = self.is_removed()
        self._file.close()
        if not removed:
            self.partial.unlink()

    def _add_imported(self, topic: str, time_ns: int, content: Mapping[str, Any]) -> None:
        self.add(topic, time_ns, time_ns, schema.as_json(content))
        if self.messages % _FLUSH_EVERY == 0:
            self.flush()

    def _register(self, topic: str) -> int:
        name = schema.schema_name(topic)
        if name not in self._schemas:
            text = json.dumps(schema.schemas()[name], sort_keys=True, ensure_ascii=False).encode()
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", text)
        return self._writer.register_channel(topic, "json", self._schemas[name], self._identity)


@contextmanager
def _removed_on_failure(path: Path) -> Iterator[None]:
    try:
        yield
    except BaseException:
        path.unlink(missing_ok=True)
        raise


@contextmanager
def new_recording(
    path: Path,
    source: str,
    notes: Mapping[str, str] | None = None,
    table: ChannelTable = PAPER_TABLE,
    *,
    keep_unfinished: bool = True,
) -> Iterator[McapFile]:
    """Yield the file of a recording of data from `source`.

    After an error it keeps the name NAME.partial, or is removed unless `keep_unfinished`. The target of a link is
    written. Raises UserError where it cannot be written, and where another program is writing it.
    """
    target = path.resolve()
    partial = Path(f"{target}{PARTIAL}")
    try:
        with sole_writer(partial), nullcontext() if keep_unfinished else _removed_on_failure(partial):
            file, name = McapFile(io.FileIO(partial, "wb")), None
            try:
                file.identify({**schema.basic_identity(source, table), **(notes or {})})
                yield file
                name = target
            finally:
                file.close(name)
    except OSError as error:
        raise UserError(f"{path}: the recording cannot be written: {error.strerror}; choose another --out") from error
