"""Records a running daemon: every message and every raw input, without blocking the event loop.

Items wait in a bounded queue. Twice a second a thread writes them to the file as one chunk. A new file begins with the
daemon, with each further experiment, and after an hour without an experiment.
"""

import asyncio
import hashlib
import platform
import re
import threading
import unicodedata
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from io import FileIO
from itertools import count
from pathlib import Path
from typing import Any, Self

import numpy as np
import structlog
from pydantic_core import PydanticSerializationError

from shearloop.daemon.clock import Clock, ClockReading
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.messaging.messages import LoopState
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.writer import PARTIAL, McapFile
from shearloop.daemon.sensing.fingertip_task import SessionRecorder
from shearloop.daemon.sensing.session_inputs import session_inputs
from shearloop.daemon.sensing.sessions import channel_table
from shearloop.daemon.sensing.snapshots import SnapshotError, snapshot
from shearloop.drivers.connection import Diagnostics
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.errors import UserError
from shearloop.estimation import BeforeFrame, Session
from shearloop.files import lock, read_file

# A kill loses the data since the last flush, less than a second even on a busy computer.
FLUSH_S = 0.5
# Limit of the queue for a slow or full disk: minutes at rated speed. Further items are dropped and counted.
MAX_WAITING_BYTES = 32 << 20
LONGEST_IDLE_FILE_S = 3600.0
# Memory of a message apart from its arrays.
_OVERHEAD_BYTES = 1000
# Configuration keys of files to attach. Secret keys are never attached, and a bank is identified by its hash.
_ATTACHED = ("calibration", "robot", "experiment")
# Calibrations and settings are far smaller.
_LARGEST_ATTACHED_BYTES = 32 << 20
# Phases of `loop.state` without a running experiment.
_IDLE_PHASES = ("idle", "done", "stopped")


@dataclass(frozen=True, slots=True)
class AttachedFile:
    """A file that is attached to the recording."""

    name: str
    media_type: str
    data: bytes

    @classmethod
    def read(cls, path: Path) -> tuple["AttachedFile", ...]:
        """Return the file, or nothing if it is missing, unreadable or too large."""
        try:
            return (cls.of(path, read_file(path, _LARGEST_ATTACHED_BYTES)),)
        except OSError:
            return ()

    @classmethod
    def of(cls, path: Path, data: bytes) -> Self:
        """Return a file that has been read."""
        media_type = "application/yaml" if path.suffix in (".yaml", ".yml") else "application/octet-stream"
        return cls(str(path), media_type, data)


@dataclass(frozen=True, slots=True)
class Identity:
    """The metadata and the attachments of a recording."""

    metadata: Mapping[str, str]
    attached: tuple[AttachedFile, ...] = ()


def daemon_identity(config: DaemonConfig, fingertips: Mapping[str, Session]) -> Identity:
    """Return the identity of a daemon's recordings: software, configuration, and the files that it names.

    `fingertips` are the sessions of the configured ones. Raises UserError where they are of different kinds, and for a
    path that is not UTF-8.
    """
    metadata = schema.basic_identity(f"a daemon on {platform.node()}", channel_table(fingertips))
    metadata["python"] = f"{platform.python_version()}, numpy {np.__version__}, {platform.machine()}"
    if config.emulated:
        metadata[schema.EMULATED] = "every device"
    for name, session in fingertips.items():
        if session.search is not None:
            metadata[f"bank_{name}"] = session.search.identity
    try:
        as_json = config.model_dump_json(indent=1).encode()
    except PydanticSerializationError as error:
        folder = config.recording.folder if config.recording is not None else Path()
        raise UserError(
            "a recording keeps the configuration and its paths, and one of them is not UTF-8 (the folder of the "
            f"recordings is {str(folder)!r}); choose another name"
        ) from error
    attached = {schema.CONFIGURATION: AttachedFile(schema.CONFIGURATION, "application/json", as_json)}
    for key, path in config.walk():
        if isinstance(path, Path) and key.rpartition(".")[2] in _ATTACHED:
            for file in AttachedFile.read(path):
                attached[file.name] = file
                metadata[f"{schema.FILE_HASH} {path}"] = hashlib.sha256(file.data).hexdigest()
    return Identity(metadata, tuple(attached.values()))


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

    @property
    def wants_state(self) -> bool:
        return self.recorder.wants_state(self.source)

    def record(self, event: RawEvent) -> None:
        self.recorder.record_input(self.source, event)

    def record_state(self, state: Mapping[str, object], fixed: Mapping[str, object], t_ns: int) -> None:
        try:
            text = snapshot(state, fixed)
        except SnapshotError as error:
            # A measurement continues without its recording.
            structlog.get_logger().error("the recording cannot be replayed from its beginning", reason=str(error))
            text = b""
        self.record(RawEvent(InputKind.STATE, t_ns, text))

    def record_before(self, frame: int, before: BeforeFrame, t_ns: int) -> None:
        for event in session_inputs(frame, before, t_ns):
            self.record(event)


