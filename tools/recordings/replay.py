"""Replay: the raw input of a recording passes through parsers and estimators again and is published as if live.

All times are the recording's own, so the result does not depend on the replay's speed. The same code gives the same
estimates bit for bit.
"""

import asyncio
import hashlib
import json
import math
import tempfile
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import structlog

from shearloop.daemon.clock import Clock, ClockReading
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.messaging import messages
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.patience import patience_of
from shearloop.daemon.recorder import schema
from shearloop.daemon.sensing.fingertip_messages import (
    adapted_message,
    estimate_message,
    frame_message,
    heatmap_message,
)
from shearloop.daemon.sensing.fingertip_task import estimate_frames
from shearloop.daemon.sensing.frame_pairing import FramePairing
from shearloop.daemon.sensing.load_cell_task import load_message
from shearloop.daemon.sensing.sessions import COMBINED, open_combined, open_session
from shearloop.daemon.sensing.skin_task import SKIN, SKIN_SOURCES
from shearloop.daemon.sensing.snapshots import SnapshotError, restored
from shearloop.daemon.sensors import load_cell_calibration
from shearloop.daemon.torques import LOAD_CELL
from shearloop.drivers.eit_kit import Frame, FrameParser
from shearloop.drivers.load_cell import LoadParser
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.errors import UserError
from shearloop.estimation import BeforeFrame, HeldTool, Measured, Session
from shearloop.models import validated
from shearloop.tools.recordings.before_frame import SESSION_KINDS, before_frame
from shearloop.tools.recordings.reader import OpenRecording, open_recording, reading
from shearloop.tools.recordings.recorded_columns import ContentError, TopicColumns, own_name
from shearloop.tools.recordings.repair import REPAIRED_METADATA, lost_in_repair
from shearloop.tools.recordings.replayed_skin import ReplayedSkin

# Topics that a replay computes. All others are sent as they were recorded.
_COMPUTED = messages.EitFrame, messages.EitEstimate, messages.EitAdapted, messages.LoadTorque, messages.SkinShear
COMPUTED_TOPICS = tuple(kind.topic for kind in _COMPUTED)
# These depend on the computer, not on the measurement.
NOT_COMPARED = ("latency_s", "timestamp", "arrival_unix_ns", "seq")
_MAX_EXAMPLES = 5
# A replay is clearly slower than asked if it takes longer by this time and by this factor.
_LATE_S, _SLOWER = 0.5, 1.1
# What tells the messages of a source apart, the first that they have; other code may move a time by less than this.
_PLACES = (("frame", 0), ("sample", 0), ("t_mono_ns", 5_000_000))
# The keys that a replay needs of each raw input and of each message, and the further ones by topic.
_INPUT_KEYS, _CLOCK_KEYS = ("t_mono_ns", "kind", "data"), ("t_mono_ns", "offset_ns")
_MESSAGE_KEYS: Mapping[str, tuple[str, ...]] = {
    messages.EitFrame.topic: ("age_s", "frame"),
    messages.SkinShear.topic: ("sample",),
}
# A daemon's has some kilobytes. One of this size is refused key by key within two seconds.
_LARGEST_CONFIGURATION_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class RecordedEvent:
    """One entry of a recording: a message under its live topic, or a raw input (`raw`)."""

    topic: str
    t_mono_ns: int
    content: Mapping[str, Any]
    source: str = ""
    raw: RawEvent | None = None
    # The keys of the content that its recording does not have with this version's type and unit.
    without: Collection[str] = ()


class ReplayEvents(NamedTuple):
    """What the frames do not contain: by source, what comes before each.

    `frame_numbers` holds the frames' times and numbers by source and arrival, `sample_numbers` the numbers of the
    skin's samples by their time; they continue from file to file.
    """

    before_frames: dict[str, "RecordedBefore"]
    frame_numbers: dict[str, dict[int, list[tuple[int, int]]]]
    sample_numbers: dict[int, int]


