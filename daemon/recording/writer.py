"""Writes a recording, message by message, live or not. A file that was not closed keeps the name NAME.partial."""

import json
import os
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from bank.bank_file import sync_directory
from bank.channels import CHANNEL_TABLE_HASH
from daemon.errors import UserError
from daemon.recording.schema import (
    FORMAT_VERSION,
    LOAD_TOPIC,
    METADATA,
    PROFILE,
    SCHEMAS,
    frame_topic,
    schema_of,
)

# Decimals of a volt: the board sends four.
_DECIMALS = 6


class RecordingWriter:
    """Appends messages in any order of time; a context manager that gives the file its name when all went well."""

    def __init__(self, path: str | Path, source: str, notes: dict[str, str] | None = None) -> None:
        """Create `path`.partial; `source` says in words where the data is from. Raises UserError where it cannot be."""
        self.path = Path(path)
        self._partial = self.path.with_name(f"{self.path.name}.partial")
        try:
            self._file: BinaryIO = self._partial.open("wb")
        except OSError as error:
            raise UserError(
                f"{self.path}: the recording cannot be written: {error.strerror}; choose another --out"
            ) from error
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile=PROFILE, library="shearloop")
        self._writer.add_metadata(
            METADATA,
            {
                "format_version": FORMAT_VERSION,
                "channel_table_hash": CHANNEL_TABLE_HASH,
                "source": source,
                **(notes or {}),
            },
        )
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def frame(self, side: str, t_mid_unix_ns: int, arrival_unix_ns: int, line: NDArray[np.float64]) -> None:
        """Append one frame: the (1024,) values of its line in volts."""
        values = [round(float(value), _DECIMALS) for value in line]
        self._add(frame_topic(side), t_mid_unix_ns, {"arrival_unix_ns": arrival_unix_ns, "line": values})

    def torque(self, t_unix_ns: int, torque_nm: float) -> None:
        """Append one torque of the load cell in N·m."""
        self._add(LOAD_TOPIC, t_unix_ns, {"torque_nm": torque_nm})

    def _add(self, topic: str, time_ns: int, content: dict[str, object]) -> None:
        if topic not in self._channels:
            name = schema_of(topic)
            if name not in self._schemas:
                text = json.dumps(SCHEMAS[name], sort_keys=True).encode()
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", text)
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[name])
            self._sequence[topic] = 0
        self._writer.add_message(
            self._channels[topic],
            log_time=time_ns,
            publish_time=time_ns,
            sequence=self._sequence[topic],
            data=json.dumps(content, separators=(",", ":")).encode(),
        )
        self._sequence[topic] += 1

    def close(self, complete: bool = True) -> None:
        """Finish the file, flush it to the disk and, when it is complete, give it its name."""
        if self._file.closed:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves its return type out
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()
        if complete:
            self._partial.replace(self.path)
            sync_directory(self.path.parent)

    def __enter__(self) -> Self:
        """Return the writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; after an error what was written stays under the name NAME.partial."""
        self.close(complete=kind is None)
