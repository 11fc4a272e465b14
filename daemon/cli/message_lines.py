"""Messages as lines of text for a person, or of JSON for a script."""

import dataclasses
import json
from collections.abc import Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from shearloop.daemon.messaging.topics import TOPICS

if TYPE_CHECKING:
    from shearloop.daemon.nonblocking_writer import NonBlockingWriter

_ENVELOPE = ("timestamp", "t_mono_ns", "seq", "source", "topic")


class EstimatePrinter:
    """Prints every estimate that is published."""

    def __init__(self, out: "TextIO | NonBlockingWriter") -> None:
        self._out = out

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Print one message."""
        if topic in ("eit.estimate", "skin.shear"):
            self._out.write(message_line(topic, content) + "\n")
            self._out.flush()


def message_line(topic: str, content: Mapping[str, Any]) -> str:
    """Return one line of text: time, topic, source, and the values with their units."""
    clock = datetime.fromtimestamp(content["timestamp"]).astimezone().strftime("%H:%M:%S.%f")[:-3]
    body = _BODIES.get(topic, _columns)(topic, content)
    return f"{clock}  {topic:<13} {content['source']:<7} {body}"


def message_json(topic: str, content: Mapping[str, Any]) -> str:
    """Return one line of JSON: the topic and the content, arrays as lists."""
    return json.dumps({"topic": topic, **content}, default=np.ndarray.tolist, ensure_ascii=False, allow_nan=True)


def _estimate(_: str, content: Mapping[str, Any]) -> str:
    if not content["valid"]:
        return f"no estimate: {content['why']}"
    diameter = "" if content["diameter_mm"] is None else f"   diameter {content['diameter_mm']:5.1f} mm"
    cell = "" if content["k"] is None else f"   k {content['k']:.3f}  sigma {content['sigma']:.3f} cm"
    score = "" if content["score"] is None else f"   score {content['score']:.3f}"
    interval = f"[{content['torque_low_nm']:+.4f}, {content['torque_high_nm']:+.4f}]"
    return f"torque {content['torque_nm']:+.4f} N·m {interval}{diameter}{cell}{score}"


def _shear(_: str, content: Mapping[str, Any]) -> str:
    if not content["valid"]:
        return f"no force: {content['why']}"
    interval = f"[{content['shear_low_n']:+.3f}, {content['shear_high_n']:+.3f}]"
    torque = "" if content["torque_nm"] is None else f"   torque {content['torque_nm']:+.4f} N·m"
    direction = "within the deadband" if content["deadband"] else content["direction"]
    return f"shear {content['shear_n']:+.3f} N {interval}{torque}   response {content['response']:+.5f}   {direction}"


def _health(_: str, content: Mapping[str, Any]) -> str:
    tasks = []
    for name, status in content["tasks"].items():
        state = "done" if status.get("done") else "alive" if status.get("alive", True) else "DEAD"
        restarts = f", {status['restarts']} restarts" if status.get("restarts") else ""
        errors = "".join(f", {count} {kind}" for kind, count in (status.get("errors") or {}).items())
        reason = f" ({status['trouble']})" if status.get("trouble") else ""
        tasks.append(f"{name} {state}{restarts}{errors}{reason}")
    return f"{content['memory_mb']:.0f} MB  {content['cpu_percent']:.1f} % CPU  " + "; ".join(tasks)


def _columns(topic: str, content: Mapping[str, Any]) -> str:
    fields = dataclasses.fields(TOPICS[topic]) if topic in TOPICS else ()
    units = {item.name: f" {item.metadata['unit']}" for item in fields if item.metadata.get("unit")}
    return "  ".join(
        f"{key} {_value(value)}{units.get(key, '')}" for key, value in content.items() if key not in _ENVELOPE
    )


def _value(value: object) -> str:
    if isinstance(value, np.ndarray):
        finite = value[np.isfinite(value)]
        span = f", {finite.min():.4g} to {finite.max():.4g}" if finite.size else ""
        return f"({'×'.join(map(str, value.shape))}{span})"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


_BODIES = {"eit.estimate": _estimate, "skin.shear": _shear, "health": _health}
