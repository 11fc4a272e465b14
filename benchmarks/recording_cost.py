"""What recording a whole rig costs: `python -m benchmarks.recording_cost --hours N`, N of them recorded as fast as
it goes.

Two boards, load cell, gripper and robot at their rated pace, with random numbers in everything, which compress worse
than any real ones. The time is the recorder's own and that of making the messages for it.
"""

import argparse
import dataclasses
import itertools
import json
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from benchmarks.daemon_parts import memory_mb
from shearloop.bank.eit.channels import N_CHANNELS, N_LINE_VALUES
from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import Message, wire_map
from shearloop.daemon.messaging.topics import TOPICS
from shearloop.daemon.recording.identity import Identity
from shearloop.daemon.recording.recorder import FLUSH_S, Recorder
from shearloop.drivers.serial_sensor import InputKind, RawEvent

STEP_S = 0.04
SOURCES = {"eit.frame": ("right", "left"), "eit.estimate": ("right", "left", "both")}
TOPICS_OF_A_RIG = ("eit.frame", "eit.estimate", "load.torque", "robot.state", "gripper.state", "loop.state", "health")
LENGTHS = {"channels": N_CHANNELS, "line": N_LINE_VALUES}


def resident_mb() -> float:
    """Return the memory that this process has in use."""
    return memory_mb(os.getpid())["resident"]


class _Played(Clock):
    """A clock that is set."""

    def __init__(self) -> None:
        super().__init__()
        self.at_ns = super().now_ns()

    def now_ns(self) -> int:
        return self.at_ns


def message(kind: type[Message], source: str, t_mono_ns: int, random: np.random.Generator) -> Message:
    """Return a message with random numbers in it."""
    hints = get_type_hints(kind)
    values: dict[str, Any] = {"source": source, "t_mono_ns": t_mono_ns}
    for item in dataclasses.fields(kind):
        hint = str(hints[item.name])
        if item.name in values:
            continue
        if "ndarray" in hint:
            values[item.name] = random.uniform(size=LENGTHS.get(item.name, 6)).round(4)
        elif "Mapping" in hint:
            values[item.name] = {
                task: {"alive": True, "rate_hz": random.uniform()} for task in ("right", "left", "loop")
            }
        else:
            values[item.name] = next(
                (given for name, given in (("float", random.normal()), ("int", 3), ("bool", True)) if name in hint),
                "text",
            )
    return kind(**values)


def happenings(hours: float) -> Iterator[tuple[int, list[str]]]:
    """Yield the steps of the time, in ns, with the topics that fall due in each."""
    due_s = dict.fromkeys(TOPICS_OF_A_RIG, 0.0)
    for number in itertools.count():
        now_s = number * STEP_S
        if now_s > hours * 3600:
            return
        due = [topic for topic, at_s in due_s.items() if at_s <= now_s]
        for topic in due:
            due_s[topic] += 1.0 / (TOPICS[topic].rate_hz or 1.0)
        yield round(now_s * 1e9), due


def measured(folder: Path, hours: float) -> dict[str, float | list[float]]:
    """Record, and return CPU in percent of a core, megabytes an hour, and the memory after each quarter of it."""
    clock, random = _Played(), np.random.default_rng(1)
    recorder = Recorder(folder, Identity({"source": "benchmarks.recording_cost"}, ()), clock)
    begun_ns, flushed_ns, resident = clock.at_ns, clock.at_ns, [resident_mb()]
    cpu_s = time.process_time()
    for after_ns, due in happenings(hours):
        clock.at_ns = begun_ns + after_ns
        for topic in due:
            for source in SOURCES.get(topic, ("rig",)):
                made = message(TOPICS[topic], source, clock.at_ns, random)
                content = wire_map(made, clock.unix_s(clock.at_ns), 0)
                recorder.record(topic, content)
                if topic == "eit.frame":
                    line = ", ".join(f"{value:.4f}" for value in np.frombuffer(content["line"], "<f4"))
                    recorder.tap(source)(RawEvent(InputKind.DATA, clock.at_ns, line.encode()))
        if clock.at_ns - flushed_ns >= FLUSH_S * 1e9:
            flushed_ns = clock.at_ns
            recorder.write()
        if after_ns >= len(resident) * hours * 900e9:
            resident.append(resident_mb())
    recorder.close()
    cpu_s = time.process_time() - cpu_s
    size_mb = sum(path.stat().st_size for path in recorder.finished) / 1e6
    return {
        "cpu_percent": 100.0 * cpu_s / (3600.0 * hours),
        "mb_per_hour": size_mb / hours,
        "files": float(len(recorder.finished)),
        "memory_mb": resident,
    }


def main() -> None:
    """Record, and print as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=2.2, help="of a rig's time (default: %(default)s)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps({"hours": args.hours, **measured(Path(folder), args.hours)}, indent=1))


if __name__ == "__main__":
    main()
