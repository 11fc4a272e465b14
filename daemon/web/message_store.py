"""The latest message of every topic and source, and the last minute of charted values. No I/O: time is passed in."""

import base64
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from pydantic_core import to_json

from shearloop.bank.errors import MatchingError
from shearloop.bank.matching import best_match
from shearloop.bank.models import MODELS
from shearloop.daemon.messaging.messages import (
    ENVELOPE,
    TOPICS,
    DaemonEnd,
    EitEstimate,
    EitHeatmap,
    Health,
    LoopState,
    LoopStop,
    stop_times,
)
from shearloop.daemon.web.event_log import EventLog

# Pairs of topic and source. A rig has nine topics and two fingertips.
MAX_STREAMS = 64
# A heatmap of 200 × 200 cells; a browser draws larger ones too slowly.
MAX_ARRAY_SIZE = 40_000
# A page charts one minute.
HISTORY_S = 65.0
MAX_SAMPLES = 2000
CHARTED: Mapping[str, tuple[str, ...]] = {
    "eit.estimate": ("torque_nm", "torque_low_nm", "torque_high_nm", "valid"),
    "load.torque": ("torque_nm", "valid"),
    "skin.shear": ("shear_n", "shear_low_n", "shear_high_n", "torque_nm", "valid"),
    "loop.state": ("ramp_nm", "phase"),
}
# Points of a conductivity profile: finer than a pixel of the drawing.
HEIGHTS = 145
# What k and σ mean as heights: factors of σ from k with their labels, and a sentence.
HEIGHT_MARKS: Mapping[str, tuple[Mapping[str, float], str]] = {
    "step": ({"k": 0.0}, "k is the height of the step"),
    "linear": ({"k": 0.0}, "k is the height without change"),
    "gaussian_derivative": (
        {"k": 0.0, "k−σ": -1.0, "k+σ": 1.0},
        "k is the height without change, k−σ and k+σ have the largest rise and fall",
    ),
}


class StoredMessage(NamedTuple):
    """One message: its number, its arrival time in s, and its JSON without the opening brace."""

    number: int
    arrival_s: float
    json_tail: str


