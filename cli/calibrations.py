"""Options and checks of the commands that make a calibration, or judge or change one."""

import argparse
import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.options import TOOL_MM, add_option, number
from shearloop.errors import UserError
from shearloop.estimation.estimator_names import DEFAULT, ESTIMATORS

if TYPE_CHECKING:
    from shearloop.drivers.calibration_files import CalibrationModel
    from shearloop.estimation import Calibration, FrameSeries

# A larger delay belongs to another recording.
DELAY_S = number(-600.0, 600.0)


def time_range(text: str) -> tuple[float, float]:
    """Return the fractions of FROM:TO, as the type of an option."""
    with contextlib.suppress(ValueError):
        start, stop = map(float, text.split(":"))
        if 0 <= start < stop <= 1:
            return start, stop
    raise argparse.ArgumentTypeError(
        f"{text} is not two fractions that rise from 0 or more to 1 or less, such as 0.5:1"
    )


def add_recipe(parser: argparse._ActionsContainer) -> None:
    """Add the options that say how a calibration is made, except `--bank`; `check_recipe` checks them."""
    text = "estimator to calibrate (default: %(default)s)"
    parser.add_argument("--estimator", choices=ESTIMATORS, default=DEFAULT, help=text)
    add_option(parser, "--mesh", Path, "FILE", "a mesh, which the estimator reconstruction needs")
    add_option(parser, "--sides", _sides, "SIDE[,SIDE]", "for recordings: sides to use, e.g. right (default: all)")
    text = "for recordings: delay of the load cell's timestamps, which is subtracted; 0 accepts them unchecked"
    add_option(parser, "--load-cell-delay-s", DELAY_S, "S", text)
    text = "for slices: no torque will exceed the calibrated range, and intervals do not extend beyond it"
    parser.add_argument("--assume-full-range", action="store_true", help=text)
    text = "diameter of the tool in recordings that do not name it; on another tool there is no torque"
    add_option(parser, "--tool-mm", TOOL_MM, "MM", text)


def _sides(text: str) -> tuple[str, ...]:
    from shearloop.daemon.recorder.schema import SIDES

    sides = tuple(text.split(","))
    if not set(sides) <= set(SIDES) or len(set(sides)) < len(sides):
        raise argparse.ArgumentTypeError(f"{text} is not {' or '.join(SIDES)}, or both with a comma between")
    return sides


def check_recipe(args: argparse.Namespace, recordings: Sequence[Path]) -> None:
    """Raise UserError for an option that has no effect on these recordings or folders of slices."""
    folders = [path.is_dir() for path in recordings]
    if args.assume_full_range and not all(folders):
        raise UserError("--assume-full-range is for slices; leave it out for recordings")
    for option, given, why in (
        ("--load-cell-delay-s", args.load_cell_delay_s, "each slice holds its torque itself"),
        ("--tool-mm", args.tool_mm, "a calibration of slices knows no tool"),
        ("--sides", args.sides, "slices do not name their side"),
    ):
        if given is not None and any(folders):
            raise UserError(f"{option} is for recordings: {why}; leave it out")


def save_measured(out: Path, calibration: "CalibrationModel") -> None:
    """Write a calibration that a person has measured; a note of a DeviceCalibrationError has its content."""
    import yaml

    from shearloop.drivers.calibration_files import save_calibration
    from shearloop.drivers.errors import DeviceCalibrationError

    try:
        save_calibration(out, calibration)
    except DeviceCalibrationError as error:
        content = yaml.safe_dump(calibration.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
        error.add_note(f"Write these measured values into a file yourself:\n{content.strip()}")
        raise


def load_calibration(path: Path) -> "Calibration":
    """Return the calibration in a file; raises UserError for a recording, and CalibrationError as `load` does."""
    from shearloop.estimation import Calibration

    _check_no_recording(path)
    return Calibration.load(path)


def _check_no_recording(path: Path) -> None:
    if ".mcap" in path.suffixes or path.is_dir():
        raise UserError(f"{path} is a recording, not a calibration; the calibration comes first, then recordings")


def of_slices(recordings: "Sequence[Path]") -> bool:
    """Return whether these are folders of slices; raises UserError for folders among recordings."""
    folders = [path.is_dir() for path in recordings]
    if any(folders) and not all(folders):
        raise UserError("raw frames and slices of differences do not fit into one calibration; make two")
    return any(folders)


def judges_slices(path: Path, recordings: "Sequence[Path]") -> bool:
    """Return whether a file is a calibration of slices.

    Raises UserError if the recordings are not of the same kind, and CalibrationError if the file is no calibration.
    """
    from shearloop.estimation.archive import kind_of
    from shearloop.studies.slices.calibration import KIND

    _check_no_recording(path)
    is_slices = kind_of(path) == KIND
    if any(recording.is_dir() != is_slices for recording in recordings):
        made, other = ("slices", "raw frames") if is_slices else ("raw frames", "slices")
        raise UserError(
            f"{path} was made from {made}, and cannot judge {other}; calibrate on recordings of the same kind"
        )
    return is_slices


def read_judged(path: Path, recordings: "Sequence[Path]") -> "tuple[Calibration, list[tuple[Path, FrameSeries]]]":
    """Return a calibration, and the series of the recordings, each with its path, that it is to judge.

    Raises UserError for a recording that is given twice.
    """
    from shearloop.tools.frame_series import check_paths_differ, read_series

    check_paths_differ(recordings)
    calibration = load_calibration(path)
    return calibration, [
        (recording, series) for recording in recordings for series in read_series(recording, calibration.sides)
    ]
