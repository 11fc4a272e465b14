"""The values that a report of a commissioning supplies to the daemon, within the ranges that its stages can measure."""

import re
from collections.abc import Mapping
from typing import Annotated, Final

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from shearloop.drivers import ranges
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.models import COUNTS_MAX, LARGEST_STROKE_MM, ModelName
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.drivers.ur.settings import LONGEST_REACTION_S, RestSpeed
from shearloop.errors import UserError

# A report raises the wrist's speed to this at most.
FASTEST_RAD_PER_S: Final = 0.5

# A person can edit the file, and nothing else bounds these values.
_Delay = Annotated[float, Field(ge=0, le=LONGEST_REACTION_S)]
_Counts = Annotated[float, Field(ge=0, le=COUNTS_MAX)]
_Width = Annotated[float, Field(gt=0, le=LARGEST_STROKE_MM)]


def _valid_sha256(text: str) -> str:
    if text and re.fullmatch("[0-9a-f]{64}", text) is None:
        raise ValueError("this is no SHA-256 of 64 hexadecimal digits")
    return text


# Empty for a source whose settings have no hash.
_Sha256 = Annotated[str, AfterValidator(_valid_sha256)]


class Record(BaseModel):
    """A part of a report."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Supplied(Record):
    """Values that the daemon takes from a stage; a key that is absent was not measured."""

    # Stage 4 tries no faster stop.
    wrist_speed_rad_per_s: Annotated[float, Field(ge=0, le=FASTEST_RAD_PER_S)] | None = None
    torque_nm: ranges.TorqueLimit | None = None
    torque_sources: Mapping[str, _Sha256] | None = None
    """Sources with the right sign and scale up to `torque_nm`, beside the load cell; each with its `source_sha256`."""
    rest_rad_per_s: RestSpeed | None = None
    actuation_s: _Delay | None = None
    reaction_s: _Delay | None = None
    stop_rad: Annotated[float, Field(ge=0, le=ranges.LARGEST_MARGIN_RAD)] | None = None
    widths: tuple[tuple[_Counts, _Width], ...] | None = None
    """Pairs of counts and mm."""


NOTHING_SUPPLIED: Final = Supplied()


def measured_widths(found: Supplied, model: ModelName) -> WidthCalibration | None:
    """Return the gripper's calibration by a report's table, or None without one."""
    if found.widths is None:
        return None
    # Most rigs have a calibration of their own, or no table.
    from shearloop.drivers.robotiq.width_fit import fit_width

    try:
        return fit_width(found.widths, model)
    except DriverError as error:
        raise UserError(f"the report's table of widths: {error}") from error
