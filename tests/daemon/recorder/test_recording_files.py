"""Recordings as files: written, read, inspected, repaired, exported, imported."""

import csv
import json
import os
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import zmq
from mcap.writer import Writer
from scipy.io import loadmat, savemat

import shearloop
from shearloop.bank.channels import PAPER_TABLE
from shearloop.cli import replay
from shearloop.daemon.config import RecordingConfig, load_daemon_config
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.recorder import daemon_identity
from shearloop.daemon.recorder.schema import EMULATED, LOAD_DOUBT_NOTE, software_version
from shearloop.daemon.recorder.writer import new_recording
from shearloop.errors import UserError
from shearloop.tools.frame_series import part_of, read_series, series_of
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.matlab_import import import_mat
from shearloop.tools.recordings.reader import read_messages
from shearloop.tools.recordings.replay import RecordedRun
from shearloop.tools.recordings.summary import summarise
from shearloop.tools.recordings.tables import RecordedTopics, arrays
from shearloop.words import counted
from tests.fixtures.recordings import START_DATENUM

LINES = PAPER_TABLE.line_of_channels(np.round(np.random.default_rng(0).uniform(0, 1, (4, 896)), 4))


def written(path: Path) -> Path:
    with new_recording(path, "a bench", {"tool": "driver"}) as writer:
        for i, line in enumerate(LINES):
            writer.add_frame("right", 10**18 + i * 541_000_000, 10**18 + i * 541_000_000 + 300_000_000, line)
            writer.add_torque(10**18 + i, 0.01 * i)
    return path


@pytest.fixture
def recording(tmp_path) -> Path:
    return written(tmp_path / "twist.mcap")


def test_info_shows_the_content(recording, ran, result_of):
    printed = ran("recording", "info", recording).out
    assert "a bench" in printed
    assert "eit.frame.right               4 messages     1.85 Hz" in printed
    assert "the same code as here" in printed
    printed = result_of("recording", "info", recording)
    assert printed["topics"]["load.torque"]["messages"] == 4
    assert (printed["closed"], printed["same_code"], printed["size_bytes"]) == (True, True, recording.stat().st_size)


@pytest.mark.parametrize(
    ("times_s", "rate_hz"),
    [([0.0, 0.0054], None), ([0.0, 600.0], None), ([0.0, 0.01, 0.02, 0.03], None), ([0.0, 0.6, 1.2], 1 / 0.6)],
)
def test_a_few_messages_or_a_short_time_have_no_rate(times_s, rate_hz, tmp_path, ran):
    with new_recording(tmp_path / "a.mcap", "a bench") as writer:
        for time_s in times_s:
            writer.add_torque(10**18 + round(1e9 * time_s), 0.1)
    topic = summarise(tmp_path / "a.mcap").topics["load.torque"]
    assert topic.rate_hz == (rate_hz and pytest.approx(rate_hz))
    assert (" Hz" in ran("recording", "info", tmp_path / "a.mcap").out) is (rate_hz is not None)


def test_info_has_one_line_for_each_name(tmp_path, ran):
    """An experiment's name may hold a line feed, and would begin a line that nothing said."""
    path = tmp_path / "a.mcap"
    with new_recording(path, "a bench\n  EMULATED") as writer:
        writer.add_torque(10**18, 0.1)
    said = ran("recording", "info", path).out
    assert "  source   a bench\\u000a  EMULATED\n" in said


@pytest.mark.parametrize(
    ("name", "begun"),
    [
        ("2026-11-21T10-46-18Z_hold-0.10-n-m.mcap", True),
        ("2026-11-21T10-46-18Z-2.mcap", True),
        ("2026-11-21T10-46-15Z.mcap", False),
        ("twist.mcap", False),
    ],
)
def test_info_explains_a_first_message_from_before_the_time_in_the_name(name, begun, tmp_path, ran):
    """Messages have the times of their measurement, and wait until their file is begun."""
    path = tmp_path / name
    began_ns = round(datetime(2026, 11, 21, 10, 46, 15, 500_000, tzinfo=UTC).timestamp() * 1e3) * 10**6
    with new_recording(path, "a bench") as writer:
        writer.add_torque(began_ns, 0.1)
    said = ran("recording", "info", path).out
    assert ("by its name; what was measured up to 2.5 s before waited for it" in said) is begun
    assert (":46:18 " in said) is begun


