"""Writes the generated pages: `docs/messages.md`, and the safety table in `docs/safety.md` (`make docs`)."""

import dataclasses
import re
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from shearloop.daemon.cli.command import COMMANDS
from shearloop.daemon.control.safety import TABLE, Response
from shearloop.daemon.messaging.addresses import COMMAND_ADDRESS, PUBLISH_ADDRESS
from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS, TOPICS, Message

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = Path("docs/examples")
RESPONSES = {
    Response.NOTE: "reported only",
    Response.REFUSE_START: "no experiment starts; a running one continues",
    Response.HOLD: "the wrist holds until the fault is gone",
    Response.STOP_AND_KEEP_GRIP: "stop, the tool stays gripped",
    Response.STOP_AND_RELEASE: "stop, the gripper opens",
}
_ENVELOPE = ("source", "t_mono_ns")
_LANGUAGES = (
    ("Python", "subscriber.py", "python"),
    ("C++", "subscriber.cpp", "cpp"),
    ("MATLAB", "subscriber.m", "matlab"),
)


def messages_page(root: Path) -> str:
    """Return the page, with the example programs below `root`."""
    parts = [_introduction()]
    for topic, kind in TOPICS.items():
        rate = "on change" if kind.rate_hz is None else f"{kind.rate_hz:g} a second"
        parts.append(
            f"### `{topic}`, {rate}\n\n{kind.__doc__}\n\n{table(('key', 'type', 'unit', 'meaning'), _keys(kind))}"
        )
    parts.append(_commands().rstrip())
    parts.append("## Subscribers\n\nEach is a complete program from `docs/examples/`.")
    for language, name, fence in _LANGUAGES:
        text = (root / EXAMPLES / name).read_text(encoding="utf-8").strip()
        parts.append(f"### {language}\n\n```{fence}\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def _introduction() -> str:
    return f"""# Messages

Written by `make docs` from `daemon/messaging/messages.py`; change it there.

The daemon publishes on a ZeroMQ PUB socket (`publish`, by default `{PUBLISH_ADDRESS}`). A message has two frames:
the topic, and a [msgpack](https://msgpack.org) map with text keys. Numbers, booleans and texts are plain keys. A
missing value is nil. An array is msgpack `bin`: little-endian float32 in C order, with its shape in `NAME_shape`.
Plotting tools ignore both. `shearloop listen TOPIC --json` prints one message per line as JSON.

PlotJuggler: see [live-view.md](live-view.md#plotjuggler).

A message is stale after {STALE_AFTER_PERIODS:g} periods of its topic. A slow subscriber loses messages: `seq` then has
a gap. Connections from other computers need keys: [security.md](security.md).

## Topics

Every message has these keys:

{table(("key", "type", "unit", "meaning"), _envelope())}"""


def _envelope() -> Iterator[tuple[str, ...]]:
    yield "`timestamp`", "number", "s", "Unix time of the measurement or event"
    yield "`t_mono_ns`", "integer", "ns", "the same time on CLOCK_MONOTONIC of the daemon's computer"
    yield "`seq`", "integer", "", "number of the message of this topic and source, without gaps"
    yield (
        "`source`",
        "text",
        "",
        "a fingertip's name, `skin`, `load_cell`, `robot`, `gripper`, `loop` or `daemon`",
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
    # Only arrays are left: NumPy's array type is an alias, and its origin depends on the versions.
    plain: dict[Any, str] = {float: "number", int: "integer", bool: "boolean", str: "text"}
    return plain.get(hint, "map" if origin is Mapping else "array")


def _commands() -> str:
    rows = [(f"`{name}`", what) for name, what in COMMANDS.items()]
    return f"""## Commands

The daemon answers on a ZeroMQ ROUTER socket (`commands`, by default `{COMMAND_ADDRESS}`). Use a REQ or DEALER socket.
A request is a msgpack map: `{{"command": NAME}}` and the command's arguments. Each gets one reply:
`{{"ok": true, …}}` or `{{"ok": false, "reason": REASON}}`. Limits are in [security.md](security.md).
`shearloop command NAME --json` sends a command from a shell.

{table(("command", "what it does"), rows)}

| argument | of | meaning |
|---|---|---|
| `experiment` | `start` | path of a file on the daemon's computer; default: the configured experiment |
| `source` | `tare` | one sensor's name; default: all |
| `heatmap` | `set` | `always` or `on_request` |
| `source` | `set` | one fingertip's name; default: all |
"""


def safety_table() -> str:
    """Return the safety table as Markdown."""
    rows = []
    for event, rule in TABLE.items():
        response = RESPONSES[rule.response]
        if rule.hold_at_most_s is not None:
            response += f"; stop after {rule.hold_at_most_s:g} s"
        rows.append((event.text, response, rule.sentence.format(detail="…").replace("….", "…"), rule.cure))
    return table(("fault", "response", "message", "what to do"), rows)


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


if __name__ == "__main__":
    for path, text in pages(ROOT).items():
        path.write_text(text, encoding="utf-8")
        print(path.relative_to(ROOT))
