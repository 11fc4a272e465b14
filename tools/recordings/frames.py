"""The frames, torques and tools of a recording as arrays, to fit or judge an estimator."""

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.daemon.recorder import schema
from shearloop.drivers.serial_sensor import InputKind
from shearloop.estimation import Measured
from shearloop.tools.recordings.before_frame import before_frame
from shearloop.tools.recordings.load_validity import STRAY, stray_values
from shearloop.tools.recordings.reader import open_recording, reading, unusable
from shearloop.words import counted

# Metadata of every recording; the other keys are notes of this one.
_IDENTITY_KEYS = (
    "format_version",
    "channel_table_hash",
    "electrodes",
    "injection",
    "software",
    "code_sha256",
    schema.CLOCK_OFFSET,
    schema.EMULATED,
)


# The keys of each topic that are read. An imported message lacks some, and its file's schema has them all the same.
_NEEDED: Mapping[str, tuple[str, ...]] = {
    schema.FRAME_TOPIC: ("line", "frame"),
    schema.LOAD_TOPIC: ("torque_nm", "valid"),
    schema.INPUT: ("t_mono_ns", "kind", "data"),
}


@dataclass(frozen=True, slots=True, eq=False)
class SideFrames:
    """One side's frames by rising time: t_mid_ns (n,) in Unix nanoseconds, lines (n, v) in volts.

    fingers_moved (n,) says which frames saw the fingers open or close, as far as it was recorded.
    """

    t_mid_ns: NDArray[np.int64]
    lines: NDArray[np.float64]
    fingers_moved: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Frames by side, and torque_nm (p,) in N·m at torque_t_ns (p,) in Unix nanoseconds; each may be empty."""

    path: Path
    source: str
    notes: dict[str, str]
    sides: dict[str, SideFrames]
    torque_t_ns: NDArray[np.int64]
    torque_nm: NDArray[np.float64]
    # The tools that a calibrated gripper held: since when (Unix ns), and the diameter or None for no tool.
    tools: tuple[tuple[int, Measured | None], ...] = ()
    table: ChannelTable = PAPER_TABLE
    # Whether a daemon recorded it: frames and torques are then stamped on arrival by one clock.
    live: bool = False
    # Frames and torques that are not in `sides` and `torque_nm`, with their number.
    left_out: tuple[str, ...] = ()
    # Whether every device was emulated.
    emulated: bool = False
    # By side, the frame period that the daemon was configured with.
    periods_s: Mapping[str, float] = field(default_factory=dict)


class _Row(NamedTuple):
    t_mid_ns: int
    line: list[float]
    # None in an imported recording.
    number: int | None


def _detail(error: Exception) -> str:
    return f"the key {error} is missing" if isinstance(error, KeyError) else str(error)


@dataclass(slots=True)
class _Messages:
    """What the messages of a recording give, in the order of their times (Unix ns)."""

    n_line_values: int
    frames: dict[str, list[_Row]] = field(default_factory=dict)
    # By side, the numbers of the frames during which the fingers moved.
    moved: defaultdict[str, set[int]] = field(default_factory=lambda: defaultdict(set))
    torques: list[tuple[int, float]] = field(default_factory=list)
    tools: list[tuple[int, Measured | None]] = field(default_factory=list)
    # By side, the frames that the board has sent again.
    repeated: Counter[str] = field(default_factory=Counter)
    # The readings of the load cell that are not valid, and why the last one is not.
    distrusted: int = 0
    why: str = ""

    def add_load(self, t_ns: int, content: Mapping[str, Any]) -> None:
        """Take a reading of the load cell."""
        if "torque_nm" in content and content.get("valid", True):
            self.torques.append((t_ns, float(content["torque_nm"])))
        else:
            self.distrusted += 1
            self.why = str(content.get("reason") or self.why)

    def add_frame(self, side: str, t_ns: int, content: Mapping[str, Any]) -> None:
        """Take a frame of a side; raises ValueError for one of another size."""
        line = content["line"]
        if len(line) != self.n_line_values:
            raise ValueError(f"a line of {len(line)} values")
        rows = self.frames.setdefault(side, [])
        if rows and rows[-1].line == line:
            self.repeated[side] += 1
        else:
            rows.append(_Row(t_ns, line, content.get("frame")))

    def add_input(self, side: str, t_ns: int, content: Mapping[str, Any]) -> None:
        """Take the inputs of a side's estimator that are not frames."""
        if content["kind"] not in (InputKind.TOOL.value, InputKind.MOVED.value):
            return
        number, before = before_frame(schema.input_event(content))
        if before.tool is not None:
            self.tools.append((t_ns, before.tool.measured))
        if before.fingers_moved:
            self.moved[side].add(number)

    def left_out(self) -> Iterator[str]:
        """Yield how many readings of the load cell, and frames of each side, were not read, and why."""
        if self.distrusted:
            example = f", e.g. {self.why}" if self.why else ""
            readings = counted(len(self.torques) + self.distrusted, "reading")
            yield f"{self.distrusted} of {readings} of the load cell, not valid{example}"
        for side, number in self.repeated.items():
            yield f"{counted(number, 'frame')} of the {side} side, repeated by the board"


