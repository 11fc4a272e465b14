"""Describes each mistake of outside data in one line of plain words.

A line names the key, the present value, the allowed values, and the probable intention if that helps: `loop.kp: 'a' is
not a number; allowed: from 0 to 10`. With the nodes of a YAML file it begins with the file's line.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from shearloop.lookalikes import note_on
from shearloop.units import unit_hint, unit_of
from shearloop.words import counted, shortened, shown

# A decimal with a comma, as German and French have it, and the cure.
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+,[0-9]+")
# A key that a sentence begins with, or names in backticks, alone or with its value: `loop.kp: 3`.
_NAMED_KEY = re.compile(r"(?:^|`)([a-z][a-z0-9_.]*)(?:: |`)")
_POINT = "; the decimal sign is a point: 0.1, not 0,1"
# The largest number of mistakes that are shown for one file.
_MAX_MISTAKES = 100
# A number with its unit.
_WITH_UNIT = re.compile(r"[-+−]?[0-9]*[.,]?[0-9]+ *[A-Za-zµμ°%·²/]+[0-9²]*")
# The kinds of files that are taken for another one, each with keys that no other kind has.
_KINDS_OF_FILES = (
    ("an experiment", {"steps"}),
    ("the robot's settings", {"host"}),
    ("a configuration", {"fingertips", "skin", "load_cell", "gripper", "robot"}),
)

# The library's names of a key that no model has.
_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")
# The library's words for frequent mistakes, and ours.
_WRONG = (
    ("finite_number", "is not a finite number"),
    ("float_", "is not a number"),
    ("int_", "is not a whole number"),
    ("bool_", "is neither true nor false"),
    ("string_pattern", "is not such a name"),
    ("string_too_short", "is empty"),
    ("too_short", "has too few entries"),
    ("string_too_long", "is too long"),
    ("too_long", "has too many entries"),
    ("string_", "is not text"),
    ("tuple_", "is not a list"),
    ("list_", "is not a list"),
    ("dict_", "is not a section with keys"),
    ("model_", "is not a section with keys"),
    ("dataclass_", "is not a section with keys"),
    ("path_", "is not the path of a file"),
    ("literal_error", "does not exist"),
    ("enum", "does not exist"),
    ("greater_than", "is too small"),
    ("less_than", "is too large"),
)


def first_key(model: type) -> str:
    """Return the first key of a model, as an example."""
    return next(iter(_schema_of(model)["properties"]), "key")


def keys_of(model: type) -> Collection[str]:
    """Return the keys of a model."""
    found: Collection[str] = _schema_of(model)["properties"].keys()
    return found


@cache
def _schema_of(model: type) -> dict[str, Any]:
    """Return the JSON Schema of a model; callers must not change it."""
    return TypeAdapter(model).json_schema()


def mistake_lines(
    error: ValidationError, model: type, content: object, where: str, root: yaml.Node | None = None
) -> list[str]:
    """Return a line for each mistake, in the order of the file; `root` is its content with line numbers.

    Only the first are shown of very many: each takes a search through the file.
    """
    schema = _schema_of(model)
    found: dict[str, int] = {}
    every = error.errors(include_url=False)
    if kind_of_file := _other_kind(every, content):
        return [f"{where}{':1' if root is not None else ''}: this is {kind_of_file}; name another file here"]
    first, more = every[:_MAX_MISTAKES], every[_MAX_MISTAKES:]
    for details in first:
        location = details["loc"]
        # A list counts only its valid entries, so that mistakes within it make it too short as well.
        if details["type"] == "too_short" and any(one["loc"][:-1][: len(location)] == location for one in first):
            continue
        kind = details["type"]
        key, line = place_of(location, content, root, missing=kind == "missing")
        wrong_key = kind == "invalid_key" or location[-1:] == ("[key]",)
        if wrong_key:
            # Only the key's section has a name.
            section = location[:-2] if location[-1] == "[key]" else location[:-1]
            key, _ = place_of(section, content, root, missing=False)
        if kind.startswith("union_tag"):
            key += "." + details["ctx"]["discriminator"].strip("'")
        subject = f"{key}: " if key else ""
        written = _written(location, content, root, key=wrong_key)
        sentence = _sentence(details, schema, written, _shown_at(details, content, root))
        if kind in _UNKNOWN_KEY:
            sentence += note_on(_written(location, content, root, key=True))
        elif kind.startswith(("float_", "int_", "bool_", "literal_", "union_tag_")):
            sentence += note_on(written)
        if kind == "value_error":
            line = _line_of_named(sentence, location, content, root) or line
        is_number = wrong_key and _written(location, content, root, key=True).isdecimal()
        if is_number and root is not None and not _written(location, content, root, key=False):
            # In braces, YAML reads the part behind a comma as a key without a value.
            sentence += _POINT
        found[f"{where}{f':{line}' if root is not None else ''}: {subject}{sentence}"] = line
    return sorted(found, key=lambda text: found[text]) + (
        [f"{where}: {counted(len(more), 'more mistake')}"] if more else []
    )


def _other_kind(every: Sequence[ErrorDetails], content: object) -> str:
    """Return the kind of file that this content is of, where most of its keys are unknown; else an empty text."""
    unknown = {one["loc"][0] for one in every if len(one["loc"]) == 1 and one["type"] in _UNKNOWN_KEY}
    if not isinstance(content, Mapping) or 2 * len(unknown) <= len(content):
        return ""
    return next((kind for kind, keys in _KINDS_OF_FILES if keys & unknown), "")


def _shown_at(details: ErrorDetails, content: object, root: yaml.Node | None) -> str:
    """Return the value of a mistake for its sentence: a list or a section as it stands in the file."""
    node = _node_at(details["loc"], content, root, key=False)
    if isinstance(node, yaml.CollectionNode) and isinstance(details["input"], list | tuple | dict):
        return shortened(_in_one_line(node))
    return shown(details["input"])


def _in_one_line(node: yaml.Node) -> str:
    """Return a value of a file as it is written, on one line."""
    if isinstance(node, yaml.CollectionNode) and node.flow_style and node.start_mark.buffer is not None:
        return " ".join(node.start_mark.buffer[node.start_mark.pointer : node.end_mark.pointer].split())
    if isinstance(node, yaml.SequenceNode):
        return f"[{', '.join(map(_in_one_line, node.value))}]"
    if isinstance(node, yaml.MappingNode):
        pairs = [f"{_in_one_line(name)}: {_in_one_line(value)}" for name, value in node.value]
        return f"{{{', '.join(pairs)}}}"
    return str(node.value)


def place_of(
    location: Sequence[int | str], content: object, node: yaml.Node | None, *, missing: bool
) -> tuple[str, int]:
    """Return a location's key, without the names of alternatives, and its line; its last part may be `missing`."""
    key, line, last = "", 1, len(location) - 1
    for number, part in enumerate(location):
        child: yaml.Node | None = None
        if isinstance(content, Mapping) and (written := _key_of(content, part)) is not None:
            if isinstance(node, yaml.MappingNode):
                name, child = _pair(content, written, node)
                line = name.start_mark.line + 1
            content = content[written]
        elif isinstance(content, list | tuple) and isinstance(part, int) and part < len(content):
            content = content[part]
            if isinstance(node, yaml.SequenceNode):
                child = node.value[part]
                line = child.start_mark.line + 1
        elif not (missing and number == last):
            continue
        node = child
        key += f"[{part}]" if isinstance(part, int) else f".{part}"
    return key.lstrip("."), line


