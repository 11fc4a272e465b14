"""What commands print, as text or JSON, with progress bars, and the lines that an operator types."""

import asyncio
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from typing import TYPE_CHECKING, Any, Self, TextIO

from shearloop.daemon.errors import UserError

if TYPE_CHECKING:
    from shearloop.daemon.logs import NonBlockingWriter

STDIN = 0
READ_BYTES = 4096


def print_result(result: Mapping[str, object], sentences: Iterable[str], *, as_json: bool) -> int:
    """Print a result as one line of JSON for a script, or as sentences for a person; return the exit status 0."""
    if as_json:
        print(json.dumps(result, ensure_ascii=False), flush=True)
    else:
        print(*sentences, sep="\n", flush=True)
    return 0


@contextmanager
def progress_bar(name: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Show a progress bar if stderr is a terminal; the yielded function takes the amount done so far."""
    from tqdm import tqdm

    # tqdm would start a monitoring thread that outlives the bars.
    tqdm.monitor_interval = 0
    with tqdm(total=total, unit=unit, desc=name, disable=None, leave=False, unit_scale=unit == "B") as bar:

        def show(done: int) -> None:
            bar.update(done - bar.n)

        yield show


class EstimatePrinter:
    """Prints every estimate that is published."""

    def __init__(self, out: "TextIO | NonBlockingWriter") -> None:
        self._out = out

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Print one message."""
        if topic in ("eit.estimate", "skin.shear"):
            self._out.write(message_line(topic, content) + "\n")
            self._out.flush()


class Operator:
    """The person at the terminal, as an asynchronous context; a pipe or a file works too."""

    def __init__(self, *, stdout_is_for_json: bool = False) -> None:
        """Print to stdout, or to stderr if stdout is for a result in JSON."""
        self._out = sys.stderr if stdout_is_for_json else sys.stdout
        self._partial = b""
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()
        self._watching = False

    async def __aenter__(self) -> Self:
        """Start reading."""
        try:
            asyncio.get_running_loop().add_reader(STDIN, self._read)
            self._watching = True
        except PermissionError:
            # epoll refuses a file; reading a file never blocks.
            while self._read():
                pass
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop reading."""
        self._stop()

    async def ask(self, prompt: str) -> str:
        """Print the prompt and return the next line; raise UserError at the end of the input."""

        self.say(prompt)
        line = await self._lines.get()
        if line is None:
            self._lines.put_nowait(None)
            raise UserError("the input ended before all was measured; press Enter after each step")
        return line

    def say(self, sentence: str) -> None:
        """Print a sentence."""
        print(sentence, file=self._out, flush=True)

    def _read(self) -> bool:
        data = os.read(STDIN, READ_BYTES)
        *lines, self._partial = (self._partial + data).split(b"\n")
        # An unfinished line must not grow without limit.
        self._partial = self._partial[-READ_BYTES:]
        for line in lines:
            self._lines.put_nowait(line.decode(errors="replace").strip())
        if not data:
            self._lines.put_nowait(None)
            self._stop()
        return bool(data)

    def _stop(self) -> None:
        if self._watching:
            asyncio.get_running_loop().remove_reader(STDIN)
            self._watching = False


def message_line(topic: str, content: Mapping[str, Any]) -> str:
    """Return one line of text: time, topic, source, and the values with their units."""
    clock = datetime.fromtimestamp(content["timestamp"]).astimezone().strftime("%H:%M:%S.%f")[:-3]
    body = _BODIES.get(topic, _columns)(topic, content)
    return f"{clock}  {topic:<13} {content['source']:<7} {body}"


def message_json(topic: str, content: Mapping[str, Any]) -> str:
    """Return one line of JSON: the topic and the content, arrays as lists."""
    return json.dumps({"topic": topic, **content}, default=lambda array: array.tolist(), ensure_ascii=False)


def _estimate(_: str, content: Mapping[str, Any]) -> str:
    if not content["valid"]:
        return f"no estimate: {content['reason']}"
    diameter = "" if content["diameter_mm"] is None else f"   diameter {content['diameter_mm']:5.1f} mm"
    cell = "" if content["k"] is None else f"   k {content['k']:.3f}  sigma {content['sigma']:.3f} cm"
    score = "" if content["score"] is None else f"   score {content['score']:.3f}"
    interval = f"[{content['torque_low_nm']:+.4f}, {content['torque_high_nm']:+.4f}]"
    return f"torque {content['torque_nm']:+.4f} N·m {interval}{diameter}{cell}{score}"


def _shear(_: str, content: Mapping[str, Any]) -> str:
    if not content["valid"]:
        return f"no force: {content['reason']}"
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
        reason = f" ({status['error']})" if status.get("error") else ""
        tasks.append(f"{name} {state}{restarts}{errors}{reason}")
    return f"{content['memory_mb']:.0f} MB  {content['cpu_percent']:.1f} % CPU  " + "; ".join(tasks)


def _columns(topic: str, content: Mapping[str, Any]) -> str:
    from shearloop.daemon.messaging.messages import ENVELOPE, TOPICS

    fields = dataclasses.fields(TOPICS[topic]) if topic in TOPICS else ()
    units = {item.name: f" {item.metadata['unit']}" for item in fields if item.metadata.get("unit")}
    own = {key: value for key, value in content.items() if key not in (*ENVELOPE, "topic")}
    return "  ".join(f"{key} {_value(value)}{units.get(key, '')}" for key, value in own.items())


def _value(value: object) -> str:
    import numpy as np

    if isinstance(value, np.ndarray):
        finite = value[np.isfinite(value)]
        span = f", {finite.min():.4g} to {finite.max():.4g}" if finite.size else ""
        return f"({'×'.join(map(str, value.shape))}{span})"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


_BODIES = {"eit.estimate": _estimate, "skin.shear": _shear, "health": _health}
