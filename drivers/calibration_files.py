"""The devices' calibration files."""

from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from shearloop.drivers.errors import DeviceCalibrationError
from shearloop.yaml_files import load_model, save_yaml

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class CalibrationModel(BaseModel):
    """Base class of calibrations: frozen, unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


ModelT = TypeVar("ModelT", bound=CalibrationModel)


def load_device_calibration(path: Path, model: type[ModelT]) -> ModelT:
    """Return the calibration in a file; DeviceCalibrationError names the file and every wrong key."""
    return load_model(path, model, DeviceCalibrationError, "calibration", "; make it with `shearloop calibrate`")


def save_calibration(path: Path, calibration: CalibrationModel) -> None:
    """Write the calibration; DeviceCalibrationError names a file that cannot be written."""
    save_yaml(path, calibration.model_dump(mode="json"), DeviceCalibrationError, "calibration")