@pytest.mark.parametrize(
    ("content", "remark"),
    [(lambda whole: whole[:8], "not closed"), (lambda whole: whole[:-40] + b"?" + whole[-39:], "index is damaged")],
    ids=["begun", "damaged"],
)
def test_list_says_what_is_wrong_with_a_file_without_an_index(content, remark, recording, tmp_path, ran):
    recording.write_bytes(content(recording.read_bytes()))
    assert remark in ran("recording", "list", tmp_path).out


def test_list_shows_the_recordings_of_a_folder_with_what_is_known_of_each(recording, tmp_path, ran, mistake):
    later, torn = tmp_path / "later" / "twist.mcap", tmp_path / "torn.mcap.partial"
    later.parent.mkdir()
    with new_recording(later, "a bench") as writer:
        writer.add_torque(2 * 10**18, 0.1)
    torn.write_bytes(recording.read_bytes()[:-400])
    (tmp_path / "other.mcap").write_bytes(b"no recording")
    lines = ran("recording", "list", tmp_path).out.splitlines()
    names = [next(word for word in line.split() if ".mcap" in word) for line in lines[1:]]
    assert [Path(name).relative_to(tmp_path) for name in names] == [
        Path("twist.mcap"),
        Path("later/twist.mcap"),
        Path("other.mcap"),
        Path("torn.mcap.partial"),
    ]
    assert lines[1].split()[3] == "2"
    assert "this is not an MCAP file, or is empty" in lines[3]
    assert "not closed, or being written" in lines[4]
    assert lines[4].split()[:3:2] == ["–", f"{torn.stat().st_size / 1e6:.1f}"]
    # Each column begins at its heading, also in a row that lacks some.
    for heading, begins in (("size", "0.0 MB"), ("file", str(tmp_path)), ("experiment", "–"), ("remark", "not closed")):
        assert lines[4][lines[0].index(heading) :].startswith(begins)
    found = [json.loads(line) for line in ran("recording", "list", tmp_path, "--json").out.splitlines()]
    assert [one["closed"] for one in found] == [True, True, True, False]
    assert found[0]["first_unix_ns"] == 10**18
    assert "is no folder" in mistake("recording", "list", recording)
    recording.rename(recording.with_name("two\nlines.mcap"))
    assert len(ran("recording", "list", tmp_path).out.splitlines()) == len(lines)
    assert "two\\u000alines.mcap" in ran("recording", "list", tmp_path).out
    recording.with_name("two\nlines.mcap").rename(recording)
    later.unlink()
    assert "no recording is in this folder" in ran("recording", "list", later.parent).out


def test_a_check_runs_beside_a_daemon(recording, tiny_bank, tmp_path, ran, mistake, monkeypatch):
    config = tmp_path / "rig.yaml"
    config.write_text(f"fingertips: {{right: {{device: {{path: a}}, bank: {tiny_bank}}}}}")
    arguments = ("recording", "replay", recording, "--speed", "max", "--config", config)
    with zmq.Context() as context, context.socket(zmq.PUB) as daemon:
        daemon.bind("tcp://127.0.0.1:*")
        address = daemon.getsockopt_string(zmq.LAST_ENDPOINT)
        monkeypatch.setattr(replay, "PUBLISH_ADDRESS", address)
        # A recording without raw input has nothing to compare.
        assert "Nothing was compared" in ran(*arguments, "--check", status=1).err
        for more in ((), ("--check", "--publish", address)):
            said = mistake(*arguments, *more)
            assert f"`publish: {address}` is already in use" in said
            assert "give another one with `--publish`" in said


def test_a_torn_recording_is_refused_and_repaired(recording, tmp_path, ran, mistake):
    whole = recording.read_bytes()
    torn = tmp_path / "torn.mcap.partial"
    torn.write_bytes(whole[: len(whole) - 400])
    mistake("evaluate", "x.cal", torn)
    assert f"shearloop recording repair {torn}" in mistake("recording", "export", torn)
    assert "It was not closed" in ran("recording", "info", torn).out
    said = ran("recording", "repair", torn).out
    assert "torn.mcap: 8 messages are saved" in said
    assert "was intact" not in said
    assert torn.exists(), "the original stays"
    found = read_recording(tmp_path / "torn.mcap")
    np.testing.assert_array_equal(found.sides["right"].lines, LINES)
    assert found.source == "a bench"
    assert "exists already" in mistake("recording", "repair", torn)


