"""Reading the paper's recordings: MATLAB files of slices, raw lines and streams, as arrays with units.

A file that cannot be used is refused with one sentence that names it.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS, N_LINE_VALUES
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.matlab_file import MatFileError, NotAMatrix, Variable, read_variables

# The names that the recording scripts gave to the same thing over time.
_SIDES = {"right": ("Right_Data", "plotthis2", "plotthis_right"), "left": ("Left_Data", "plotthis1", "plotthis_left")}
_LOADS = ("Load_Data", "plotthis3", "plotthis_truth")
_LINES = ("clipped_data", "clipped_data_hom")
# MATLAB counts days from the year 0; this is its number for 1970-01-01.
_DATENUM_OF_UNIX_EPOCH = 719529
_SECONDS_PER_DAY = 86400.0
_TORQUE_SLICE = re.compile(r"Data_Slice_(\d+)\.mat")
_DIAMETER_SLICE = re.compile(r"(\d+(?:\.\d+)?)mm_Data_(\d+)\.mat")
_HDF5_SIGNATURE = b"\x89HDF"


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """One fingertip's lines: unix_s (n,) arrival times, lines (n, 1024) in volts.

    The recording computer's clock had no time zone in the file; it is read as UTC.
    """

    unix_s: FloatArray
    lines: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LoadStream:
    """The load cell's values: unix_s (n,) arrival times as in `Stream`, torque_nm (n,), glitches and all."""

    unix_s: FloatArray
    torque_nm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TorqueSlices:
    """Differences (n, 896) |frame − homogeneous frame| in volts at torque_nm (n,), in time order."""

    differences: FloatArray
    torque_nm: FloatArray
    numbers: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class DiameterSlices:
    """Differences (n, 896) in volts on cylinders of diameter_mm (n,) at torque_nm (n,), by rising diameter."""

    differences: FloatArray
    diameter_mm: FloatArray
    torque_nm: FloatArray


def contents(path: str | Path) -> tuple[str, ...]:
    """Return which of the streams "right", "left" and "load" a file holds.

    Raises UserError for a file that cannot be read or holds none of them.
    """
    path = Path(path)
    variables = _load(path)
    known = {**_SIDES, "load": _LOADS}
    found = tuple(what for what, names in known.items() if any(name in variables for name in names))
    if not found:
        wanted = ", ".join(name for names in known.values() for name in names)
        raise UserError(f"{path} holds {', '.join(variables) or 'no variable'}, expected one of {wanted}")
    return found


def read_stream(path: str | Path, side: str | None = None) -> Stream:
    """Return the lines of a fingertip's stream; `side` ("right" or "left") chooses where a file holds both.

    Raises UserError for a file that cannot be read or holds no such stream.
    """
    path = Path(path)
    variables = _load(path)
    sides = _SIDES if side is None else {side: _SIDES[side]}
    table = _one_of(path, variables, [name for names in sides.values() for name in names])
    unix_s, lines = _timed(path, table, N_LINE_VALUES)
    return Stream(unix_s, lines)


def read_load_stream(path: str | Path) -> LoadStream:
    """Return the load cell's stream; raises UserError for a file that cannot be read or holds none."""
    path = Path(path)
    unix_s, values = _timed(path, _one_of(path, _load(path), _LOADS), 1)
    return LoadStream(unix_s, values[:, 0])


def read_line(path: str | Path) -> FloatArray:
    """Return the (1024,) values in volts of a file with a single line; raises UserError as `read_stream` does."""
    path = Path(path)
    return _row(path, _one_of(path, _load(path), _LINES), N_LINE_VALUES)


def read_torque_slices(folder: str | Path) -> TorqueSlices:
    """Return the slices Data_Slice_N.mat of a folder by rising N, which need not begin at 1 nor be without gaps.

    Raises UserError for a folder without any, and for a file that cannot be used.
    """
    folder = Path(folder)
    files = sorted((int(found[1]), path) for path, found in _matching(folder, _TORQUE_SLICE))
    if not files:
        raise UserError(f"{folder} has no torque slices: expected files named Data_Slice_1.mat, Data_Slice_2.mat …")
    slices = [_slice(path, "torque_value") for _, path in files]
    return TorqueSlices(
        np.array([difference for difference, _ in slices]),
        np.array([torque for _, torque in slices]),
        np.array([number for number, _ in files]),
    )