def _line_of_named(sentence: str, location: Sequence[int | str], content: object, root: yaml.Node | None) -> int | None:
    """Return the line of the first key in a section that a sentence names, None if it names none.

    A rule of several keys is broken by the section that has them, and its first line says nothing.
    """
    for named in _NAMED_KEY.findall(sentence):
        place = (*location, *named.split("."))
        key, line = place_of(place, content, root, missing=False)
        if key.endswith(named):
            return line
    return None


def _key_of(content: Mapping[Any, object], part: int | str) -> Any:
    """Return the key of a section that a part of a location means, None for another part: 0.5 is a text there."""
    return next((key for key in content if key == part or (isinstance(key, float) and str(key) == part)), None)


def _pair(content: Mapping[Any, object], key: Any, node: yaml.MappingNode) -> tuple[yaml.Node, yaml.Node]:
    """Return the nodes of a key and of its value; keys are unique, so that they stand in the content's order."""
    name, value = node.value[list(content).index(key)]
    return name, value


def _node_at(location: Sequence[int | str], content: object, node: yaml.Node | None, *, key: bool) -> yaml.Node | None:
    """Return the node of the value at a location in the file, or of its key; None for one that is missing."""
    name = node
    for part in location:
        if isinstance(content, Mapping) and isinstance(node, yaml.MappingNode):
            written = _key_of(content, part)
            if written is not None:
                name, node = _pair(content, written, node)
                content = content[written]
        elif isinstance(content, list) and isinstance(part, int) and isinstance(node, yaml.SequenceNode):
            if part >= len(content):
                return None
            name = node = node.value[part]
            content = content[part]
    return name if key else node


