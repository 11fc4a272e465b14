"""The two files of a skin's calibration: the recorded table (CSV) that goes in, the YAML that comes out."""

import csv
import math
from pathlib import Path

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from shearloop.bank.eit.stored import replaced
from shearloop.bank.errors import CalibrationError
from shearloop.bank.skin.calibration import CalibrationTable, SkinCalibration

FORMAT = "shearloop skin calibration 1"
# A load cell at rest may read a little less than nothing; a skin cannot be pulled off its core.
MOST_PULL_N = 0.05
COLUMNS = ("r1_ohm", "r2_ohm", "shear_n", "normal_n")


def read_table(path: Path) -> CalibrationTable:
    """Return the rows of a CSV file with the columns r1_ohm, r2_ohm, shear_n, normal_n, in the order of recording.

    Raises CalibrationError naming the file, and the line and column that cannot be used.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if sorted(reader.fieldnames or ()) != sorted(COLUMNS):
                raise CalibrationError(
                    f"{path}: the first line is {','.join(reader.fieldnames or ())!r}; "
                    f"the columns must be {', '.join(COLUMNS)}."
                )
            rows = [_numbers(path, reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CalibrationError(f"{path}: the table cannot be read: {error}.") from error
    if not rows:
        raise CalibrationError(f"{path}: the table has no rows.")
    return CalibrationTable(*np.array(rows).T)


def _numbers(path: Path, line: int, row: dict[str | None, str]) -> list[float]:
    if None in row:
        raise CalibrationError(f"{path}, line {line}: there are more values than columns.")
    numbers = []
    for column in COLUMNS:
        try:
            number = float(row[column] or "")
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or (column.endswith("_ohm") and number <= 0):
            raise CalibrationError(f"{path}, line {line}: {column} is {row[column]!r}, not a usable number.")
        if column == "normal_n" and number < -MOST_PULL_N:
            raise CalibrationError(
                f"{path}, line {line}: normal_n is {row[column]}; a force that presses on the skin is positive."
            )
        numbers.append(number)
    return numbers


class _File(BaseModel):
    """What stands in a calibration file, and nothing else."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    format: str = Field(pattern=f"^{FORMAT}$")
    friction: float = Field(ge=0, le=1)
    gauge_angle_deg: float = Field(gt=0, lt=90)
    linear_to_n: float = Field(gt=0)
    tension_n: list[float] = Field(min_length=2)
    response: list[float] = Field(min_length=2)
    response_half_width: float = Field(ge=0)
    rows: int = Field(ge=1)
    rows_beyond: int = Field(ge=0)
    rest_ohm: list[float] = Field(min_length=2, max_length=2)


def save_calibration(calibration: SkinCalibration, path: Path) -> None:
    """Write a calibration as YAML over what was there, so that no half of it is ever read."""
    document = {
        "format": FORMAT,
        "friction": calibration.friction,
        "gauge_angle_deg": calibration.gauge_angle_deg,
        "linear_to_n": calibration.linear_to_n,
        "tension_n": list(calibration.tension_n),
        "response": list(calibration.response),
        "response_half_width": calibration.response_half_width,
        "rows": calibration.rows,
        "rows_beyond": calibration.rows_beyond,
        "rest_ohm": list(calibration.rest_ohm),
    }
    try:
        with replaced(path) as file:
            file.write(yaml.safe_dump(document, sort_keys=False).encode())
    except OSError as error:
        raise CalibrationError(f"{path}: the calibration cannot be written: {error}.") from error


def load_calibration(path: Path) -> SkinCalibration:
    """Return the calibration in a YAML file; raises CalibrationError naming the file and every key that is wrong."""
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        file = _File.model_validate(document)
        values = file.model_dump(exclude={"format"})
        lists = {name: tuple(values[name]) for name in ("tension_n", "response", "rest_ohm")}
        return SkinCalibration(**values | lists)
    except OSError as error:
        raise CalibrationError(
            f"{path}: the calibration cannot be read: {error.strerror}; make it with `shearloop skin calibrate`."
        ) from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise CalibrationError(f"{path}: the calibration cannot be read: {' '.join(str(error).split())}.") from error
    except ValidationError as error:
        if not (isinstance(document, dict) and "format" in document):
            raise CalibrationError(
                f"{path} is not a calibration as `shearloop skin calibrate` writes it: it has no `format: {FORMAT}`."
            ) from error
        wrong = "; ".join(f"{'.'.join(map(str, e['loc'])) or 'the file'}: {e['msg']}" for e in error.errors())
        raise CalibrationError(
            f"{path} is not a calibration as `shearloop skin calibrate` writes it: {wrong}."
        ) from error
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
