"""Reads the paper's MATLAB files (version 5 to 7.2) of slices, raw lines and streams as arrays with units.

The format is MathWorks' "MAT-File Format" (level 5). scipy's reader trusts sizes and types in the file, so some damaged
files end its process with a segmentation fault (docs/decisions/0040).
"""

import math
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS, N_LINE_VALUES
from shearloop.daemon.errors import UserError

# The recording scripts changed these names over time.
_SIDES = {"right": ("Right_Data", "plotthis2", "plotthis_right"), "left": ("Left_Data", "plotthis1", "plotthis_left")}
_LOADS = ("Load_Data", "plotthis3", "plotthis_truth")
_LINES = ("clipped_data", "clipped_data_hom")
# MATLAB counts days from the year 0; this is its number for 1970-01-01.
_DATENUM_OF_UNIX_EPOCH = 719529
_SECONDS_PER_DAY = 86400.0
_TORQUE_SLICE = re.compile(r"Data_Slice_(\d+)\.mat")
_DIAMETER_SLICE = re.compile(r"(\d+(?:\.\d+)?)mm_Data_(\d+)\.mat")
_HDF5_SIGNATURE = b"\x89HDF"

_HEADER_BYTES = 128
_COMPRESSED, _MATRIX, _INT8, _INT32, _UINT32 = 15, 14, 1, 5, 6
# The stored type of numbers is often narrower than their class.
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_NUMBER_CLASSES = range(6, 16)
_OTHER_CLASSES = {1: "cell array", 2: "struct", 3: "object", 4: "text", 5: "sparse matrix", 16: "function"}
_COMPLEX_FLAG = 0x0800
# An hour of lines is 55 MB. A variable that unpacks to more than this is damaged.
_LARGEST_VARIABLE_BYTES = 1 << 30


# A matrix of real numbers, or the description of something else.
Variable: TypeAlias = FloatArray | str


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """One fingertip's lines: unix_s (n,) arrival times, lines (n, 1024) in volts.

    The file names no time zone, so its times are read as UTC.
    """

    unix_s: FloatArray
    lines: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LoadStream:
    """The load cell's values: unix_s (n,) arrival times as in `Stream`, torque_nm (n,), including damaged values."""

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


def find_streams(path: str | Path) -> tuple[str, ...]:
    """Return the streams of a file: "right", "left" or "load"; raises UserError if it cannot be read or has none."""
    path = Path(path)
    variables = _load(path)
    known = {**_SIDES, "load": _LOADS}
    found = tuple(stream for stream, names in known.items() if any(name in variables for name in names))
    if not found:
        wanted = ", ".join(name for names in known.values() for name in names)
        raise UserError(f"{path} holds {', '.join(variables) or 'no variable'}, expected one of {wanted}")
    return found


def read_stream(path: str | Path, side: str | None = None) -> Stream:
    """Return a fingertip's stream; `side` ("right" or "left") is needed for a file with both.

    Raises UserError for a file that cannot be read or holds no such stream.
    """
    path = Path(path)
    variables = _load(path)
    names = sum(_SIDES.values(), ()) if side is None else _SIDES[side]
    return Stream(*_timed(path, _one_of(path, variables, names), N_LINE_VALUES))


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
    """Return the slices Data_Slice_N.mat of a folder by rising N, which may have gaps.

    Raises UserError for a folder without any, and for a file that cannot be used.
    """
    examples = "Data_Slice_1.mat, Data_Slice_2.mat"
    numbers, differences, torque_nm = _read_slices(folder, "torque", _TORQUE_SLICE, "torque_value", examples)
    return TorqueSlices(differences, torque_nm, numbers[:, 0].astype(int))


def read_diameter_slices(folder: str | Path) -> DiameterSlices:
    """Return the slices DDmm_Data_N.mat of a folder by rising diameter, then N; raises as `read_torque_slices` does."""
    examples = "10mm_Data_1.mat, 20mm_Data_1.mat"
    numbers, differences, torque_nm = _read_slices(folder, "diameter", _DIAMETER_SLICE, "mean_torque", examples)
    return DiameterSlices(differences, numbers[:, 0], torque_nm)


