"""What commands print, as text or JSON, with progress bars, and the lines that an operator types."""

import asyncio
import json
import os
import shutil
import sys
import termios
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from datetime import datetime
from typing import TYPE_CHECKING, Any, Self, TextIO

from shearloop.errors import UserError
from shearloop.printable import printable

if TYPE_CHECKING:
    from shearloop.daemon.config import DaemonConfig
    from shearloop.daemon.logs import NonBlockingWriter

STDIN = 0
READ_BYTES = 4096
# The topics of the sensors that have estimates.
ESTIMATES = ("eit.estimate", "skin.shear")


def print_result(result: object, sentences: Iterable[str], *, as_json: bool) -> int:
    """Print a result as one line of JSON for a script, or as sentences for a person; return the exit status 0."""
    if as_json:
        print(json.dumps(result, ensure_ascii=False), flush=True)
    else:
        print(*sentences, sep="\n", flush=True)
    return 0


def shown_topics(config: "DaemonConfig") -> tuple[str, ...]:
    """Return the topics to show of a rig's sensors: estimates, or the load cell's readings if it is the only sensor."""
    return ESTIMATES if config.fingertips or config.skin is not None else ("load.torque",)


def print_estimate(
    out: "TextIO | NonBlockingWriter",
    topic: str,
    content: Mapping[str, Any],
    *,
    label: str = "",
    topics: tuple[str, ...] = ESTIMATES,
) -> None:
    """Print a message of one of the topics, behind a label."""
    if topic in topics:
        out.write(printable(label + message_line(topic, content)) + "\n")
        out.flush()


class StatusLine:
    """Shows a daemon's state on one line of a terminal, as a context that leaves an empty line."""

    def __init__(self, out: "TextIO | NonBlockingWriter", label: str = "", topics: tuple[str, ...] = ESTIMATES) -> None:
        """`topics` are shown of a daemon without a robot."""
        self._out = out
        self._label = label
        self._topics = topics
        self._state = self._torque = ""
        # None until a control loop reports; a daemon without a robot has no loop.
        self._driving: str | None = None

    def __enter__(self) -> Self:
        """Show that the daemon starts."""
        self._draw("starting")
        return self

    def __exit__(self, *_: object) -> None:
        """Empty the line."""
        self._draw("")

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Take one message; redraw after those that it shows."""
        if topic == "loop.state":
            self._state = loop_line(content)
            self._driving = content["torque_source"]
        elif topic in ("eit.estimate", "load.torque", "skin.shear") and content["source"] == self._driving:
            torque = _shown(topic, content, "torque_nm", "+.3f") if content["valid"] else ""
            self._torque = torque and f"   {self._driving} {torque}"
        elif topic in self._topics and self._driving is None:
            self._state = message_line(topic, content)
        else:
            return
        self._draw(self._state, self._torque)

    def _draw(self, text: str, end: str = "") -> None:
        from shearloop.daemon.logs import CLEAR_LINE

        # A longer line would wrap, and could not be cleared.
        text = f"{self._label}{text}" if text else ""
        text, end = (printable(part).replace("\n", " ") for part in (text, end))
        width = shutil.get_terminal_size().columns - 1 - len(end)
        self._out.write(f"{CLEAR_LINE}{text if len(text) <= width else text[: width - 1] + '…'}{end}")
        self._out.flush()


@contextmanager
def stdin_lines(on_line: Callable[[str | None], None]) -> Iterator[None]:
    """Have the event loop call `on_line` with each line of standard input, and with None at its end.

    Raises PermissionError for a file, which an event loop cannot watch.
    """
    loop, partial = asyncio.get_running_loop(), b""

    def read() -> None:
        nonlocal partial
        data = os.read(STDIN, READ_BYTES)
        *lines, partial = (partial + data).split(b"\n")
        # An unfinished line must not grow without limit.
        partial = partial[-READ_BYTES:]
        for line in lines:
            on_line(line.decode(errors="replace").strip())
        if not data:
            loop.remove_reader(STDIN)
            on_line(None)

    loop.add_reader(STDIN, read)
    try:
        yield
    finally:
        loop.remove_reader(STDIN)


def forget_typed_ahead(descriptor: int) -> bool:
    """Drop what was typed at a terminal before the question that it would answer; return whether this is a terminal.

    What a pipe or a file holds is a script, and stays.
    """
    if not os.isatty(descriptor):
        return False
    termios.tcflush(descriptor, termios.TCIFLUSH)
    return True


class Operator:
    """The person at the terminal, as a context within an event loop; a pipe or a file works too."""

    def __init__(self, *, stdout_is_for_json: bool = False) -> None:
        """Print to stdout, or to stderr if stdout is for a result in JSON."""
        self._out = sys.stderr if stdout_is_for_json else sys.stdout
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()
        self._reading = ExitStack()

    def __enter__(self) -> Self:
        """Start reading."""
        try:
            self._reading.enter_context(stdin_lines(self._lines.put_nowait))
        except PermissionError:
            # Reading a file never blocks.
            with open(STDIN, closefd=False) as file:
                for line in (*file, None):
                    self._lines.put_nowait(line)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop reading."""
        self._reading.close()

    async def ask(self, prompt: str) -> None:
        """Print the prompt and wait for the next line; raise UserError at the end of the input."""
        if forget_typed_ahead(STDIN):
            self._forget_lines()
        self.say(prompt)
        if await self._lines.get() is None:
            raise UserError("the input ended before all was measured; press Enter after each step")

    def _forget_lines(self) -> None:
        """Drop the lines that were read before a question; the end of the input stays."""
        ended = False
        while not self._lines.empty():
            ended |= self._lines.get_nowait() is None
        if ended:
            self._lines.put_nowait(None)

    def say(self, sentence: str) -> None:
        """Print a sentence."""
        print(sentence, file=self._out, flush=True)


