"""The latest message of every topic and source, ready to be sent to a page. A plain object: the time is passed in."""

import base64
import json
import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from shearloop.bank.eit.matching import best_match
from shearloop.bank.errors import MatchingError
from shearloop.daemon.messaging.messages import EitEstimate, EitHeatmap
from shearloop.daemon.messaging.topics import TOPICS
from shearloop.daemon.web.conductivity import profile

# Topics and their sources that are kept. A rig has nine topics and two fingertips; more is no rig of ours.
MOST_STREAMS = 64
LONGEST_SOURCE = 64
# A heatmap of 200 × 200 cells. What is larger would keep the page from drawing.
LARGEST_ARRAY = 40_000
# A page draws a minute; of that much a new one gets what was before it came, and one that was cut off what it missed.
HISTORY_S = 65.0
MOST_SAMPLES = 2000
CHARTED: Mapping[str, tuple[str, ...]] = {
    "eit.estimate": ("torque_nm", "torque_low_nm", "torque_high_nm", "valid"),
    "load.torque": ("torque_nm", "valid"),
    "skin.shear": ("shear_n", "shear_low_n", "shear_high_n", "torque_nm", "valid"),
    "loop.state": ("ramp_nm", "phase"),
}
_ENVELOPE = frozenset({"timestamp", "t_mono_ns", "seq", "source"})


@dataclass(frozen=True, slots=True)
class Kept:
    """One message as the page gets it, but for its age."""

    number: int
    heard_s: float
    # JSON without its opening brace, so that the age can be put before it.
    rest: str


class Latest:
    """Takes messages in, and gives out what is new to a page; keeps the latest of each topic, and a minute to chart."""

    def __init__(self, height_cm: float) -> None:
        """Take the fingertip's height, over which the conductivity is told."""
        self._height_cm = height_cm
        self._kept: dict[tuple[str, str], Kept] = {}
        self._models: dict[str, str] = {}
        self._samples: dict[tuple[str, str], deque[tuple[float, dict[str, Any]]]] = {}
        self.number = 0
        self.heard_s: float | None = None
        self.refused: Counter[str] = Counter()

    def take(self, topic: str, content: Mapping[str, Any], now_s: float) -> None:
        """Take one decoded message that arrived at now_s; what is not one of ours is counted by kind."""
        source = content.get("source")
        if topic not in TOPICS:
            self.refused["unknown topic"] += 1
        elif not isinstance(source, str) or len(source) > LONGEST_SOURCE or not content.keys() >= _ENVELOPE:
            self.refused["incomplete message"] += 1
        elif (topic, source) not in self._kept and len(self._kept) >= MOST_STREAMS:
            self.refused["too many sources"] += 1
        else:
            try:
                text = json.dumps(
                    {"topic": topic, **self._derived(topic, source, content), "content": plain(content)},
                    ensure_ascii=False,
                    allow_nan=False,
                )
            except (TypeError, ValueError, RecursionError):
                self.refused["message without a JSON form"] += 1
                return
            self.number += 1
            self.heard_s = now_s
            self._kept[topic, source] = Kept(self.number, now_s, text.removeprefix("{"))
            self._chart(topic, source, content, now_s)

    def refuse(self, kind: str) -> None:
        """Count what could not even be decoded."""
        self.refused[kind] += 1

    def quiet_s(self, now_s: float) -> float | None:
        """Return for how long nothing has been heard; None where nothing ever was."""
        return None if self.heard_s is None else max(0.0, now_s - self.heard_s)

    def batch(self, after: int, now_s: float, **beside: Any) -> str:
        """Return JSON of every message numbered after `after`, oldest first, with its age, and what stands beside."""
        new = sorted((kept for kept in self._kept.values() if kept.number > after), key=lambda kept: kept.number)
        messages = ",".join(f'{{"age_s":{max(0.0, now_s - kept.heard_s):.3f},{kept.rest}' for kept in new)
        head = json.dumps({"quiet_s": self.quiet_s(now_s), "refused": dict(self.refused), **beside}, allow_nan=False)
        return f'{head.removesuffix("}")}, "messages": [{messages}]}}'

    def history(self, now_s: float) -> list[dict[str, Any]]:
        """Return what was charted in the last minute, oldest first in each stream."""
        return [
            {"topic": topic, "content": {"source": source, **sample}}
            for (topic, source), samples in self._samples.items()
            for heard_s, sample in samples
            if now_s - heard_s <= HISTORY_S
        ]

    def _chart(self, topic: str, source: str, content: Mapping[str, Any], now_s: float) -> None:
        if topic in CHARTED:
            sample = {key: plain(content.get(key)) for key in ("timestamp", *CHARTED[topic])}
            self._samples.setdefault((topic, source), deque(maxlen=MOST_SAMPLES)).append((now_s, sample))

    def _derived(self, topic: str, source: str, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the page draws and does not compute by itself."""
        if topic == EitHeatmap.topic:
            self._models[source] = str(content.get("model", ""))
            return {"peaks": _peaks(content.get("scores"))}
        k, sigma = content.get("k"), content.get("sigma")
        if topic == EitEstimate.topic and isinstance(k, float) and isinstance(sigma, float):
            return {"conductivity": profile(self._models.get(source, ""), k, sigma, self._height_cm)}
        return {}


def _peaks(scores: object) -> dict[str, tuple[int, int] | None] | None:
    """Return the cells of a heatmap's maximum and runner-up, None where it has none."""
    if not isinstance(scores, np.ndarray) or scores.ndim != 2:
        return None
    rows, columns = (np.arange(float(n)) for n in scores.shape)
    try:
        match = best_match(scores.astype(np.float64), rows, columns)
    except MatchingError:
        return None
    return {"best": match.cell, "runner_up": match.runner_up_cell}


def plain(value: Any) -> Any:
    """Return a message's value as JSON has it: arrays as base64 of float32 with their shape, nothing for not-a-number.

    Raises ValueError for what is too large, and TypeError for bytes that are no array.
    """
    if isinstance(value, np.ndarray):
        if value.size > LARGEST_ARRAY:
            raise ValueError(f"an array of {value.size} numbers")
        packed = base64.b64encode(np.ascontiguousarray(value, "<f4").tobytes()).decode()
        return {"shape": list(value.shape), "float32": packed}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in _bounded(value)]
    return value


def _bounded(values: "list[Any] | tuple[Any, ...]") -> Iterable[Any]:
    if len(values) > LARGEST_ARRAY:
        raise ValueError(f"a list of {len(values)} values")
    return values
