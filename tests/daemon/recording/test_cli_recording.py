import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

import shearloop
from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.reader import read_recording
from shearloop.daemon.recording.tables import arrays
from shearloop.daemon.recording.writer import RecordingWriter

LINES = PAPER_TABLE.line_of_channels(np.round(np.random.default_rng(0).uniform(0, 1, (4, 896)), 4))


@pytest.fixture
def recording(tmp_path) -> Path:
    path = tmp_path / "twist.mcap"
    with RecordingWriter(path, "a bench") as writer:
        for i, line in enumerate(LINES):
            writer.add_frame("right", 10**18 + i * 541_000_000, 10**18 + i * 541_000_000 + 300_000_000, line)
            writer.add_torque(10**18 + i, 0.01 * i)
    return path


def test_info_shows_the_content(recording, ran, result_of):
    printed = ran("recording", "info", recording).out
    assert "a bench" in printed
    assert "eit.frame.right               4 messages     1.85 Hz" in printed
    assert "the same code as here" in printed
    printed = result_of("recording", "info", recording)
    assert printed["topics"]["load.torque"]["messages"] == 4
    assert (printed["closed"], printed["same_code"], printed["size_bytes"]) == (True, True, recording.stat().st_size)


def test_a_torn_recording_is_refused_and_repaired(recording, tmp_path, ran, mistake):
    whole = recording.read_bytes()
    torn = tmp_path / "torn.mcap.partial"
    torn.write_bytes(whole[: len(whole) - 400])
    mistake("evaluate", "x.cal", torn)
    assert f"shearloop recording repair {torn}" in mistake("recording", "export", torn)
    assert "It was not closed" in ran("recording", "info", torn).out
    assert "torn.mcap: 8 messages are saved" in ran("recording", "repair", torn).out
    assert torn.exists(), "the original stays"
    found = read_recording(tmp_path / "torn.mcap")
    np.testing.assert_array_equal(found.sides["right"].lines, LINES)
    assert found.source == "a bench"
    assert "exists already" in mistake("recording", "repair", torn)


def test_a_damaged_chunk_is_left_out_and_counted(tmp_path, ran, result_of, monkeypatch):
    monkeypatch.setattr("shearloop.daemon.recording.writer._FLUSH_EVERY", 1)
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, "a bench") as writer:
        for i in range(100):
            writer.add_torque(10**18 + i, 0.01 * i)
    content = bytearray(path.read_bytes())
    at = content.index(b'{"torque_nm":0.5}') if b'{"torque_nm":0.5}' in content else len(content) // 4
    content[at : at + 4] = bytes(255 - byte for byte in content[at : at + 4])
    path.write_bytes(content)
    assert "  1 chunk is damaged and left out.\n" in ran("recording", "info", path).out
    printed = result_of("recording", "repair", path)
    assert (printed["path"], printed["damaged_chunks"]) == (str(tmp_path / "a.repaired.mcap"), 1)
    kept = read_recording(tmp_path / "a.repaired.mcap").torque_nm
    assert set(np.round(kept, 2)) < set(np.round(0.01 * np.arange(100), 2))
    assert len(kept) == printed["messages"] >= 24


