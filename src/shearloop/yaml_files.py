"""YAML files: read with unique keys, checked by pydantic, and replaced at once when written.

Each caller names the exception to raise. Its message has a line for each mistake: `file:line: key: the mistake;
allowed: …; did you mean …?`.
"""

import copy
import math
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from shearloop.files import read_file, replace_file
from shearloop.units import unit_hint, unit_of
from shearloop.words import counted

Model = TypeVar("Model")

_LONGEST_VALUE = 60
# Of Linux.
_LONGEST_NAME, _LONGEST_PATH = 255, 4096
# Bounds on what a file may cost: its bytes, its values with every alias written out, and its mistakes that are shown.
MOST_BYTES, _MOST_VALUES, _MOST_MISTAKES = 1 << 17, 20_000, 100


class _Loader(yaml.SafeLoader):
    """A SafeLoader that refuses duplicate keys and type tags, bounds aliases, and knows neither dates nor base 60.

    Of two equal keys YAML would silently keep the last.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        # How many values each node holds, its aliases written out.
        self._sizes: dict[yaml.Node, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event: yaml.NodeEvent = self.peek_event()  # type: ignore[no-untyped-call]
        tag = getattr(event, "tag", None)
        if tag not in (None, "!"):
            raise self._refusal(f"the type tag {tag} is not supported", event)
        node = super().compose_node(parent, index)
        if node is None:
            return None
        if node not in self._sizes:
            if isinstance(event, yaml.AliasEvent):
                raise self._refusal("an alias stands within its anchor", event)
            pairs = node.value if isinstance(node, yaml.MappingNode) else [node.value]
            inside = [] if isinstance(node, yaml.ScalarNode) else [each for pair in pairs for each in pair]
            self._sizes[node] = 1 + sum(self._sizes[each] for each in inside)
        if self._sizes[node] > _MOST_VALUES:
            raise self._refusal(f"more than {_MOST_VALUES} values, with every alias written out", event)
        return node

    @staticmethod
    def _refusal(problem: str, event: yaml.NodeEvent) -> yaml.MarkedYAMLError:
        mark: Any = event.start_mark  # typed as C's marks too
        return yaml.composer.ComposerError(None, None, problem, mark)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Hashable] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable):
                if key in seen:
                    problem = f"the key `{key}` is given twice"
                    raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
                seen.add(key)
        return super().construct_mapping(node, deep)


_INT, _FLOAT, _DATE = (f"tag:yaml.org,2002:{kind}" for kind in ("int", "float", "timestamp"))
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in (_INT, _FLOAT, _DATE)]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(_INT, re.compile(r"[-+]?(0|[1-9][0-9]{0,30})$"), list("-+0123456789"))
_Loader.add_implicit_resolver(
    _FLOAT,
    re.compile(
        r"(?=.{1,40}$)[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"
    ),
    list("-+.0123456789"),
)


@dataclass(frozen=True, slots=True)
class Document:
    """The content of one YAML file, with its lines; `raises` is the exception for each mistake."""

    path: Path
    content: Any
    raises: type[Exception]
    _root: yaml.Node | None
    # What `with_values` was given as a number or as true or false: the text by its place in the content.
    _given: Mapping[tuple[int | str, ...], str] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path, raises: type[Exception], what: str = "configuration", cure: str = "") -> Self:
        """Read a file that is neither missing nor empty; `cure` ends the message of a missing one."""
        if "\0" in str(path) or len(path.name) > _LONGEST_NAME or len(str(path)) > _LONGEST_PATH:
            raise raises(f"{shown(str(path))}: no {what} has such a name")
        try:
            data = read_file(path, MOST_BYTES)
        except OSError as error:
            raise raises(f"{path}: the {what} cannot be read: {error.strerror}{cure}") from error
        return cls.parse(path, data, raises, what)

    @classmethod
    def parse(cls, path: Path, data: bytes, raises: type[Exception], what: str = "configuration") -> Self:
        """Parse the bytes of a file, which is not read again."""
        try:
            loader = _Loader(data.decode("utf-8"))
            root = loader.get_single_node()
            content = loader.construct_document(root) if root is not None else None
        except UnicodeDecodeError as error:
            raise raises(f"{path}: the {what} is not UTF-8 text (byte {error.start})") from error
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            where = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
            raise raises(f"{where}: {_syntax(error)}") from error
        except yaml.YAMLError as error:
            raise raises(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
        except RecursionError as error:
            raise raises(f"{path}: the {what} is nested too deeply") from error
        if content is None:
            raise raises(f"{path}: the {what} is empty")
        return cls(path, content, raises, root)

    def model(self, model: type[Model]) -> Model:
        """Return the content as a pydantic model or dataclass; its validators get the file's `folder`."""
        if not isinstance(self.content, dict):
            example = next(iter(TypeAdapter(model).json_schema()["properties"]), "key")
            raise self.raises(f"{self.path}: expected keys and values such as `{example}: …`")
        try:
            return _validated(self.content, model, self.path.resolve().parent)
        except ValidationError as error:
            if texts := self._expected_texts(error):
                return self._with_texts(texts).model(model)
            raise self.raises("\n".join(_mistakes(error, model, self.content, str(self.path), self._root))) from error

    def _expected_texts(self, error: ValidationError) -> dict[tuple[int | str, ...], str]:
        """Return the given values, as they were written, where a text or a path is expected."""
        places = [one["loc"] for one in error.errors() if one["type"] in ("string_type", "path_type")]
        return {place: self._given[place] for place in places if place in self._given}

    def _with_texts(self, texts: Mapping[tuple[int | str, ...], str]) -> Self:
        content = copy.deepcopy(self.content)
        for place, text in texts.items():
            section = content
            for part in place[:-1]:
                section = section[part]
            section[place[-1]] = text
        others = {place: text for place, text in self._given.items() if place not in texts}
        return type(self)(self.path, content, self.raises, self._root, others)

    def with_values(self, values: Mapping[str, str]) -> Self:
        """Return the document with other values, given as YAML by their keys, such as `loop.kp` or `steps.0`.

        Sections that are missing are made. A number is a text where a text is expected, as it is written: a shell takes
        its quotes away. Mistakes in the result are named without a line.
        """
        content, given = copy.deepcopy(self.content), dict(self._given)
        for key, text in values.items():
            try:
                value = yaml.load(text, _Loader)  # noqa: S506 - it is a SafeLoader
            except yaml.MarkedYAMLError as error:
                raise self.raises(f"{key}={text}: the value is not YAML: {_syntax(error)}") from error
            *sections, last = key.split(".")
            section = content
            for number, name in enumerate(sections):
                section = self._section(section, name, ".".join(sections[:number]))
            if isinstance(section, list):
                section[self._index(section, last, ".".join(sections))] = value
            elif isinstance(section, dict):
                section[last] = value
            else:
                raise self.raises(f"{self.path}: {'.'.join(sections)} is a value, so it has no {last}")
            if isinstance(value, bool | int | float):
                given[tuple(int(part) if part.isdecimal() else part for part in key.split("."))] = text.strip()
        return type(self)(self.path, content, self.raises, None, given)

    def _section(self, section: Any, name: str, key: str) -> Any:
        if isinstance(section, list):
            return section[self._index(section, name, key)]
        if not isinstance(section, dict):
            raise self.raises(f"{self.path}: {key} is a value, so it has no {name}")
        if section.get(name) is None:
            section[name] = {}
        return section[name]

    def _index(self, section: list[Any], name: str, key: str) -> int:
        if not (name.isdecimal() and int(name) < len(section)):
            raise self.raises(f"{self.path}: {key} is a list of {len(section)}, so {name} is not one of its numbers")
        return int(name)

    def located(self, mistakes: Iterable[tuple[tuple[int | str, ...], str]]) -> list[str]:
        """Return `file:line: key: sentence` for each mistake, given by its location in the content."""
        found = []
        for location, sentence in mistakes:
            key, line = _place(location, self.content, self._root, missing=True)
            found.append((line, f"{self.path}:{line}: {key}: {sentence}"))
        return [text for _, text in sorted(found)]


