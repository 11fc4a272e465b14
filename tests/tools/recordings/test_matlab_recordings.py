import contextlib
import datetime
import io
import struct
import zlib
from functools import partial

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.io import loadmat, savemat

from shearloop.bank.matlab_file import MatFileError, read_variables
from shearloop.cli import main
from shearloop.daemon.recorder.writer import new_recording
from shearloop.drivers.serial_sensor import SETTLE_VALUES
from shearloop.errors import UserError
from shearloop.tools.frame_series import read_series
from shearloop.tools.recordings import lerobot_export
from shearloop.tools.recordings.matlab_import import (
    import_mat,
    read_diameter_slices,
    read_line,
    read_stream,
    read_torque_slices,
)
from shearloop.tools.recordings.summary import summarise
from shearloop.tools.recordings.time_formats import TIME_FORMATS

# 2024-12-03 16:09:38 on MATLAB's count of days.
DATENUM = 739589 + (16 * 3600 + 9 * 60 + 38) / 86400


read_load_stream = partial(read_stream, name="load")


def stream_table(rows: int, width: int) -> np.ndarray:
    times = DATENUM + np.arange(rows) * 0.54 / 86400
    return np.column_stack([times, np.arange(rows * width).reshape(rows, width) / 1000.0])


@pytest.mark.parametrize(
    "name", ["Right_Data", "Left_Data", "plotthis1", "plotthis2", "plotthis_right", "plotthis_left"]
)
def test_a_stream_has_several_names(tmp_path, name):
    savemat(tmp_path / "device.mat", {name: stream_table(5, 1024)})
    stream = read_stream(tmp_path / "device.mat")
    assert stream.values.shape == (5, 1024)
    assert stream.values[1, 0] == 1.024
    first = datetime.datetime(2024, 12, 3, 16, 9, 38, tzinfo=datetime.UTC).timestamp()
    # A datenum of this size has steps of 10 µs.
    np.testing.assert_allclose(stream.unix_s, first + 0.54 * np.arange(5), atol=2e-5)


@pytest.mark.parametrize("name", ["Load_Data", "plotthis3", "plotthis_truth"])
def test_a_load_stream_keeps_damaged_values(tmp_path, name):
    table = stream_table(4, 1)
    table[2, 1] = 3.84e7
    savemat(tmp_path / "load.mat", {name: table})
    load = read_load_stream(tmp_path / "load.mat")
    assert load.values[:, 0].tolist() == [0.0, 0.001, 3.84e7, 0.003]
    assert load.unix_s.shape == (4,)


def test_a_file_with_two_fingertips_needs_a_side(tmp_path):
    left, right = stream_table(2, 1024), stream_table(3, 1024)
    savemat(tmp_path / "both.mat", {"Left_Data": left, "Right_Data": right})
    assert len(read_stream(tmp_path / "both.mat", name="left").values) == 2
    assert len(read_stream(tmp_path / "both.mat", name="right").values) == 3
    with pytest.raises(UserError, match=r"both\.mat holds Right_Data and Left_Data; choose one"):
        read_stream(tmp_path / "both.mat")


def test_torque_slices_are_sorted_by_number(tmp_path):
    for number in (10, 2, 1, 37):
        content = {"data_diff": np.full((1, 896), number), "torque_value": number / 100}
        savemat(tmp_path / f"Data_Slice_{number}.mat", content)
    (tmp_path / "Data_Slice_notes.txt").write_text("not a slice")
    slices = read_torque_slices(tmp_path)
    assert slices.numbers.tolist() == [1, 2, 10, 37]
    assert slices.differences[:, 5].tolist() == [1.0, 2.0, 10.0, 37.0]
    assert slices.torque_nm.tolist() == [0.01, 0.02, 0.1, 0.37]


