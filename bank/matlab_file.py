"""Reads matrices and structs of MATLAB files of version 5 to 7.2, and skips other variables.

The format is MathWorks' "MAT-File Format" (level 5). scipy's reader trusts sizes and types in the file, so some damaged
files end its process with a segmentation fault (docs/decisions/0040).
"""

import math
import struct
import zlib
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.words import counted

_HEADER_BYTES = 128
_COMPRESSED, _MATRIX, _INT8, _INT32, _UINT32 = 15, 14, 1, 5, 6
# The stored type of numbers is often narrower than their class.
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_STRUCT, _OPAQUE, _NUMBER_CLASSES = 2, 17, range(6, 16)
_OTHER_CLASSES = {1: "cell array", 3: "object", 4: "text", 5: "sparse matrix", 16: "function"}
_COMPLEX_FLAG = 0x0800
# Of structs within structs.
_DEEPEST = 20
# An hour of lines is 55 MB. A variable that unpacks to more than this is damaged.
_LARGEST_VARIABLE_BYTES = 1 << 30


class Struct(list[dict[str, "Variable"]]):
    """The fields of each element of a struct by name, in MATLAB's order."""

    def __str__(self) -> str:
        """Return the number of elements in words."""
        return counted(len(self), "struct")


# A matrix of real numbers, structs, or the description of something else.
Variable: TypeAlias = FloatArray | Struct | str


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
        if not name:
            # MATLAB keeps the content of all objects of a file in a variable without a name.
            continue
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


def _variable(parts: _Elements, depth: int = 0) -> tuple[str, Variable]:
    flags = parts.numbers({_UINT32: "u4"})
    if len(flags) == 2 and int(flags[0]) & 0xFF == _OPAQUE:
        return _opaque(parts)
    shape = tuple(map(int, parts.numbers({_INT32: "i4"})))
    kind, name_bytes = parts.next_element()
    if len(flags) != 2 or len(shape) < 2 or min(shape) < 0 or kind != _INT8 or not name_bytes.tobytes().isascii():
        raise MatFileError("it has a variable without a proper class, shape and name")
    name = name_bytes.tobytes().decode("ascii")
    number_class, is_complex = int(flags[0]) & 0xFF, bool(int(flags[0]) & _COMPLEX_FLAG)
    size = " × ".join(map(str, shape))
    if number_class == _STRUCT:
        return name, _structs(parts, math.prod(shape), depth)
    if number_class not in _NUMBER_CLASSES:
        return name, f"{size} {_OTHER_CLASSES.get(number_class, f'of the unknown class {number_class}')}"
    if is_complex or len(shape) != 2:
        return name, f"{size} {'complex' if is_complex else 'real'} numbers"
    values = parts.numbers(_STORED)
    if len(values) != math.prod(shape):
        raise MatFileError(f"{name} has {len(values)} numbers for a matrix of {size}")
    return name, values.reshape(shape, order="F")


def _opaque(parts: _Elements) -> tuple[str, str]:
    """Return name and description of an object, such as a datetime or a table, which has no shape here."""
    texts = [parts.next_element() for _ in range(3)]
    if any(kind != _INT8 or not text.tobytes().isascii() for kind, text in texts):
        raise MatFileError("it has an object without proper names of itself and its class")
    name, _, class_name = (text.tobytes().decode("ascii") for _, text in texts)
    return name, f"an object of the class {class_name}"


def _structs(parts: _Elements, count: int, depth: int) -> Struct:
    width = parts.numbers({_INT32: "i4"})
    kind, names_bytes = parts.next_element()
    size = int(width[0]) if len(width) == 1 else 0
    if kind != _INT8 or size < 1 or len(names_bytes) % size or depth > _DEEPEST:
        raise MatFileError("it has a struct without proper names of its fields, or too deep")
    text = names_bytes.tobytes().decode("latin-1")
    names = [text[at : at + size].partition("\0")[0] for at in range(0, len(text), size)]
    found = Struct()
    # A struct without fields has no elements to end the file.
    for _ in range(count if names else 0):
        found.append({})
        for name in names:
            kind, data = parts.next_element()
            if kind != _MATRIX:
                raise MatFileError(f"it has an element of type {kind} where the field {name!r} is expected")
            found[-1][name] = _variable(_Elements(data, parts.order), depth + 1)[1] if data else np.zeros((0, 0))
    return found


def _unpacked(data: memoryview) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        unpacked = unpacker.decompress(data, _LARGEST_VARIABLE_BYTES)
    except zlib.error as error:
        raise MatFileError(f"a compressed variable does not unpack ({error})") from error
    if not unpacker.eof:
        raise MatFileError("a compressed variable is not complete")
    return unpacked
