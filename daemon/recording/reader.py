"""Reads a recording back, and refuses by name what is truncated, foreign, damaged or of another channel table."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.channels import CHANNEL_TABLE_HASH, N_LINE_VALUES
from shearloop.bank.estimation import Measured
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.content import as_json, input_of
from shearloop.daemon.recording.opened import opened
from shearloop.daemon.recording.schema import (
    DIAMETER_NOTE,
    EXPERIMENT_METADATA,
    FORMAT_VERSION,
    FRAME_TOPIC,
    LOAD_TOPIC,
    METADATA,
    input_topic,
)
from shearloop.daemon.sensing.tool_diameter import tool_from_bytes
from shearloop.drivers.raw_event import InputKind

# What every recording says of itself, beside the notes of this one.
_IDENTITIES = ("format_version", "channel_table_hash", "software", "code_sha256")
# How a raw input of this kind is written; see `input_json`.
_TELLS_OF_A_TOOL = as_json({"kind": InputKind.TOOL.value})[1:-1]


@dataclass(frozen=True, slots=True, eq=False)
class SideFrames:
    """One side's frames by rising time: t_mid_ns and arrival_ns (n,) in Unix nanoseconds, lines (n, 1024) in volts."""

    t_mid_ns: IntArray
    arrival_ns: IntArray
    lines: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """All of a recording: frames by side, and the torque in N·m at t_ns (p,), Unix nanoseconds, both maybe empty."""

    path: Path
    source: str
    notes: dict[str, str]
    sides: dict[str, SideFrames]
    torque_t_ns: IntArray
    torque_nm: FloatArray
    # Which tool a calibrated gripper told of from when on (Unix ns), None where it held nothing.
    tools: tuple[tuple[int, Measured | None], ...] = ()


def read_recording(path: str | Path) -> Recording:
    """Read a recording whole; raises UserError, naming the file, for one that cannot be used."""
    path = Path(path)
    with opened(path) as recording:
        metadata = recording.metadata()
        _check(path, metadata.get(METADATA))
        inputs = {input_topic(topic.removeprefix(f"{FRAME_TOPIC}.")) for topic in recording.counts}
        wanted = [
            topic
            for topic in recording.counts
            if topic == LOAD_TOPIC or topic.startswith(f"{FRAME_TOPIC}.") or topic in inputs
        ]
        # Most of what the inputs hold is the lines once more.
        messages = [
            (channel, message)
            for channel, message in recording.messages(wanted)
            if channel.topic not in inputs or _TELLS_OF_A_TOOL in message.data
        ]
    named = metadata.get(EXPERIMENT_METADATA, {})
    told = {DIAMETER_NOTE: named[DIAMETER_NOTE]} if DIAMETER_NOTE in named else {}
    return _sorted(path, {**metadata[METADATA], **told}, messages)


def _check(path: Path, identities: dict[str, str] | None) -> None:
    if identities is None:
        raise _unusable(path, "it is an MCAP file, but not a recording of shearloop")
    if identities.get("format_version") != FORMAT_VERSION:
        raise _unusable(path, f"it has format version {identities.get('format_version')}, expected {FORMAT_VERSION}")
    found = str(identities.get("channel_table_hash"))
    if found != CHANNEL_TABLE_HASH:
        raise _unusable(
            path, f"it was made under the channel table {found[:12]}…, and this is {CHANNEL_TABLE_HASH[:12]}…"
        )


def _sorted(path: Path, identities: dict[str, str], messages: list[tuple[Channel, Message]]) -> Recording:
    frames: dict[str, list[tuple[int, int, list[float]]]] = {}
    torques: list[tuple[int, float]] = []
    tools: list[tuple[int, Measured | None]] = []
    for channel, message in messages:
        content = _content(path, channel, message)
        try:
            if channel.topic == LOAD_TOPIC:
                # What the driver took for no load at all, or had no number for, is no truth to calibrate on.
                if "torque_nm" in content and _is_believed(content):
                    torques.append((message.log_time, float(content["torque_nm"])))
            elif channel.topic.startswith(f"{FRAME_TOPIC}."):
                line = content["line"]
                if len(line) != N_LINE_VALUES:
                    raise ValueError(f"a line of {len(line)} values")
                side = channel.topic.removeprefix(f"{FRAME_TOPIC}.")
                frames.setdefault(side, []).append((message.log_time, int(content["arrival_unix_ns"]), line))
            else:
                tools.append((message.log_time, tool_from_bytes(input_of(content).data)[1]))
        except (KeyError, TypeError, ValueError) as error:
            raise _unusable(path, f"a message on {channel.topic} is not what its schema says ({error!r})") from error
    torques.sort(key=lambda pair: pair[0])
    sides = {}
    for side, found in frames.items():
        found.sort(key=lambda row: row[0])
        # A line that is the one before to the last digit is an old frame sent again; live it is refused.
        rows = [found[0], *(row for before, row in pairwise(found) if row[2] != before[2])]
        sides[side] = SideFrames(
            np.array([row[0] for row in rows], dtype=np.int64),
            np.array([row[1] for row in rows], dtype=np.int64),
            np.array([row[2] for row in rows], dtype=np.float64),
        )
    notes = {key: value for key, value in identities.items() if key not in _IDENTITIES}
    return Recording(
        path,
        notes.pop("source", ""),
        notes,
        sides,
        np.array([t for t, _ in torques], dtype=np.int64),
        np.array([torque for _, torque in torques], dtype=np.float64),
        tuple(sorted(tools, key=lambda pair: pair[0])),
    )


def _is_believed(load: Mapping[str, Any]) -> bool:
    """Return whether a reading of the load cell is one; those recorded before they said so have two flags alone."""
    return bool(load.get("valid", not (load.get("saturated") or load.get("spike"))))


def _content(path: Path, channel: Channel, message: Message) -> dict[str, Any]:
    try:
        content = json.loads(message.data)
    except ValueError as error:
        raise _unusable(path, f"a message on {channel.topic} is not JSON") from error
    if not isinstance(content, dict):
        raise _unusable(path, f"a message on {channel.topic} is not a JSON object")
    return content


def _unusable(path: Path, why: str) -> UserError:
    return UserError(
        f"{path}: this recording cannot be used: {why}; record it again, or import it with `shearloop import`"
    )