def _read_slices(
    folder: str | Path, kind: str, pattern: re.Pattern[str], torque_name: str, examples: str
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the numbers (n, m) in the files' names in rising order, the differences (n, 896) and torques (n,)."""
    try:
        found = [(pattern.fullmatch(path.name), path) for path in Path(folder).iterdir()]
    except OSError as error:
        raise UserError(f"{folder}: the recordings cannot be listed: {error.strerror}") from error
    files = sorted((tuple(map(float, match.groups())), path) for match, path in found if match)
    if not files:
        raise UserError(f"{folder} has no {kind} slices: expected files named {examples} …")
    differences, torques = [], []
    for _, path in files:
        variables = _load(path)
        differences.append(_row(path, _one_of(path, variables, ["data_diff"]), N_CHANNELS))
        if not differences[-1].any():
            raise UserError(f"{path}: data_diff is zero in all channels; leave this slice out")
        torques.append(_row(path, _one_of(path, variables, [torque_name]), 1)[0])
    return np.array([numbers for numbers, _ in files]), np.array(differences), np.array(torques)


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
    """Return the only matrix that has one of these names."""
    present = [name for name in names if name in variables]
    if len(present) > 1:
        raise UserError(f"{path} holds {' and '.join(present)}; choose one of them")
    if not present:
        others = ", ".join(variables) or "no variable"
        raise UserError(f"{path} holds {others}, expected {' or '.join(names)}")
    values = variables[present[0]]
    if isinstance(values, str):
        raise UserError(f"{path}: {present[0]} is {values}, expected a matrix of real numbers")
    if not np.isfinite(values).all():
        raise UserError(f"{path}: {int((~np.isfinite(values)).sum())} values of {present[0]} are not finite numbers")
    return values


def _row(path: Path, values: FloatArray, length: int) -> FloatArray:
    if values.shape not in ((1, length), (length, 1)):
        raise UserError(f"{path}: expected 1 × {length} values, found {_size(values)}")
    return values.ravel()


def _timed(path: Path, table: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Return the Unix times of a table's datenum column and its other columns."""
    if table.shape[1] != width + 1 or len(table) == 0:
        value = "value" if width == 1 else "values"
        raise UserError(f"{path}: expected rows of one time and {width} {value}, found {_size(table)}")
    return (table[:, 0] - _DATENUM_OF_UNIX_EPOCH) * _SECONDS_PER_DAY, np.ascontiguousarray(table[:, 1:])


def _size(values: FloatArray) -> str:
    return " × ".join(map(str, values.shape))


class MatFileError(ValueError):
    """The content is foreign, truncated or damaged."""


def read_variables(content: bytes) -> dict[str, Variable]:
    """Return the variables of a file's content by name, matrices as (rows, columns); raises only MatFileError."""
    if len(content) < _HEADER_BYTES:
        raise MatFileError(f"it ends after {len(content)} bytes, inside its header")
    mark = content[126:128]
    if mark not in (b"IM", b"MI"):
        raise MatFileError(f"its byte order mark is {mark!r}, expected b'IM' or b'MI'")
    order = "<" if mark == b"IM" else ">"
    variables: dict[str, Variable] = {}
    elements = _Elements(memoryview(content)[_HEADER_BYTES:], order, padded=False)
    while elements.left:
        kind, data = elements.next_element()
        if kind == _COMPRESSED:
            kind, data = _Elements(memoryview(_unpacked(data)), order).next_element()
        if kind != _MATRIX:
            raise MatFileError(f"it has an element of type {kind} where a variable is expected")
        name, variable = _variable(_Elements(data, order))
        if name in variables:
            raise MatFileError(f"it has the variable {name!r} twice")
        variables[name] = variable
    return variables


class _Elements:
    """Reads consecutive elements; each has a type, a size and that many bytes."""

    def __init__(self, data: memoryview, order: str, padded: bool = True) -> None:
        self.left = data
        self.order = order
        self._padded = padded

    def next_element(self) -> tuple[int, memoryview]:
        """Return the type and the bytes of the next element."""
        if len(self.left) < 8:
            raise MatFileError("it ends inside an element's tag")
        (first,) = struct.unpack_from(f"{self.order}I", self.left)
        # A small element keeps up to four bytes in its tag, and their number in the tag's upper half.
        kind, size, start = (first & 0xFFFF, first >> 16, 4) if first >> 16 else (first, -1, 8)
        if start == 8:
            (size,) = struct.unpack_from(f"{self.order}I", self.left, 4)
        if size > (4 if start == 4 else len(self.left) - 8):
            raise MatFileError(f"it has {len(self.left) - start} bytes where an element of {size} is expected")
        data = self.left[start : start + size]
        padding = -size % 8 if self._padded and start == 8 else 0
        self.left = self.left[8 if start == 4 else start + size + padding :]
        return kind, data

    def numbers(self, kinds: dict[int, str]) -> FloatArray:
        """Return the next element as numbers; `kinds` are the allowed types."""
        kind, data = self.next_element()
        if kind not in kinds:
            raise MatFileError(f"it has an element of type {kind} where numbers are expected")
        stored = np.dtype(f"{self.order}{kinds[kind]}")
        if len(data) % stored.itemsize:
            raise MatFileError(f"it has {len(data)} bytes for numbers of {stored.itemsize} bytes each")
        return np.frombuffer(data, stored).astype(np.float64)


def _variable(parts: _Elements) -> tuple[str, Variable]:
    flags = parts.numbers({_UINT32: "u4"})
    shape = tuple(map(int, parts.numbers({_INT32: "i4"})))
    kind, name_bytes = parts.next_element()
    if len(flags) != 2 or len(shape) < 2 or min(shape) < 0 or kind != _INT8 or not name_bytes.tobytes().isascii():
        raise MatFileError("it has a variable without a proper class, shape and name")
    name = name_bytes.tobytes().decode("ascii")
    number_class, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) & _COMPLEX_FLAG)
    size = " × ".join(map(str, shape))
    if number_class not in _NUMBER_CLASSES:
        return name, f"{size} {_OTHER_CLASSES.get(number_class, f'of the unknown class {number_class}')}"
    if is_complex or len(shape) != 2:
        return name, f"{size} {'complex' if is_complex else 'real'} numbers"
    values = parts.numbers(_STORED)
    if len(values) != math.prod(shape):
        raise MatFileError(f"{name} has {len(values)} numbers for a matrix of {size}")
    return name, values.reshape(shape, order="F")


def _unpacked(data: memoryview) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        unpacked = unpacker.decompress(data, _LARGEST_VARIABLE_BYTES)
    except zlib.error as error:
        raise MatFileError(f"a compressed variable does not unpack ({error})") from error
    if not unpacker.eof:
        raise MatFileError("a compressed variable is not complete")
    return unpacked
