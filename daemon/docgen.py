"""Writes the generated parts of `docs/messages.md` and `docs/safety.md` (`make docs`)."""

import dataclasses
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from shearloop.daemon.cli.command import COMMANDS
from shearloop.daemon.control.safety import TABLE, Response
from shearloop.daemon.messaging.messages import TOPICS, Message

DOCS = Path(__file__).resolve().parents[1] / "docs"
EXAMPLES = DOCS / "examples"
RESPONSES = {
    Response.NOTE: "reported only",
    Response.REFUSE_START: "no experiment starts; a running one continues",
    Response.HOLD: "the wrist holds until the fault is gone",
    Response.STOP_AND_KEEP_GRIP: "stop, the tool stays gripped",
    Response.STOP_AND_RELEASE: "stop, the gripper opens",
}
_ENVELOPE = ("source", "t_mono_ns")
_LANGUAGES = {"Python": ("py", "python"), "C++": ("cpp", "cpp"), "MATLAB": ("m", "matlab")}


def topics() -> str:
    """Return the topics of `daemon/messaging/messages.py` with their keys."""
    parts = []
    for topic, kind in TOPICS.items():
        rate = "on change" if kind.rate_hz is None else f"{kind.rate_hz:g} a second"
        keys = table(("key", "type", "unit", "meaning"), _keys(kind))
        parts.append(f"### `{topic}`, {rate}\n\n{kind.__doc__}\n\n{keys}")
    return "\n\n".join(parts)


def commands() -> str:
    """Return the table of commands."""
    return table(("command", "what it does"), [(f"`{name}`", what) for name, what in COMMANDS.items()])


def subscribers() -> str:
    """Return the example programs of `docs/examples/`."""
    parts = []
    for language, (ending, fence) in _LANGUAGES.items():
        text = (EXAMPLES / f"subscriber.{ending}").read_text(encoding="utf-8").strip()
        parts.append(f"### {language}\n\n```{fence}\n{text}\n```")
    return "\n\n".join(parts)


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


def safety_table() -> str:
    """Return the safety table as Markdown."""
    rows = []
    for event, rule in TABLE.items():
        response = RESPONSES[rule.response]
        if rule.hold_at_most_s is not None:
            response += f"; stop after {rule.hold_at_most_s:g} s"
        rows.append((event.text, response, rule.sentence.format(detail="…").replace("….", "…"), rule.cure))
    return table(("fault", "response", "message", "what to do"), rows)


def pages() -> dict[Path, str]:
    """Return the expected text of each page by its path: generated parts stand between two comments."""
    parts = {"topics": topics, "commands": commands, "subscribers": subscribers, "safety table": safety_table}
    found = {}
    for name in ("messages.md", "safety.md"):
        text = (DOCS / name).read_text(encoding="utf-8")
        for part, write in parts.items():
            begin, end = f"<!-- generated: {part} -->\n", "<!-- end -->"
            before, mark, rest = text.partition(begin)
            text = before + mark + (f"\n{write()}\n\n{end}{rest.partition(end)[2]}" if mark else "")
        found[DOCS / name] = text
    return found


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; bars within cells are escaped."""
    escaped = [[cell.replace("|", "\\|").replace("\n", " ") for cell in cells] for cells in (head, *rows)]
    head_row, *body = [f"| {' | '.join(cells)} |" for cells in escaped]
    return "\n".join([head_row, "|---" * len(head) + "|", *body])


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
        print(path.relative_to(DOCS.parent))
