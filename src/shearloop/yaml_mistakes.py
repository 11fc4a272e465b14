"""Explains the syntax errors of YAML files, and proposes the file that was probably meant."""

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from shearloop.files import read_file
from shearloop.mistakes import keys_of
from shearloop.yaml_loader import MAX_BYTES, parse_yaml

_SUFFIXES = (".yaml", ".yml")
# The number of files with near names that are read, to find which may be meant.
_LOOKED_AT = 5
# The library's words for frequent mistakes, and ours.
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


def syntax(error: yaml.MarkedYAMLError) -> str:
    """Return the syntax error of a text in words."""
    problem = str(error.problem or error.context)
    return next((words for begin, words in _SYNTAX if problem.startswith(begin)), problem)


def meant(path: Path, model: type[Any] | None) -> str:
    """Return which YAML file was probably meant by the path of a folder, or of no file; empty where none is near.

    A path in a file counts from this file's folder. Where it was written as the shell has it, the folder stands twice
    in it, and the file of this name is above.
    """
    folder = path if path.is_dir() else path.parent
    try:
        names = sorted(one.name for one in folder.iterdir() if one.suffix in _SUFFIXES)
    except OSError:
        names = []
    if folder is path:
        # A folder of `init` has its configuration under this name.
        near = ["rig.yaml"] if "rig.yaml" in names else names
    else:
        near = get_close_matches(path.name, [name for name in names if name != path.name], _LOOKED_AT)
    found = [folder / name for name in near[:_LOOKED_AT]]
    if folder is not path:
        found += [above for parent in folder.parents if (above := parent / path.name).is_file()]
    found = [one for one in found if model is None or _may_be(one, model)]
    return f"; did you mean {found[0]}?" if found else ""


def _may_be(path: Path, model: type[Any]) -> bool:
    """Return whether a file may be meant for a model: most of its keys are the model's, or it cannot be known."""
    try:
        content = parse_yaml(read_file(path, MAX_BYTES))
    except OSError:
        return False
    except (yaml.YAMLError, ValueError, RecursionError):
        return True
    if content is None:
        return True
    return isinstance(content, dict) and 2 * sum(key in keys_of(model) for key in content) >= len(content)
