"""Arguments that the commands on recordings share."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.schema import SIDES

if TYPE_CHECKING:
    from shearloop.bank.estimation import Calibration, FrameSeries


def parsed_time_range(text: str) -> tuple[float, float]:
    """Return the shares of FROM:TO; UserError for anything that is not 0 ≤ FROM < TO ≤ 1."""
    try:
        start, stop = (float(share) for share in text.split(":"))
    except ValueError as error:
        raise UserError(f"--time-range must be two shares such as 0.5:1, not {text!r}") from error
    if not 0 <= start < stop <= 1:
        raise UserError(f"--time-range must rise from 0 or more to 1 or less, not {text!r}")
    return start, stop


def parsed_sides(text: str | None) -> tuple[str, ...] | None:
    """Return the sides of SIDE[,SIDE], None for none given; UserError for an unknown one."""
    if text is None:
        return None
    sides = tuple(text.split(","))
    if not set(sides) <= set(SIDES) or len(set(sides)) < len(sides):
        raise UserError(f"--sides must be {' or '.join(SIDES)}, or both with a comma between, not {text!r}")
    return sides


def check_kind(path: Path, calibration: "Calibration", series: "Sequence[FrameSeries]") -> None:
    """Raise UserError for a calibration of slices before raw frames, or of raw frames before slices."""
    kinds = {"raw": "raw frames", "difference": "slices"}
    other = next((one.kind for one in series if one.kind != calibration.kind), None)
    if other is not None:
        raise UserError(
            f"{path} was made from {kinds[calibration.kind]}, and cannot judge {kinds[other]}; "
            "calibrate on recordings of the same kind"
        )