def read_yaml(path: Path, raises: type[Exception], what: str = "configuration", cure: str = "") -> Any:
    """Return the content of a YAML file that is neither missing nor empty; `cure` ends the message of a missing one."""
    return Document.read(path, raises, what, cure).content


def parse_yaml(text: bytes) -> Any:
    """Return the content of a YAML text; raises yaml.YAMLError, ValueError or RecursionError."""
    if len(text) > MOST_BYTES:
        raise ValueError(f"its header is larger than {MOST_BYTES >> 10} kB")
    return yaml.load(text.decode(), _Loader)  # noqa: S506 - it is a SafeLoader


def load_model(
    path: Path, model: type[Model], raises: type[Exception], what: str = "configuration", cure: str = ""
) -> Model:
    """Return a YAML file's content as a pydantic model or dataclass; its validators get the file's `folder`."""
    return Document.read(path, raises, what, cure).model(model)


def validated(content: object, model: type[Model], where: str, raises: type[Exception], *, cure: str = "") -> Model:
    """Return the content as a model; each line of the message begins with `where`, and the last ends with `cure`."""
    try:
        return _validated(content, model)
    except ValidationError as error:
        raise raises("\n".join(_mistakes(error, model, content, where)) + cure) from error


def _validated(content: object, model: type[Model], folder: Path | None = None) -> Model:
    return TypeAdapter(model).validate_python(content, context=folder and {"folder": folder})


