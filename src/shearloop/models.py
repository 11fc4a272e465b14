"""Loads outside data into pydantic models; `mistakes.py` describes what does not fit."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

Model = TypeVar("Model")

_LONGEST_VALUE = 60

# Making an adapter takes longer than reading a file.
adapter_of: Callable[[type], TypeAdapter[Any]] = cache(TypeAdapter)


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
    adapter: TypeAdapter[Model] = adapter_of(model)
    return adapter.validate_python(content, context=folder and {"folder": folder})


def shown(value: object) -> str:
    """Return a value of a file for a message, at most 60 characters."""
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"