def together(earlier: BeforeFrame, later: BeforeFrame) -> BeforeFrame:
    """Return what two inputs say of the same frame."""
    return BeforeFrame(
        begins_tare=earlier.begins_tare or later.begins_tare,
        gives_up_tare=earlier.gives_up_tare or later.gives_up_tare,
        tool=later.tool or earlier.tool,
        fingers_moved=earlier.fingers_moved or later.fingers_moved,
        known_torques=later.known_torques or earlier.known_torques,
    )


class RecordedBefore:
    """What a recording says of one source's frames, by their numbers: what comes before each."""

    def __init__(self) -> None:
        self._before: dict[int, BeforeFrame] = {}
        self._tools: list[tuple[int, HeldTool]] = []

    def add(self, number: int, before: BeforeFrame) -> None:
        """Take the next input."""
        if before.tool is not None:
            self._tools.append((number, before.tool))
        self._before[number] = together(self._before.get(number, BeforeFrame()), replace(before, tool=None))

    def of(self, number: int, last: int) -> BeforeFrame:
        """Return what comes before a frame and after the `last` one.

        A later file of a run begins with the tool that is held then, and with the number of that tool's first frame.
        """
        tools = [tool for first, tool in self._tools if last < first <= number]
        return replace(self._before.get(number, BeforeFrame()), tool=tools[-1] if tools else None)