def message_line(topic: str, content: Mapping[str, Any]) -> str:
    """Return one line of text: time, topic, source, and the values with their units."""
    clock = datetime.fromtimestamp(content["timestamp"]).astimezone().strftime("%H:%M:%S.%f")[:-3]
    body = _BODIES.get(topic, _columns)(topic, content)
    return f"{clock}  {topic:<13} {content['source']:<9} {body}"


def message_json(topic: str, content: Mapping[str, Any]) -> str:
    """Return one line of JSON: the topic and the content, arrays as lists, null for a number that is not finite."""
    from pydantic_core import to_json

    def plain(value: Any) -> Any:
        return value.tolist() if hasattr(value, "tolist") else str(value)

    compact = to_json({"topic": topic, **content}, inf_nan_mode="null", bytes_mode="base64", fallback=plain)
    return json.dumps(json.loads(compact), ensure_ascii=False)


def _estimate(topic: str, content: Mapping[str, Any]) -> str:
    if not content["valid"]:
        return f"no estimate: {content['reason']}"
    details = (
        _shown(topic, content, "diameter_mm", "5.1f", "diameter "),
        _shown(topic, content, "k", ".3f", "k "),
        _shown(topic, content, "sigma", ".3f", "sigma "),
        _shown(topic, content, "score", ".3f", "score "),
    )
    return "   ".join(filter(None, (_with_interval(topic, content, "torque", "nm", "+.4f") or "no torque", *details)))


def _shear(topic: str, content: Mapping[str, Any]) -> str:
    if not content["valid"]:
        return f"no force: {content['reason']}"
    details = (
        _shown(topic, content, "torque_nm", "+.4f", "torque "),
        _shown(topic, content, "response", "+.5f", "response "),
        "within the deadband" if content["deadband"] else content["direction"],
    )
    return "   ".join(filter(None, (_with_interval(topic, content, "shear", "n", "+.3f") or "no force", *details)))


