"""The base of configuration models, and the loader of their files."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator, model_validator

from shearloop.errors import UserError
from shearloop.files import expanded_path
from shearloop.models import booleans_as_text
from shearloop.yaml_files import Document

# No length of a tool, a grip or a lever is smaller.
MIN_MM = 0.1


class ConfigModel(BaseModel):
    """Base of the configuration models: unknown keys are mistakes, values do not change.

    Relative paths are taken from the folder of the file; `~` and variables in paths are expanded. `what` names the file
    in errors.
    """

    what: ClassVar[str] = "configuration"

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _booleans_are_no_numbers(cls, content: Any) -> Any:
        return booleans_as_text(content, {key: field.annotation for key, field in cls.model_fields.items()})

    @field_validator("*")
    @classmethod
    def _check(cls, value: object, info: ValidationInfo) -> object:
        if str(info.field_name).endswith("_mm") and isinstance(value, float) and 0 < abs(value) < MIN_MM:
            raise ValueError(f"{value:g} is too small for mm; did you mean {1000 * value:g}, the thousandfold?")
        if isinstance(value, Path) and (value == Path() or "\0" in str(value)):
            raise ValueError(f"must be the path of a file, not {str(value)!r}")
        # Without a file, the paths belong to the computer that wrote them, such as a recording's.
        if not info.context:
            return value
        if isinstance(value, tuple):
            return tuple(_located(one, info.context["folder"]) for one in value)
        return _located(value, info.context["folder"])

    def walk(self, key: str = "") -> Iterator[tuple[str, object]]:
        """Yield every value and section within this section, with its key in the file."""
        for name, value in self:
            own = f"{key}.{name}".lstrip(".")
            inner = {f"{own}.{part}": item for part, item in value.items()} if isinstance(value, dict) else {own: value}
            for path, item in inner.items():
                yield path, item
                if isinstance(item, ConfigModel):
                    yield from item.walk(path)


def _located(value: object, folder: Path) -> object:
    """Return a path from a file in `folder` as an absolute one, and any other value as it is."""
    if not isinstance(value, Path):
        return value
    # Normalised, not resolved: a port's link must stay a link.
    return Path(os.path.normpath(folder / expanded_path(value)))


Model = TypeVar("Model", bound=ConfigModel)


class FileKind(NamedTuple):
    """A kind of file: its name, its proper use, and the keys by which it is recognised."""

    what: str
    cure: str
    keys: tuple[str, ...]


# Files that a configuration names, or that another command takes.
NAMED_FILES = (
    FileKind("the robot's settings", "name this file in a configuration as `robot`", ("host",)),
    FileKind("a fingertip's description", "name it in a bank's as `fingertip`", ("electrodes",)),
    FileKind("a bank's description", "`shearloop bank build --config FILE` takes it", ("sigma",)),
    FileKind("a skin's calibration", "name it in a configuration as `skin.calibration`", ("gauge_angle_deg",)),
    FileKind(
        "a load cell's calibration", "name it in a configuration as `load_cell.calibration`", ("scale_n_per_count",)
    ),
    FileKind("a gripper's calibration", "name it in a configuration as `gripper.calibration`", ("open_counts",)),
    FileKind("a commissioning report", "name it in a configuration as `commissioned`", ("stages",)),
)


def not_of_kind(*others: FileKind) -> Any:
    """Return a model's validator: content with a key of one of these kinds is of that kind."""

    def check(content: object) -> object:
        if not isinstance(content, dict):
            return content
        for one in others:
            if not content.keys().isdisjoint(one.keys):
                raise ValueError(f"this is {one.what}; {one.cure}")
        return content

    return model_validator(mode="before")(check)


def either(one: str, other: str) -> Any:
    """Return a model's validator: exactly one of two keys must be given."""

    def check(section: Model) -> Model:
        if (getattr(section, one) is None) == (getattr(section, other) is None):
            raise ValueError(f"give either {one} or {other}, with a value, and not both")
        return section

    return model_validator(mode="after")(check)


def load_yaml_model(path: str | Path, model: type[Model], values: Mapping[str, str] | None = None) -> Model:
    """Return a YAML file's content as a pydantic model; raises UserError with every mistake.

    `values` replace some of the content: YAML by its keys, such as `loop.kp`.
    """
    document = Document.read(Path(path), UserError, model.what, model=model)
    return (document.with_values(values) if values else document).model(model)