def test_diameter_slices_are_sorted_by_diameter(tmp_path):
    for name in ("40mm_Data_1", "9.5mm_Data_2", "9.5mm_Data_1", "100mm_Data_10"):
        savemat(tmp_path / f"{name}.mat", {"data_diff": np.ones((896, 1)), "mean_torque": [[0.1]]})
    slices = read_diameter_slices(tmp_path)
    assert slices.diameter_mm.tolist() == [9.5, 9.5, 40.0, 100.0]
    assert slices.differences.shape == (4, 896)
    assert slices.torque_nm.tolist() == [0.1] * 4


@pytest.mark.parametrize("name", ["clipped_data", "clipped_data_hom"])
def test_a_raw_line_is_read(tmp_path, name):
    savemat(tmp_path / "line.mat", {name: np.arange(1024.0)[None]})
    assert read_line(tmp_path / "line.mat").tolist() == list(range(1024))


@pytest.mark.parametrize(
    ("read", "variables", "says"),
    [
        (read_stream, {"other": [[1.0]]}, "holds other, expected Right_Data or plotthis2 or"),
        (read_stream, {}, "holds no variable, expected"),
        (read_stream, {"Right_Data": np.ones((4, 1024))}, "one time and 1024 values, found 4 × 1024"),
        (read_stream, {"Right_Data": np.ones((0, 1025))}, "found 0 × "),
        (read_stream, {"Right_Data": "text"}, "Right_Data is 1 × 4 text, expected a matrix"),
        (read_stream, {"Right_Data": np.full((2, 1025), np.nan)}, "Right_Data has 2050 values that are not finite"),
        (read_load_stream, {"Load_Data": np.ones((4, 3))}, "one time and 1 value, found 4 × 3"),
        (read_line, {"clipped_data": np.ones((1, 896))}, "expected 1 × 1024 values, found 1 × 896"),
    ],
)
def test_other_variables_are_refused(tmp_path, read, variables, says):
    path = tmp_path / "device.mat"
    savemat(path, variables)
    with pytest.raises(UserError, match=says) as refusal:
        read(path)
    assert str(path) in str(refusal.value)


def test_unusable_slices_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"has no torque slices: expected files named Data_Slice_1\.mat"):
        read_torque_slices(tmp_path)
    with pytest.raises(UserError, match=r"has no diameter slices: expected files named 10mm_Data_1\.mat"):
        read_diameter_slices(tmp_path)
    with pytest.raises(UserError, match="absent: the recordings cannot be listed: No such file"):
        read_torque_slices(tmp_path / "absent")
    savemat(tmp_path / "Data_Slice_1.mat", {"data_diff": np.zeros((1, 896)), "torque_value": 0.1})
    with pytest.raises(UserError, match=r"Data_Slice_1\.mat: data_diff is zero in all channels"):
        read_torque_slices(tmp_path)
    savemat(tmp_path / "Data_Slice_1.mat", {"data_diff": np.ones((1, 896))})
    with pytest.raises(UserError, match=r"Data_Slice_1\.mat holds data_diff, expected torque_value"):
        read_torque_slices(tmp_path)


def test_structs_are_read_with_their_fields():
    found = read_variables(saved({"x": {"a": 1.0, "long_name": {"b": np.eye(2)}}}))["x"]
    assert str(found) == "1 struct"
    assert found[0]["a"] == 1.0
    np.testing.assert_array_equal(found[0]["long_name"][0]["b"], np.eye(2))


def nested(depth: int) -> dict:
    return {"x": nested(depth - 1)} if depth else {"x": 1.0}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is not a MATLAB file"),
        (b"#!/bin/sh\n", "is not a MATLAB file"),
        (b"\x89HDF\r\n\x1a\n" + bytes(600), "version 7.3; save it again with `save -v7`"),
        (b"MATLAB 7.3 MAT-file" + bytes(600), "version 7.3; save it again with `save -v7`"),
        (b"MATLAB 5.0 MAT-file", "truncated or damaged"),
    ],
)
def test_foreign_files_are_refused(tmp_path, content, says):
    path = tmp_path / "device.mat"
    path.write_bytes(content)
    with pytest.raises(UserError, match=says):
        read_stream(path)
    with pytest.raises(UserError, match=r"absent\.mat: the recording cannot be read: No such file"):
        read_stream(tmp_path / "absent.mat")
    with pytest.raises(UserError, match="cannot be read: it is a folder; name a file in it"):
        read_stream(tmp_path)


