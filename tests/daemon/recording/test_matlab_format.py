import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.io import loadmat, savemat

from shearloop.daemon.recording.matlab import MatFileError, read_variables

NAMES = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,30}", fullmatch=True)
KINDS = ["f8", "f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"]
MATRICES = st.sampled_from(KINDS).flatmap(
    lambda kind: hnp.arrays(np.dtype(kind), hnp.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=5))
)


def saved(variables: dict[str, object], compressed: bool = False) -> bytes:
    file = io.BytesIO()
    savemat(file, variables, do_compression=compressed)
    return file.getvalue()


def element(kind: int, data: bytes, order: str) -> bytes:
    return struct.pack(f"{order}II", kind, len(data)) + data + bytes(-len(data) % 8)


def written_by_hand(order: str, stored: int, numbers: bytes, shape: tuple[int, int] = (2, 2)) -> bytes:
    """A file with one matrix of doubles `x`, its numbers stored as another type, as MATLAB saves small integers."""
    inside = (
        element(6, struct.pack(f"{order}II", 6, 0), order)
        + element(5, struct.pack(f"{order}ii", *shape), order)
        + element(1, b"x", order)
        + element(stored, numbers, order)
    )
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(f"{order}H", 0x0100) + (b"IM" if order == "<" else b"MI")
    return header + element(14, inside, order)


@given(st.dictionaries(NAMES, MATRICES, max_size=3), st.booleans())
def test_matrices_round_trip(variables: dict[str, np.ndarray], compressed: bool) -> None:
    found = read_variables(saved(dict(variables), compressed))
    assert found.keys() == variables.keys()
    for name, values in variables.items():
        matrix = found[name]
        assert isinstance(matrix, np.ndarray)
        assert matrix.shape == values.shape
        np.testing.assert_array_equal(matrix, values.astype(np.float64))


@pytest.mark.parametrize("order", ["<", ">"])
def test_narrow_numbers_in_both_byte_orders(order: str) -> None:
    found = read_variables(written_by_hand(order, 3, struct.pack(f"{order}4h", 1, -2, 3, 300)))
    np.testing.assert_array_equal(found["x"], [[1, 3], [-2, 300]])


@pytest.mark.parametrize(
    ("value", "what"),
    [
        ("text", "1 × 4 text"),
        ({"a": 1.0}, "1 × 1 struct"),
        (np.array([["a", 1.0]], dtype=object), "1 × 2 cell array"),
        (np.ones((2, 3)) * 1j, "2 × 3 complex numbers"),
        (np.ones((2, 3, 4)), "2 × 3 × 4 real numbers"),
    ],
)
def test_other_kinds_of_variables_are_described(value: object, what: str) -> None:
    found = read_variables(saved({"x": value, "y": 2.0}))
    assert found["x"] == what
    assert isinstance(found["y"], np.ndarray)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"MATLAB 5.0", "ends after 10 bytes, inside its header"),
        (b"MATLAB 5.0".ljust(200), "its byte order mark is b'  '"),
        (written_by_hand("<", 3, bytes(8))[:-1], "bytes where an element of"),
        (written_by_hand("<", 3, bytes(8)) + b"abc", "ends inside an element's tag"),
        (written_by_hand("<", 3, bytes(6)), "x has 3 numbers for a matrix of 2 × 2"),
        (written_by_hand("<", 3, bytes(7)), "7 bytes for numbers of 2 bytes each"),
        (written_by_hand("<", 8, bytes(8)), "element of type 8 where numbers are expected"),
        (written_by_hand("<", 3, bytes(8), (-2, -2)), "without a proper class, shape and name"),
        (written_by_hand("<", 3, bytes(8)) + written_by_hand("<", 3, bytes(8))[128:], "the variable 'x' twice"),
        (saved({})[:128] + element(9, bytes(8), "<"), "element of type 9 where a variable is expected"),
        (saved({})[:128] + element(15, b"not packed", "<"), "does not unpack"),
        (saved({})[:128] + element(15, zlib.compress(bytes(100))[:-6], "<"), "is not complete"),
    ],
)
def test_damaged_content_is_an_error(content: bytes, says: str) -> None:
    with pytest.raises(MatFileError, match=says):
        read_variables(content)


def test_files_of_matlab_are_read_like_scipy_does(shared: Path) -> None:
    for name in ("torque_slices/Data_Slice_7", "diameter_slices/10mm_Data_2", "streams/cylinders/10mm_1_truth"):
        path = shared / "recordings" / f"{name}.mat"
        expected = {key: value for key, value in loadmat(path).items() if not key.startswith("__")}
        found = read_variables(path.read_bytes())
        assert found.keys() == expected.keys()
        for key, values in expected.items():
            np.testing.assert_array_equal(found[key], values)
