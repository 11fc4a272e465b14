"""What a recording holds, read with the mcap library and the json module alone, and the recordings to read."""

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from mcap.reader import make_reader

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import TOPICS, Message, wire_map
from shearloop.daemon.recorder.recorder import Identity, Recorder
from shearloop.daemon.recorder.schema import basic_identity
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from tests.sample_messages import hints_of, sample

Row = dict[str, Any]
Published = list[tuple[str, Row]]
EIT = ("eit.frame", "eit.estimate", "eit.adapted", "eit.heatmap")
STEP_NS = 100_000_000
WORDS = ("", 'a "quoted", and', "two\r\nlines", "\x1b[31mred", "µ;\tend")


def live_topic(topic: str) -> str:
    """Return the topic under which a message was published."""
    return next((live for live in EIT if topic.startswith(f"{live}.")), topic)


@dataclasses.dataclass(frozen=True)
class Recorded:
    """A recording and what the daemon published while it was made."""

    path: Path
    published: Published
    # Whether its raw input gives the same estimates again.
    replayable: bool = True

    def rows(self) -> dict[str, list[Row]]:
        """Return the rows of each recorded topic by time: log time, publish time, and the keys that it has."""
        found: dict[str, list[Row]] = {}
        with self.path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                times = {"log_time_ns": message.log_time, "publish_time_ns": message.publish_time}
                found.setdefault(channel.topic, []).append({**times, **json.loads(message.data)})
        return found

    def by_stream(self) -> dict[tuple[str, str, int], Row]:
        """Return the rows of the live messages by topic, source and number."""
        return {
            (live_topic(topic), row["source"], row["seq"]): row
            for topic, rows in self.rows().items()
            for row in rows
            if "seq" in row
        }

    def columns(self) -> dict[str, dict[str, str]]:
        """Return the keys of each recorded topic and their JSON types, by the schemas in the file."""
        with self.path.open("rb") as file:
            summary = make_reader(file).get_summary()
        described = {one.id: json.loads(one.data)["properties"] for one in summary.schemas.values()}
        return {
            channel.topic: {key: one["type"] for key, one in described[channel.schema_id].items()}
            for channel in summary.channels.values()
        }


def value_of(content: Row, key: str) -> Any:
    """Return a published value as a recording holds it: arrays to six decimals, None for what is not finite."""
    value = content[key]
    if isinstance(value, bytes):
        array = np.frombuffer(value, "<f4").astype(float).round(6)
        return [number if np.isfinite(number) else None for number in array.tolist()]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


class Held(Clock):
    """A clock that shows what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.t_ns = 0

    def now_ns(self) -> int:
        return self.t_ns


def distinct(kind: type[Message], number: int, source: str, t_ns: int) -> Message:
    """Return a message in which no two numbers are alike; every third one has nothing in each key that may be empty."""
    changes, hints, plain = Row(), hints_of(kind), sample(kind)
    for place, item in enumerate(dataclasses.fields(kind)):
        value = getattr(plain, item.name)
        own = 1000 * number + place + 0.125
        optional = type(None) in get_args(hints[item.name])
        if number % 3 == 1 and (optional or hints[item.name] is float) and item.name != "age_s":
            changes[item.name] = None if optional else float("nan")
        elif isinstance(value, np.ndarray):
            changes[item.name] = own + np.arange(6.0).reshape(2, 3)
        elif isinstance(value, tuple):
            changes[item.name] = tuple(own + element for element in value)
        elif isinstance(value, bool):
            changes[item.name] = number % 2 == 0
        elif isinstance(value, float):
            changes[item.name] = own
        elif isinstance(value, int):
            changes[item.name] = 1000 * number + place
        elif isinstance(value, str):
            changes[item.name] = WORDS[(number + place) % len(WORDS)]
    if kind.topic == "eit.frame":
        changes |= {"line": np.arange(1024) / 2048 + number, "channels": np.arange(896) / 2048, "age_s": 0.25}
        if number % 3 == 1:
            changes["line"] = np.where(np.arange(1024) % 7, changes["line"], np.nan)
    return dataclasses.replace(plain, **{**changes, "source": source, "t_mono_ns": t_ns})


def made(folder: Path, topics: Iterable[str] = TOPICS) -> Recorded:
    """Record seven messages of each topic as a daemon does, of two fingertips, and raw input with lines in it."""
    clock, published = Held(), Published()
    recorder = Recorder(folder / "recordings", Identity(basic_identity("a test")), clock)
    recorder.record_experiment("made", tool_mm=20.0)
    for number in range(7):
        clock.t_ns = number * STEP_NS
        for topic in topics:
            for source in ("right", "left-2") if topic in EIT else ("one",):
                message = distinct(TOPICS[topic], number, source, clock.t_ns)
                content = wire_map(message, clock.unix_s(clock.t_ns), number)
                recorder.record_message(topic, content)
                published.append((topic, content))
        text = WORDS[number % len(WORDS)].encode() + bytes(range(256))
        recorder.input_recorder("right").record(RawEvent(InputKind.DATA, clock.t_ns, text))
    recorder.close()
    (path,) = recorder.closed_files
    return Recorded(path, published, replayable=False)


def latest_recording(folder: Path) -> Path:
    """Return the last closed recording of a folder."""
    return max(folder.glob("*.mcap"))


def by_stream(published: Published) -> Mapping[tuple[str, str, int], Row]:
    """Return what was published by topic, source and number."""
    return {(topic, content["source"], content["seq"]): content for topic, content in published}