class RecordedRun:
    """A recording as a sequence of events; raises UserError for a file that cannot be replayed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_recording(path) as recording:
            known = {topic: own_name(topic) is not None for topic in recording.counts}
            # Of the topics of this version; a replay leaves out the others.
            self.counts = {topic: count for topic, count in recording.counts.items() if known[topic]}
            self.unknown_topics = sorted(
                topic for topic, count in recording.counts.items() if count and not known[topic]
            )
            self.metadata = recording.identity
            self._attached = recording.attachments()
            continued = recording.metadata.get(schema.CONTINUED_METADATA, {})
            # By topic: what a repaired copy does not have.
            self.lost = lost_in_repair(recording.metadata.get(REPAIRED_METADATA, {}))
            # By topic.
            self._columns = {
                topic: self._checked_columns(recording, topic) for topic, count in self.counts.items() if count
            }
        # Of a recording that begins in the middle of a run: the sources that continue from a state.
        self.continued = frozenset(continued.get("sources", "").split())
        self._own: DaemonConfig | None = None

    def _checked_columns(self, recording: OpenRecording, topic: str) -> TopicColumns:
        """Return the columns of a topic; raises MissingKeyError if it lacks a key that the replay needs."""
        columns, name = recording.columns(topic), schema.schema_name(topic)
        if name == schema.INPUT:
            needed: Collection[str] = _INPUT_KEYS
        elif name == schema.CLOCK_TOPIC:
            needed = _CLOCK_KEYS
        else:
            own = _MESSAGE_KEYS if self.has_inputs else schema.IMPORTED_KEYS
            needed = (*sorted(messages.ENVELOPE), *own.get(name, ()))
        columns.need(topic, needed, "a replay")
        return columns

    @property
    def not_recorded(self) -> dict[str, list[str]]:
        """By topic, the keys of this version that the recording does not have."""
        return {topic: columns.not_recorded for topic, columns in self._columns.items() if columns.not_recorded}

    @property
    def differing(self) -> dict[str, Mapping[str, str]]:
        """By topic, the keys that were recorded with another type or unit than this version's, and how."""
        return {topic: columns.differing for topic, columns in self._columns.items() if columns.differing}

    @property
    def left_out(self) -> dict[str, list[str]]:
        """By topic, the recorded keys that this version does not have, which a replay does not send."""
        return {topic: columns.unknown for topic, columns in self._columns.items() if columns.unknown}

    @property
    def has_inputs(self) -> bool:
        """Whether it holds raw input; an imported recording holds only lines."""
        return any(topic.startswith(schema.input_topic("")) and topic != schema.CLOCK_TOPIC for topic in self.counts)

    @property
    def tool(self) -> Measured | None:
        """The tool that an imported recording names; a daemon's recording holds what was held at each time."""
        named_mm = self.metadata.get(schema.DIAMETER_NOTE)
        if named_mm is None or self.has_inputs:
            return None
        with reading(self.path):
            return Measured(float(named_mm), 0.0)

    def continues_with(self, config: DaemonConfig) -> bool:
        """Whether its states fit: they are of the same code, and of the recorded configuration."""
        return bool(self.continued) and config is self._own and self.metadata.get("code_sha256") == schema.code_digest()

    @contextmanager
    def configuration(self) -> Iterator[DaemonConfig]:
        """Yield the recorded configuration, with the attached files in a temporary folder."""
        if schema.CONFIGURATION not in self._attached:
            raise UserError(
                f"{self.path} has no configuration because no daemon recorded it; give one with --config CONFIG"
            )
        with tempfile.TemporaryDirectory(prefix="shearloop-replay-") as folder:
            files: dict[str, str] = {}
            self._check_lost_files()
            for number, (name, data) in enumerate(self._attached.items()):
                copy = Path(folder) / f"{number}-{Path(name).name[-60:]}"
                copy.write_bytes(data)
                files[name] = str(copy)

            def with_copies(section: dict[str, Any]) -> dict[str, Any]:
                return {key: files.get(str(value), value) for key, value in section.items()}

            with reading(self.path):
                written = self._attached[schema.CONFIGURATION]
                if len(written) > _LARGEST_CONFIGURATION_BYTES:
                    raise ContentError(f"its configuration has {len(written) >> 10} kB: no daemon wrote it")
                content = json.loads(written, object_hook=with_copies)
            where = f"{self.path}: its configuration does not fit this version"
            self._own = validated(content, DaemonConfig, where, UserError, cure="; give one with --config CONFIG")
            yield self._own

    def _check_lost_files(self) -> None:
        """Raise UserError for an attached file that is lost, if the file in its place now is another one."""
        for key, recorded in self.metadata.items():
            word, _, name = key.partition(" ")
            if word != schema.FILE_HASH or name in self._attached:
                continue
            try:
                same = hashlib.sha256(Path(name).read_bytes()).hexdigest() == recorded
            except OSError:
                same = False
            if not same:
                raise UserError(
                    f"{self.path} has lost its copy of {name}, and the file that it was recorded with is no longer "
                    "there; give a configuration that names such a file with --config CONFIG"
                )

    def events(self) -> Iterator[RecordedEvent]:
        """Yield the events in recorded order."""
        with open_recording(self.path) as recording:
            # An imported recording has one side after the other, a live one is in order.
            recorded = recording.messages(self._columns, by_time=not self.has_inputs)
            imported: Counter[str] = Counter()
            for channel, message in recorded:
                columns = self._columns[channel.topic]
                content = columns.known(recording.content(channel, message))
                if schema.schema_name(channel.topic) in schema.IMPORTED_KEYS and "source" not in content:
                    yield _imported_event(channel.topic, content, message.log_time, imported[channel.topic])
                    imported[channel.topic] += 1
                else:
                    yield _live_event(channel.topic, content, columns.unusable)

    def replay_events(self) -> ReplayEvents:
        """Return the events that the frames do not contain."""
        found = ReplayEvents(defaultdict(RecordedBefore), defaultdict(lambda: defaultdict(list)), {})
        for event in self.events() if self.has_inputs else ():
            with reading(self.path):
                match event:
                    case RecordedEvent(topic=messages.EitFrame.topic, content=content):
                        arrival_ns = event.t_mono_ns + round(content["age_s"] * 1e9)
                        found.frame_numbers[event.source][arrival_ns].append((event.t_mono_ns, content["frame"]))
                    case RecordedEvent(topic=messages.SkinShear.topic, content=content):
                        found.sample_numbers[event.t_mono_ns] = content["sample"]
                    # The tares of the load cell and of the skin are of no frame.
                    case RecordedEvent(source=source, raw=RawEvent(kind=kind) as raw) if (
                        kind in SESSION_KINDS and source not in (LOAD_CELL, SKIN)
                    ):
                        found.before_frames[source].add(*before_frame(raw))
        return found