@pytest.fixture(scope="module", params=[True, False], ids=["compressed", "plain"])
def recording(tmp_path_factory, request) -> bytes:
    path = tmp_path_factory.mktemp("recording") / "Data_Slice_1.mat"
    noise = np.random.default_rng(1).integers(0, 5, (1, 896)) * 0.00215
    savemat(path, {"torque_value": 0.1, "data_diff": noise}, do_compression=request.param)
    return path.read_bytes()


def test_a_truncated_recording_is_refused(tmp_path, recording):
    path = tmp_path / "Data_Slice_1.mat"
    for length in [*range(0, len(recording), 97), len(recording) - 1]:
        path.write_bytes(recording[:length])
        with pytest.raises(UserError, match=r"Data_Slice_1\.mat") as refusal:
            read_torque_slices(tmp_path)
        assert "\n" not in str(refusal.value)


@given(data=st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_recording_is_refused_or_has_the_right_shape(tmp_path, recording, data):
    damaged = bytearray(recording)
    # The head is where sizes and types stand; changing values alone would teach nothing.
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, min(len(damaged) - 1, 400)))
        damaged[at] = data.draw(st.integers(0, 255))
    path = tmp_path / "Data_Slice_1.mat"
    path.write_bytes(damaged)
    with contextlib.suppress(UserError):
        slices = read_torque_slices(tmp_path)
        assert slices.differences.shape == (1, 896)
        assert np.isfinite(slices.differences).all()


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
def test_matrices_round_trip(variables, compressed):
    found = read_variables(saved(dict(variables), compressed))
    assert found.keys() == variables.keys()
    for name, values in variables.items():
        matrix = found[name]
        assert matrix.shape == values.shape
        np.testing.assert_array_equal(matrix, values.astype(np.float64))


def opaque(name: bytes, class_name: bytes, order: str) -> bytes:
    """An object as MATLAB saves it: a reference into the file's nameless last variable."""
    reference = element(6, struct.pack(f"{order}II", 13, 0), order) + element(5, struct.pack(f"{order}ii", 1, 1), order)
    reference += element(1, b"", order) + element(6, struct.pack(f"{order}I", 0xDD000000), order)
    inside = element(6, struct.pack(f"{order}II", 17, 0), order)
    inside += element(1, name, order) + element(1, b"MCOS", order) + element(1, class_name, order)
    return element(14, inside + element(14, reference, order), order)


@pytest.mark.parametrize("order", ["<", ">"])
def test_an_object_beside_the_data_is_skipped(order):
    content = written_by_hand(order, 3, struct.pack(f"{order}4h", 1, 2, 3, 4)) + opaque(b"when", b"datetime", order)
    nameless = element(6, struct.pack(f"{order}II", 9, 0), order) + element(5, struct.pack(f"{order}ii", 1, 8), order)
    content += element(14, nameless + element(1, b"", order) + element(2, bytes(8), order), order)
    found = read_variables(content)
    np.testing.assert_array_equal(found["x"], loadmat(io.BytesIO(content))["x"])
    assert found["when"] == "an object of the class datetime"
    assert found.keys() == {"x", "when"}


def test_an_object_without_names_is_damage():
    damaged = opaque(b"when", b"date\xff\xff\xff\xff", "<")
    with pytest.raises(MatFileError, match="an object without proper names"):
        read_variables(saved({})[:128] + damaged)


# 2024-12-03 16:09:38 in seconds since 1970.
UNIX_S = (DATENUM - 719529) * 86400
WRITTEN = {
    "datenum": lambda t_s: (UNIX_S + t_s) / 86400 + 719529,
    "unix": lambda t_s: UNIX_S + t_s,
    "unix-ms": lambda t_s: 1e3 * (UNIX_S + t_s),
    "excel": lambda t_s: (UNIX_S + t_s) / 86400 + 25569,
    "elapsed": lambda t_s: t_s,
    "elapsed-ms": lambda t_s: 1e3 * t_s,
}


