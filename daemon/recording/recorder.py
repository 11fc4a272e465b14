"""Records a running daemon: every message and every raw input, without ever making the loop wait for a disk.

What is recorded waits in a queue with a bound; twice a second a thread turns it into JSON and writes it as one
chunk. A file begins with the daemon and with every further experiment, and in any case after an hour without one.
"""

import asyncio
import re
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from shearloop.daemon.clock import Clock
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.messages import Scalar
from shearloop.daemon.recording.content import NoJsonError, as_json, input_json, message_json
from shearloop.daemon.recording.identity import Attached, Identity
from shearloop.daemon.recording.mcap_file import McapFile
from shearloop.daemon.recording.schema import (
    CLOCK_TOPIC,
    END_METADATA,
    EXPERIMENT_METADATA,
    METADATA,
    input_topic,
    recorded_topic,
)
from shearloop.drivers.serial_sensor import InputKind, OnRaw, RawEvent

# A kill costs what came since the last flush: below a second, and so even where the machine is busy.
FLUSH_S = 0.5
# What may wait for a disk that is slow or full: minutes at rated speed. Beyond it things are dropped, and counted.
MOST_WAITING_BYTES = 32 << 20
LONGEST_IDLE_FILE_S = 3600.0
# What a message costs beside its arrays: the map and its scalars.
_OVERHEAD_BYTES = 1000
# Files that begin in the same second.
_MOST_ALIKE = 100


@dataclass(frozen=True, slots=True)
class _Message:
    topic: str
    content: Mapping[str, Any]
    offset_ns: int
    now_ns: int


@dataclass(frozen=True, slots=True)
class _Input:
    source: str
    told: RawEvent
    offset_ns: int


@dataclass(frozen=True, slots=True)
class _Experiment:
    name: str
    attached: tuple[Attached, ...]
    notes: Mapping[str, str]
    t_unix_ns: int


_Item: TypeAlias = _Message | _Input | _Experiment


