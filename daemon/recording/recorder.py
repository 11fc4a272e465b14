"""Records a running daemon: every message and every raw input, without blocking the event loop.

Items wait in a bounded queue. Twice a second a thread writes them to the file as one chunk. A new file begins with the
daemon, with each further experiment, and after an hour without an experiment.
"""

import asyncio
import re
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from shearloop.daemon.clock import Clock
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.messages import Scalar
from shearloop.daemon.recording import schema
from shearloop.daemon.recording.identity import AttachedFile, Identity
from shearloop.daemon.recording.writer import McapFile
from shearloop.drivers.serial_sensor import InputKind, InputRecorder, RawEvent

# A kill loses the data since the last flush, less than a second even on a busy computer.
FLUSH_S = 0.5
# Limit of the queue for a slow or full disk: minutes at rated speed. Further items are dropped and counted.
MAX_WAITING_BYTES = 32 << 20
LONGEST_IDLE_FILE_S = 3600.0
# Memory of a message apart from its arrays.
_OVERHEAD_BYTES = 1000


@dataclass(frozen=True, slots=True)
class _Item:
    # Adds it to the current file.
    add: Callable[[], None]
    size: int
    # Items dropped before this one.
    dropped: int
    begins_experiment: bool


@dataclass(frozen=True, slots=True)
class _SourceRecorder:
    recorder: "Recorder"
    source: str

    def record(self, event: RawEvent) -> None:
        self.recorder.record_input(self.source, event)