class ReplayClock(Clock):
    """A clock that shows the recording's own time."""

    def __init__(self) -> None:
        """Start at zero until the first event sets the time."""
        self._reading = ClockReading(0, 0)
        self._now_ns = 0

    def now_ns(self) -> int:
        """Return the time of the current event."""
        return self._now_ns

    def set(self, now_ns: int, offset_ns: int | None = None) -> None:
        """Set the time, and the offset to Unix time if it is given."""
        self._now_ns = now_ns
        if offset_ns is not None:
            self._reading = ClockReading(offset_ns, 0)


@dataclass(slots=True)
class ReplayComparison:
    """Compares computed messages with recorded ones, bit for bit.

    `recorded_topics` are the topics of the recording. Computed messages of other topics are only counted.
    """

    recorded_topics: Collection[str] = ()
    compared: Counter[str] = field(default_factory=Counter)
    different: Counter[str] = field(default_factory=Counter)
    examples: list[str] = field(default_factory=list)
    # Lines of fingertips and load cell that the replay dropped, because they may have waited before an opening.
    dropped_at_opening: int = 0
    # Sources that continue from a state which has not come yet: their messages are sent as they were recorded, and
    # counted here by topic and source.
    awaited: set[str] = field(default_factory=set)
    before_state: Counter[tuple[str, str]] = field(default_factory=Counter)
    _foreign: int = 0
    # Computed messages of recorded topics without a recorded one in their place.
    _passed: int = 0
    waiting: dict[tuple[str, str], deque[Mapping[str, Any]]] = field(default_factory=dict)

    def add_computed(self, topic: str, content: Mapping[str, Any]) -> None:
        """Store a message that the replay published."""
        if topic not in COMPUTED_TOPICS:
            return
        if schema.recorded_topic(topic, content["source"]) not in self.recorded_topics:
            self._foreign += 1
        else:
            plain = json.loads(schema.message_json(topic, content, 0))
            self.waiting.setdefault((topic, content["source"]), deque()).append(plain)

    def restart(self, source: str) -> None:
        """Forget the messages of a source so far: they were forwarded, and it is computed from here on."""
        self.awaited.discard(source)
        self.waiting = {key: waiting for key, waiting in self.waiting.items() if key[1] != source}

    def compare(self, event: RecordedEvent) -> None:
        """Compare a recorded message with the computed one of its topic, source, and frame, sample or time.

        Where a part of the recording is lost, either can be missing.
        """
        waiting = self.waiting.get((event.topic, event.source), deque())
        self.compared[event.topic] += 1
        key, tolerance = next(one for one in _PLACES if event.content.get(one[0]) is not None)
        place = event.content[key]
        while waiting and waiting[0][key] < place - tolerance:
            waiting.popleft()
            self._passed += 1
        if not waiting or waiting[0][key] > place + tolerance:
            self._add_difference(event, "the replay did not compute it")
            return
        computed = waiting.popleft()
        compared = (key for key in event.content if key not in NOT_COMPARED and key not in event.without)
        keys = [key for key in compared if computed.get(key) != event.content[key]]
        if keys:
            changes = (f"{key} was {_short(event.content[key])}, is {_short(computed.get(key))}" for key in keys)
            self._add_difference(event, ", ".join(changes))

    @property
    def without_state(self) -> list[str]:
        """The sources without a state in the recording, whose messages could not be compared."""
        return sorted({source for _, source in self.before_state if source in self.awaited})

    @property
    def passed(self) -> bool:
        """Whether something was compared, nothing differs, and no source was left out."""
        return bool(self.compared) and not self.different and not self.without_state

    @property
    def unrecorded(self) -> int:
        """Computed messages that are not in the recording, such as those at the moment of the daemon's stop."""
        return self._foreign + self._passed + sum(map(len, self.waiting.values()))

    def _add_difference(self, event: RecordedEvent, text: str) -> None:
        self.different[event.topic] += 1
        if len(self.examples) < _MAX_EXAMPLES:
            self.examples.append(f"{event.topic} of {event.source}, number {event.content['seq']}: {text}")


