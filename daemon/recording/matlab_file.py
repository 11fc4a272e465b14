"""The matrices of a MATLAB file of version 5 to 7.2, checked byte by byte.

MathWorks, "MAT-File Format" (level 5). scipy's reader is not used: it trusts the sizes and types in the file, and
ends the process with a segmentation fault where some of them are damaged (docs/decisions/0040).
"""

import math
import struct
import zlib
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class NotAMatrix:
    """A variable of another kind than a matrix of real numbers, and what it is."""

    what: str


Variable: TypeAlias = NDArray[np.float64] | NotAMatrix

_HEADER_BYTES = 128
_COMPRESSED, _MATRIX, _INT8, _INT32, _UINT32 = 15, 14, 1, 5, 6
# How numbers are stored, which is often narrower than their class.
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_NUMBER_CLASSES = range(6, 16)
_OTHER_CLASSES = {1: "cell array", 2: "struct", 3: "object", 4: "text", 5: "sparse matrix", 16: "function"}
_COMPLEX_FLAG = 0x0800
# An hour of lines is 55 MB: what claims to unpack to more than this is damaged.
_LARGEST_VARIABLE_BYTES = 1 << 30


class MatFileError(ValueError):
    """Bytes that are no MATLAB file of these versions, or a damaged one; the message says what was found."""


def read_variables(content: bytes) -> dict[str, Variable]:
    """Return the variables of a file's content by name: matrices as (rows, columns) float64.

    Raises MatFileError, and nothing else, for content that is foreign, truncated or damaged.
    """
    if len(content) < _HEADER_BYTES:
        raise MatFileError(f"it ends after {len(content)} bytes, inside its header")
    mark = content[126:128]
    if mark not in (b"IM", b"MI"):
        raise MatFileError(f"its byte order mark is {mark!r}, expected b'IM' or b'MI'")
    order = "<" if mark == b"IM" else ">"
    variables: dict[str, Variable] = {}
    elements = _Elements(memoryview(content)[_HEADER_BYTES:], order, padded=False)
    while elements.left:
        kind, data = elements.take()
        if kind == _COMPRESSED:
            kind, data = _Elements(memoryview(_unpacked(data)), order).take()
        if kind != _MATRIX:
            raise MatFileError(f"it has an element of type {kind} where a variable should be")
        name, variable = _variable(_Elements(data, order))
        if name in variables:
            raise MatFileError(f"it has the variable {name!r} twice")
        variables[name] = variable
    return variables


class _Elements:
    """Takes the elements of a part of the file, one after the other; each is a type, a size and that many bytes."""

    def __init__(self, data: memoryview, order: str, padded: bool = True) -> None:
        self.left = data
        self.order = order
        self._padded = padded

    def take(self) -> tuple[int, memoryview]:
        """Return the type and the bytes of the next element."""
        if len(self.left) < 8:
            raise MatFileError("it ends inside an element's tag")
        (first,) = struct.unpack_from(f"{self.order}I", self.left)
        # Up to four bytes stand in the tag itself, with their number in its upper half.
        kind, size, start = (first & 0xFFFF, first >> 16, 4) if first >> 16 else (first, -1, 8)
        if start == 8:
            (size,) = struct.unpack_from(f"{self.order}I", self.left, 4)
        if size > (4 if start == 4 else len(self.left) - 8):
            raise MatFileError(f"it has {len(self.left) - start} bytes where an element of {size} should be")
        data = self.left[start : start + size]
        padding = -size % 8 if self._padded and start == 8 else 0
        self.left = self.left[8 if start == 4 else start + size + padding :]
        return kind, data

    def numbers(self, kinds: dict[int, str]) -> NDArray[np.float64]:
        """Return the next element, stored as one of these types, as numbers."""
        kind, data = self.take()
        if kind not in kinds:
            raise MatFileError(f"it has an element of type {kind} where numbers should be")
        stored = np.dtype(f"{self.order}{kinds[kind]}")
        if len(data) % stored.itemsize:
            raise MatFileError(f"it has {len(data)} bytes for numbers of {stored.itemsize} bytes each")
        return np.frombuffer(data, stored).astype(np.float64)


def _variable(parts: _Elements) -> tuple[str, Variable]:
    flags = parts.numbers({_UINT32: "u4"})
    shape = tuple(map(int, parts.numbers({_INT32: "i4"})))
    kind, name_bytes = parts.take()
    if len(flags) != 2 or len(shape) < 2 or min(shape) < 0 or kind != _INT8 or not name_bytes.tobytes().isascii():
        raise MatFileError("it has a variable without a proper class, shape and name")
    name = name_bytes.tobytes().decode("ascii")
    number_class, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) & _COMPLEX_FLAG)
    size = " × ".join(map(str, shape))
    if number_class not in _NUMBER_CLASSES:
        return name, NotAMatrix(f"{size} {_OTHER_CLASSES.get(number_class, f'of the unknown class {number_class}')}")
    if is_complex or len(shape) != 2:
        return name, NotAMatrix(f"{size} {'complex' if is_complex else 'real'} numbers")
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