@dataclass(slots=True)
class _Counts:
    """Numbers over all files. The event loop counts `queued_bytes` and `dropped` up, the writing thread the others."""

    queued_bytes: int = 0
    written_bytes: int = 0
    dropped: int = 0
    # Messages without a JSON form, and the latest error.
    unwritable: int = 0
    last_unwritable: str = ""


@dataclass(slots=True)
class _Carried:
    """What a file that begins in the middle of the run needs from before it."""

    sources: set[str] = field(default_factory=set)
    # The sources that owe their state to the current file.
    missing: set[str] = field(default_factory=set)
    # The latest tool event of each source, and its query that has no reply yet.
    tools: dict[str, RawEvent] = field(default_factory=dict)
    asked: dict[str, RawEvent] = field(default_factory=dict)
    # A further experiment begins a file.
    experiment_began: bool = False

    def want_states(self) -> None:
        self.missing |= self.sources


@dataclass(slots=True)
class _CurrentFile:
    file: McapFile
    began_ns: int
    # All Unix times of the file minus the monotonic clock.
    offset_ns: int
    # Items lost before this file began.
    lost_before: int
    experiment: str = ""
    # The latest reading in `input.clock`.
    clock: ClockReading | None = None
    closed: bool = False


class Recorder:
    """Writes files in a folder. `record_message`, `input_recorder` and `record_experiment` never block.

    `failure` is the error of the last finished flush, empty without one. `closed_files` are complete.
    """

    def __init__(self, folder: Path, identity: Identity, clock: Clock) -> None:
        """Begin the first file; raises UserError if that is not possible."""
        self._folder = folder
        self._identity = identity
        self._clock = clock
        self._queue: deque[_Item] = deque()
        self._counts = _Counts()
        self._experiment_runs = False
        self._carried = _Carried()
        # A flush may still run in its thread when the recorder is closed.
        self._lock = threading.Lock()
        self.failure = ""
        # The error of the present flush. `failure` keeps the last one's meanwhile: a disk that stays full stays known.
        self._failing = ""
        self.closed_files: list[Path] = []
        self._new_folders = [one for one in (folder, *folder.parents) if not one.exists()]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._current = self._new_file(lost_before=0)
        except OSError as error:
            self._remove_new_folders()
            # `mkdir` only says of such a link that a file exists.
            lost = folder.is_symlink() and not folder.exists()
            why = f"it is a link to {folder.readlink()}, which does not exist" if lost else error.strerror
            raise UserError(f"{folder}: cannot record there: {why}; choose another folder") from error

    @property
    def path(self) -> Path:
        """The current file."""
        return self._current.file.partial

    def record_message(self, topic: str, content: Mapping[str, Any]) -> None:
        """Queue a published message."""
        # A float32 becomes about eight bytes of JSON.
        size = _OVERHEAD_BYTES + 2 * sum(len(value) for value in content.values() if isinstance(value, bytes))
        self._enqueue(size, partial(self._add_message, topic, content, self._clock.now_ns(), self._clock.reading))

    def input_recorder(self, source: str) -> SessionRecorder:
        """Return the recorder of one source's raw input."""
        self._carried.sources.add(source)
        return _SourceRecorder(self, source)

    def wants_state(self, source: str) -> bool:
        """Return whether a file began in the middle of the run, and has no state of this source yet."""
        return source in self._carried.missing

    def record_input(self, source: str, event: RawEvent) -> None:
        """Queue a raw input."""
        add = partial(self._add_input, source, event, self._clock.reading)
        queued = self._enqueue(_OVERHEAD_BYTES + len(event.data), add)
        # A state that the full queue drops is still wanted.
        if queued and event.kind is InputKind.STATE:
            self._carried.missing.discard(source)

    def record_experiment(
        self, name: str, path: Path | None = None, content: bytes = b"", tool_mm: float | None = None
    ) -> None:
        """Record the start of an experiment: a new file begins, unless the current one has no experiment yet.

        `path` and `content` are of the experiment's own file, which is attached.
        """
        attached = () if path is None else (AttachedFile.of(path, content),)
        notes = {} if tool_mm is None else {schema.DIAMETER_NOTE: f"{tool_mm:g}"}
        add = partial(self._add_experiment, name, attached, notes, self._clock.now_ns())
        if self._carried.experiment_began:
            self._carried.want_states()
        self._carried.experiment_began = True
        self._enqueue(_OVERHEAD_BYTES, add, begins_experiment=True)

    async def flushes(self) -> AsyncIterator[str]:
        """Write every FLUSH_S and yield `failure` each time."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            due_s = max(due_s + FLUSH_S, loop.time())
            await asyncio.sleep(due_s - loop.time())
            await asyncio.to_thread(self.write)
            yield self.failure

    def diagnostics(self) -> Diagnostics:
        """Return the recorder's state for `health`."""
        counts, file = self._counts, self._current.file
        return {
            "file": str(self.path),
            "files": len(self.closed_files) + 1,
            "file_messages": file.messages,
            "file_bytes": file.bytes_written,
            "waiting_bytes": self._waiting_bytes,
            "errors": {kind: n for kind, n in (("dropped", counts.dropped), ("unwritable", counts.unwritable)) if n},
            "error": self.failure or counts.last_unwritable,
        }

    def write(self) -> None:
        """Write the queue to the disk; an error is stored in `failure`, and the next call tries again."""
        with self._lock:
            if not self._current.closed:
                self._write()
                self.failure = self._failing

    def close(self) -> None:
        """Write the queue and close the file; an error is stored in `failure`."""
        with self._lock:
            if self._current.closed:
                return
            try:
                self._write()
            finally:
                self._current.closed = True
                self._finish_file(self._current, self._counts.dropped + self._counts.unwritable)
                self.failure = self._failing
                if not self.closed_files:
                    self._remove_new_folders()

    def _remove_new_folders(self) -> None:
        """Remove the folders that this recorder made and that are empty: a refused run leaves nothing."""
        for folder in self._new_folders:
            # One that is not empty stays.
            with suppress(OSError):
                folder.rmdir()

    @property
    def _waiting_bytes(self) -> int:
        return self._counts.queued_bytes - self._counts.written_bytes + self._current.file.bytes_waiting

    def _enqueue(self, size: int, add: Callable[[], None], *, begins_experiment: bool = False) -> bool:
        """Add an item to the queue; return whether there was room."""
        if self._waiting_bytes + size > MAX_WAITING_BYTES:
            self._counts.dropped += 1
            return False
        self._counts.queued_bytes += size
        self._queue.append(_Item(add, size, self._counts.dropped, begins_experiment))
        return True

    def _write(self) -> None:
        self._failing = ""
        if self._current.file.is_removed():
            self._change_file(self._queue[0].dropped if self._queue else self._counts.dropped)
            if self._current.file.is_removed():
                return
        # Items that arrive meanwhile wait for the next flush.
        for _ in range(len(self._queue)):
            item = self._queue.popleft()
            if item.begins_experiment and self._current.experiment:
                self._change_file(item.dropped, states_follow=True)
            elif not item.begins_experiment and self._is_idle_too_long():
                self._change_file(item.dropped)
            try:
                item.add()
            finally:
                self._counts.written_bytes += item.size
        self._flush()

    def _flush(self) -> bool:
        try:
            self._current.file.flush()
        except OSError as error:
            self._failing = f"{self.path}: {error.strerror}"
            return False
        return True

    def _is_idle_too_long(self) -> bool:
        age_s = (self._clock.now_ns() - self._current.began_ns) / 1e9
        return age_s > LONGEST_IDLE_FILE_S and not self._experiment_runs

    def _change_file(self, dropped: int, *, states_follow: bool = False) -> None:
        """Begin the next file; on failure continue with the current one. `dropped` counts the drops so far.

        `states_follow`: the states of all sources were asked for when the next item was queued.
        """
        try:
            self._current.file.free_if_deleted()
        except OSError as error:
            # The new file may still have room.
            self._failing = f"{self.path}: {error.strerror}"
        # A removed file that cannot be written does not prevent a new one.
        if not self._flush() and not self._current.file.is_removed():
            return
        previous, lost = self._current, dropped + self._counts.unwritable
        try:
            self._current = self._new_file(lost)
        except OSError as error:
            self._failing = f"{self._folder}: {error.strerror}"
            return
        if not states_follow:
            self._carried.want_states()
        self._finish_file(previous, lost)
        self._current.file.add_metadata(schema.CONTINUED_METADATA, {"sources": " ".join(sorted(self._carried.sources))})
        for source, event in list(self._carried.asked.items()):
            self._add_input(source, event, self._clock.reading)
        for source, event in self._carried.tools.items():
            # The tool is still held, and a replay of this file must know it.
            self._add_input(source, replace(event, t_ns=self._current.began_ns), self._clock.reading)

    def _new_file(self, lost_before: int) -> _CurrentFile:
        now_ns, offset_ns = self._clock.now_ns(), self._clock.offset_ns
        name = datetime.fromtimestamp((now_ns + offset_ns) / 1e9, UTC).strftime(schema.NAME_FORMAT)
        # Another file may have begun in the same second, or before the clock was set back.
        for number in count(1):
            began = name if number == 1 else f"{name}-{number}"
            with suppress(FileExistsError):
                if not any(self._folder.glob(f"{began}*")):
                    path = self._folder / f"{began}.mcap{PARTIAL}"
                    opened = FileIO(path, "xb")
                    file = McapFile(opened)
                    break
        try:
            # So that a repair knows that the file is being written.
            lock(opened.fileno(), path)
            file.identify({**self._identity.metadata, schema.CLOCK_OFFSET: str(offset_ns)})
            for one in self._identity.attached:
                file.attach(one.name, one.media_type, one.data, now_ns + offset_ns)
            file.flush()
        except OSError:
            # The next flush tries again.
            with suppress(OSError):
                file.discard()
            raise
        return _CurrentFile(file, now_ns, offset_ns, lost_before)

    def _finish_file(self, current: _CurrentFile, lost: int) -> None:
        """Close a file under a name with its experiment; if that fails, the PARTIAL file stays for a repair."""
        file = current.file
        began = file.partial.name.removesuffix(f".mcap{PARTIAL}")
        slug = slug_of(current.experiment)
        path = file.partial.with_name(f"{began}_{slug}.mcap" if slug else f"{began}.mcap")
        try:
            if not file.messages and not current.experiment:
                # The daemon stopped before its first message.
                file.discard()
                return
            file.add_metadata(schema.END_METADATA, {"dropped": str(lost - current.lost_before)})
            file.close(path)
        except OSError as error:
            self._failing = f"{file.partial}: {error.strerror}"
        else:
            self.closed_files.append(path)

    def _add_message(self, topic: str, content: Mapping[str, Any], now_ns: int, clock: ClockReading) -> None:
        if topic == LoopState.topic:
            self._experiment_runs = content["phase"] not in _IDLE_PHASES
        self._add_clock(now_ns, clock)
        name, offset_ns = schema.recorded_topic(topic, content["source"]), self._current.offset_ns
        try:
            data = schema.message_json(topic, content, offset_ns)
        except ValueError as error:
            self._counts.unwritable += 1
            self._counts.last_unwritable = f"a message of {name} has no JSON form and is left out: {error}"
            return
        self._current.file.add(name, content["t_mono_ns"] + offset_ns, now_ns + offset_ns, data)

    def _add_input(self, source: str, event: RawEvent, clock: ClockReading) -> None:
        match event.kind:
            case InputKind.TOOL:
                self._carried.tools[source] = event
            case InputKind.ASKED:
                self._carried.asked[source] = event
            case InputKind.DATA:
                self._carried.asked.pop(source, None)
        self._add_clock(event.t_ns, clock)
        t_unix_ns = event.t_ns + self._current.offset_ns
        self._current.file.add(schema.input_topic(source), t_unix_ns, t_unix_ns, schema.input_json(event))

    def _add_experiment(
        self, name: str, attached: tuple[AttachedFile, ...], notes: Mapping[str, str], now_ns: int
    ) -> None:
        current = self._current
        t_unix_ns = now_ns + current.offset_ns
        current.experiment, self._experiment_runs = name, True
        current.file.add_metadata(schema.EXPERIMENT_METADATA, {**notes, "name": name, "t_unix_ns": str(t_unix_ns)})
        for one in attached:
            if one not in self._identity.attached:
                current.file.attach(one.name, one.media_type, one.data, t_unix_ns)

    def _add_clock(self, now_ns: int, clock: ClockReading) -> None:
        current = self._current
        if clock == current.clock:
            return
        current.clock = clock
        entry = {"t_mono_ns": now_ns, "offset_ns": clock.offset_ns, schema.SUSPENDED: clock.suspended_ns}
        t_unix_ns = now_ns + current.offset_ns
        current.file.add(schema.CLOCK_TOPIC, t_unix_ns, t_unix_ns, schema.as_json(entry))


# Some letters become several, and a file's name has at most 255.
_LONGEST_SLUG = 100


def slug_of(name: str) -> str:
    """Return an experiment's name as a part of a file's: letters without accents, digits, points and hyphens."""
    # casefold makes ss of ß, and NFKD divides a letter from its accent.
    apart = unicodedata.normalize("NFKD", name.casefold())
    letters = "".join(one for one in apart if not unicodedata.combining(one))
    return re.sub(r"[^a-z0-9.]+", "-", letters)[:_LONGEST_SLUG].strip("-.")