@dataclass(frozen=True, slots=True)
class ReplayPace:
    """How fast events were replayed: the asked factor, the time that they took as they happened, and in the replay."""

    asked: float
    recorded_s: float
    took_s: float

    @property
    def reached(self) -> float | None:
        """How many times as fast as they happened the events were replayed, None for no time at all."""
        return self.recorded_s / self.took_s if self.took_s > 0 and self.recorded_s > 0 else None

    @property
    def is_behind(self) -> bool:
        """Whether the replay was clearly slower than asked; `max` asks for no factor."""
        late_s = self.took_s - self.recorded_s / self.asked
        return self.asked < math.inf and late_s > _LATE_S and self.took_s > _SLOWER * self.recorded_s / self.asked


class Replay:
    """The parsers and estimators of one configuration, fed with a recording; `clock` is the publisher's clock."""

    def __init__(self, run: RecordedRun, config: DaemonConfig, publisher: Publisher, clock: ReplayClock) -> None:
        """Open all files of the configuration; raises BankError or UserError."""
        self._run = run
        self._events = run.replay_events()
        self._publisher = publisher
        self._clock = clock
        self.comparison = ReplayComparison(run.counts)
        if run.has_inputs:
            publisher.add_listener(self.comparison.add_computed, raises=True)
        # Per source: the difference between recorded and replayed numbers of frames or samples, and the latest frame.
        self._number_offset: dict[str, int] = {}
        self._latest_frame: dict[str, int] = {}
        self._sessions: dict[str, Session] = {
            name: open_session(fingertip, name) for name, fingertip in config.fingertips.items()
        }
        if config.combined is not None:
            self._sessions[COMBINED] = open_combined(config.combined, config.fingertips)
        if (tool := run.tool) is not None:
            for session in self._sessions.values():
                session.set_tool(tool)
        self._frame_parsers = {
            name: FrameParser(
                self._sessions[name].calibration.table.zero_slots,
                nominal_period_ns=round(fingertip.frame_period_s * 1e9),
                patience=patience_of(config),
            )
            for name, fingertip in config.fingertips.items()
        }
        self._pairing: FramePairing[Frame] | None = None
        if config.combined is not None:
            sides = self._sessions[COMBINED].calibration.sides
            self._pairing = FramePairing(sides, config.fingertips[sides[0]].frame_period_s)
        self._load_parser: LoadParser | None = None
        if config.load_cell is not None:
            self._load_parser = LoadParser(load_cell_calibration(config.load_cell), config.load_cell.rate_hz)
        self._skin = ReplayedSkin(config.skin) if config.skin is not None else None
        if run.continues_with(config):
            self.comparison.awaited.update(run.continued.intersection(self._sources))

    @property
    def _sources(self) -> set[str]:
        """The sources of the messages that are computed."""
        load_cell = (LOAD_CELL,) if self._load_parser is not None else ()
        return {*self._sessions, *load_cell, *((SKIN,) if self._skin is not None else ())}

    async def play(self, speed: float, progress: Callable[[int], None] = lambda _: None) -> ReplayPace:
        """Replay all events `speed` times as fast as they happened; math.inf does not wait at all."""
        loop = asyncio.get_running_loop()
        began_s, first_ns, last_ns = loop.time(), None, 0
        for number, event in enumerate(self._run.events(), 1):
            # The time of a message lies before its sending. Only a raw input has its arrival time.
            if event.raw is not None or not self._run.has_inputs:
                first_ns = event.t_mono_ns if first_ns is None else first_ns
                last_ns = event.t_mono_ns
                due_s = began_s + (event.t_mono_ns - first_ns) / 1e9 / speed
                if due_s > loop.time():
                    await asyncio.sleep(due_s - loop.time())
            await self._process(event)
            progress(number)
            if number % 100 == 0:
                # Let signals and sockets run.
                await asyncio.sleep(0)
        dropped = [parser.dropped_at_opening for parser in self._frame_parsers.values()]
        if self._load_parser is not None:
            dropped.append(self._load_parser.dropped_at_opening)
        self.comparison.dropped_at_opening = sum(dropped)
        recorded_ns = 0 if first_ns is None else last_ns - first_ns
        return ReplayPace(speed, recorded_ns / 1e9, loop.time() - began_s)

    async def _process(self, event: RecordedEvent) -> None:
        if event.topic == schema.CLOCK_TOPIC:
            self._clock.set(event.t_mono_ns, int(event.content["offset_ns"]))
        elif event.raw is not None:
            self._clock.set(event.t_mono_ns)
            await self._process_input(event.source, event.raw)
        elif self._is_compared(event):
            self.comparison.compare(event)
        elif self._run.has_inputs and event.topic in COMPUTED_TOPICS and event.source in self.comparison.awaited:
            self.comparison.before_state[event.topic, event.source] += 1
            self._publisher.forward(event.topic, messages.with_packed_arrays(event.content))
        elif event.topic != messages.EitHeatmap.topic:
            self._publisher.forward(event.topic, messages.with_packed_arrays(event.content))

    def _is_compared(self, event: RecordedEvent) -> bool:
        computed = self._sources - self.comparison.awaited
        return self._run.has_inputs and event.topic in COMPUTED_TOPICS and event.source in computed

    async def _process_input(self, source: str, event: RawEvent) -> None:
        """Publish the messages that follow from a raw input; an input of another source is ignored."""
        if event.kind is InputKind.STATE:
            if source in self.comparison.awaited:
                for waiting in self._restore(source, event.data):
                    await self._estimate(COMBINED, *waiting)
        elif source in self.comparison.awaited:
            # Its state, which comes soon, includes what follows from this.
            return
        elif source in self._frame_parsers:
            for frame in self._renumbered(source, self._frame_parsers[source].handle(event)):
                self._publisher.publish(frame_message(source, frame))
                await self._estimate(source, frame)
                if self._publisher.has_subscriber(messages.EitHeatmap.topic):
                    await self._publish_heatmap(source, frame)
                if self._pairing is None or COMBINED in self.comparison.awaited:
                    continue
                if (pair := self._pairing.add(source, frame)) is not None:
                    await self._estimate(COMBINED, *pair)
        elif source == LOAD_CELL and self._load_parser is not None:
            for sample in self._load_parser.handle(event):
                self._publisher.publish(load_message(sample))
        elif self._skin is not None and source in SKIN_SOURCES:
            # A query before the state may have its reply after it.
            for message in self._skin.handle(source, event):
                if SKIN not in self.comparison.awaited:
                    self._publisher.publish(self._continued(message))

    def _restore(self, source: str, text: bytes) -> list[tuple[Frame, ...]]:
        """Continue a source from its recorded state, and return the pairs of frames that waited then.

        Raises UserError for a state that does not fit.
        """
        pairs: list[tuple[Frame, ...]] = []
        try:
            if source in self._sessions:
                session = self._sessions[source]
                state = restored(text, session.fixed, {"session": session, "parser": self._frame_parsers.get(source)})
                self._sessions[source] = state["session"]
                if source in self._frame_parsers:
                    self._frame_parsers[source] = state["parser"]
                else:
                    self._pairing = state["pairing"]
                    pairs += state["pairs"]
            elif source == LOAD_CELL:
                self._load_parser = restored(text, {}, {"parser": self._load_parser})["parser"]
            elif self._skin is not None:
                self._skin.restore(text)
        except (SnapshotError, KeyError) as error:
            raise UserError(f"{self._run.path}: the state of {source} cannot be used: {error}") from error
        self.comparison.restart(source)
        self._number_offset[source] = 0
        return pairs

    def _renumbered(self, source: str, frames: list[Frame]) -> list[Frame]:
        """Return frames with their recorded numbers: a later file of a run continues to count, as after lost input."""
        if frames:
            # Several frames can arrive together. The first may have begun in the file before, and the last may have
            # been published after the end of this file, so that the nearest times tell which frame is which.
            recorded = self._events.frame_numbers[source].get(frames[0].t_arrival_ns, [])
            places = [(abs(frame.t_mid_ns - t_ns), number - frame.seq) for frame in frames for t_ns, number in recorded]
            if places:
                _, self._number_offset[source] = min(places)
        offset = self._number_offset.get(source, 0)
        return [replace(frame, seq=frame.seq + offset) for frame in frames] if offset else frames

    def _continued(self, message: messages.SkinShear) -> messages.SkinShear:
        """Return a message with the number of its sample in the run; the first takes the number of the nearest time."""
        numbers = self._events.sample_numbers
        if SKIN not in self._number_offset:
            nearest = min(numbers, key=lambda t_ns: abs(t_ns - message.t_mono_ns), default=None)
            self._number_offset[SKIN] = 0 if nearest is None else numbers[nearest] - message.sample
        elif message.t_mono_ns in numbers:
            self._number_offset[SKIN] = numbers[message.t_mono_ns] - message.sample
        return replace(message, sample=message.sample + self._number_offset[SKIN])

    async def _estimate(self, source: str, *frames: Frame) -> None:
        session, number = self._sessions[source], frames[0].seq
        before = self._events.before_frames[source].of(number, self._latest_frame.get(source, -1))
        self._latest_frame[source] = number
        session.prepare(before)
        known = before.known_torques
        if known is not None and len(known.torque_nm) != len(session.grip_t_s):
            reason = "the recording begins in the middle of the grip, so the correction of its gain is left out"
            structlog.get_logger().warning(reason, source=source, frame=number)
        elif known is not None:
            correction = session.adapt(known.torque_nm)
            self._publisher.publish(adapted_message(source, frames, known.reference, correction))
        estimate = await estimate_frames(session, frames, fingers_moved=before.fingers_moved)
        # The replayed latency is 0; the recording holds the live one.
        arrival_ns = max(frame.t_arrival_ns for frame in frames)
        self._publisher.publish(estimate_message(source, frames, estimate, arrival_ns))

    async def _publish_heatmap(self, source: str, frame: Frame) -> None:
        heatmap = await heatmap_message(source, frame, self._sessions[source])
        if heatmap is not None:
            self._publisher.publish(heatmap)