class MessageStore:
    """Stores messages and returns the new ones for a page."""

    def __init__(self, height_cm: float) -> None:
        """Take the fingertip's height, for the conductivity profiles."""
        self._height_cm = height_cm
        self._stored: dict[tuple[str, str], StoredMessage] = {}
        self._models: dict[str, str] = {}
        self._samples: dict[tuple[str, str], deque[tuple[float, dict[str, Any]]]] = {}
        self.number = 0
        # Whether the latest message says that the daemon has ended.
        self._ended = False
        # The daemon's process and instance, by its latest `health`.
        self.process: int | None = None
        self.instance: str | None = None
        self.refused: Counter[str] = Counter()
        self._log = EventLog()
        # Whether a stop waits for its acknowledgement; its run and its times.
        self._stop_waits = False
        self._stop_times: tuple[int | None, str] = (None, "")

    def add(self, topic: str, content: Mapping[str, Any], now_s: float) -> None:
        """Store one decoded message that arrived at `now_s`; count invalid ones by kind."""
        source = content.get("source")
        if topic not in TOPICS:
            self.refused["unknown topic"] += 1
        elif not isinstance(source, str) or not content.keys() >= ENVELOPE:
            self.refused["incomplete message"] += 1
        elif (topic, source) not in self._stored and len(self._stored) >= MAX_STREAMS:
            self.refused["too many sources"] += 1
        else:
            try:
                text = page_json({"topic": topic, **self._derived(topic, source, content), "content": content})
            except (TypeError, ValueError):
                self.refused["message without a JSON form"] += 1
                return
            self.number += 1
            self._ended = topic == DaemonEnd.topic
            if topic == Health.topic:
                self.process, self.instance = content.get("process"), content.get("instance")
            self._stored[topic, source] = StoredMessage(self.number, now_s, text.removeprefix("{"))
            self._log.add(topic, content, self.number)
            if topic in CHARTED:
                sample = {key: content.get(key) for key in ("timestamp", *CHARTED[topic])}
                self._samples.setdefault((topic, source), deque(maxlen=MAX_SAMPLES)).append((now_s, sample))

    def batch(self, after: int, now_s: float, **other: Any) -> str:
        """Return JSON of `other`, and of every message numbered after `after`, oldest first, with its age.

        With them come the events of these messages, and of all that later ones have replaced.
        """
        stored = sorted(self._stored.values())
        quiet_s = max(0.0, now_s - stored[-1].arrival_s) if stored else None
        messages = ",".join(
            f'{{"age_s":{max(0.0, now_s - message.arrival_s):.3f},{message.json_tail}'
            for message in stored
            if message.number > after
        )
        state = {
            "quiet_s": quiet_s,
            "ended": self._ended,
            "refused": dict(self.refused),
            "events": self._log.after(after),
        }
        head = page_json({**state, **other})
        return f'{head.removesuffix("}")}, "messages": [{messages}]}}'

    def history(self, now_s: float) -> list[dict[str, Any]]:
        """Return the charted values of the last minute, oldest first in each stream."""
        return [
            {"topic": topic, "content": {"source": source, **sample}}
            for (topic, source), samples in self._samples.items()
            for arrival_s, sample in samples
            if now_s - arrival_s <= HISTORY_S
        ]

    def _derived(self, topic: str, source: str, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return values that the page draws and does not compute itself."""
        if topic == EitHeatmap.topic:
            self._models[source] = str(content.get("model", ""))
            known = MODELS.get(self._models[source])
            return {"peaks": _peaks(content.get("scores")), "k_unit": known.k_unit if known is not None else ""}
        if topic == LoopStop.topic and self._stop_waits:
            self._stop_times = content.get("run"), stop_times(content)
        if topic == LoopState.topic:
            self._stop_waits = bool(content.get("stop"))
            # An acknowledged stop's times are not those of the next one.
            if not self._stop_waits or content.get("run") != self._stop_times[0]:
                self._stop_times = (None, "")
            return {"stop_times": self._stop_times[1]}
        k, sigma = content.get("k"), content.get("sigma")
        if topic == EitEstimate.topic and isinstance(k, float) and isinstance(sigma, float):
            model = self._models.get(source, "")
            offsets, meaning = HEIGHT_MARKS.get(model, ({}, ""))
            marks = [(k + offset * sigma, label) for label, offset in offsets.items()]
            profile = conductivity_profile(model, k, sigma, self._height_cm)
            return {"conductivity": profile, "marks": marks if profile else [], "meaning": meaning if profile else ""}
        return {}


def _peaks(scores: object) -> dict[str, tuple[int, int] | None] | None:
    """Return the cells of a heatmap's maximum and runner-up; None if it has no maximum."""
    if not isinstance(scores, np.ndarray) or scores.ndim != 2:
        return None
    rows, columns = (np.arange(float(n)) for n in scores.shape)
    try:
        match = best_match(scores.astype(np.float64), rows, columns)
    except MatchingError:
        return None
    return {"best": match.cell, "runner_up": match.runner_up_cell}


def conductivity_profile(model: str, k: float, sigma: float, height_cm: float) -> list[float] | None:
    """Return the conductivity relative to the untouched gel at HEIGHTS heights, bottom to top.

    None for an unknown model or invalid parameters (Trehan et al. 2025, equations 1 to 5).
    """
    if model not in MODELS or not (np.isfinite(k) and np.isfinite(sigma) and sigma > 0):
        return None
    y_cm = np.linspace(0.0, height_cm, HEIGHTS)
    with np.errstate(over="ignore", invalid="ignore"):
        values = 1.0 + MODELS[model].function(y_cm, k, sigma, height_cm / 2)
    return values.tolist() if np.isfinite(values).all() else None


def page_json(content: Mapping[str, Any]) -> str:
    """Return JSON: arrays as base64 of float32 with their shape, null for numbers that are not finite.

    Raises ValueError or TypeError for arrays that are too large, and for what has no JSON form.
    """
    return to_json(content, inf_nan_mode="null", fallback=_plain).decode()


def _plain(value: Any) -> dict[str, Any]:
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.ndarray) and value.size <= MAX_ARRAY_SIZE:
        packed = base64.b64encode(np.ascontiguousarray(value, "<f4").tobytes()).decode()
        return {"shape": list(value.shape), "float32": packed}
    raise TypeError(f"a value of {type(value).__name__} has no place on the page")