def read_diameter_slices(folder: str | Path) -> DiameterSlices:
    """Return the slices DDmm_Data_N.mat of a folder by rising diameter, then N; raises as `read_torque_slices` does."""
    folder = Path(folder)
    files = sorted((float(found[1]), int(found[2]), path) for path, found in _matching(folder, _DIAMETER_SLICE))
    if not files:
        raise UserError(f"{folder} has no diameter slices: expected files named 10mm_Data_1.mat, 20mm_Data_1.mat …")
    slices = [_slice(path, "mean_torque") for *_, path in files]
    return DiameterSlices(
        np.array([difference for difference, _ in slices]),
        np.array([diameter for diameter, *_ in files]),
        np.array([torque for _, torque in slices]),
    )


def _matching(folder: Path, pattern: re.Pattern[str]) -> Iterator[tuple[Path, re.Match[str]]]:
    try:
        paths = list(folder.iterdir())
    except OSError as error:
        raise UserError(f"{folder}: the recordings cannot be listed: {error.strerror}") from error
    for path in paths:
        if found := pattern.fullmatch(path.name):
            yield path, found


def _slice(path: Path, torque_name: str) -> tuple[FloatArray, float]:
    variables = _load(path)
    difference = _row(path, _one_of(path, variables, ["data_diff"]), N_CHANNELS)
    if not difference.any():
        raise UserError(f"{path}: data_diff is zero in all channels; leave this slice out")
    torque = _row(path, _one_of(path, variables, [torque_name]), 1)
    return difference, float(torque[0])


def _load(path: Path) -> dict[str, Variable]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: the recording cannot be read: {error.strerror}") from error
    if content.startswith(_HDF5_SIGNATURE) or content.startswith(b"MATLAB 7.3"):
        raise UserError(f"{path} is a MATLAB file of version 7.3; save it again with `save -v7`")
    if not content.startswith(b"MATLAB"):
        raise UserError(f"{path} is not a MATLAB file: expected a recording saved with `save -v6` or `save -v7`")
    try:
        return read_variables(content)
    except MatFileError as error:
        raise UserError(f"{path}: the recording is truncated or damaged: {error}; copy it again") from error


def _one_of(path: Path, variables: dict[str, Variable], names: Sequence[str]) -> FloatArray:
    """Return the one matrix that goes by one of these names."""
    present = [name for name in names if name in variables]
    if len(present) > 1:
        raise UserError(f"{path} holds {' and '.join(present)}; say which of them is wanted")
    if not present:
        others = ", ".join(variables) or "no variable"
        raise UserError(f"{path} holds {others}, expected {' or '.join(names)}")
    values = variables[present[0]]
    if isinstance(values, NotAMatrix):
        raise UserError(f"{path}: {present[0]} is {values.what}, expected a matrix of real numbers")
    if not np.isfinite(values).all():
        raise UserError(f"{path}: {int((~np.isfinite(values)).sum())} values of {present[0]} are not finite numbers")
    return values


def _row(path: Path, values: FloatArray, length: int) -> FloatArray:
    if values.shape not in ((1, length), (length, 1)):
        raise UserError(f"{path}: expected 1 × {length} values, found {_size(values)}")
    return values.ravel()


def _timed(path: Path, table: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Split a table into the Unix times of its datenum column and the values beside them."""
    if table.shape[1] != width + 1 or len(table) == 0:
        value = "value" if width == 1 else "values"
        raise UserError(f"{path}: expected rows of one time and {width} {value}, found {_size(table)}")
    return (table[:, 0] - _DATENUM_OF_UNIX_EPOCH) * _SECONDS_PER_DAY, np.ascontiguousarray(table[:, 1:])


def _size(values: FloatArray) -> str:
    return " × ".join(map(str, values.shape))