def _live_event(topic: str, content: dict[str, Any], without: Collection[str]) -> RecordedEvent:
    if topic == schema.CLOCK_TOPIC:
        return RecordedEvent(topic, content["t_mono_ns"], content)
    live = schema.schema_name(topic)
    if live == schema.INPUT:
        raw = schema.input_event(content)
        return RecordedEvent(topic, raw.t_ns, content, topic.removeprefix(schema.input_topic("")), raw)
    return RecordedEvent(live, content["t_mono_ns"], content, content["source"], without=without)


def _imported_event(topic: str, content: dict[str, Any], log_ns: int, number: int) -> RecordedEvent:
    if topic.startswith(f"{schema.FRAME_TOPIC}."):
        # The line as the board sent it: four decimals, each followed by a comma and a space.
        values = np.asarray(content["line"], dtype=np.float64)
        if math.isqrt(values.size) ** 2 != values.size:
            raise ContentError(f"{topic}: a line of {values.size} values")
        text = "".join(f"{value:.4f}, " for value in values.tolist()) + "\r\n"
        side, t_ns = topic.removeprefix(f"{schema.FRAME_TOPIC}."), int(content["arrival_unix_ns"])
        return RecordedEvent(schema.input_topic(side), t_ns, {}, side, RawEvent(InputKind.DATA, t_ns, text.encode()))
    complete = {
        # The only imported topic other than the frames.
        "source": LOAD_CELL,
        "raw": content.get("torque_nm"),
        "saturated": False,
        "spike": False,
        "valid": True,
        "reason": "",
        **content,
        "timestamp": log_ns / 1e9,
        "t_mono_ns": log_ns,
        "seq": number,
    }
    return RecordedEvent(topic, log_ns, complete, complete["source"])


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 40 else f"{text[:40]}…"
