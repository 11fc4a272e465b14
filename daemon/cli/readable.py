"""Messages as lines for a person, and as JSON for a script."""

import dataclasses
import json
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import numpy as np

from shearloop.daemon.messaging.messages import TOPICS

_ENVELOPE = ("timestamp", "t_mono_ns", "seq", "source", "topic")


def as_line(topic: str, content: Mapping[str, Any]) -> str:
    """Return one readable line: time, topic, source, and the values with their units."""
    clock = datetime.fromtimestamp(content["timestamp"]).astimezone().strftime("%H:%M:%S.%f")[:-3]
    if topic == "eit.estimate":
        body = _estimate(content)
    elif topic == "skin.shear":
        body = _shear(content)
    elif topic == "health":
        body = _health(content)
    else:
        body = _columns(topic, content)
    return f"{clock}  {topic:<13} {content['source']:<7} {body}"


def as_json(topic: str, content: Mapping[str, Any]) -> str:
    """Return one line of JSON with the topic beside the content, arrays as lists."""
    return json.dumps({"topic": topic, **content}, default=_plain, ensure_ascii=False, allow_nan=True)


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _estimate(content: Mapping[str, Any]) -> str:
    if not content["valid"]:
        return f"no estimate: {content['reason']}"
    diameter = "" if content["diameter_mm"] is None else f"   diameter {content['diameter_mm']:5.1f} mm"
    cell = "" if content["k"] is None else f"   k {content['k']:.3f}  sigma {content['sigma']:.3f} cm"
    score = "" if content["score"] is None else f"   score {content['score']:.3f}"
    interval = f"[{content['torque_low_nm']:+.4f}, {content['torque_high_nm']:+.4f}]"
    return f"torque {content['torque_nm']:+.4f} N·m {interval}{diameter}{cell}{score}"


def _shear(content: Mapping[str, Any]) -> str:
    if not content["valid"]:
        return f"no force: {content['reason']}"
    interval = f"[{content['shear_low_n']:+.3f}, {content['shear_high_n']:+.3f}]"
    torque = "" if content["torque_nm"] is None else f"   torque {content['torque_nm']:+.4f} N·m"
    told = "within the deadband" if content["deadband"] else content["direction"]
    return f"shear {content['shear_n']:+.3f} N {interval}{torque}   response {content['response']:+.5f}   {told}"


def _health(content: Mapping[str, Any]) -> str:
    tasks = []
    for name, facts in content["tasks"].items():
        state = "done" if facts.get("done") else "alive" if facts.get("alive", True) else "DEAD"
        errors = "".join(f", {count} {kind}" for kind, count in (facts.get("errors") or {}).items())
        trouble = f" ({facts['error']})" if facts.get("error") else ""
        restarts = f", {facts['restarts']} restarts" if facts.get("restarts") else ""
        tasks.append(f"{name} {state}{restarts}{errors}{trouble}")
    return f"{content['memory_mb']:.0f} MB  {content['cpu_percent']:.1f} % CPU  " + "; ".join(tasks)


def _columns(topic: str, content: Mapping[str, Any]) -> str:
    units = {}
    if topic in TOPICS:
        units = {item.name: item.metadata.get("unit", "") for item in dataclasses.fields(TOPICS[topic])}
    parts = []
    for key, value in content.items():
        if key in _ENVELOPE:
            continue
        unit = f" {units[key]}" if units.get(key) else ""
        parts.append(f"{key} {_value(value)}{unit}")
    return "  ".join(parts)


def _value(value: object) -> str:
    if isinstance(value, np.ndarray):
        finite = value[np.isfinite(value)]
        spread = f", {finite.min():.4g} to {finite.max():.4g}" if finite.size else ""
        return f"({'×'.join(map(str, value.shape))}{spread})"
    return f"{value:.5g}" if isinstance(value, float) else str(value)
