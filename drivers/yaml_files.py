"""YAML files: read with unique keys, validated as calibrations, and replaced atomically when written."""

from collections.abc import Hashable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shearloop.drivers.errors import DeviceCalibrationError, DriverError
from shearloop.files import replace_file

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _UniqueKeyLoader(yaml.SafeLoader):
    """A SafeLoader that refuses duplicate keys, where YAML would silently keep the last."""

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


def read_yaml(path: Path) -> Any:
    """Return the content of a YAML file; DriverError, with file and line, if it is missing, empty or not YAML."""
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), _UniqueKeyLoader)  # noqa: S506 - it is a SafeLoader
    except OSError as error:
        raise DriverError(f"{path}: the configuration cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DriverError(f"{path}: the configuration is not UTF-8 text (byte {error.start})") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise DriverError(f"{path}: {where}{error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise DriverError(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
    except RecursionError as error:
        raise DriverError(f"{path}: the configuration is nested too deeply") from error
    if content is None:
        raise DriverError(f"{path}: the configuration is empty")
    return content


class CalibrationModel(BaseModel):
    """Base class of calibrations: frozen, unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


ModelT = TypeVar("ModelT", bound=CalibrationModel)


def load_calibration(path: Path, model: type[ModelT]) -> ModelT:
    """Return the calibration in a file; DeviceCalibrationError names the file and every wrong key."""
    try:
        content = yaml.safe_load(path.read_text("utf-8"))
    except OSError as error:
        raise DeviceCalibrationError(
            f"{path}: cannot be read ({error.strerror}); make it with `shearloop calibrate`"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise DeviceCalibrationError(f"{path}: is not YAML ({' '.join(str(error).split())})") from error
    try:
        return model.model_validate(content)
    except ValidationError as error:
        mistakes = "; ".join(f"{'.'.join(map(str, e['loc'])) or 'the file'}: {e['msg']}" for e in error.errors())
        raise DeviceCalibrationError(f"{path}: {mistakes}") from error


def save_calibration(path: Path, calibration: CalibrationModel) -> None:
    """Write the calibration atomically: a reader sees the old file or the new one."""
    text = yaml.safe_dump(calibration.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    try:
        with replace_file(path) as file:
            file.write(text.encode())
    except OSError as error:
        raise DeviceCalibrationError(f"{path}: cannot be written ({error.strerror})") from error