def _written(location: Sequence[int | str], content: object, node: yaml.Node | None, *, key: bool) -> str:
    """Return the value at a location as it is written in the file, or its key; else an empty text."""
    wrong = _node_at(location, content, node, key=key)
    return str(wrong.value) if isinstance(wrong, yaml.ScalarNode) else ""


def _unquoted(found: object, written: str, what: str) -> str:
    """Return a sentence on a text that YAML reads as something else, and its cure."""
    read_as = "true or false" if isinstance(found, bool) else "a number"
    return f"{what}{written or shown(found)} without quotes is {read_as}, and no text; put it in quotes"


def _sentence(details: ErrorDetails, schema: Mapping[str, Any], written: str, value: str) -> str:
    """Return a mistake in words; `written` is its scalar or key as in the file, `value` what the sentence shows."""
    location, kind, found = details["loc"], details["type"], details["input"]
    if kind == "invalid_key" or (kind == "string_type" and location[-1:] == ("[key]",)):
        if isinstance(found, bool):
            return _unquoted(found, written, "the key ")
        return f"the key {written or shown(found)} is a number; a name is expected"
    if kind == "string_type" and isinstance(found, bool | int | float):
        return f'{_unquoted(found, written, "")}: "{written or found}"'
    if kind in _UNKNOWN_KEY:
        return f"is not a known key{_known_keys(location, schema)}"
    if kind in ("value_error", "assertion_error"):
        return details["msg"].split(", ", 1)[1]
    here = _schema_at(schema, location, schema)
    choices, allowed = list(map(str, here.get("enum", ()))), _allowed_length(details) or _allowed(here)
    if kind.startswith("union_tag"):
        choices = [tag.strip("'") for tag in details["ctx"].get("expected_tags", "").split(", ") if tag]
        found, allowed = details["ctx"].get("tag"), ", ".join(choices)
    if kind in ("missing", "union_tag_not_found"):
        sentence = "is missing"
    elif kind == "union_tag_invalid":
        sentence = f"{shown(found)} does not exist"
    else:
        if found in ("true", "false") and kind.startswith(("float_", "int_")):
            return "is true or false, which YAML also reads from yes and no; write a number"
        wrong = (words for begin, words in _WRONG if kind.startswith(begin))
        sentence = "has no value" if found is None else f"{value} {next(wrong, details['msg'])}"
    if isinstance(found, str) and _DECIMAL_COMMA.fullmatch(found) and kind.startswith(("float_", "int_")):
        sentence += _POINT
    if kind == "too_long" and all(isinstance(one, int) for one in found):
        # YAML takes a decimal comma in a list for the next entry.
        sentence += _POINT
    near = get_close_matches(str(found), choices, 1)
    hint = f"did you mean {near[0]}?" if near else _unit_hint(location, found, here) or _form_hint(details, here)
    return "; ".join(filter(None, (sentence, f"allowed: {allowed}" if allowed else "", hint)))


def _unit_hint(location: Sequence[int | str], found: object, schema: Mapping[str, Any]) -> str:
    """Return a question where a number would fit in another unit."""
    if not isinstance(found, int | float) or isinstance(found, bool) or not _allowed(schema):
        return ""
    low = schema.get("minimum", schema.get("exclusiveMinimum", -math.inf))
    high = schema.get("maximum", schema.get("exclusiveMaximum", math.inf))
    key = next((part for part in reversed(location) if isinstance(part, str)), "")
    return unit_hint(found, schema.get("unit") or unit_of(key), low, high)


