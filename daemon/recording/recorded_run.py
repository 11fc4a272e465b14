"""A recording as a run to be replayed: its configuration, and all that happened, in the order in which it happened."""

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from shearloop.bank.eit.channels import N_LINE_VALUES
from shearloop.bank.estimation import Measured
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.config_file import ConfigModel, mistakes
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.messages import EitFrame
from shearloop.daemon.recording.content import input_of
from shearloop.daemon.recording.opened import damaged, opened
from shearloop.daemon.recording.schema import (
    CLOCK_TOPIC,
    CONFIGURATION,
    FRAME_TOPIC,
    INPUT,
    METADATA,
    completed,
    input_topic,
    schema_of,
)
from shearloop.daemon.sensing.tool_diameter import tool_from_bytes
from shearloop.drivers.raw_event import InputKind, RawEvent

Model = TypeVar("Model", bound=ConfigModel)


@dataclass(frozen=True, slots=True)
class ReplayEvents:
    """What estimators were told beside their frames, by source and the number of the frame that it was told before.

    Zeros are asked for before the frame has come, and tools are held by the gripper: neither follows from the frames.
    `numbers` has those of the frames by source and arrival (the last that arrived then): they go on from file to file.
    """

    tares: dict[str, set[int]] = field(default_factory=dict)
    tools: dict[str, dict[int, Measured | None]] = field(default_factory=dict)
    numbers: dict[str, dict[int, int]] = field(default_factory=dict)

    def note(self, source: str, told: RawEvent) -> None:
        """Take in a raw input, if it is one of these."""
        if told.kind is InputKind.TARE and told.data.isdigit():
            self.tares.setdefault(source, set()).add(int(told.data))
        elif told.kind is InputKind.TOOL:
            frame, tool = tool_from_bytes(told.data)
            self.tools.setdefault(source, {})[frame] = tool

    def note_frame(self, source: str, content: Mapping[str, Any]) -> None:
        """Take in a frame as it was published."""
        arrival_ns = content["t_mono_ns"] + round(content["age_s"] * 1e9)
        self.numbers.setdefault(source, {})[arrival_ns] = content["frame"]


@dataclass(frozen=True, slots=True)
class RecordedEvent:
    """One message of a recording; of a raw input `told` is set, of a published message `topic` is the wire's."""

    topic: str
    t_mono_ns: int
    content: Mapping[str, Any]
    source: str = ""
    told: RawEvent | None = None


class RecordedRun:
    """One recording, closed. Raises UserError, naming the file, for one that cannot be replayed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with opened(path) as recording:
            self.counts = recording.counts
            metadata = recording.metadata()
            self._attached = recording.attachments()
        if METADATA not in metadata:
            raise UserError(f"{path} is an MCAP file, but not a recording of shearloop, and cannot be replayed")
        self.metadata = metadata[METADATA]

    @property
    def has_inputs(self) -> bool:
        """Whether the bytes themselves were recorded; a recording brought in from elsewhere has lines alone."""
        return any(topic.startswith(f"{INPUT}.") and topic != CLOCK_TOPIC for topic in self.counts)

    @property
    def messages(self) -> int:
        """How many messages are in it."""
        return sum(self.counts.values())

    @contextmanager
    def configuration(self) -> Iterator[DaemonConfig]:
        """Give the configuration that it was made with; the files that it names lie in a folder of their own."""
        if CONFIGURATION not in self._attached:
            raise UserError(
                f"{self.path} was not recorded by a daemon and has no configuration; give one with --config CONFIG"
            )
        with damaged(self.path):
            content = json.loads(self._attached[CONFIGURATION])
        try:
            config = DaemonConfig.model_validate(content)
        except ValidationError as error:
            raise UserError(
                f"{self.path}: its configuration is not one of this version: {mistakes(error, DaemonConfig)}; "
                "give one with --config CONFIG"
            ) from error
        with tempfile.TemporaryDirectory(prefix="shearloop-replay-") as folder:
            written: dict[Path, Path] = {}
            for number, (name, data) in enumerate(self._attached.items()):
                written[Path(name)] = Path(folder) / f"{number}-{Path(name).name}"
                written[Path(name)].write_bytes(data)
            yield _with_files(config, written)

    def happenings(self) -> Iterator[RecordedEvent]:
        """Yield everything in the order in which it was recorded."""
        with opened(self.path) as recording:
            # An imported recording has a side after the other; one made live is in order as it is.
            messages = recording.messages(in_order_of_time=not self.has_inputs)
            for number, (channel, message) in enumerate(messages):
                yield from self._happened(channel.topic, json.loads(message.data), message.log_time, number)

    def asides(self) -> ReplayEvents:
        """Return what the estimators were told beside their frames."""
        found = ReplayEvents()
        if self.has_inputs:
            for one in self.happenings():
                with damaged(self.path):
                    if one.told is not None:
                        found.note(one.source, one.told)
                    elif one.topic == EitFrame.topic:
                        found.note_frame(one.source, one.content)
        return found

    def _happened(self, topic: str, content: dict[str, Any], log_ns: int, number: int) -> Iterator[RecordedEvent]:
        if topic == CLOCK_TOPIC:
            yield RecordedEvent(topic, content["t_mono_ns"], content)
        elif topic.startswith(f"{INPUT}."):
            told = input_of(content)
            yield RecordedEvent(topic, told.t_ns, content, topic.removeprefix(f"{INPUT}."), told)
        elif self.has_inputs:
            wire = schema_of(topic)
            yield RecordedEvent(wire, content["t_mono_ns"], completed(wire, content), content["source"])
        elif topic.startswith(f"{FRAME_TOPIC}."):
            yield from _line_as_input(topic.removeprefix(f"{FRAME_TOPIC}."), content)
        else:
            complete = {
                "source": topic.partition(".")[0],
                "raw": content.get("torque_nm"),
                "saturated": False,
                "spike": False,
                "valid": True,
                "why": "",
                **content,
                "timestamp": log_ns / 1e9,
                "t_mono_ns": log_ns,
                "seq": number,
            }
            yield RecordedEvent(topic, log_ns, complete, complete["source"])


def _line_as_input(side: str, content: Mapping[str, Any]) -> Iterator[RecordedEvent]:
    """Yield a recorded line's values as the board sent them: four decimals, each followed by a comma and a space."""
    values = np.asarray(content["line"], dtype=np.float64)
    if values.shape != (N_LINE_VALUES,):
        raise ValueError(f"a line of {values.size} values")
    text = "".join(f"{value:.4f}, " for value in values.tolist()) + "\r\n"
    t_ns = int(content["arrival_unix_ns"])
    yield RecordedEvent(input_topic(side), t_ns, {}, side, RawEvent(InputKind.DATA, t_ns, text.encode()))


def _with_files(section: Model, written: Mapping[Path, Path]) -> Model:
    """Return the configuration with the files as they were when it was recorded, whatever became of them since."""
    changed: dict[str, object] = {}
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, Path):
            changed[name] = written.get(value, value)
        elif isinstance(value, ConfigModel):
            changed[name] = _with_files(value, written)
        elif isinstance(value, dict):
            changed[name] = {key: _with_files(item, written) for key, item in value.items()}
    return section.model_copy(update=changed)