def test_csv_parquet_and_matlab_exports_agree(recording, tmp_path, result_of):
    pyarrow_parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    for form in ("csv", "parquet", "mat"):
        files = result_of("recording", "export", recording, "--format", form)["files"]
        assert all(Path(file).stat().st_size for file in files)
    with (tmp_path / "twist_csv" / "eit.frame.right.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0][:3] == ["log_time_ns", "arrival_unix_ns", "line_0"]
    np.testing.assert_array_equal(np.array(rows[1:])[:, 2:].astype(float), LINES)
    table = pyarrow_parquet.read_table(tmp_path / "twist_parquet" / "eit.frame.right.parquet").to_pydict()
    np.testing.assert_array_equal(np.array(table["line"]), LINES)
    assert table["log_time_ns"][1] == 10**18 + 541_000_000
    struct = loadmat(tmp_path / "twist.mat", simplify_cells=True)
    np.testing.assert_array_equal(struct["eit_frame_right"]["line"], LINES)
    np.testing.assert_allclose(struct["load_torque"]["torque_nm"], 0.01 * np.arange(4))
    assert struct["load_torque"]["log_time_ns"].tolist() == [10**18 + i for i in range(4)]


def test_a_recording_is_read_into_arrays_and_frames(recording, monkeypatch):
    read = shearloop.read(recording)
    assert dict(read.counts) == {"eit.frame.right": 4, "load.torque": 4}
    assert read.metadata["source"] == "a bench"
    np.testing.assert_array_equal(read["eit.frame.right"]["line"], LINES)
    np.testing.assert_array_equal(read["load.torque"]["log_time_ns"], 10**18 + np.arange(4))
    with pytest.raises(KeyError, match=r"has no topic 'health'; it has eit.frame.right, load.torque"):
        read["health"]
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pandas", None)
        with pytest.raises(UserError, match=r"needs pandas: `.* -m pip install 'shearloop\[notebook\]'`"):
            read.frame("load.torque")
    pandas = pytest.importorskip("pandas", reason="frames need the extra `notebook`")
    frame = read.frame("eit.frame.right")
    assert list(frame.columns[:2]) == ["arrival_unix_ns", "line_0"]
    np.testing.assert_array_equal(frame.iloc[:, 1:], LINES)
    assert frame.index[1] - frame.index[0] == pandas.Timedelta(541, "ms")
    assert frame.index[0] == pandas.Timestamp("2001-09-09T01:46:40Z")


@pytest.mark.parametrize(
    ("values", "kind", "expected"),
    [
        ([1, 2], np.int64, [1, 2]),
        ([1, None], np.float64, [1, np.nan]),
        ([True, False], np.bool_, [True, False]),
        (["a", None], np.object_, ["a", ""]),
        ([np.array([1.0, np.nan]), np.array([2.0])], np.float64, [[1, np.nan], [2, np.nan]]),
        ([None], np.float64, [np.nan]),
    ],
)
def test_arrays_have_the_types_of_their_values(values, kind, expected):
    found = arrays([{"key": value} for value in values])["key"]
    assert found.dtype == kind
    np.testing.assert_array_equal(found, np.array(expected, dtype=kind))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["info", "nowhere.mcap"], "nowhere.mcap: the recording cannot be read: No such file"),
        (["info", "{folder}/text.mcap"], "is not an MCAP file"),
        (["repair", "{folder}/text.mcap"], "is not an MCAP file"),
        (["export", "{recording}", "--topic", "eit.frame.left"], "it has eit.frame.right, load.torque"),
        (["export", "{recording}", "--out", "{folder}/text.mcap"], "the export cannot be written: File exists"),
        (
            ["export", "{recording}", "--format", "mat", "--out", "{folder}/no/where.mat"],
            "no/where.mat: the export cannot be written: No such file or directory",
        ),
    ],
)
def test_mistakes_end_in_one_sentence(arguments, message, recording, tmp_path, mistake):
    (tmp_path / "text.mcap").write_text("not a recording at all")
    given = [one.format(folder=tmp_path, recording=recording) for one in arguments]
    assert message in mistake("recording", *given)
    assert not list(tmp_path.glob("*.tmp"))


def test_a_topic_of_another_version_is_named(tmp_path, mistake, monkeypatch):
    path = tmp_path / "new.mcap"
    with monkeypatch.context() as newer:
        newer.setattr("shearloop.daemon.recording.schema.schema_name", lambda _: "load.torque")
        newer.setattr("shearloop.daemon.recording.schema.software_version", lambda: "99.1")
        with RecordingWriter(path, "a bench") as writer:
            writer._add("arm.temperature", 10**18, {"torque_nm": 0.5})
    said = mistake("recording", "export", path)
    assert "has no topic 'arm.temperature'; version 99.1 wrote this recording" in said
    assert "KeyError" not in said
