"""Writes a recording message by message, from data that is there already; a live one is `recorder`'s business."""

import io
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.content import as_json
from shearloop.daemon.recording.identity import basic_identity
from shearloop.daemon.recording.mcap_file import PARTIAL, McapFile
from shearloop.daemon.recording.schema import LOAD_TOPIC, METADATA, frame_topic

# Decimals of a volt: the board sends four.
_DECIMALS = 6
# A chunk of a megabyte or so.
_FLUSH_EVERY = 128


class RecordingWriter:
    """Appends messages in any order of time; a context manager that gives the file its name when all went well."""

    def __init__(self, path: str | Path, source: str, notes: dict[str, str] | None = None) -> None:
        """Create `path`.partial; `source` says in words where the data is from. Raises UserError where it cannot be."""
        self.path = Path(path)
        try:
            partial = self.path.with_name(self.path.name + PARTIAL)
            self._file = McapFile(self.path, io.FileIO(partial, "wb"))
        except OSError as error:
            raise self._unwritable(error) from error
        self._file.metadata(METADATA, {**basic_identity(source), **(notes or {})})

    def frame(self, side: str, t_mid_unix_ns: int, arrival_unix_ns: int, line: NDArray[np.float64]) -> None:
        """Append one frame: the (1024,) values of its line in volts."""
        values = np.asarray(line, dtype=np.float64)
        # A board's lines have fewer decimals, and are as they should be: a tenth of the time.
        rounded = values.tolist()
        if not np.array_equal(np.round(values, _DECIMALS), values):
            rounded = [round(value, _DECIMALS) for value in rounded]
        self._add(frame_topic(side), t_mid_unix_ns, {"arrival_unix_ns": arrival_unix_ns, "line": rounded})

    def torque(self, t_unix_ns: int, torque_nm: float) -> None:
        """Append one torque of the load cell in N·m."""
        self._add(LOAD_TOPIC, t_unix_ns, {"torque_nm": torque_nm})

    def close(self, complete: bool = True) -> None:
        """Finish the file, flush it to the disk and, when it is complete, give it its name."""
        try:
            self._file.close(complete)
        except OSError as error:
            raise self._unwritable(error) from error

    def __enter__(self) -> Self:
        """Return the writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; after an error what was written stays under the name NAME.partial."""
        self.close(complete=kind is None)

    def _add(self, topic: str, time_ns: int, content: dict[str, object]) -> None:
        self._file.add(topic, time_ns, time_ns, as_json(content))
        if self._file.messages % _FLUSH_EVERY == 0:
            try:
                self._file.flush()
            except OSError as error:
                raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> UserError:
        return UserError(f"{self.path}: the recording cannot be written: {error.strerror}; choose another --out")
