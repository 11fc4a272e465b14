"""The generated pages: `docs/messages.md`, and the safety table in `docs/safety.md`."""

import dataclasses
import re
import types
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from shearloop.daemon.cli.command import COMMANDS
from shearloop.daemon.control.safety import TABLE, Response
from shearloop.daemon.messaging.addresses import COMMAND_ADDRESS, PUBLISH_ADDRESS
from shearloop.daemon.messaging.messages import Message
from shearloop.daemon.messaging.topics import STALE_AFTER_PERIODS, TOPICS

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = Path("docs/examples")
RESPONSES = {
    Response.NOTE: "told, nothing else",
    Response.REFUSE_START: "no experiment is begun; what runs goes on",
    Response.HOLD: "the wrist stands still until it is over",
    Response.STOP_AND_KEEP_GRIP: "stopped, the tool stays gripped",
    Response.STOP_AND_RELEASE: "stopped, the gripper opens",
}
_ENVELOPE = ("source", "t_mono_ns")
_LANGUAGES = (
    ("Python", "subscriber.py", "python"),
    ("C++", "subscriber.cpp", "cpp"),
    ("MATLAB", "subscriber.m", "matlab"),
)


def messages_page(root: Path) -> str:
    """Return the page; the subscribers are read from the folder of examples below `root`."""
    parts = [_introduction()]
    for topic, kind in TOPICS.items():
        rate = "on change" if kind.rate_hz is None else f"{kind.rate_hz:g} a second"
        parts.append(
            f"### `{topic}`, {rate}\n\n{kind.__doc__}\n\n{table(('key', 'type', 'unit', 'meaning'), _keys(kind))}"
        )
    parts.append(_commands())
    parts.append("## Subscribers\n\nEach is a whole program; the files are in `docs/examples/`.")
    for language, name, fence in _LANGUAGES:
        text = (root / EXAMPLES / name).read_text(encoding="utf-8").strip()
        parts.append(f"### {language}\n\n```{fence}\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def _introduction() -> str:
    return f"""# Messages

Written by `make docs` from `daemon/messaging/messages.py`; change it there.

The daemon publishes on a ZeroMQ PUB socket (`publish`, by default `{PUBLISH_ADDRESS}`). A message is exactly two
frames: the topic, and a [msgpack](https://msgpack.org) map with text keys. Numbers, truth values and texts are plain
keys; an absent value is nil. An array is msgpack `bin`, little-endian float32 in C order, and its shape is in a key of
its own, `NAME_shape`; plotting tools pass over both. `shearloop listen TOPIC --json` shows the same as JSON, a message
a line.

PlotJuggler: Streaming → ZMQ Subscriber, `tcp://`, 127.0.0.1, port 7761, protocol MessagePack, topics empty or a
beginning such as `eit.`; let it take the time from the field `timestamp`.

What is older than {STALE_AFTER_PERIODS:g} periods of its topic is out of date. A subscriber that does not keep up loses
messages, and sees it by a gap in `seq`. Beyond this machine connections need keys: [security.md](security.md).

## Topics

Every message has these keys:

{table(("key", "type", "unit", "meaning"), _envelope())}"""


def _envelope() -> Iterator[tuple[str, ...]]:
    yield "`timestamp`", "number", "s", "Unix time of what the message speaks of"
    yield "`t_mono_ns`", "integer", "ns", "the same on CLOCK_MONOTONIC of the daemon's computer"
    yield "`seq`", "integer", "", "number of the message of this topic and source, without gaps"
    yield (
        "`source`",
        "text",
        "",
        "who says it: a fingertip's name, `skin`, `load_cell`, `robot`, `gripper`, `loop`, `daemon`",
    )


def _keys(kind: type[Message]) -> Iterator[tuple[str, ...]]:
    hints = get_type_hints(kind)
    for item in dataclasses.fields(kind):
        if item.name not in _ENVELOPE:
            shown = _type_name(hints[item.name])
            yield f"`{item.name}`", shown, item.metadata["unit"], item.metadata["meaning"]


def _type_name(hint: Any) -> str:
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        names = [_type_name(part) for part in get_args(hint) if part is not type(None)]
        return " or ".join([*dict.fromkeys(names), *(["nil"] if type(None) in get_args(hint) else [])])
    if origin in (np.ndarray, tuple) or hint is np.ndarray:
        return "array"
    plain: dict[Any, str] = {float: "number", int: "integer", bool: "truth value", str: "text"}
    return plain.get(hint, "map")


def _commands() -> str:
    rows = [(f"`{name}`", what) for name, what in COMMANDS.items()]
    return f"""## Commands

The daemon answers on a ZeroMQ ROUTER socket (`commands`, by default `{COMMAND_ADDRESS}`); a REQ or DEALER socket asks.
A request is one msgpack map, `{{"command": NAME}}` with what the command takes beside it. Each is answered once, with
`{{"ok": true, …}}` or `{{"ok": false, "why": SENTENCE}}`. Limits are in [security.md](security.md);
`shearloop command NAME --json` does the same from a shell.

{table(("command", "what it does"), rows)}

`start` takes `experiment`, the path of a file on the daemon's computer, or starts what the configuration names; `tare`
takes `source`, one sensor's name, or tares all; `set` takes `heatmap` (`always` or
`on_request`) and `source`, one fingertip's name, or sets all."""


def safety_table() -> str:
    """Return the safety table as Markdown."""
    rows = []
    for event, rule in TABLE.items():
        response = RESPONSES[rule.response]
        if rule.hold_at_most_s is not None:
            response += f"; stopped after {rule.hold_at_most_s:g} s"
        rows.append((event.value, response, rule.sentence.format(detail="…").replace("….", "…"), rule.cure))
    return table(("event", "response", "what is said", "what to do"), rows)


def pages(root: Path) -> dict[Path, str]:
    """Return the expected text of each page by its path."""
    safety = root / "docs/safety.md"
    return {
        root / "docs/messages.md": messages_page(root),
        safety: re.sub(
            r"(<!-- generated: safety table -->\n).*?(<!-- end -->)",
            lambda match: f"{match[1]}\n{safety_table()}\n\n{match[2]}",
            safety.read_text(encoding="utf-8"),
            flags=re.DOTALL,
        ),
    }


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; bars within cells are escaped."""
    escaped = [[cell.replace("|", "\\|").replace("\n", " ") for cell in cells] for cells in (head, *rows)]
    head_row, *body = [f"| {' | '.join(cells)} |" for cells in escaped]
    return "\n".join([head_row, "|---" * len(head) + "|", *body])
