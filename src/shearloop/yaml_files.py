"""YAML files: read with unique keys, checked by pydantic, and replaced at once when written.

Each caller names the exception to raise. Its message names the file and every mistake, with the key and allowed range.
"""

import re
from collections.abc import Hashable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from shearloop.files import replace_file

Model = TypeVar("Model")

_LONGEST_VALUE = 60
# Bounds on what a file may cost: its bytes, and its values with every alias written out.
_MOST_BYTES, _MOST_VALUES = 1 << 17, 20_000


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


def read_yaml(path: Path, raises: type[Exception], what: str = "configuration", cure: str = "") -> Any:
    """Return the content of a YAML file that is neither missing nor empty; `cure` ends the message of a missing one."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise raises(f"{path}: the {what} is larger than {_MOST_BYTES >> 10} kB; is it another file?")
        content = yaml.load(path.read_text(encoding="utf-8"), _Loader)  # noqa: S506 - it is a SafeLoader
    except OSError as error:
        raise raises(f"{path}: the {what} cannot be read: {error.strerror}{cure}") from error
    except UnicodeDecodeError as error:
        raise raises(f"{path}: the {what} is not UTF-8 text (byte {error.start})") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise raises(f"{path}: {where}{error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise raises(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise raises(f"{path}: the {what} is nested too deeply") from error
    if content is None:
        raise raises(f"{path}: the {what} is empty")
    return content


def load_model(
    path: Path, model: type[Model], raises: type[Exception], what: str = "configuration", cure: str = ""
) -> Model:
    """Return a YAML file's content as a pydantic model or dataclass; its validators get the file's `folder`."""
    content = read_yaml(path, raises, what, cure)
    if not isinstance(content, dict):
        example = next(iter(TypeAdapter(model).json_schema()["properties"]), "key")
        raise raises(f"{path}: expected keys and values such as `{example}: …`, found {_shown(content)}")
    return validated(content, model, str(path), raises, folder=path.resolve().parent)


def validated(
    content: object,
    model: type[Model],
    where: str,
    raises: type[Exception],
    *,
    cure: str = "",
    folder: Path | None = None,
) -> Model:
    """Return the content as a model; the message begins with `where`, lists every mistake, and ends with `cure`."""
    adapter = TypeAdapter(model)
    try:
        return adapter.validate_python(content, context=folder and {"folder": folder})
    except ValidationError as error:
        schema = adapter.json_schema()
        mistakes = dict.fromkeys(_sentence(details, schema) for details in error.errors(include_url=False))
        raise raises(f"{where}: {'; '.join(mistakes)}{cure}") from error


def save_yaml(path: Path, content: Mapping[str, Any], raises: type[Exception]) -> None:
    """Write the content atomically: a reader sees the old file or the new one."""
    try:
        with replace_file(path) as file:
            file.write(yaml.safe_dump(content, sort_keys=False, allow_unicode=True).encode())
    except OSError as error:
        raise raises(f"{path}: the calibration cannot be written: {error.strerror}") from error


def _sentence(details: ErrorDetails, schema: Mapping[str, Any]) -> str:
    location = details["loc"]
    if details["type"] == "invalid_key":
        return f"the key {_shown(details['input'])} is a number; a name is expected"
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    subject = f"`{key}` " if key else ""
    if details["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{subject}is not a known key{_known_keys(str(location[-1]), _schema_at(schema, location[:-1], schema))}"
    allowed = _allowed(_schema_at(schema, location, schema))
    if details["type"] == "missing":
        return f"{subject}is missing{f' (allowed: {allowed})' if allowed else ''}"
    if details["type"] in ("value_error", "assertion_error"):
        return f"{subject}{details['msg'].split(', ', 1)[1]}"
    if details["type"].startswith("union_tag"):
        return f"{subject}{_tag(details)}"
    reason = details["msg"].replace("Input should", "should", 1).replace("Value should", "should", 1)
    allowed_text = f", allowed: {allowed}" if allowed else ""
    return f"{subject}{reason} (found {_shown(details['input'])}{allowed_text})"


def _tag(details: ErrorDetails) -> str:
    """Return the mistake in a key that selects the kind of a section."""
    context = details["ctx"]
    key = context["discriminator"].strip("'")
    if "tag" not in context:
        return f"lacks `{key}`, its kind"
    known = [tag.strip("'") for tag in context["expected_tags"].split(", ")]
    near = get_close_matches(context["tag"], known, 1)
    meant = f", did you mean {near[0]!r}?" if near else ""
    return f"has the {key} {context['tag']!r}, which does not exist{meant} (allowed: {', '.join(known)})"


def _known_keys(wrong: str, schema: Mapping[str, Any]) -> str:
    known = list(schema.get("properties", {}))
    near = get_close_matches(wrong, known, n=1)
    if near:
        return f", did you mean `{near[0]}`?"
    return f", known are {', '.join(known)}" if known else ""


def _schema_at(schema: Mapping[str, Any], location: Sequence[int | str], root: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the JSON schema of a location in the document, or an empty one if it is ambiguous."""
    if "$ref" in schema:
        return _schema_at(root["$defs"][schema["$ref"].rsplit("/", 1)[-1]], location, root)
    if "anyOf" in schema:
        candidates = [part for part in schema["anyOf"] if part.get("type") != "null"]
        return _schema_at(candidates[0], location, root) if len(candidates) == 1 else {}
    if not location:
        return schema
    step, rest = location[0], location[1:]
    if isinstance(step, int):
        inside = schema.get("items")
    else:
        named = schema.get("properties", {}).get(step)
        inside = (
            named
            or schema.get("additionalProperties")
            or next(iter(schema.get("patternProperties", {}).values()), None)
        )
    return _schema_at(inside, rest, root) if isinstance(inside, Mapping) else {}


def _allowed(schema: Mapping[str, Any]) -> str:
    bounds = []
    for name, word in (
        ("exclusiveMinimum", "above"),
        ("minimum", "from"),
        ("exclusiveMaximum", "below"),
        ("maximum", "to"),
    ):
        if name in schema:
            bounds.append(f"{word} {schema[name]:g}")
    if "enum" in schema:
        return ", ".join(map(str, schema["enum"]))
    return " ".join(bounds)


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"
