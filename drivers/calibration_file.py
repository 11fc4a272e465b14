"""Calibration files: YAML with units in the keys, checked on the way in, replaced whole on the way out."""

from pathlib import Path
from typing import Annotated, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shearloop.drivers.errors import DriverError
from shearloop.files import replace_file

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class CalibrationError(DriverError):
    """A calibration that cannot be used, or measurements from which none can be made; the message says why."""


class CalibrationModel(BaseModel):
    """What every calibration has in common: unknown keys are refused, values do not change once read."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


ModelT = TypeVar("ModelT", bound=CalibrationModel)


def load_calibration(path: Path, model: type[ModelT]) -> ModelT:
    """Return the calibration in the file; CalibrationError names the file and every key that is wrong in it."""
    try:
        content = yaml.safe_load(path.read_text("utf-8"))
    except OSError as error:
        raise CalibrationError(
            f"{path}: cannot be read ({error.strerror}); make it with `shearloop calibrate`"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: is not YAML ({' '.join(str(error).split())})") from error
    try:
        return model.model_validate(content)
    except ValidationError as error:
        mistakes = "; ".join(f"{'.'.join(map(str, e['loc'])) or 'the file'}: {e['msg']}" for e in error.errors())
        raise CalibrationError(f"{path}: {mistakes}") from error


def save_calibration(path: Path, calibration: CalibrationModel) -> None:
    """Write the calibration; a reader sees the old file or the new one, never half of one."""
    text = yaml.safe_dump(calibration.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    try:
        with replace_file(path) as file:
            file.write(text.encode())
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be written ({error.strerror})") from error