def save_yaml(path: Path, content: Mapping[str, Any], raises: type[Exception]) -> None:
    """Write the content atomically: a reader sees the old file or the new one."""
    try:
        with replace_file(path) as file:
            file.write(yaml.safe_dump(content, sort_keys=False, allow_unicode=True).encode())
    except OSError as error:
        raise raises(f"{path}: the calibration cannot be written: {error.strerror}") from error


# The libraries' words for frequent mistakes, and ours.
_SYNTAX = (
    ("found character '\\t'", "a tab indents this line; use spaces"),
    ("mapping values are not allowed", "a second `:` stands in this line, or the line before is indented otherwise"),
    ("could not find expected ':'", "a key without its `:`"),
    ("expected <block end>", "this line is indented otherwise than those above"),
    ("expected ',' or ']'", "a list is not closed: `,` or `]` is missing"),
    ("expected ',' or '}'", "a section is not closed: `,` or `}` is missing"),
    ("found unhashable key", "a key is a list or a section; a name is expected"),
    ("could not determine a constructor", "the keys `<<` and `=` are not supported"),
    ("but found another document", "a second document begins here; a file has one"),
    ("found undefined alias", "an alias `*name` without its anchor `&name`"),
)
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


def _syntax(error: yaml.MarkedYAMLError) -> str:
    problem = str(error.problem or error.context)
    return next((words for begin, words in _SYNTAX if problem.startswith(begin)), problem)


def _mistakes(
    error: ValidationError, model: type, content: object, where: str, root: yaml.Node | None = None
) -> list[str]:
    """Return a line for each mistake, in the order of the file; `root` is its content with line numbers.

    Only the first are shown of very many: each takes a search through the file.
    """
    schema = TypeAdapter(model).json_schema()
    found: dict[str, int] = {}
    every = error.errors(include_url=False)
    first, more = every[:_MOST_MISTAKES], every[_MOST_MISTAKES:]
    for details in first:
        location = details["loc"]
        # A list counts only its valid entries, so that mistakes within it make it too short as well.
        if details["type"] == "too_short" and any(one["loc"][:-1][: len(location)] == location for one in first):
            continue
        kind = details["type"]
        key, line = _place(location, content, root, missing=kind == "missing")
        wrong_key = kind == "invalid_key" or location[-1:] == ("[key]",)
        if wrong_key:
            # Only the key's section has a name.
            section = location[:-2] if location[-1] == "[key]" else location[:-1]
            key, _ = _place(section, content, root, missing=False)
        if kind.startswith("union_tag"):
            key += "." + details["ctx"]["discriminator"].strip("'")
        subject = f"{key}: " if key else ""
        sentence = _sentence(details, schema, _written(location, content, root, key=wrong_key))
        found[f"{where}{f':{line}' if root is not None else ''}: {subject}{sentence}"] = line
    return sorted(found, key=lambda text: found[text]) + (
        [f"{where}: {counted(len(more), 'more mistake')}"] if more else []
    )


