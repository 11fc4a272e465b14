"""YAML files: read with unique keys, checked by pydantic, and replaced at once when written.

Each caller names the exception to raise. Its message has a line for each mistake: `file:line: key: the mistake;
allowed: …; did you mean …?`. Modules that describe mistakes are imported where one occurs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import yaml
from pydantic import ValidationError

from shearloop.files import is_missing, is_possible, read_file, replace_file
from shearloop.models import Model, as_model
from shearloop.words import shown
from shearloop.yaml_loader import MAX_BYTES, Loader


@dataclass(frozen=True, slots=True)
class Document:
    """The content of one YAML file, with its lines; `raises` is the exception for each mistake."""

    path: Path
    content: Any
    raises: type[Exception]
    _root: yaml.Node | None
    # What `with_values` was given as a number or as true or false: as it was written, by its place in the content.
    _given: Mapping[tuple[int | str, ...], str] = field(default_factory=dict)

    @classmethod
    def read(
        cls,
        path: Path,
        raises: type[Exception],
        what: str = "configuration",
        cure: str = "",
        *,
        most_bytes: int = MAX_BYTES,
        model: type[Any] | None = None,
    ) -> Self:
        """Read a file that is neither missing nor empty; `cure` ends the message of a missing one.

        That message may name another file, one with the keys of `model`.
        """
        if not is_possible(path):
            raise raises(f"{shown(str(path))}: no {what} has such a name")
        try:
            data = read_file(path, most_bytes)
        except OSError as error:
            from shearloop.yaml_mistakes import meant

            ending = f"{meant(path, model)}{cure if is_missing(error) else ''}"
            raise raises(f"{path}: the {what} cannot be read: {error.strerror}{ending}") from error
        return cls.parse(path, data, raises, what)

    @classmethod
    def parse(cls, path: Path, data: bytes, raises: type[Exception], what: str = "configuration") -> Self:
        """Parse the bytes of a file, which is not read again."""
        try:
            loader = Loader(data.decode("utf-8"))
            root = loader.get_single_node()
            content = loader.construct_document(root) if root is not None else None
        except UnicodeDecodeError as error:
            from shearloop.binary_files import why_no_text

            raise raises(f"{path}{why_no_text(data, error.start, what)}") from error
        except yaml.YAMLError as error:
            from shearloop.yaml_mistakes import place_and_syntax

            raise raises(f"{path}{place_and_syntax(error, data.decode())}") from error
        except RecursionError as error:
            raise raises(f"{path}: the {what} is nested too deeply") from error
        if content is None:
            raise raises(f"{path}: the {what} is empty")
        return cls(path, content, raises, root)

    def model(self, model: type[Model]) -> Model:
        """Return the content as a pydantic model or dataclass; its validators get the file's `folder`."""
        if not isinstance(self.content, dict):
            from shearloop.mistakes import first_key

            raise self.raises(f"{self.path}: expected keys and values such as `{first_key(model)}: …`")
        content, folder = self.content, self.path.resolve().parent
        if self._given:
            from shearloop.yaml_overrides import with_texts_as_written

            content = with_texts_as_written(content, self._given, model, folder)
        try:
            return as_model(content, model, folder)
        except ValidationError as error:
            from shearloop.mistakes import mistake_lines

            lines = mistake_lines(error, model, content, str(self.path), self._root)
            raise self.raises("\n".join(lines)) from error

    def with_values(self, values: Mapping[str, str]) -> Self:
        """Return the document with other values, given as YAML by their keys, such as `loop.kp` or `steps.0`.

        Mistakes in the result are named without a line.
        """
        from shearloop.yaml_overrides import with_values

        content, given = with_values(self.content, values, self.path, self.raises)
        return type(self)(self.path, content, self.raises, None, {**self._given, **given})

    def located(self, mistakes: Sequence[tuple[tuple[int | str, ...], str]]) -> list[str]:
        """Return `file:line: key: sentence` for each mistake, given by its location in the content."""
        if not mistakes:
            return []
        from shearloop.mistakes import place_of

        found = []
        for location, sentence in mistakes:
            key, line = place_of(location, self.content, self._root, missing=True)
            found.append((line, f"{self.path}:{line}: {key}: {sentence}"))
        return [text for _, text in sorted(found)]


def read_yaml(path: Path, raises: type[Exception], what: str = "configuration", cure: str = "") -> Any:
    """Return the content of a YAML file that is neither missing nor empty; `cure` ends the message of a missing one."""
    return Document.read(path, raises, what, cure).content


def load_model(
    path: Path, model: type[Model], raises: type[Exception], what: str = "configuration", cure: str = ""
) -> Model:
    """Return a YAML file's content as a pydantic model or dataclass; its validators get the file's `folder`."""
    return Document.read(path, raises, what, cure, model=model).model(model)


def save_yaml(
    path: Path, content: Mapping[str, Any], raises: type[Exception], what: str, cure: str = "choose another path"
) -> None:
    """Write the content atomically: a reader sees the old file or the new one. `what` names the file in an error."""
    try:
        with replace_file(path) as file:
            file.write(yaml.safe_dump(content, sort_keys=False, allow_unicode=True).encode())
    except OSError as error:
        raise raises(f"{path}: the {what} cannot be written: {error.strerror}; {cure}") from error