def test_an_intact_recording_that_is_repaired_is_said_to_have_been_intact(recording, ran, result_of):
    assert f"{recording} was intact: it needs no repair" in ran("recording", "repair", recording).out
    recording.with_name(f"{recording.stem}.repaired.mcap").unlink()
    assert result_of("recording", "repair", recording)["was_damaged"] is False


def test_a_damaged_chunk_is_left_out_and_counted(tmp_path, ran, result_of, monkeypatch):
    monkeypatch.setattr("shearloop.daemon.recorder.writer._FLUSH_EVERY", 1)
    path = tmp_path / "a.mcap"
    with new_recording(path, "a bench") as writer:
        for i in range(100):
            writer.add_torque(10**18 + i, 0.01 * i)
    content = bytearray(path.read_bytes())
    # In the packed data of a chunk: zstd's magic number begins it.
    at = content.index(b"\x28\xb5\x2f\xfd", len(content) // 4) + 8
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


@pytest.mark.parametrize(
    ("out", "written"), [("mine", "mine.mat"), ("mine.mat", "mine.mat"), ("folder", "folder/twist.mat")]
)
def test_a_matlab_export_has_the_ending_that_matlab_reads(out, written, recording, tmp_path, result_of):
    (tmp_path / "folder").mkdir()
    files = result_of("recording", "export", recording, "--format", "mat", "--out", tmp_path / out)["files"]
    assert files == [str(tmp_path / written)]
    assert "load_torque" in loadmat(files[0])


def test_csv_is_refused_where_a_later_array_is_longer(tmp_path, mistake):
    with new_recording(tmp_path / "x.mcap", "a bench") as file:
        for length in (3, 4):
            file.add_frame("right", 10**18, 10**18, np.zeros(length))
    assert "3 values of line and a later one 4; use --format mat" in mistake(
        "recording", "export", tmp_path / "x.mcap", "--format", "csv"
    )


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
            "no/where.mat: there is no folder",
        ),
    ],
)
def test_mistakes_end_in_one_sentence(arguments, message, recording, tmp_path, mistake):
    (tmp_path / "text.mcap").write_text("not a recording at all")
    given = [one.format(folder=tmp_path, recording=recording) for one in arguments]
    assert message in mistake("recording", *given)
    assert not list(tmp_path.glob("*.tmp"))


def test_a_recording_round_trips(recording):
    found = read_recording(recording)
    assert (found.source, found.notes) == ("a bench", {"tool": "driver"})
    np.testing.assert_array_equal(found.sides["right"].lines, LINES)
    np.testing.assert_array_equal(np.diff(found.sides["right"].t_mid_ns), 541_000_000)
    arrivals = [content["arrival_unix_ns"] for _, content, _ in read_messages(recording, ["eit.frame.right"])]
    np.testing.assert_array_equal(arrivals, found.sides["right"].t_mid_ns + 300_000_000)
    np.testing.assert_allclose(found.torque_nm, 0.01 * np.arange(4))
    assert list(recording.parent.iterdir()) == [recording]


def test_messages_out_of_order_are_sorted(tmp_path):
    with new_recording(tmp_path / "a.mcap", "x") as writer:
        for t in (3, 1, 2):
            writer.add_torque(t, float(t))
    np.testing.assert_array_equal(read_recording(tmp_path / "a.mcap").torque_nm, [1, 2, 3])


