"""Loads outside data into pydantic models; `mistakes.py` describes what does not fit."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

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