class Recorder:
    """Writes into files of a folder. `record`, `tap` and `experiment` are called in the event loop and never wait."""

    def __init__(
        self,
        folder: Path,
        identity: Identity,
        clock: Clock,
        *,
        busy: Callable[[], bool] = lambda: False,
        on_failure: Callable[[str], None] = lambda _: None,
        opener: Callable[[Path], McapFile] = McapFile,
        most_waiting_bytes: int = MOST_WAITING_BYTES,
    ) -> None:
        """Begin the first file; raises UserError where that is not possible.

        `busy` says whether an experiment is running; `on_failure` hears why nothing can be written, or an empty text.
        """
        self._folder = folder
        self._identity = identity
        self._clock = clock
        self._busy = busy
        self._on_failure = on_failure
        self._opener = opener
        self._most_waiting_bytes = most_waiting_bytes
        # Each with its size, and how many had been dropped before it.
        self._queue: deque[tuple[_Item, int, int]] = deque()
        # Each is counted up by one thread alone; what waits is their difference.
        self._taken_bytes = 0
        self._done_bytes = 0
        self._dropped = 0
        # What has no JSON form, and why the last one had none.
        self._unwritable = 0
        self._last_unwritable = ""
        # How many of both before the file being written began.
        self._lost_before = 0
        # Which tool each source was told of last.
        self._tools: dict[str, RawEvent] = {}
        # One thread at a time writes: a flush that was cancelled may still be under way when the end comes.
        self._writing = threading.Lock()
        self._ended = False
        self.failure = ""
        self.finished: list[Path] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._begin()
        except OSError as error:
            raise UserError(
                f"{folder}: nothing can be recorded there: {error.strerror}; choose another folder"
            ) from error

    @property
    def path(self) -> Path:
        """The file being written."""
        return self._file.partial

    def record(self, topic: str, content: Mapping[str, Any]) -> None:
        """Take in a published message, as it goes on the wire."""
        # In JSON the four bytes of a float32 become some eight.
        size = _OVERHEAD_BYTES + 2 * sum(len(value) for value in content.values() if isinstance(value, bytes))
        self._add(_Message(topic, content, self._clock.offset_ns, self._clock.now_ns()), size)

    def tap(self, source: str) -> OnRaw:
        """Return what hears of all that a source's parser is told."""

        def hear(told: RawEvent) -> None:
            self._add(_Input(source, told, self._clock.offset_ns), _OVERHEAD_BYTES + len(told.data))

        return hear

    def experiment(
        self, name: str, attached: tuple[Attached, ...] = (), notes: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        """Take note that an experiment was started: another file begins, unless this one has had none yet."""
        self._add(_Experiment(name, attached, notes, self._clock.now_ns() + self._clock.offset_ns), _OVERHEAD_BYTES)

    async def run(self) -> None:
        """Write every FLUSH_S until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            due_s = max(due_s + FLUSH_S, loop.time())
            await asyncio.sleep(due_s - loop.time())
            await asyncio.to_thread(self.write)
            self._on_failure(self.failure)

    def facts(self) -> Mapping[str, Scalar | Mapping[str, int]]:
        """Return what health tells of the recording."""
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
        """Write all that waits. A disk that does not take it is told in `failure`, and is tried again next time."""
        with self._writing:
            if not self._ended:
                self._write()

    def close(self) -> None:
        """Write what is left and give the file its name; where that fails, `failure` says so."""
        with self._writing:
            if not self._ended:
                self._ended = True
                try:
                    self._write()
                finally:
                    self._end()

    def _end(self) -> None:
        if self._file.messages or self._experiment:
            self._finish(self._file, self._experiment, self._dropped + self._unwritable - self._lost_before)
        else:
            # A daemon that did not get as far as its first message has nothing to keep.
            try:
                self._file.discard()
            except OSError as error:
                self.failure = f"{self.path}: {error.strerror}"

    @property
    def _waiting_bytes(self) -> int:
        return self._taken_bytes - self._done_bytes + self._file.bytes_waiting

    def _add(self, item: _Item, size: int) -> None:
        if self._waiting_bytes + size > self._most_waiting_bytes:
            self._dropped += 1
            return
        self._taken_bytes += size
        self._queue.append((item, size, self._dropped))

    def _write(self) -> None:
        self.failure = ""
        # What comes meanwhile waits for the next time.
        for _ in range(len(self._queue)):
            item, size, dropped = self._queue.popleft()
            if self._begins_another(item):
                self._begin_another(dropped)
            try:
                self._put(item)
            finally:
                self._done_bytes += size
        self._flush()

    def _flush(self) -> bool:
        try:
            self._file.flush()
        except OSError as error:
            self.failure = f"{self.path}: {error.strerror}"
            return False
        return True

    def _begins_another(self, item: _Item) -> bool:
        if isinstance(item, _Experiment):
            return bool(self._experiment)
        return (self._clock.now_ns() - self._began_ns) / 1e9 > LONGEST_IDLE_FILE_S and not self._busy()

    def _begin_another(self, dropped: int) -> None:
        """Go on in another file; where none can be begun, in the same one. So many were dropped until now."""
        if not self._flush():
            return
        lost = dropped + self._unwritable
        finished = self._file, self._experiment, lost - self._lost_before
        try:
            self._begin()
        except OSError as error:
            self.failure = f"{self._folder}: {error.strerror}"
            return
        self._lost_before = lost
        self._finish(*finished)
        for source, told in self._tools.items():
            # It is held on, and a replay of this file has heard of it nowhere else.
            self._put(_Input(source, replace(told, t_ns=self._began_ns), self._clock.offset_ns))

    def _begin(self) -> None:
        now_ns, offset_ns = self._clock.now_ns(), self._clock.offset_ns
        file = self._opened(datetime.fromtimestamp((now_ns + offset_ns) / 1e9, UTC).strftime("%Y-%m-%dT%H-%M-%SZ"))
        try:
            file.metadata(METADATA, self._identity.metadata)
            for one in self._identity.attached:
                file.attach(one.name, one.media_type, one.data, now_ns + offset_ns)
            file.flush()
        except OSError:
            # What says nothing of a run is in the way of those who look for one, and is tried again soon.
            with suppress(OSError):
                file.discard()
            raise
        self._file, self._began_ns = file, now_ns
        self._offset_ns: int | None = None
        self._experiment = ""

    def _opened(self, name: str) -> McapFile:
        for number in range(2, _MOST_ALIKE):
            try:
                return self._opener(self._folder / f"{name}.mcap")
            except FileExistsError:
                name = f"{name.partition('Z')[0]}Z-{number}"
        raise FileExistsError(17, f"there are {_MOST_ALIKE} files of this second")

    def _finish(self, file: McapFile, experiment: str, lost: int) -> None:
        """Close a file, under a name that tells its experiment; what cannot be closed stays PARTIAL, to be repaired."""
        slug = re.sub(r"[^a-z0-9.]+", "-", experiment.lower()).strip("-.")
        if slug:
            file.path = file.path.with_name(f"{file.path.stem}_{slug}.mcap")
        try:
            file.metadata(END_METADATA, {"dropped": str(lost)})
            self.finished.append(file.close())
        except OSError as error:
            self.failure = f"{file.partial}: {error.strerror}"

    def _put(self, item: _Item) -> None:
        match item:
            case _Message(topic, content, offset_ns, now_ns):
                self._put_clock(now_ns, offset_ns)
                name = recorded_topic(topic, content["source"])
                try:
                    data = message_json(topic, content, offset_ns)
                except NoJsonError as error:
                    self._unwritable += 1
                    self._last_unwritable = f"a message of {name} is left out, for it has no JSON form: {error}"
                    return
                self._file.add(name, content["t_mono_ns"] + offset_ns, now_ns + offset_ns, data)
            case _Input(source, told, offset_ns):
                if told.kind is InputKind.TOOL:
                    self._tools[source] = told
                self._put_clock(told.t_ns, offset_ns)
                t_unix_ns = told.t_ns + offset_ns
                self._file.add(input_topic(source), t_unix_ns, t_unix_ns, input_json(told))
            case _Experiment(name, attached, notes, t_unix_ns):
                self._experiment = name
                self._file.metadata(EXPERIMENT_METADATA, {**notes, "name": name, "t_unix_ns": str(t_unix_ns)})
                for one in attached:
                    if one not in self._identity.attached:
                        self._file.attach(one.name, one.media_type, one.data, t_unix_ns)

    def _put_clock(self, now_ns: int, offset_ns: int) -> None:
        if offset_ns == self._offset_ns:
            return
        self._offset_ns = offset_ns
        content = {"t_mono_ns": now_ns, "offset_ns": offset_ns}
        self._file.add(CLOCK_TOPIC, now_ns + offset_ns, now_ns + offset_ns, as_json(content))
