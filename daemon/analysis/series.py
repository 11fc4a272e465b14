"""From recordings and folders of slices to the series of frames that estimators are made from and judged by."""

from pathlib import Path

import numpy as np

from shearloop.bank.arrays import IntArray
from shearloop.bank.eit.channels import channels_of_line
from shearloop.bank.estimation.values import FrameSeries
from shearloop.daemon.analysis.tools import tool_of
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.matlab_streams import read_diameter_slices, read_torque_slices
from shearloop.daemon.recording.reader import Recording, read_recording
from shearloop.daemon.recording.schema import SIDES

# The side that slices are said to be of: they do not tell.
SLICE_SIDE = "right"
# Frames of two sides further apart than this share of the period do not make a pair.
_LARGEST_APART = 0.75
_TORQUE_FOLDER, _DIAMETER_FOLDER = "torque_slices", "diameter_slices"


def read_series(path: Path, sides: tuple[str, ...] | None = None, tool_mm: float | None = None) -> list[FrameSeries]:
    """Return the series of a recording, of a folder of slices, or of a folder with torque_slices and diameter_slices.

    `sides` chooses the sides of a recording, by default all that are there; `tool_mm` is the diameter of its tool,
    unless it names it itself. Raises UserError for what is neither.
    """
    if not path.is_dir():
        return [series_of(read_recording(path), sides, tool_mm)]
    inside = [path / name for name in (_TORQUE_FOLDER, _DIAMETER_FOLDER) if (path / name).is_dir()]
    if inside:
        return [series for folder in inside for series in read_series(folder)]
    names = [one.name for one in path.iterdir()]
    if any(name.startswith("Data_Slice_") for name in names):
        return [_torque_slices(path)]
    if any("mm_Data_" in name for name in names):
        return [_diameter_slices(path)]
    raise UserError(
        f"{path} is a folder without slices; name a recording (.mcap, of `shearloop run --record` or of `shearloop "
        "import`), or a folder of slices"
    )


def series_of(recording: Recording, sides: tuple[str, ...] | None = None, tool_mm: float | None = None) -> FrameSeries:
    """Return a recording's frames, those of two sides paired by time; times are in seconds since its first frame."""
    wanted = sides or tuple(side for side in SIDES if side in recording.sides) or tuple(recording.sides)
    missing = [side for side in wanted if side not in recording.sides]
    if wanted and not set(wanted) <= {*SIDES, *recording.sides}:
        # No file that could be imported has any of these.
        raise UserError(
            f"{recording.path} has frames of {' and '.join(recording.sides) or 'no side'}, not of "
            f"{' and '.join(missing)}; name a side that it has"
        )
    if missing or not wanted:
        raise UserError(
            f"{recording.path} has frames of {' and '.join(recording.sides) or 'no side'}, not of "
            f"{' and '.join(missing) or 'any'}; import those files as well"
        )
    first = recording.sides[wanted[0]]
    rows = [_nearest(first.t_mid_ns, recording.sides[side].t_mid_ns) for side in wanted]
    period_ns = float(np.median(np.diff(first.t_mid_ns))) if len(first.t_mid_ns) > 1 else 1.0
    times = np.array([recording.sides[side].t_mid_ns[row] for side, row in zip(wanted, rows, strict=True)])
    paired = np.ptp(times, axis=0) <= _LARGEST_APART * period_ns
    lines = [recording.sides[side].lines[row][paired] for side, row in zip(wanted, rows, strict=True)]
    start = int(first.t_mid_ns[0])
    t_s = (times[:, paired] - start).mean(axis=0) / 1e9
    diameter_mm, gripped_mm = tool_of(recording, first.t_mid_ns, tool_mm)
    return FrameSeries(
        "raw",
        wanted,
        t_s,
        np.stack([channels_of_line(one) for one in lines], axis=1),
        (recording.torque_t_ns - start) / 1e9,
        recording.torque_nm,
        np.full(len(t_s), diameter_mm),
        gripped_mm,
    )


def part_of(series: FrameSeries, start: float, stop: float) -> FrameSeries:
    """Return the frames between two shares (0 to 1) of a series, in time order; UserError where there are none."""
    n = len(series.t_s)
    first, end = round(start * n), round(stop * n)
    if first == end:
        raise UserError(f"of {n} frames none lies between the shares {start:g} and {stop:g}; use a longer part")
    return series.between(first, end)


def _nearest(wanted: IntArray, times: IntArray) -> IntArray:
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    if len(times) == 1:
        return np.zeros(len(wanted), dtype=np.int64)
    nearer = np.abs(times[after - 1] - wanted) <= np.abs(times[after] - wanted)
    return np.where(nearer, after - 1, after)


def _torque_slices(folder: Path) -> FrameSeries:
    slices = read_torque_slices(folder)
    t_s = slices.numbers.astype(np.float64)
    return FrameSeries(
        "difference",
        (SLICE_SIDE,),
        t_s,
        slices.differences[:, None],
        t_s,
        slices.torque_nm,
        np.full(len(t_s), np.nan),
    )


def _diameter_slices(folder: Path) -> FrameSeries:
    """Return the slices of all cylinders in turn: first of each its first, so that a part in time has them all."""
    slices = read_diameter_slices(folder)
    numbers = np.concatenate([np.arange(count) for count in np.unique(slices.diameter_mm, return_counts=True)[1]])
    order = np.lexsort((slices.diameter_mm, numbers))
    t_s = np.arange(len(order), dtype=np.float64)
    return FrameSeries(
        "difference",
        (SLICE_SIDE,),
        t_s,
        slices.differences[order][:, None],
        t_s,
        slices.torque_nm[order],
        slices.diameter_mm[order],
    )
