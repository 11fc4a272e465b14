"""Overrides values of a YAML file, as `--set loop.kp=2` does."""

import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from shearloop.models import as_model
from shearloop.yaml_loader import Loader
from shearloop.yaml_mistakes import syntax

Place = tuple[int | str, ...]
# Makes the exception for a mistake out of its sentence.
Wrong = Callable[[str], Exception]


def with_values(
    content: Any, values: Mapping[str, str], path: Path, raises: type[Exception]
) -> tuple[Any, dict[Place, str]]:
    """Return the content with other values, given as YAML by their keys, such as `loop.kp` or `steps.0`.

    Sections that are missing are made. The second part has each number, true or false as it was written.
    """
    content, given = copy.deepcopy(content), {}
    for key, text in values.items():
        try:
            value = yaml.load(text, Loader)  # noqa: S506 - it is a SafeLoader
        except yaml.YAMLError as error:
            raise raises(f"{key}={text}: the value is not YAML: {syntax(error, text)}") from error
        _replace(content, key, value, lambda sentence: raises(f"{path}: {sentence}"))
        if isinstance(value, bool | int | float):
            given[tuple(int(part) if part.isdecimal() else part for part in key.split("."))] = text.strip()
    return content, given


def with_texts_as_written(content: Any, given: Mapping[Place, str], model: type[Any], folder: Path) -> Any:
    """Return the content with each overridden value as it was written, where the model expects a text.

    A shell takes the quotes of a text away. `given` has the values as they were written, by their places.
    """
    left = dict(given)
    while left:
        try:
            as_model(content, model, folder)
        except ValidationError as error:
            places = [one["loc"] for one in error.errors() if one["type"] in ("string_type", "path_type")]
        else:
            break
        texts = {place: left.pop(place) for place in places if place in left}
        if not texts:
            break
        content = copy.deepcopy(content)
        for place, text in texts.items():
            section = content
            for part in place[:-1]:
                section = section[part]
            section[place[-1]] = text
    return content


def _replace(content: Any, key: str, value: object, wrong: Wrong) -> None:
    """Put a value into the content; a key that leads to no section is wrong."""
    *sections, last = key.split(".")
    section = content
    for number, name in enumerate(sections):
        section = _section(section, name, ".".join(sections[:number]), wrong)
    if isinstance(section, list):
        section[_index(section, last, ".".join(sections), wrong)] = value
    elif isinstance(section, dict):
        section[last] = value
    else:
        raise wrong(f"{'.'.join(sections)} is a value, so it has no {last}")


def _section(section: Any, name: str, key: str, wrong: Wrong) -> Any:
    if isinstance(section, list):
        return section[_index(section, name, key, wrong)]
    if not isinstance(section, dict):
        raise wrong(f"{key} is a value, so it has no {name}")
    if section.get(name) is None:
        section[name] = {}
    return section[name]


def _index(section: list[Any], name: str, key: str, wrong: Wrong) -> int:
    if not (name.isdecimal() and int(name) < len(section)):
        raise wrong(f"{key} is a list of {len(section)}, so {name} is not one of its numbers")
    return int(name)