def _place(location: Sequence[int | str], content: object, node: yaml.Node | None, *, missing: bool) -> tuple[str, int]:
    """Return a location's key, without the names of alternatives, and its line; its last part may be `missing`."""
    key, line, last = "", 1, len(location) - 1
    for number, part in enumerate(location):
        child: yaml.Node | None = None
        if isinstance(content, Mapping) and part in content:
            if isinstance(node, yaml.MappingNode):
                name, child = _pair(content, part, node)
                line = name.start_mark.line + 1
            content = content[part]
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


def _pair(content: Mapping[Any, object], key: int | str, node: yaml.MappingNode) -> tuple[yaml.Node, yaml.Node]:
    """Return the nodes of a key and of its value; keys are unique, so that they stand in the content's order."""
    name, value = node.value[list(content).index(key)]
    return name, value


def _written(location: Sequence[int | str], content: object, node: yaml.Node | None, *, key: bool) -> str:
    """Return the value at a location as it is written in the file, or its key; else an empty text."""
    name = node
    for part in location:
        if isinstance(content, Mapping) and part in content and isinstance(node, yaml.MappingNode):
            name, node = _pair(content, part, node)
            content = content[part]
        elif isinstance(content, list) and isinstance(part, int) and isinstance(node, yaml.SequenceNode):
            name = node = node.value[part]
            content = content[part]
    wrong = name if key else node
    return str(wrong.value) if isinstance(wrong, yaml.ScalarNode) else ""


def _unquoted(found: object, written: str, what: str) -> str:
    """Return a sentence on a text that YAML reads as something else, and its cure."""
    read_as = "true or false" if isinstance(found, bool) else "a number"
    return f"{what}{written or shown(found)} without quotes is {read_as}, and no text; put it in quotes"


def _sentence(details: ErrorDetails, schema: Mapping[str, Any], written: str = "") -> str:
    location, kind, found = details["loc"], details["type"], details["input"]
    if kind == "invalid_key" or (kind == "string_type" and location[-1:] == ("[key]",)):
        if isinstance(found, bool):
            return _unquoted(found, written, "the key ")
        return f"the key {written or shown(found)} is a number; a name is expected"
    if kind == "string_type" and isinstance(found, bool | int | float):
        return f'{_unquoted(found, written, "")}: "{written or found}"'
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"is not a known key{_known_keys(str(location[-1]), _schema_at(schema, location[:-1], schema))}"
    if kind in ("value_error", "assertion_error"):
        return details["msg"].split(", ", 1)[1]
    here = _schema_at(schema, location, schema)
    choices, allowed = list(map(str, here.get("enum", ()))), _allowed(here)
    if kind.startswith("union_tag"):
        choices = [tag.strip("'") for tag in details["ctx"].get("expected_tags", "").split(", ") if tag]
        found, allowed = details["ctx"].get("tag"), ", ".join(choices)
    if kind in ("missing", "union_tag_not_found"):
        sentence = "is missing"
    elif kind == "union_tag_invalid":
        sentence = f"{shown(found)} does not exist"
    else:
        wrong = (words for begin, words in _WRONG if kind.startswith(begin))
        sentence = f"{shown(found)} {next(wrong, details['msg'])}"
    near = get_close_matches(str(found), choices, 1)
    hint = f"did you mean {near[0]}?" if near else _unit_hint(location, found, here)
    return "; ".join(filter(None, (sentence, f"allowed: {allowed}" if allowed else "", hint)))


def _unit_hint(location: Sequence[int | str], found: object, schema: Mapping[str, Any]) -> str:
    """Return a question where a number would fit in another unit."""
    if not isinstance(found, int | float) or isinstance(found, bool) or not _allowed(schema):
        return ""
    low = schema.get("minimum", schema.get("exclusiveMinimum", -math.inf))
    high = schema.get("maximum", schema.get("exclusiveMaximum", math.inf))
    key = next((part for part in reversed(location) if isinstance(part, str)), "")
    return unit_hint(found, schema.get("unit") or unit_of(key), low, high)


def _known_keys(wrong: str, schema: Mapping[str, Any]) -> str:
    known = list(schema.get("properties", {}))
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


def _allowed(schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return ", ".join(map(str, schema["enum"]))
    bounds = {"exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "to"}
    return " ".join(f"{word} {schema[name]:g}" for name, word in bounds.items() if name in schema)


def shown(value: object) -> str:
    """Return a value of a file for a message, at most 60 characters."""
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"