def save_times(path, times) -> None:
    savemat(path, {"Load_Data": np.column_stack([times, np.zeros(len(times))]).astype(times.dtype)})


@pytest.mark.parametrize("form", TIME_FORMATS)
@pytest.mark.parametrize("step_s", [0.0916, 0.54])
def test_times_of_every_format_are_read_and_named_where_they_are_not_datenum(tmp_path, form, step_s):
    t_s = step_s * np.arange(50)
    save_times(tmp_path / "a.mat", WRITTEN[form](t_s))
    began_s = UNIX_S if TIME_FORMATS[form].has_date else 86400.0
    stream = read_load_stream(tmp_path / "a.mat", time_format=form)
    np.testing.assert_allclose(stream.unix_s, began_s + t_s, atol=2e-5)
    for other in TIME_FORMATS.keys() - {form}:
        with pytest.raises(UserError) as refusal:
            read_load_stream(tmp_path / "a.mat", time_format=other)
        said = str(refusal.value)
        assert f"a.mat: the times begin with {WRITTEN[form](0.0):.10g} and rise by" in said
        assert f"which is not {other}, " in said
        assert said.endswith(f"; give --time-format {form}")


@pytest.mark.parametrize("form", ["datenum", "unix", "unix-ms", "excel"])
def test_times_in_single_precision_are_refused(tmp_path, form):
    save_times(tmp_path / "a.mat", WRITTEN[form](0.54 * np.arange(301)).astype(np.float32))
    for read_as in TIME_FORMATS:
        with pytest.raises(
            UserError, match=r"301 rows have \d different times?: they were saved in single precision; save"
        ):
            read_load_stream(tmp_path / "a.mat", time_format=read_as)


@pytest.mark.parametrize(
    ("times", "says"),
    [
        (np.arange(9.0) + 20241203, r"not datenum, .*; correct the first column"),
        (
            WRITTEN["datenum"](np.array([0, 0.5, 1.0, -4.0, -3.5])),
            "the time in row 4 is 5.0 s before that of row 3: the clock was set back",
        ),
        (
            WRITTEN["datenum"](0.54 * np.arange(40) - (np.arange(40) >= 20)),
            "the time in row 21 is 0.5 s before that of row 20: the clock was set back",
        ),
        (np.full(9, WRITTEN["unix"](0.3)), "every row has the time .*: write the time of each row"),
        (np.zeros(9), "every row has the time 0: write the time of each row"),
        (np.repeat(WRITTEN["unix"](np.arange(3.0)), 4), "12 rows have 3 different times; save the times again"),
        (WRITTEN["datenum"](np.r_[0:9, 8:4:-1, 9:20] * 0.54), "3 rows are before the row above them, row 11 first"),
        # Seconds since 1900, as NTP counts them, and microseconds.
        (WRITTEN["unix"](0.54 * np.arange(9)) + 2_208_988_800, "correct the first column"),
        (WRITTEN["unix"](0.54 * np.arange(9)) * 1e6, "correct the first column"),
    ],
)
def test_other_times_are_refused(tmp_path, times, says):
    save_times(tmp_path / "a.mat", times)
    with pytest.raises(UserError, match=says):
        read_load_stream(tmp_path / "a.mat")


def test_frames_are_at_least_a_twentieth_of_a_second_apart(tmp_path):
    """Minutes since the start look like a fast load cell, and like no fingertip."""
    rows = np.column_stack([0.54 / 60 * np.arange(1, 31), np.ones((30, 1024))])
    savemat(tmp_path / "right.mat", {"Right_Data": rows})
    for form in TIME_FORMATS:
        with pytest.raises(UserError, match="correct the first column"):
            read_stream(tmp_path / "right.mat", "right", form)


