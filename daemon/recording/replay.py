"""Replay: what was recorded goes through parsers and estimators again, and is published as if it happened now.

All times are the recording's own, so the result does not depend on how fast it is replayed; the wall clock only says
when the next input is due.
"""

import asyncio
import json
import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import EitHeatmap
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.recording.content import message_json
from shearloop.daemon.recording.recorded_run import RecordedEvent, RecordedRun
from shearloop.daemon.recording.replay_pipeline import MADE_ANEW, ReplayPipeline
from shearloop.daemon.recording.schema import CLOCK_TOPIC, recorded_topic

# These two say when a message was made and by which reading of the clocks, and not what was measured.
NOT_COMPARED = ("latency_s", "timestamp")
# An inequality is shown with so many examples.
_MOST_SHOWN = 5


class ReplayClock(Clock):
    """The recording's own time."""

    def __init__(self) -> None:
        """Begin where a recording says."""
        self._offset_ns = 0
        self._now_ns = 0

    def now_ns(self) -> int:
        """Return the time of what is being replayed."""
        return self._now_ns

    def synchronise(self) -> float:
        """Do nothing: the recording says how its clocks were to each other."""
        return 0.0

    def set(self, now_ns: int, offset_ns: int | None = None) -> None:
        """Go on to a time, and to another offset where one was recorded."""
        self._now_ns = now_ns
        if offset_ns is not None:
            self._offset_ns = offset_ns


@dataclass(slots=True)
class Comparison:
    """What was made anew beside what was recorded, message by message, bit for bit.

    `unrecorded` counts, when all is replayed, the messages that were made now and not recorded, as those of the moment
    in which the daemon was stopped. `there` are the recording's topics: what is in none of them is counted, not kept.
    """

    there: Collection[str] = ()
    compared: Counter[str] = field(default_factory=Counter)
    different: Counter[str] = field(default_factory=Counter)
    examples: list[str] = field(default_factory=list)
    _foreign: int = 0
    _made: dict[tuple[str, str], deque[Mapping[str, Any]]] = field(default_factory=dict)

    def made(self, topic: str, content: Mapping[str, Any]) -> None:
        """Take in a message as it was published now."""
        if topic not in MADE_ANEW:
            return
        if recorded_topic(topic, content["source"]) not in self.there:
            self._foreign += 1
        else:
            plain = json.loads(message_json(topic, content, 0))
            self._made.setdefault((topic, content["source"]), deque()).append(plain)

    def recorded(self, happened: RecordedEvent) -> None:
        """Take in a message as it was recorded, after all that led to it."""
        waiting = self._made.get((happened.topic, happened.source))
        self.compared[happened.topic] += 1
        if not waiting:
            self._differs(happened, "it was not made again")
            return
        made = waiting.popleft()
        keys = [key for key in happened.content if key not in (*NOT_COMPARED, "arrival_unix_ns", "seq")]
        unlike = [key for key in keys if made.get(key) != happened.content[key]]
        if unlike:
            self._differs(
                happened,
                ", ".join(f"{key} was {_short(happened.content[key])}, is {_short(made.get(key))}" for key in unlike),
            )

    @property
    def unrecorded(self) -> int:
        """Messages made now that were not recorded."""
        return self._foreign + sum(map(len, self._made.values()))

    def _differs(self, happened: RecordedEvent, why: str) -> None:
        self.different[happened.topic] += 1
        if len(self.examples) < _MOST_SHOWN:
            self.examples.append(f"{happened.topic} of {happened.source}, number {happened.content['seq']}: {why}")


class Replay:
    """Replays one recording through a chain, to a publisher whose clock is `clock`."""

    def __init__(self, run: RecordedRun, chain: ReplayPipeline, publisher: Publisher, clock: ReplayClock) -> None:
        self._run = run
        self._chain = chain
        self._publisher = publisher
        self._clock = clock
        self.comparison = Comparison(run.counts)
        if run.has_inputs:
            # Of a recording from elsewhere nothing is compared, and what was kept for it would be kept for ever.
            publisher.add_listener(self.comparison.made)

    async def play(self, speed: float, progress: Callable[[int], None] = lambda _: None) -> None:
        """Replay all of it, `speed` times as fast as it happened; math.inf waits for nothing."""
        loop = asyncio.get_running_loop()
        began_s, first_ns = loop.time(), None
        for number, happened in enumerate(self._run.happenings(), 1):
            # A message speaks of a time before it was sent; only an input says when it came.
            if happened.told is not None or not self._run.has_inputs:
                first_ns = happened.t_mono_ns if first_ns is None else first_ns
                if math.isfinite(speed):
                    due_s = began_s + (happened.t_mono_ns - first_ns) / 1e9 / speed
                    await asyncio.sleep(max(0.0, due_s - loop.time()))
            await self._happen(happened)
            progress(number)
            if number % 100 == 0:
                # Signals and sockets have their turn.
                await asyncio.sleep(0)

    async def _happen(self, happened: RecordedEvent) -> None:
        if happened.topic == CLOCK_TOPIC:
            self._clock.set(happened.t_mono_ns, int(happened.content["offset_ns"]))
        elif happened.told is not None:
            self._clock.set(happened.t_mono_ns)
            await self._chain.take(happened.source, happened.told)
        elif happened.topic in MADE_ANEW and self._run.has_inputs and happened.source in self._chain.publishes:
            self.comparison.recorded(happened)
        elif happened.topic != EitHeatmap.topic:
            self._publisher.forward(happened.topic, wire_map_of(happened.content))


def wire_map_of(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the map that goes on the wire of a recorded message: its lists as float32 with their shapes."""
    on_wire: dict[str, Any] = {}
    for key, value in content.items():
        if isinstance(value, list):
            array = np.array([np.nan if one is None else one for one in value], "<f4")
            on_wire[key], on_wire[f"{key}_shape"] = array.tobytes(), list(array.shape)
        else:
            on_wire[key] = value
    return on_wire


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) < 40 else f"{text[:40]}…"
