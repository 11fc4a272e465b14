"""Folders of slices as series: |frame − idle frame| at torque peaks, one measurement each."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.errors import CalibrationError
from shearloop.errors import UserError
from shearloop.estimation import FrameSeries, Measured
from shearloop.estimation.series import check_finite_values
from shearloop.tools.frame_series import check_paths_differ, part_of
from shearloop.tools.recordings.matlab_import import (
    DIAMETER_FOLDER,
    TORQUE_FOLDER,
    Slices,
    read_diameter_slices,
    read_torque_slices,
)
from shearloop.words import counted

# Slices do not name their side.
SLICE_SIDE = "right"


@dataclass(frozen=True, slots=True, eq=False)
class SliceSeries(FrameSeries):
    """Slices in time order: channels hold |frame − idle frame| in volts, t_s their numbers or places in turn.

    torque_t_s is t_s. diameter_mm is NaN where a slice is not of a cylinder.
    """

    @property
    def tool_mm(self) -> Measured | None:
        """None: slices have no common diameter, because slices of cylinders have one each."""
        return None

    @property
    def differences(self) -> FloatArray:
        """The slices (n, c) of one fingertip in volts."""
        return self.channels[:, 0]


def read_slices(folder: Path) -> list[SliceSeries]:
    """Return the series of a folder of slices, or of a folder with torque_slices and diameter_slices.

    Raises UserError for anything else.
    """
    inside = [folder / name for name in (TORQUE_FOLDER, DIAMETER_FOLDER) if (folder / name).is_dir()]
    if inside:
        return [series for subfolder in inside for series in read_slices(subfolder)]
    names = [path.name for path in folder.iterdir()]
    if any(name.startswith("Data_Slice_") for name in names):
        return [_series_of(read_torque_slices(folder))]
    if any("mm_Data_" in name for name in names):
        return [_series_of(read_diameter_slices(folder))]
    raise UserError(
        f"{folder} is a folder without slices; name a recording (.mcap, from `shearloop run --record` or "
        "`shearloop recording import`), or a folder of slices"
    )


def _series_of(slices: Slices) -> SliceSeries:
    """Return slices in time order; slices of cylinders in turn, so that every part in time has all cylinders."""
    diameter_mm, t_s = slices.diameter_mm, slices.numbers.astype(np.float64)
    order = np.arange(len(t_s))
    if np.isfinite(diameter_mm).all():
        numbers = np.concatenate([np.arange(count) for count in np.unique(diameter_mm, return_counts=True)[1]])
        order, t_s = np.lexsort((diameter_mm, numbers)), np.arange(len(t_s), dtype=np.float64)
    frames, torque_nm = slices.differences[order, None], slices.torque_nm[order]
    return SliceSeries((SLICE_SIDE,), t_s, frames, t_s, torque_nm, diameter_mm[order])


def read_parts(folders: Sequence[Path], time_range: tuple[float, float]) -> tuple[list[Path], list[SliceSeries]]:
    """Return these fractions (0 to 1) of the series of folders, and the folder of each.

    Raises UserError for a folder that is given twice, and for copies of a slice.
    """
    check_paths_differ(folders)
    named = [(folder, part_of(series, *time_range)) for folder in folders for series in read_slices(folder)]
    check_no_copies(named)
    return [folder for folder, _ in named], [series for _, series in named]


def check_no_copies(named: Sequence[tuple[Path, SliceSeries]]) -> None:
    """Raise UserError for two slices that are the same frame.

    A copy is no second measurement: intervals fitted to it are too narrow, and figures count frames twice.
    """
    known: dict[bytes, str] = {}
    copies = []
    for name, frame in (measurement for folder, series in named for measurement in _measurements(folder, series)):
        first = known.setdefault(hashlib.sha256(np.ascontiguousarray(frame).data).digest(), name)
        if first is not name:
            copies.append((name, first))
    if copies:
        name, first = copies[0]
        others = counted(len(copies) - 1, "more is such a copy", "more are such copies")
        more = f", and {others}" if len(copies) > 1 else ""
        raise UserError(f"{name} equals {first}{more}; leave one of the two out")


def _measurements(folder: Path, series: SliceSeries) -> Iterator[tuple[str, FloatArray]]:
    """Yield each slice with its name."""
    for i, (number, frame, diameter) in enumerate(zip(series.t_s, series.channels, series.diameter_mm, strict=True)):
        if np.isfinite(diameter):
            # The times of cylinders in turn are not their numbers.
            nth = np.count_nonzero(series.diameter_mm[: i + 1] == diameter)
            yield f"{folder}: slice {nth} of {diameter:g} mm", frame
        else:
            yield f"{folder}: Data_Slice_{number:g}.mat", frame


def check_slices(recordings: Sequence[SliceSeries]) -> str:
    """Return the fingertip of all slices; raises CalibrationError for slices that do not belong together."""
    if not recordings:
        raise CalibrationError("there is no recording to calibrate on")
    # A slice without a torque may be of a cylinder.
    check_finite_values([(recording.t_s, recording.channels) for recording in recordings])
    if len({recording.table for recording in recordings}) > 1:
        raise CalibrationError("the recordings are of different kinds of fingertips; make a calibration of each")
    sides = tuple(side for side in recordings[0].sides if all(side in recording.sides for recording in recordings))
    if len(sides) != 1:
        raise CalibrationError(
            f"slices of {len(sides)} fingertips ({', '.join(sides)}) do not fit into one calibration; make one for each"
        )
    return sides[0]


def torques_of(series: SliceSeries) -> FloatArray:
    """Return the (n,) torques, NaN where a slice is of a cylinder: twisted at one torque each, it determines none."""
    return np.where(np.isfinite(series.diameter_mm), np.nan, series.torque_at_frames())