@pytest.mark.parametrize("form", TIME_FORMATS)
def test_a_recording_of_every_format_is_imported(tmp_path, form):
    times = WRITTEN[form](0.54 * np.arange(30))
    savemat(tmp_path / "right.mat", {"Right_Data": np.column_stack([times, np.ones((30, 1024))])})
    imported = import_mat([tmp_path / "right.mat"], tmp_path / "a.mcap", form)
    assert imported.frames == {"right": 30}
    assert any("no date" in remark for remark in imported.remarks) is not TIME_FORMATS[form].has_date
    summary = summarise(tmp_path / "a.mcap")
    assert summary.topics["eit.frame.right"].rate_hz == pytest.approx(1 / 0.54, rel=0.01)
    assert main(["import", "mat", str(tmp_path), "--out", str(tmp_path / "b.mcap"), "--time-format", form]) == 0


def test_a_recording_longer_than_a_day_is_whole(tmp_path, capsys):
    """No command says that it is damaged, because a repair would change nothing."""
    path = tmp_path / "a.mcap"
    with new_recording(path, "a test") as file:
        for hour in (0, 25, 50):
            t_ns = round(1e9 * (UNIX_S + 3600 * hour))
            file.add_frame("right", t_ns, t_ns + 10**8, np.ones(1024))
            file.add_torque(t_ns, 0.1)
    assert main(["recording", "info", str(path)]) == 0
    for form in ("csv", "parquet", "mat"):
        assert main(["recording", "export", str(path), "--format", form, "--out", str(tmp_path / form)]) == 0
    assert main(["recording", "export", str(path), "--format", "lerobot", "--out", str(tmp_path / "dataset")]) == 2
    said = capsys.readouterr()
    assert "messages span 25 hours, and a dataset holds 24 at most; export it with --format parquet" in said.err
    assert "repair" not in said.out + said.err
    assert "damaged" not in said.out + said.err


def test_a_dataset_of_more_than_a_day_is_refused_before_its_first_row(tmp_path, mistake, monkeypatch):
    pytest.importorskip("pyarrow", reason="needs the extra `export`")
    computed: list[int] = []
    monkeypatch.setattr(lerobot_export.Dataset, "_row", lambda _, now_ns: computed.append(now_ns))
    path = tmp_path / "a.mcap"
    with new_recording(path, "a test") as file:
        for minute in (0, 1, 2, 23 * 60, 25 * 60):
            file.add_torque(round(1e9 * (UNIX_S + 60 * minute)), 0.1)
    said = mistake("recording", "export", path, "--format", "lerobot", "--out", tmp_path / "dataset")
    assert "its messages span 25 hours, and a dataset holds 24 at most" in said
    assert computed == []
    assert not (tmp_path / "dataset").exists()


@pytest.mark.parametrize("order", ["<", ">"])
def test_narrow_numbers_in_both_byte_orders(order):
    found = read_variables(written_by_hand(order, 3, struct.pack(f"{order}4h", 1, -2, 3, 300)))
    np.testing.assert_array_equal(found["x"], [[1, 3], [-2, 300]])


@pytest.mark.parametrize(
    ("value", "what"),
    [
        ("text", "1 × 4 text"),
        (np.array([["a", 1.0]], dtype=object), "1 × 2 cell array"),
        (np.ones((2, 3)) * 1j, "2 × 3 complex numbers"),
        (np.ones((2, 3, 4)), "2 × 3 × 4 real numbers"),
    ],
)
def test_other_kinds_of_variables_are_described(value, what):
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
        (saved({"x": nested(25)}), "too deep"),
        (saved({})[:128] + element(9, bytes(8), "<"), "element of type 9 where a variable is expected"),
        (saved({})[:128] + element(15, b"not packed", "<"), "does not unpack"),
        (saved({})[:128] + element(15, zlib.compress(bytes(100))[:-6], "<"), "is not complete"),
    ],
)
def test_damaged_content_is_an_error(content, says):
    with pytest.raises(MatFileError, match=says):
        read_variables(content)


def test_files_of_matlab_are_read_like_scipy_does(shared):
    for name in ("torque_slices/Data_Slice_7", "diameter_slices/10mm_Data_2", "streams/cylinders/10mm_1_truth"):
        path = shared / "recordings" / f"{name}.mat"
        expected = {key: value for key, value in loadmat(path).items() if not key.startswith("__")}
        found = read_variables(path.read_bytes())
        assert found.keys() == expected.keys()
        for key, values in expected.items():
            np.testing.assert_array_equal(found[key], values)