def test_an_unfinished_recording_stays_partial(tmp_path):
    def interrupted():
        with new_recording(tmp_path / "a.mcap", "x") as writer:
            writer.add_torque(1, 1.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.partial"]
    assert read_recording(tmp_path / "a.mcap.partial").torque_nm.tolist() == [1.0]


@pytest.mark.parametrize("read", [read_recording, RecordedRun, RecordedTopics])
def test_foreign_and_outdated_files_are_refused(tmp_path, monkeypatch, read):
    (tmp_path / "text.mcap").write_text("hello")
    with (tmp_path / "other.mcap").open("wb") as file:
        other = Writer(file)
        other.start()
        other.finish()
    # The digest is cached in the table once it is read.
    for name, owner, key, value in (
        ("stale", PAPER_TABLE, "digest", "0" * 64),
        ("old", schema, "FORMAT_VERSION", "1"),
        ("newer", schema, "FORMAT_VERSION", "11"),
    ):
        with monkeypatch.context() as outdated:
            outdated.setitem(vars(owner), key, value)
            written(tmp_path / f"{name}.mcap")
    for name, why in (
        ("text", r"text\.mcap: this is not an MCAP file"),
        ("other", "not a recording of shearloop"),
        ("none", "No such file"),
        ("stale", "channel table 000000000000…"),
        ("old", "format version 1, expected 2; record it again, or import it again"),
        ("newer", f"is newer: it has format version 11, expected 2; use shearloop {software_version()} or later"),
    ):
        with pytest.raises(UserError, match=why):
            read(tmp_path / f"{name}.mcap")


def test_a_recording_without_frames_is_refused_in_a_sentence(tmp_path):
    with new_recording(tmp_path / "a.mcap", "x") as writer:
        writer.add_torque(1, 1.0)
    with pytest.raises(UserError, match=r"a\.mcap has no frames of a fingertip; record or import them"):
        read_series(tmp_path / "a.mcap")


def test_info_names_the_version_that_other_commands_refuse(tmp_path, monkeypatch, ran):
    with monkeypatch.context() as outdated:
        outdated.setattr(schema, "FORMAT_VERSION", "1")
        written(tmp_path / "a.mcap")
    said = ran("recording", "info", tmp_path / "a.mcap").out
    assert "It has format version 1, expected 2: other commands refuse it." in said


def test_info_shows_the_recordings_beside_an_unreadable_one(tmp_path, ran):
    written(tmp_path / "a.mcap")
    said = ran("recording", "info", tmp_path / "none.mcap", tmp_path / "a.mcap", "--json", status=2)
    assert json.loads(said.out)["path"] == str(tmp_path / "a.mcap")
    assert "none.mcap: the recording cannot be read: No such file or directory" in said.err


def test_an_unwritable_recording_is_an_error(tmp_path):
    with pytest.raises(UserError, match="choose another --out"), new_recording(tmp_path / "no" / "where.mcap", "x"):
        pass


def test_a_side_that_no_file_has_is_not_to_be_imported(recording):
    for side, cure in (("left", "import those files as well"), ("up", "name a side that it has")):
        with pytest.raises(UserError, match=f"has frames of right, not of {side}; {cure}"):
            read_series(recording, (side,))


def test_a_folder_name_that_is_not_utf8_is_an_error(config):
    recorded = RecordingConfig(folder=Path(os.fsdecode(b"caf\xe9")))
    with pytest.raises(
        UserError, match=r"not UTF-8 \(the folder of the recordings is 'caf\\udce9'\); choose another name"
    ):
        daemon_identity(load_daemon_config(config()).model_copy(update={"recording": recorded}), {})


PERIOD_S = 0.5408


@pytest.mark.parametrize(
    "late", [[(20, 0.3), (21, 0.12), (40, 1.4), (41, 0.9), (42, 0.35)], [(59, 0.5)], [(57, 1.2), (58, 0.9), (59, 0.5)]]
)
def test_late_frames_get_the_middle_of_their_acquisition(late, mat_folder, tmp_path):
    imported = import_mat([mat_folder(late=late)], tmp_path / "a.mcap")
    assert "missing" not in " ".join(imported.remarks)
    frames = read_recording(tmp_path / "a.mcap").sides["right"]
    expected = (START_DATENUM - 719529) * 86400 + PERIOD_S * (np.arange(60) + 0.5)
    np.testing.assert_allclose(frames.t_mid_ns / 1e9, expected, rtol=0, atol=0.01)


@pytest.mark.parametrize("missing", [[30], range(25, 40), [20, 24, 41]])
def test_frames_on_either_side_of_missing_ones_keep_their_times(missing, mat_folder, tmp_path):
    imported = import_mat([mat_folder(missing=missing, late=[(23, 0.3), (45, 0.4)])], tmp_path / "a.mcap")
    frames = read_recording(tmp_path / "a.mcap").sides["right"]
    whole_s = (START_DATENUM - 719529) * 86400 + PERIOD_S * (np.arange(60) + 0.5)
    expected = np.delete(whole_s, missing)
    np.testing.assert_allclose(frames.t_mid_ns / 1e9, expected, rtol=0, atol=0.01)
    places = 1 + np.count_nonzero(np.diff(missing) > 1)
    assert f"Frames of the right side are missing in {counted(int(places), 'place')}, for up to" in " ".join(
        imported.remarks
    )


def test_a_loop_that_paused_is_refused(mat_folder, tmp_path):
    folder = mat_folder(one_loop=True, missing=range(25, 40))
    with pytest.raises(UserError, match=r"missing between the rows 25 and 26, for 8\.7 s"):
        import_mat([folder], tmp_path / "a.mcap")


def test_a_load_read_once_per_frame_gets_its_own_period(mat_folder, tmp_path):
    imported = import_mat([mat_folder(one_loop=True)], tmp_path / "a.mcap")
    assert "read once per frame" in imported.remarks[0]
    found = read_recording(tmp_path / "a.mcap")
    np.testing.assert_allclose(np.diff(found.torque_t_ns) / 1e9, 0.0916, atol=1e-6)
    assert "read once per frame" in found.notes["remarks"]


@pytest.mark.parametrize(("begins_s", "moved_s", "error_s"), [(3.8, "3.53", 0.27), (2.6, "2.70", 0.37 + 0.27)])
def test_a_loop_that_waits_for_its_load_gives_the_times_of_both(begins_s, moved_s, error_s, mat_folder, tmp_path):
    """A row is stamped, then waits for its frame and for its load value; the load cell begins late.

    Stamps that agree with the paper's program within their doubt count as that program, whose delay is known.
    """
    frame_s, load_s, stamps = 0.8 + PERIOD_S * np.arange(60), begins_s + 0.0916 * np.arange(60), [0.0]
    for ends in zip(frame_s[:-1], load_s[:-1], strict=True):
        stamps.append(max(stamps[-1], *ends))
    late = list(enumerate(np.array(stamps) - PERIOD_S * np.arange(1, 61)))
    imported = import_mat([mat_folder(one_loop=True, late=late)], tmp_path / "a.mcap")
    found = read_recording(tmp_path / "a.mcap")
    start_ns = found.torque_t_ns[0] - begins_s * 1e9
    np.testing.assert_allclose((found.torque_t_ns - start_ns) / 1e9, load_s, atol=1e-3)
    middle_s = (found.sides["right"].t_mid_ns - start_ns) / 1e9
    assert np.abs(frame_s - PERIOD_S / 2 - middle_s).max() <= error_s + 0.01
    assert f"The load's times were moved by {moved_s} s" in imported.remarks[1]
    assert LOAD_DOUBT_NOTE not in found.notes
    import_mat([mat_folder("regular", one_loop=True)], tmp_path / "b.mcap")
    assert "times may be seconds off" in read_series(tmp_path / "b.mcap")[0].load_doubt


def test_damaged_load_values_are_counted_and_left_out(mat_folder, tmp_path, ran):
    imported = import_mat([mat_folder(glitches=(0, 8))], tmp_path / "a.mcap")
    found = read_recording(tmp_path / "a.mcap")
    assert imported.torques == len(found.torque_nm) == 353
    assert np.abs(found.torque_nm).max() < 0.06
    assert "Left out: 2 of 355 load values beyond 1.75 N·m, which a damaged line sends" in imported.remarks[0]
    assert imported.torque_range_nm == (found.torque_nm.min(), found.torque_nm.max())
    assert f"  import   {imported.remarks[0]}" in ran("recording", "info", tmp_path / "a.mcap").out


def test_values_of_a_load_cell_that_stands_still_are_left_out(mat_folder, tmp_path):
    """A cable that broke: the last value came again and again, through the twists."""
    folder = mat_folder()
    load = loadmat(folder / "load.mat")["Load_Data"]
    load[100:150, 1] = load[100, 1]
    load[200:203, 1] = load[200, 1]
    savemat(folder / "load.mat", {"Load_Data": load})
    imported = import_mat([folder], tmp_path / "a.mcap")
    assert imported.torques == 355 - 50
    assert "Left out: 50 of 355 load values that stood 20 times or more in a row" in imported.remarks[0]


@pytest.mark.parametrize("step_nm", [1e-4, 5e-4, 1e-3, 5e-3, 0.02])
def test_rounded_load_values_that_repeat_are_kept_and_those_of_a_line_that_hung_are_not(step_nm, mat_folder, tmp_path):
    """A sketch that prints few digits repeats a value while the load rests or moves slowly."""
    folder = mat_folder()
    load = loadmat(folder / "load.mat")["Load_Data"]
    seconds = np.arange(0, 33, 0.03)[: len(load)]
    noise = np.random.default_rng(0).normal(0, 1.4e-5, len(load))
    torque = np.where(seconds > 3, 0.04 * (1 - np.cos(1.5 * (seconds - 3))), 0.0) + noise
    load[:, 1] = np.round(torque / step_nm) * step_nm
    savemat(folder / "load.mat", {"Load_Data": load})
    assert import_mat([folder], tmp_path / "a.mcap").torques == 355
    # From no load to the largest one.
    load[130:172, 1] = load[130, 1] = 0.0
    savemat(folder / "load.mat", {"Load_Data": load})
    hung = import_mat([folder], tmp_path / "b.mcap")
    assert "Left out: 42 of 355 load values that stood 20 times or more in a row" in hung.remarks[0]


def test_what_an_import_left_out_of_the_load_is_said_where_it_is_missed(mat_folder, tmp_path, mistake):
    folder = mat_folder()
    load = loadmat(folder / "load.mat")["Load_Data"]
    load[:, 1] = 0.05
    savemat(folder / "load.mat", {"Load_Data": load})
    import_mat([folder], tmp_path / "a.mcap")
    said = mistake("calibrate", tmp_path / "a.mcap", "--out", tmp_path / "a.cal")
    assert "no torque is known for these frames, and left out: 355 of 355 load values that are all 0.05 N·m" in said
    assert "record the load cell with them" not in said


def test_a_load_that_is_written_faster_than_its_cell_measures_is_kept(mat_folder, tmp_path):
    folder, repeats = mat_folder(), 15
    load = loadmat(folder / "load.mat")["Load_Data"]
    # The cell itself may measure the same twice.
    load[101::2, 1] = load[100:-1:2, 1]
    repeated = np.repeat(load, repeats, axis=0)
    repeated[:, 0] = np.interp(np.arange(len(repeated)), repeats * np.arange(len(load)), load[:, 0])
    kept = repeated[: repeats * (len(load) - 1)]
    savemat(folder / "load.mat", {"Load_Data": kept})
    assert import_mat([folder], tmp_path / "a.mcap").torques == len(kept)


def test_torques_of_another_unit_are_refused(mat_folder, tmp_path):
    folder = mat_folder(glitches=range(0, 353, 5))
    with pytest.raises(
        UserError, match=r"load\.mat: 71 of 355 load values are beyond 1\.75 N·m, .*they have another unit"
    ):
        import_mat([folder], tmp_path / "a.mcap")
    assert not list(tmp_path.glob("a.mcap*"))


def test_a_twist_in_another_unit_is_no_damage(mat_folder, tmp_path):
    """Most values of a recording without a load are small in any unit."""
    with pytest.raises(UserError, match=r"5 of 355 load values are beyond 1\.75 N·m, .*another unit"):
        import_mat([mat_folder(glitches=range(100, 105))], tmp_path / "a.mcap")


@pytest.mark.parametrize(("factor", "cause"), [(100, r"are beyond 1\.75 N·m, the capacity"), (20, "jump by more than")])
def test_a_unit_that_the_rig_cannot_reach_is_refused(factor, cause, mat_folder, tmp_path):
    """N·cm is no damage: many values are too large, or the load jumps again and again and stays there."""
    folder = mat_folder()
    load = loadmat(folder / "load.mat")["Load_Data"]
    load[:, 1] *= factor
    savemat(folder / "load.mat", {"Load_Data": load})
    with pytest.raises(UserError, match=rf"load\.mat: \d+ of 355 load values {cause}.*another unit"):
        import_mat([folder], tmp_path / "a.mcap")


@pytest.mark.parametrize("width", [1, 2])
@pytest.mark.parametrize("spike_nm", [0.13, 0.0])
def test_values_that_leave_their_neighbours_and_come_back_are_left_out(spike_nm, width, mat_folder, tmp_path):
    """Below 2 N·m/s, so that a slipping tool could do it; but it would not come back at once."""
    folder = mat_folder()
    load = loadmat(folder / "load.mat")["Load_Data"]
    load[:, 1] = 0.05 + 0.02 * np.sin(0.1 * np.arange(355))
    for at in (20, 100, 300):
        load[at : at + width, 1] = spike_nm
    savemat(folder / "load.mat", {"Load_Data": load})
    imported = import_mat([folder], tmp_path / "a.mcap")
    assert f"Left out: {3 * width} of 355 load values that leave the values around them" in imported.remarks[0]
    found = read_recording(tmp_path / "a.mcap")
    assert found.torque_nm.min() > 0.025
    assert found.torque_nm.max() < 0.075


def test_readings_of_a_daemon_that_come_back_at_once_are_not_used(tmp_path):
    """The daemon cannot wait for the next readings, which show it."""
    with new_recording(tmp_path / "a.mcap", "a daemon") as file:
        file.add_frame("right", 10**18, 10**18 + 10**8, np.ones(1024))
        for n in range(100):
            file.add_torque(10**18 + n * 91_600_000, 0.15 if n == 50 else 0.01 + 1e-5 * (n % 3))
    found = read_recording(tmp_path / "a.mcap")
    assert len(found.torque_nm) == 99
    assert found.torque_nm.max() < 0.02
    assert "1 of 100 readings of the load cell that leave the values around them" in found.left_out[0]


@pytest.mark.parametrize("factor", [1000, -1])
def test_voltages_of_another_unit_are_refused(factor, mat_folder, tmp_path):
    folder = mat_folder()
    table = loadmat(folder / "device0.mat")["Right_Data"]
    table[:, 1:] *= factor
    savemat(folder / "device0.mat", {"Right_Data": table})
    with pytest.raises(UserError, match=r"device0\.mat: 8\d% of the values are not within 0 to 2\.2 V, the range of"):
        import_mat([folder], tmp_path / "a.mcap")


@pytest.mark.parametrize("moved", ["load.mat", "device1.mat"])
def test_streams_of_two_recordings_are_refused(moved, mat_folder, tmp_path):
    folder, other = mat_folder(), mat_folder("other")
    content = {name: table for name, table in loadmat(other / moved).items() if not name.startswith("__")}
    for table in content.values():
        table[:, 0] += 377 / 86400
    savemat(other / moved, content)
    sources = [path for path in folder.iterdir() if path.name != moved]
    with pytest.raises(
        UserError, match=rf"other/{moved} begins 34\d s after the end of .*: they are of two recordings"
    ):
        import_mat([*sources, other / moved], tmp_path / "a.mcap")


@pytest.mark.parametrize(("hours", "named"), [(1, "1 h"), (-5.5, "5.5 h"), (9, "9 h")])
def test_times_in_another_time_zone_are_named(hours, named, mat_folder, tmp_path):
    folder = mat_folder()
    load = loadmat(folder / "load.mat")["Load_Data"]
    load[:, 0] += hours / 24
    savemat(folder / "load.mat", {"Load_Data": load})
    later, earlier = ("load", r"device\d") if hours > 0 else (r"device\d", "load")
    cause = rf"{later}\.mat begins {named} after .*{earlier}\.mat, .*: their times are of two time zones; write both in"
    with pytest.raises(UserError, match=cause):
        import_mat([folder], tmp_path / "a.mcap")


@pytest.mark.parametrize("name", ["device0.mat", "load.mat"])
def test_a_file_with_each_row_twice_is_told_to_hold_copies(name, mat_folder, tmp_path):
    folder = mat_folder()
    ((key, rows),) = ((key, rows) for key, rows in loadmat(folder / name).items() if not key.startswith("__"))
    savemat(folder / name, {key: np.repeat(rows, 2, axis=0)})
    with pytest.raises(
        UserError, match=rf"{name}: row 2 is a copy of the row above, .*{len(rows)} copies in all.*remove"
    ):
        import_mat([folder], tmp_path / "a.mcap")


def test_a_clock_that_was_set_forward_beyond_the_last_frame_is_no_gap(mat_folder, tmp_path):
    folder = mat_folder()
    load = loadmat(folder / "load.mat")["Load_Data"]
    load[200:, 0] += 3600 / 86400
    savemat(folder / "load.mat", {"Load_Data": load})
    remarks = " ".join(import_mat([folder], tmp_path / "a.mcap").remarks)
    said = "the last 155 of 355 load values are after the last frame, from a step of 3600.1 s in their times on"
    assert said in remarks
    assert "its clock was set forward" in remarks
    assert "missing" not in remarks


@pytest.mark.parametrize("small_disk", ["64k"], indirect=True)
def test_a_refused_import_leaves_no_file(mat_folder, small_disk):
    with pytest.raises(UserError, match="No space left on device"):
        import_mat([mat_folder()], small_disk / "a.mcap")
    assert not list(small_disk.iterdir())


def test_a_recording_has_one_writer(tmp_path):
    with new_recording(tmp_path / "a.mcap", "first") as writer:
        writer.add_torque(1, 1.0)
        with pytest.raises(UserError, match="another program is writing it"), new_recording(tmp_path / "a.mcap", "b"):
            pass
        writer.add_torque(2, 2.0)
    assert read_recording(tmp_path / "a.mcap").torque_nm.tolist() == [1.0, 2.0]


def test_the_diameter_in_the_files_names_is_noted(mat_folder, tmp_path):
    folder = mat_folder()
    for path in list(folder.iterdir()):
        path.rename(folder / f"12.5mm_1_{path.name}")
    import_mat([folder], tmp_path / "a.mcap")
    (series,) = read_series(tmp_path / "a.mcap")
    assert (series.diameter_mm == 12.5).all()
    one = next(folder.glob("*load*"))
    one.rename(folder / "20mm_1_load.mat")
    with pytest.raises(UserError, match=r"of cylinders of 12\.5 and 20 mm"):
        import_mat([folder], tmp_path / "b.mcap")


def test_two_sides_are_paired_by_time(mat_folder, tmp_path):
    import_mat([mat_folder()], tmp_path / "a.mcap")
    both = series_of(read_recording(tmp_path / "a.mcap"))
    assert both.sides == ("right", "left")
    assert both.channels.shape == (60, 2, 896)
    left = series_of(read_recording(tmp_path / "a.mcap"), ("left",))
    np.testing.assert_array_equal(left.channels[:, 0], both.channels[:, 1])
    # Times count from the first right frame; the left ones arrived 0.05 s later.
    np.testing.assert_allclose(left.t_s, PERIOD_S * np.arange(60) + 0.05, atol=1e-6)
    np.testing.assert_allclose(both.t_s, PERIOD_S * np.arange(60) + 0.025, atol=1e-6)
    import_mat([mat_folder("alone", sides=("Left_Data",))], tmp_path / "b.mcap")
    np.testing.assert_allclose(series_of(read_recording(tmp_path / "b.mcap")).t_s[0], 0.0, atol=1e-9)
    assert np.isfinite(both.torque_at_frames()[2:55]).all()
    early, later = part_of(both, 0, 0.25), part_of(both, 0.25, 1)
    assert (len(early.t_s), len(later.t_s)) == (15, 45)
    with pytest.raises(UserError, match=r"none of 60 frames lies between the fractions 0 and 0\.001"):
        part_of(both, 0, 0.001)


def test_unusable_files_are_refused_by_name(mat_folder, tmp_path):
    (tmp_path / "empty").mkdir()
    savemat(tmp_path / "other.mat", {"x": np.zeros((2, 2))})
    folder = mat_folder()
    for sources, why in (
        ([tmp_path / "empty"], r"holds no \.mat files"),
        ([tmp_path / "other.mat"], r"other\.mat holds x, expected one of Right_Data"),
        ([folder, folder / "device0.mat"], "second stream of right, after .*name its files instead of the folder"),
        ([folder / "load.mat"], "no frames"),
    ):
        with pytest.raises(UserError, match=why):
            import_mat(sources, tmp_path / "a.mcap")
    with pytest.raises(UserError, match="is a folder; name a recording"):
        read_series(tmp_path / "empty")


@pytest.mark.parametrize("emulated", [False, True])
def test_a_recording_of_an_emulated_rig_says_so(emulated, config, tmp_path, ran):
    identity = daemon_identity(load_daemon_config(config()).model_copy(update={"emulated": emulated}), {})
    notes = {key: value for key, value in identity.metadata.items() if key == EMULATED}
    path = tmp_path / "moved" / "twist.mcap"
    path.parent.mkdir()
    with new_recording(path, "a bench", notes) as writer:
        for i, line in enumerate(LINES):
            writer.add_frame("right", 10**18 + i * 541_000_000, 10**18 + i * 541_000_000 + 300_000_000, line)
    assert ("EMULATED" in ran("recording", "info", path).out) is emulated
    assert read_series(path)[0].emulated is emulated