def _with_interval(topic: str, content: Mapping[str, Any], name: str, suffix: str, form: str) -> str:
    """Return a value with its interval, or alone without one end of it; empty without the value."""
    shown = _shown(topic, content, f"{name}_{suffix}", form, f"{name} ")
    low, high = content[f"{name}_low_{suffix}"], content[f"{name}_high_{suffix}"]
    return f"{shown} [{low:{form}}, {high:{form}}]" if shown and low is not None and high is not None else shown


def _shown(topic: str, content: Mapping[str, Any], key: str, form: str, name: str = "") -> str:
    """Return a value behind its name, with the unit of its key; empty without the value."""
    from shearloop.daemon.messaging.messages import with_unit

    return "" if content[key] is None else name + with_unit(topic, key, content[key], form)


def _load(topic: str, content: Mapping[str, Any]) -> str:
    raw = _shown(topic, content, "raw", ".10g", "raw ")
    if not content["valid"]:
        return f"no torque: {content['reason']}   {raw}"
    return f"{_shown(topic, content, 'torque_nm', '+.4f', 'torque ')}   {raw}"


def _loop(_topic: str, content: Mapping[str, Any]) -> str:
    return loop_line(content)


def loop_line(content: Mapping[str, Any]) -> str:
    """Return phase, progress, the cause of the hold or the stop, step, and activity."""
    from shearloop.daemon.messaging.messages import cause_of

    cause = cause_of(content)
    if not content["experiment"]:
        return f"{content['phase']}: {cause}" if cause else str(content["phase"])
    step = f"step {content['step']} of {content['steps']} {content['step_name']}"
    activity, stopped = content["activity"] or content["experiment"], content["phase"] == "stopped"
    percent = "" if stopped or content["progress"] is None else f" {100 * content['progress']:.0f} %"
    # After a stop the activity is its reasons. A narrow terminal cuts the end.
    cause = cause or (activity if stopped else "")
    parts = (f"{content['phase']}{percent}{f': {cause}' if cause else ''}", step, activity)
    return "  ".join(parts[:2] if stopped else parts)


def _health(topic: str, content: Mapping[str, Any]) -> str:
    from shearloop.tools.task_row import task_row

    rows = [task_row(name, facts) for name, facts in (content["tasks"] or {}).items()]
    tasks = (f"{name} {', '.join(filter(None, cells))}" for name, *cells in rows)
    memory, cpu = _shown(topic, content, "memory_mb", ".0f"), _shown(topic, content, "cpu_percent", ".1f")
    return f"{memory}  {cpu} CPU  " + "; ".join(tasks)


def one_line(text: str) -> str:
    """Return a text as a terminal shows it in one line: a file's name may hold a line feed."""
    return printable(text).replace("\n", "\\u000a").replace("\t", "\\u0009")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table with aligned columns, a line for each row."""
    every = [tuple(map(one_line, row)) for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*every, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in every]


def _columns(topic: str, content: Mapping[str, Any]) -> str:
    from shearloop.daemon.messaging.messages import ENVELOPE, units

    hidden = (*ENVELOPE, "topic")
    own = {
        key: value
        for key, value in content.items()
        if key not in hidden and value is not None and not (isinstance(value, str) and not value)
    }
    return "  ".join(f"{key} {_value(value)} {units(topic).get(key, '')}".rstrip() for key, value in own.items())


def _value(value: object) -> str:
    import numpy as np

    if isinstance(value, np.ndarray):
        finite = value[np.isfinite(value)]
        span = f", {finite.min():.4g} to {finite.max():.4g}" if finite.size else ""
        return f"({'×'.join(map(str, value.shape))}{span})"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


_BODIES: Mapping[str, Callable[[str, Mapping[str, Any]], str]] = {
    "eit.estimate": _estimate,
    "skin.shear": _shear,
    "load.torque": _load,
    "loop.state": _loop,
    "health": _health,
}
