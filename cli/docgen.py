"""Writes the generated parts of the pages, and the schemas of `config/schemas/` (`make docs`)."""

import dataclasses
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from shearloop.cli.command import DAEMON_COMMANDS
from shearloop.cli.config_schema import MODELS, Section, references, schema_of, schema_text, sections
from shearloop.daemon.control.faults import TABLE, Response
from shearloop.daemon.messaging.messages import TOPICS, Message
from shearloop.daemon.recorder.schema import json_type
from shearloop.drivers.eit_kit import FrameErrorKind
from shearloop.drivers.shear_skin.skin import SkinFault
from shearloop.units import unit_of

DOCS = Path(__file__).resolve().parents[1] / "docs"
EXAMPLES = DOCS / "examples"
SCHEMAS = DOCS.parent / "config" / "schemas"
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
    return table(("command", "what it does"), [(f"`{name}`", what) for name, what in DAEMON_COMMANDS.items()])


def subscribers() -> str:
    """Return the example programs of `docs/examples/` for a daemon on the same machine."""
    parts = []
    for language, (ending, fence) in _LANGUAGES.items():
        parts.append(f"### {language}\n\n{_program(f'subscriber.{ending}', fence)}")
    return "\n\n".join(parts)


def subscriber_with_keys() -> str:
    """Return the example program for a daemon on another computer."""
    return _program("subscriber_with_keys.py", "python")


def _program(name: str, fence: str) -> str:
    return f"```{fence}\n{(EXAMPLES / name).read_text(encoding='utf-8').strip()}\n```"


def _keys(kind: type[Message]) -> Iterator[tuple[str, ...]]:
    hints = get_type_hints(kind)
    for item in dataclasses.fields(kind):
        if item.name not in _ENVELOPE:
            shown = _type_name(hints[item.name])
            yield f"`{item.name}`", shown, item.metadata["unit"], item.metadata["meaning"]


def _type_name(hint: Any) -> str:
    words = {"string": "text", "object": "map"}
    kind: str = json_type(hint)["type"]
    return words.get(kind, kind) + (" or nil" if type(None) in get_args(hint) else "")


def safety_table() -> str:
    """Return the safety table as Markdown."""
    rows = []
    for event, rule in TABLE.items():
        response = RESPONSES[rule.response]
        if rule.hold_at_most_s is not None:
            response += f"; stop after {rule.hold_at_most_s:g} s"
        if rule.stops_at_rest:
            response += "; a stop also where nothing moved"
        rows.append((event.text, response, rule.sentence.format(detail="…").replace("….", "…"), rule.cure))
    return table(("fault", "response", "message", "what to do"), rows)


def error_kinds() -> str:
    """Return the kinds of errors that `health` counts of fingertips and of the skin."""
    kinds = [("fingertip", kind.name, kind.value) for kind in FrameErrorKind]
    # A start is no error.
    kinds += [("skin", fault.name, fault.value) for fault in SkinFault if fault is not SkinFault.SOURCE_STARTING]
    return table(("kind", "of", "meaning"), [(f"`{name.lower()}`", source, what) for source, name, what in kinds])


def configuration() -> str:
    """Return the keys of all files that people write, section by section."""
    parts = []
    for kind in MODELS:
        first, *inner = sections(schema_of(kind))
        parts.append(f"## {kind.capitalize()}\n\n{_section_text(first)}")
        parts += [f"### `{section.paths[0]}`\n\n{_section_text(section)}" for section in inner]
    return "\n\n".join(parts)


def _section_text(section: Section) -> str:
    _, *others = section.paths
    also = f" Also {', '.join(f'`{path}`' for path in others)}." if others else ""
    required = section.schema.get("required", ())
    rows = [_setting(key, found, key in required) for key, found in section.schema["properties"].items()]
    return f"{section.schema['description']}{also}\n\n{table(('key', 'value', 'unit', 'default', 'meaning'), rows)}"


def _setting(key: str, found: Mapping[str, Any], required: bool) -> tuple[str, ...]:
    unit = unit_of(key)
    default = found.get("default")
    if required or default is None:
        shown = "required" if required else "–"
    else:
        # The defaults of a section stand with its keys.
        shown = "" if isinstance(default, dict) else f"`{json.dumps(default, ensure_ascii=False)}`"
    return f"`{key}`", _value(found), unit, shown, found["description"].removesuffix(f" [{unit}]")


def _value(found: Mapping[str, Any]) -> str:
    """Return a value's kind and range in words."""
    if "anyOf" in found:
        return " or ".join(_value(option) for option in found["anyOf"] if option.get("type") != "null")
    if "const" in found or "enum" in found:
        return ", ".join(f"`{value}`" for value in found.get("enum", [found.get("const")]))
    if any(references(found)) or found["type"] == "object":
        return "list of sections" if "items" in found else "section"
    if found["type"] == "array":
        count = f" of {found['minItems']}" if found.get("minItems") == found.get("maxItems", 0) else ""
        kinds = dict.fromkeys(_value(item) for item in found.get("prefixItems") or [found["items"]])
        return f"list{count}: {', then '.join(kinds)}"
    names = {"string": "path" if found.get("format") == "path" else "text", "boolean": "true or false"}
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    bounds = [f"{sign} {found[name]:g}" for name, sign in signs.items() if name in found]
    return " ".join([names.get(found["type"], found["type"]), ", ".join(bounds)]).strip()


def pages() -> dict[Path, str]:
    """Return the expected text of each generated file by its path: in pages, between two comments."""
    parts = {
        "topics": topics,
        "commands": commands,
        "subscribers": subscribers,
        "subscriber with keys": subscriber_with_keys,
        "safety table": safety_table,
        "error kinds": error_kinds,
        "configuration": configuration,
    }
    found = {SCHEMAS / f"{kind}.json": schema_text(kind) for kind in MODELS}
    for name in ("configuration.md", "faults.md", "messages.md"):
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