@pytest.mark.parametrize("repeats", [2, 6])
def test_a_frame_that_was_copied_is_refused(repeats, tmp_path):
    rows = np.repeat(stream_table(30, 1024), np.where(np.arange(30) == 20, repeats, 1), axis=0)
    savemat(tmp_path / "right.mat", {"Right_Data": rows})
    number = {2: "1 copy", 6: "5 copies"}[repeats]
    with pytest.raises(
        UserError, match=rf"right\.mat: row 22 is a copy of the row above, .* \({number} in all\): remove"
    ):
        import_mat([tmp_path / "right.mat"], tmp_path / "a.mcap")


def test_spikes_of_the_load_cell_are_left_out_and_counted(tmp_path):
    """A real step to another torque is none, but for the values that the daemon needs to know it."""
    seconds = np.arange(0, 60, 0.1)
    torque_nm = np.where(seconds < 30, 0.0, 0.4) + np.random.default_rng(1).normal(0.0, 1e-3, len(seconds))
    torque_nm[50::97] = 1.5
    rows = stream_table(110, 1024)
    rows[:, 1:] = np.random.default_rng(0).uniform(0.1, 0.5, (110, 1024))
    savemat(tmp_path / "device.mat", {"Right_Data": rows})
    savemat(tmp_path / "load.mat", {"Load_Data": np.column_stack([DATENUM + seconds / 86400, torque_nm])})
    result = import_mat([tmp_path / "device.mat", tmp_path / "load.mat"], tmp_path / "a.mcap")
    count = len(torque_nm[50::97]) + SETTLE_VALUES - 1
    says = f"Left out: {count} of 600 load values that jump by more than 2 N·m/s: spikes of a damaged line."
    assert says in result.remarks
    (series,) = read_series(tmp_path / "a.mcap")
    assert set(np.round(series.torque_nm, 1)) == {0.0, 0.4}


@pytest.mark.parametrize("gap_s", [1.5, 18.0])
def test_missing_load_values_are_named_and_no_torque_is_made_up_there(gap_s, tmp_path):
    seconds = np.arange(0, 60, 0.1)
    kept = seconds[(seconds < 20) | (seconds > 20 + gap_s)]
    frames = stream_table(110, 1024)
    frames[:, 1:] = np.random.default_rng(0).uniform(0.1, 0.5, (110, 1024))
    savemat(tmp_path / "device.mat", {"Right_Data": frames})
    savemat(tmp_path / "load.mat", {"Load_Data": np.column_stack([DATENUM + kept / 86400, np.sin(kept)])})
    result = import_mat([tmp_path / "device.mat", tmp_path / "load.mat"], tmp_path / "a.mcap")
    begins = f"Load values are missing in 1 place, for up to {int(gap_s)}."
    assert len([one for one in result.remarks if one.startswith(begins)]) == 1
    (series,) = read_series(tmp_path / "a.mcap")
    since_s = series.t_s - series.torque_t_s[0]
    silent = (since_s > 19.95) & (since_s < 20.05 + gap_s)
    assert silent.sum() >= 2
    assert not np.isfinite(series.torque_at_frames()[silent]).any()


def test_times_without_a_date_count_from_the_named_one(tmp_path):
    t_s, volts = 0.54 * np.arange(1, 41), np.random.default_rng(0).uniform(0.01, 0.5, (40, 1024))
    frames = np.column_stack([t_s, volts])
    savemat(tmp_path / "right.mat", {"Right_Data": frames})
    found = import_mat([tmp_path / "right.mat"], tmp_path / "a.mcap", "elapsed")
    assert found.remarks[0] == "The files name no date: their time 0 is 1970-01-02 00:00 UTC in the recording."
    # A frame is measured before it arrives, here before the time 0.
    began_ns = summarise(tmp_path / "a.mcap").first_unix_ns
    assert abs(began_ns - 86_400e9) < 1e9