class Recorder:
    """Writes files in a folder. `record_message`, `input_recorder` and `record_experiment` never block."""

    def __init__(
        self,
        folder: Path,
        identity: Identity,
        clock: Clock,
        *,
        is_busy: Callable[[], bool] = lambda: False,
        on_failure: Callable[[str], None] = lambda _: None,
        open_file: Callable[[Path], McapFile] = McapFile,
        max_waiting_bytes: int = MAX_WAITING_BYTES,
    ) -> None:
        """Begin the first file; raises UserError if that is not possible.

        `is_busy` returns whether an experiment is running. `on_failure` receives the error after each flush, empty
        without an error.
        """
        self._folder = folder
        self._identity = identity
        self._clock = clock
        self._is_busy = is_busy
        self._on_failure = on_failure
        self._open_file = open_file
        self._max_waiting_bytes = max_waiting_bytes
        self._queue: deque[_Item] = deque()
        # One thread counts each of these up. Their difference is the size of the queue.
        self._queued_bytes = 0
        self._done_bytes = 0
        self._dropped = 0
        # Messages without a JSON form, and the latest error.
        self._unwritable = 0
        self._last_unwritable = ""
        # Items lost before the current file began.
        self._lost_before = 0
        # The latest tool event of each source.
        self._tools: dict[str, RawEvent] = {}
        # A flush may still run in its thread when the recorder is closed.
        self._lock = threading.Lock()
        self._closed = False
        self.failure = ""
        self.finished: list[Path] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._begin_file()
        except OSError as error:
            raise UserError(f"{folder}: cannot record there: {error.strerror}; choose another folder") from error

    @property
    def path(self) -> Path:
        """The current file."""
        return self._file.partial

    def record_message(self, topic: str, content: Mapping[str, Any]) -> None:
        """Queue a published message."""
        # A float32 becomes about eight bytes of JSON.
        size = _OVERHEAD_BYTES + 2 * sum(len(value) for value in content.values() if isinstance(value, bytes))
        self._enqueue(size, partial(self._add_message, topic, content, self._clock.now_ns(), self._clock.offset_ns))

    def input_recorder(self, source: str) -> InputRecorder:
        """Return the recorder of one source's raw input."""
        return _SourceRecorder(self, source)

    def record_input(self, source: str, event: RawEvent) -> None:
        """Queue a raw input."""
        add = partial(self._add_input, source, event, self._clock.offset_ns)
        self._enqueue(_OVERHEAD_BYTES + len(event.data), add)

    def record_experiment(
        self, name: str, attached: tuple[AttachedFile, ...] = (), notes: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        """Record the start of an experiment: a new file begins, unless the current one has no experiment yet."""
        t_unix_ns = self._clock.now_ns() + self._clock.offset_ns
        add = partial(self._add_experiment, name, attached, notes, t_unix_ns)
        self._enqueue(_OVERHEAD_BYTES, add, begins_experiment=True)

    async def run(self) -> None:
        """Write every FLUSH_S until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            due_s = max(due_s + FLUSH_S, loop.time())
            await asyncio.sleep(due_s - loop.time())
            await asyncio.to_thread(self.write)
            self._on_failure(self.failure)

    def diagnostics(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return the recorder's state for `health`."""
        return {
            "file": str(self.path),
            "files": len(self.finished) + 1,
            "file_messages": self._file.messages,
            "file_bytes": self._file.bytes_written,
            "waiting_bytes": self._waiting_bytes,
            "errors": {kind: n for kind, n in (("dropped", self._dropped), ("unwritable", self._unwritable)) if n},
            "error": self.failure or self._last_unwritable,
        }

    def write(self) -> None:
        """Write the queue to the disk; an error is stored in `failure`, and the next call tries again."""
        with self._lock:
            if not self._closed:
                self._write()

    def close(self) -> None:
        """Write the queue and close the file; an error is stored in `failure`."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            try:
                self._write()
            finally:
                if self._file.messages or self._experiment:
                    self._finish_file(self._file, self._experiment, self._dropped + self._unwritable)
                else:
                    # The daemon stopped before its first message.
                    try:
                        self._file.discard()
                    except OSError as error:
                        self.failure = f"{self.path}: {error.strerror}"

    @property
    def _waiting_bytes(self) -> int:
        return self._queued_bytes - self._done_bytes + self._file.bytes_waiting

    def _enqueue(self, size: int, add: Callable[[], None], *, begins_experiment: bool = False) -> None:
        if self._waiting_bytes + size > self._max_waiting_bytes:
            self._dropped += 1
            return
        self._queued_bytes += size
        self._queue.append(_Item(add, size, self._dropped, begins_experiment))

    def _write(self) -> None:
        self.failure = ""
        # Items that arrive meanwhile wait for the next flush.
        for _ in range(len(self._queue)):
            item = self._queue.popleft()
            if self._experiment if item.begins_experiment else self._is_idle_too_long():
                self._change_file(item.dropped)
            try:
                item.add()
            finally:
                self._done_bytes += item.size
        self._flush()

    def _flush(self) -> bool:
        try:
            self._file.flush()
        except OSError as error:
            self.failure = f"{self.path}: {error.strerror}"
            return False
        return True

    def _is_idle_too_long(self) -> bool:
        return (self._clock.now_ns() - self._began_ns) / 1e9 > LONGEST_IDLE_FILE_S and not self._is_busy()

    def _change_file(self, dropped: int) -> None:
        """Begin the next file; on failure continue with the current one. `dropped` counts the drops so far."""
        if not self._flush():
            return
        previous, experiment = self._file, self._experiment
        try:
            self._begin_file()
        except OSError as error:
            self.failure = f"{self._folder}: {error.strerror}"
            return
        self._finish_file(previous, experiment, dropped + self._unwritable)
        for source, event in self._tools.items():
            # The tool is still held, and a replay of this file must know it.
            self._add_input(source, replace(event, t_ns=self._began_ns), self._clock.offset_ns)

    def _begin_file(self) -> None:
        now_ns, offset_ns = self._clock.now_ns(), self._clock.offset_ns
        file = self._create_file(datetime.fromtimestamp((now_ns + offset_ns) / 1e9, UTC).strftime("%Y-%m-%dT%H-%M-%SZ"))
        try:
            file.add_metadata(schema.METADATA, self._identity.metadata)
            for one in self._identity.attached:
                file.attach(one.name, one.media_type, one.data, now_ns + offset_ns)
            file.flush()
        except OSError:
            # The next flush tries again.
            with suppress(OSError):
                file.discard()
            raise
        self._file, self._began_ns = file, now_ns
        self._offset_ns: int | None = None
        self._experiment = ""

    def _create_file(self, name: str) -> McapFile:
        number, path = 1, self._folder / f"{name}.mcap"
        while True:
            try:
                return self._open_file(path)
            except FileExistsError:
                # It began in the same second.
                number += 1
                path = self._folder / f"{name}-{number}.mcap"

    def _finish_file(self, file: McapFile, experiment: str, lost: int) -> None:
        """Close a file under a name with its experiment; if that fails, the PARTIAL file stays for a repair."""
        slug = re.sub(r"[^a-z0-9.]+", "-", experiment.lower()).strip("-.")
        if slug:
            file.path = file.path.with_name(f"{file.path.stem}_{slug}.mcap")
        try:
            file.add_metadata(schema.END_METADATA, {"dropped": str(lost - self._lost_before)})
            self.finished.append(file.close())
        except OSError as error:
            self.failure = f"{file.partial}: {error.strerror}"
        self._lost_before = lost

    def _add_message(self, topic: str, content: Mapping[str, Any], now_ns: int, offset_ns: int) -> None:
        self._add_clock(now_ns, offset_ns)
        name = schema.recorded_topic(topic, content["source"])
        try:
            data = schema.message_json(topic, content, offset_ns)
        except schema.NoJsonError as error:
            self._unwritable += 1
            self._last_unwritable = f"a message of {name} has no JSON form and is left out: {error}"
            return
        self._file.add(name, content["t_mono_ns"] + offset_ns, now_ns + offset_ns, data)

    def _add_input(self, source: str, event: RawEvent, offset_ns: int) -> None:
        if event.kind is InputKind.TOOL:
            self._tools[source] = event
        self._add_clock(event.t_ns, offset_ns)
        t_unix_ns = event.t_ns + offset_ns
        self._file.add(schema.input_topic(source), t_unix_ns, t_unix_ns, schema.input_json(event))

    def _add_experiment(
        self, name: str, attached: tuple[AttachedFile, ...], notes: Mapping[str, str], t_unix_ns: int
    ) -> None:
        self._experiment = name
        self._file.add_metadata(schema.EXPERIMENT_METADATA, {**notes, "name": name, "t_unix_ns": str(t_unix_ns)})
        for one in attached:
            if one not in self._identity.attached:
                self._file.attach(one.name, one.media_type, one.data, t_unix_ns)

    def _add_clock(self, now_ns: int, offset_ns: int) -> None:
        if offset_ns == self._offset_ns:
            return
        self._offset_ns = offset_ns
        data = schema.as_json({"t_mono_ns": now_ns, "offset_ns": offset_ns})
        self._file.add(schema.CLOCK_TOPIC, now_ns + offset_ns, now_ns + offset_ns, data)
