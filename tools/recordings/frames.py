"""The frames, torques and tools of a recording as arrays, for whoever fits or judges an estimator."""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from shearloop.bank.channels import PAPER_TABLE, ChannelTable
from shearloop.daemon.recorder import schema
from shearloop.daemon.sensing.fingertip_messages import moved_from_bytes, tool_from_bytes
from shearloop.drivers.serial_sensor import InputKind
from shearloop.estimation import Measured
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
    # What is not in `sides` and `torque_nm`, with its number.
    left_out: tuple[str, ...] = ()
    # Whether every device was emulated.
    emulated: bool = False


class _Row(NamedTuple):
    t_mid_ns: int
    line: list[float]
    # None in an imported recording.
    number: int | None


def _detail(error: Exception) -> str:
    return f"the key {error} is missing" if isinstance(error, KeyError) else str(error)


def read_recording(path: str | Path) -> Recording:
    """Read the frames, torques and tools of a recording; raises UserError for a file that cannot be used."""
    path = Path(path)
    frames: dict[str, list[_Row]] = {}
    moved: dict[str, set[int]] = {}
    torques: list[tuple[int, float]] = []
    tools: list[tuple[int, Measured | None]] = []
    repeated, distrusted, why = Counter[str](), 0, ""
    with open_recording(path) as recording:
        identity, table, metadata = recording.identity, recording.table, recording.metadata
        prefix = f"{schema.FRAME_TOPIC}."
        sides = {topic: topic.removeprefix(prefix) for topic in recording.counts if topic.startswith(prefix)}
        inputs = [schema.input_topic(side) for side in sides.values()]
        live = bool(inputs) and recording.counts.keys() >= {*inputs}
        for channel, message in recording.messages([schema.LOAD_TOPIC, *sides, *inputs]):
            topic, t_ns = channel.topic, message.log_time
            try:
                content = dict(from_json(message.data))
                if topic == schema.LOAD_TOPIC:
                    if "torque_nm" in content and content.get("valid", True):
                        torques.append((t_ns, float(content["torque_nm"])))
                    else:
                        distrusted, why = distrusted + 1, str(content.get("reason") or why)
                elif topic in sides:
                    line = content["line"]
                    if len(line) != table.n_line_values:
                        raise ValueError(f"a line of {len(line)} values")
                    rows = frames.setdefault(sides[topic], [])
                    # The board repeated an old frame.
                    if not rows or rows[-1].line != line:
                        rows.append(_Row(t_ns, line, content.get("frame")))
                    else:
                        repeated[sides[topic]] += 1
                elif content["kind"] == InputKind.TOOL.value:
                    tools.append((t_ns, tool_from_bytes(schema.input_event(content).data)[1]))
                elif content["kind"] == InputKind.MOVED.value:
                    side = topic.removeprefix(schema.input_topic(""))
                    moved.setdefault(side, set()).add(moved_from_bytes(schema.input_event(content).data))
            except (KeyError, TypeError, ValueError) as error:
                raise unusable(path, f"a message on {topic} does not match its schema ({_detail(error)})") from error
    with reading(path):
        side_frames = {side: _side_frames(rows, moved.get(side, set())) for side, rows in frames.items()}
    notes = {key: value for key, value in identity.items() if key not in _IDENTITY_KEYS}
    experiment = metadata.get(schema.EXPERIMENT_METADATA, {})
    if schema.DIAMETER_NOTE in experiment:
        notes[schema.DIAMETER_NOTE] = experiment[schema.DIAMETER_NOTE]
    return Recording(
        path,
        notes.pop("source", ""),
        notes,
        side_frames,
        np.array([t for t, _ in torques], dtype=np.int64),
        np.array([torque for _, torque in torques], dtype=np.float64),
        tuple(tools),
        table,
        live,
        tuple(_left_out(distrusted, len(torques) + distrusted, why, repeated)),
        schema.EMULATED in identity,
    )


def _left_out(distrusted: int, torques: int, why: str, repeated: Counter[str]) -> Iterator[str]:
    """Yield how many readings of the load cell, and frames of each side, were not read, and why."""
    if distrusted:
        example = f", e.g. {why}" if why else ""
        yield f"{distrusted} of {counted(torques, 'reading')} of the load cell, not valid{example}"
    for side, number in repeated.items():
        yield f"{counted(number, 'frame')} of the {side} side, repeated by the board"


def _side_frames(rows: list[_Row], moved: Collection[int]) -> SideFrames:
    t_mid_ns, lines, numbers = zip(*rows, strict=True)
    return SideFrames(
        np.array(t_mid_ns, np.int64), np.array(lines, np.float64), np.array([number in moved for number in numbers])
    )
