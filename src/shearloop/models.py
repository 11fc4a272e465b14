"""Loads outside data into pydantic models; `mistakes.py` describes what does not fit."""

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import TypeAdapter, ValidationError

Model = TypeVar("Model")

# Making an adapter takes longer than reading a file.
_adapter_of: Callable[[type], TypeAdapter[Any]] = cache(TypeAdapter)


def validated(content: object, model: type[Model], where: str, raises: type[Exception], *, cure: str = "") -> Model:
    """Return the content as a model; each line of the message begins with `where`, and the last ends with `cure`."""
    try:
        return as_model(content, model)
    except ValidationError as error:
        # Only a mistake needs the module.
        from shearloop.mistakes import mistake_lines

        raise raises("\n".join(mistake_lines(error, model, content, where)) + cure) from error


def as_model(content: object, model: type[Model], folder: Path | None = None) -> Model:
    """Return the content as a model; raises ValidationError. Its validators get the `folder`."""
    adapter: TypeAdapter[Model] = _adapter_of(model)
    return adapter.validate_python(content, context=folder and {"folder": folder})


def booleans_as_text(content: object, types: Mapping[str, Any]) -> object:
    """Return a section's content with each true or false as text where its key's type is a number.

    Pydantic takes true for 1, which may be within the bounds. It takes the text `true` for no number.
    """
    if not isinstance(content, Mapping):
        return content
    return {key: _as_text(value) if _is_number(types.get(key)) else value for key, value in content.items()}


def _is_number(annotation: Any) -> bool:
    """Return whether a value may hold a number, also in a list or as an alternative, and no boolean."""
    return (_holds(annotation, int) or _holds(annotation, float)) and not _holds(annotation, bool)


def _holds(annotation: Any, kind: type) -> bool:
    return annotation is kind or any(_holds(one, kind) for one in get_args(annotation))


def _as_text(value: object) -> object:
    """Return a boolean, or each one in a list, as text."""
    if isinstance(value, list):
        return [_as_text(one) for one in value]
    return str(value).lower() if isinstance(value, bool) else value