def _form_hint(details: ErrorDetails, schema: Mapping[str, Any]) -> str:
    """Return how a value of another form is written, or an empty text."""
    kind, found = details["type"], details["input"]
    if isinstance(found, str) and kind.startswith(("float_", "int_")) and _WITH_UNIT.fullmatch(found):
        key = next((part for part in reversed(details["loc"]) if isinstance(part, str)), "")
        unit = schema.get("unit") or unit_of(key)
        return f"write the number alone{f', in {unit}' if unit else ''}"
    if isinstance(found, dict) and kind.startswith(("list_", "tuple_")):
        return "each entry of a list begins with `- `"
    tag = schema.get("discriminator", {})
    kinds, name = tag.get("mapping", {}), tag.get("propertyName", "")
    if isinstance(found, str) and found in kinds:
        return f"write `{name}: {found}`"
    if isinstance(found, dict) and (glued := next((key for key in found if str(key).startswith(f"{name}:")), None)):
        return f"a space is missing in `{glued}`"
    if isinstance(found, dict) and (named := next((key for key in found if key in kinds), None)):
        return f"write `{name}: {named}`, and its keys beside it"
    if kind.startswith(("model_", "dataclass_")) and (keys := schema.get("properties")):
        return f"its keys are {', '.join(keys)}"
    return ""


def _sections_with(key: str, schema: Mapping[str, Any], root: Mapping[str, Any]) -> list[str]:
    """Return the sections directly below a schema that have a key."""
    sections = schema.get("properties", {})
    return [name for name in sections if key in _schema_at(schema, (name,), root).get("properties", {})]


def _known_keys(location: Sequence[int | str], root: Mapping[str, Any]) -> str:
    """Return which key was probably meant by the unknown one at a location, its place, or the known ones."""
    wrong, schema = str(location[-1]), _schema_at(root, location[:-1], root)
    known = list(schema.get("properties", {}))
    if sections := _sections_with(wrong, schema, root):
        return f"; it belongs in {' or '.join(f'`{name}`' for name in sections[:3])}"
    if len(location) > 1 and wrong in root.get("properties", {}):
        return "; it belongs in no section: write it without indentation"
    # Often the unit is missing: `speed` for `speed_rad_per_s`.
    near = get_close_matches(wrong, known, n=1) or [name for name in known if name.startswith(f"{wrong}_")]
    if near:
        return f"; did you mean {near[0]}?"
    return f"; allowed: {', '.join(known)}" if known else ""


def _schema_at(schema: Mapping[str, Any], location: Sequence[int | str], root: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the JSON schema of a location in the document, or an empty one if it is ambiguous."""
    if "$ref" in schema:
        return _schema_at(root["$defs"][schema["$ref"].rsplit("/", 1)[-1]], location, root)
    if "anyOf" in schema:
        candidates = [part for part in schema["anyOf"] if part.get("type") != "null"]
        if location and isinstance(location[0], int):
            candidates = [part for part in candidates if part.get("type") == "array"]
        return _schema_at(candidates[0], location, root) if len(candidates) == 1 else {}
    if not location:
        return schema
    if "oneOf" in schema:
        kind = schema.get("discriminator", {}).get("mapping", {}).get(location[0])
        return _schema_at({"$ref": kind}, location[1:], root) if kind else {}
    step, rest = location[0], location[1:]
    if isinstance(step, int):
        each = schema.get("prefixItems", ())
        inside = each[step] if step < len(each) else schema.get("items")
    else:
        named = schema.get("properties", {}).get(step)
        inside = (
            named
            or schema.get("additionalProperties")
            or next(iter(schema.get("patternProperties", {}).values()), None)
        )
    return _schema_at(inside, rest, root) if isinstance(inside, Mapping) else {}


def _allowed_length(details: ErrorDetails) -> str:
    """Return the lengths that a text or a list of a wrong length may have, else an empty text."""
    limits = details.get("ctx", {})
    match details["type"]:
        case "string_too_long":
            return f"up to {counted(limits['max_length'], 'character')}"
        case "too_long":
            return f"up to {counted(limits['max_length'], 'entry', 'entries')}"
        case "too_short":
            return f"{counted(limits['min_length'], 'entry', 'entries')} or more"
        case _:
            return ""


def _allowed(schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return ", ".join(map(str, schema["enum"]))
    bounds = {"exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "to"}
    return " ".join(f"{word} {schema[name]:g}" for name, word in bounds.items() if name in schema)
