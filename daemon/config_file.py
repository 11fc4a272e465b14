"""Loads a YAML file into a pydantic model and reports every mistake with its key and allowed range."""

import os
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator
from pydantic_core import ErrorDetails

from shearloop.daemon.errors import UserError
from shearloop.drivers.errors import DriverError
from shearloop.drivers.yaml_files import read_yaml

_LONGEST_VALUE = 60


class ConfigModel(BaseModel):
    """Base of the configuration models: unknown keys are mistakes, values do not change.

    Relative paths are taken from the folder of the file.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _resolve_path(cls, value: object, info: ValidationInfo) -> object:
        if not isinstance(value, Path):
            return value
        if value == Path() or "\0" in str(value):
            raise ValueError(f"must be the path of a file, not {str(value)!r}")
        # Normalised, not resolved: a port's link must stay a link.
        return Path(os.path.normpath(info.context["folder"] / value)) if info.context else value


Model = TypeVar("Model", bound=BaseModel)


def load_yaml_model(path: str | Path, model: type[Model]) -> Model:
    """Return a YAML file's content as a pydantic model.

    Raises UserError for a file that is missing, no YAML map of keys, or has a key twice; and for invalid values, with
    all of them.
    """
    path = Path(path)
    try:
        content = read_yaml(path)
    except DriverError as error:
        raise UserError(str(error)) from error
    if not isinstance(content, dict):
        raise UserError(f"{path}: expected keys and values such as `{_example(model)}`, found {_shown(content)}")
    try:
        return model.model_validate(content, context={"folder": path.resolve().parent})
    except ValidationError as error:
        raise UserError(f"{path}: {mistakes(error, model)}") from error


def mistakes(error: ValidationError, model: type[BaseModel]) -> str:
    """Return a sentence with every mistake: its key, the value and the allowed range."""
    schema = model.model_json_schema()
    return "; ".join(dict.fromkeys(_sentence(details, schema) for details in error.errors(include_url=False)))


def _sentence(details: ErrorDetails, schema: Mapping[str, Any]) -> str:
    location = details["loc"]
    if details["type"] == "invalid_key":
        return f"the key {_shown(details['input'])} is a number; a name is expected"
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    subject = f"`{key}` " if key else ""
    if details["type"] == "extra_forbidden":
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


def _example(model: type[BaseModel]) -> str:
    return f"{next(iter(model.model_fields), 'key')}: …"


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"