def read_recording(path: str | Path) -> Recording:
    """Read the frames, torques and tools of a recording; raises UserError for a file that cannot be used."""
    path = Path(path)
    with open_recording(path) as recording:
        identity, table, metadata = recording.identity, recording.table, recording.metadata
        prefix = f"{schema.FRAME_TOPIC}."
        sides = {topic: topic.removeprefix(prefix) for topic in recording.counts if topic.startswith(prefix)}
        inputs = {schema.input_topic(side): side for side in sides.values()}
        live = bool(inputs) and recording.counts.keys() >= inputs.keys()
        periods_s = _configured_periods_s(recording.attachments().get(schema.CONFIGURATION))
        for topic in sides.keys() | inputs.keys() | {schema.LOAD_TOPIC}:
            if topic in recording.counts:
                recording.columns(topic).need(topic, _NEEDED[schema.schema_name(topic)], "a fit or a judgement")
        found = _Messages(table.n_line_values)
        for channel, message in recording.messages([schema.LOAD_TOPIC, *sides, *inputs]):
            topic, t_ns = channel.topic, message.log_time
            try:
                content = dict(from_json(message.data))
                if topic == schema.LOAD_TOPIC:
                    found.add_load(t_ns, content)
                elif topic in sides:
                    found.add_frame(sides[topic], t_ns, content)
                else:
                    found.add_input(inputs[topic], t_ns, content)
            except (KeyError, TypeError, ValueError) as error:
                raise unusable(path, f"a message on {topic} does not match its schema ({_detail(error)})") from error
    with reading(path):
        side_frames = {side: _side_frames(rows, found.moved[side]) for side, rows in found.frames.items()}
    notes = {key: value for key, value in identity.items() if key not in _IDENTITY_KEYS}
    torque_t_ns = np.array([t_ns for t_ns, _ in found.torques], dtype=np.int64)
    torque_nm = np.array([torque_nm for _, torque_nm in found.torques], dtype=np.float64)
    is_stray = stray_values(torque_t_ns / 1e9, torque_nm)
    left_out = list(found.left_out())
    if is_stray.any():
        readings = counted(len(is_stray), "reading")
        left_out.insert(0, f"{np.count_nonzero(is_stray)} of {readings} of the load cell that {STRAY}")
    if schema.LEFT_OUT_NOTE in notes:
        left_out.insert(0, notes[schema.LEFT_OUT_NOTE])
    experiment = metadata.get(schema.EXPERIMENT_METADATA, {})
    if schema.DIAMETER_NOTE in experiment:
        notes[schema.DIAMETER_NOTE] = experiment[schema.DIAMETER_NOTE]
    return Recording(
        path=path,
        source=notes.pop("source", ""),
        notes=notes,
        sides=side_frames,
        torque_t_ns=torque_t_ns[~is_stray],
        torque_nm=torque_nm[~is_stray],
        tools=tuple(found.tools),
        table=table,
        live=live,
        left_out=tuple(left_out),
        emulated=schema.EMULATED in identity,
        periods_s=periods_s,
    )


def _configured_periods_s(configuration: bytes | None) -> dict[str, float]:
    """Return the frame period of each fingertip by an attached configuration, where it has one."""
    found: dict[str, float] = {}
    content = from_json(configuration) if configuration is not None else {}
    fingertips = content.get("fingertips") if isinstance(content, dict) else None
    for side, own in fingertips.items() if isinstance(fingertips, dict) else ():
        period_s = own.get("frame_period_s") if isinstance(own, dict) else None
        if isinstance(period_s, int | float) and 0.0 < period_s < math.inf:
            found[side] = float(period_s)
    return found


def _side_frames(rows: list[_Row], moved: Collection[int]) -> SideFrames:
    t_mid_ns, lines, numbers = zip(*rows, strict=True)
    return SideFrames(
        np.array(t_mid_ns, np.int64), np.array(lines, np.float64), np.array([number in moved for number in numbers])
    )
