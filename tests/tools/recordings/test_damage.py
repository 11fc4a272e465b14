"""What becomes of a recording whose bytes are spoilt or cut off: a sentence, or all that was in it."""

import io
import json
import re
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from shearloop.bank.channels import PAPER_TABLE
from shearloop.cli import main
from shearloop.daemon.clock import Clock
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.recorder import AttachedFile, Identity, Recorder
from shearloop.daemon.recorder.schema import basic_identity
from shearloop.daemon.recorder.writer import new_recording
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.errors import UserError
from shearloop.tools.recordings.export import export
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.listing import list_recordings
from shearloop.tools.recordings.reader import open_recording
from shearloop.tools.recordings.repair import repair
from shearloop.tools.recordings.replay import RecordedRun
from shearloop.tools.recordings.summary import summarise
from shearloop.tools.recordings.tables import RecordedTopics
from tests.daemon.recorder.test_recorder import frame, torque

CONFIGURATION = {"fingertips": {"right": {"device": {"path": "eit-right"}}}}


@pytest.fixture(scope="module")
def content(tmp_path_factory) -> bytes:
    """Return a recording as the daemon's own recorder makes it, of two chunks, with inputs and a configuration."""
    folder = tmp_path_factory.mktemp("whole")
    attached = AttachedFile("configuration.json", "application/json", json.dumps(CONFIGURATION).encode())
    recorder = Recorder(folder, Identity(basic_identity("a test"), (attached,)), Clock())
    inputs = recorder.input_recorder("right")
    for number in range(4):
        inputs.record(RawEvent(InputKind.DATA, time.monotonic_ns(), b"0.1, 0.2\r\n"))
        recorder.record_message("eit.frame", frame(number))
        recorder.record_message("load.torque", torque(number))
        if number == 1:
            recorder.write()
    recorder.close()
    (path,) = recorder.closed_files
    return path.read_bytes()


def happened(path: Path) -> list[Any]:
    run = RecordedRun(path)
    with run.configuration() as config:
        assert list(config.fingertips) == ["right"]
    run.replay_events()
    return list(run.events())


def exported(path: Path) -> list[bytes]:
    return [one.read_bytes() for one in export(path, "csv", path.parent / "csv", list(RecordedTopics(path)))]


def info(path: Path) -> list[tuple[str, int]]:
    found = summarise(path)
    # What is torn or damaged is said so here, and is no mistake.
    if found.closed and not found.damaged_chunks:
        return sorted((name, topic.messages) for name, topic in found.topics.items())
    return []


def test_a_recording_that_is_being_written_says_so_and_an_abandoned_one_is_repaired(tmp_path, ran):
    recorder = Recorder(tmp_path, Identity(basic_identity("a test")), Clock())
    recorder.input_recorder("right").record(RawEvent(InputKind.OPENED, 5))
    recorder.write()
    (partial,) = tmp_path.glob("*.partial")
    abandoned = tmp_path / "killed.mcap.partial"
    abandoned.write_bytes(partial.read_bytes())
    with pytest.raises(UserError, match="is being written, and its writer finishes it: end the run, or name a copy"):
        repair(partial)
    copied = repair(partial, tmp_path / "copy.mcap")
    assert copied.being_written
    assert "It is being written" in ran("recording", "info", partial).out
    assert not repair(abandoned).being_written
    assert "not closed, or is being written" in ran("recording", "info", abandoned).out
    listed = {Path(one.path).name: one.being_written for one in list_recordings(tmp_path)}
    assert listed[partial.name]
    assert not listed[abandoned.name]
    with pytest.raises(UserError, match="the recording is being written; end the run"), open_recording(partial):
        pass
    recorder.close()
    assert recorder.failure == ""


def repaired(path: Path) -> int:
    done = repair(path, path.with_name("repaired.mcap"))
    assert sum(RecordedTopics(done.path).counts.values()) == done.messages
    return 0


def calibrated(path: Path) -> list[float]:
    found = read_recording(path)
    return [*found.torque_nm.tolist(), *found.sides["right"].lines.ravel().tolist()]


READERS: list[Callable[[Path], Any]] = [happened, exported, calibrated, info, repaired]


@pytest.fixture(scope="module")
def sound(content, tmp_path_factory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("sound") / "x.mcap"
    path.write_bytes(content)
    return {read.__name__: read(path) for read in READERS}


@settings(max_examples=200, deadline=None)
@given(where=st.floats(0, 0.9999), length=st.integers(1, 30), cut=st.booleans(), reader=st.sampled_from(READERS))
def test_damage_is_an_error_with_the_files_name_or_harmless(
    content, sound, tmp_path_factory, where, length, cut, reader
):
    at = int(where * len(content))
    spoilt = bytes(255 - byte for byte in content[at : at + length])
    path = tmp_path_factory.mktemp("damaged") / "x.mcap"
    path.write_bytes(content[:at] if cut else content[:at] + spoilt + content[at + length :])
    try:
        found = reader(path)
    except UserError as error:
        said = str(error)
    else:
        assert found in (sound[reader.__name__], [])
        assert not cut or reader in (info, repaired)
        return
    assert str(path) in said


def spoilt(content: bytes, what: str) -> bytes:
    changed = bytearray(content)
    match what:
        case "chunk":
            # The second chunk's compressed bytes: zstd's magic number begins them.
            at = content.rindex(b"\x28\xb5\x2f\xfd")
            changed[at + 8 : at + 24] = bytes(16)
        case "configuration":
            changed[content.index(b'{"fingertips"')] = 0xFF
        case "index":
            changed[-200] ^= 0xFF
        case "cut":
            return content[: len(content) // 2]
        case "short":
            return content[:8]
    return bytes(changed)


@pytest.mark.parametrize(
    ("arguments", "damages"),
    [
        (["recording", "export", "{path}"], ["chunk", "index", "cut", "short"]),
        (["recording", "replay", "{path}", "--publish", "{address}"], ["chunk", "configuration", "cut", "short"]),
        (["calibrate", "{path}", "--out", "{out}"], ["chunk", "cut", "short"]),
    ],
)
def test_each_command_exits_with_status_2(arguments, damages, content, tmp_path, mistake):
    path = tmp_path / "x.mcap"
    places = {"path": path, "address": f"ipc://{tmp_path}/replay", "out": tmp_path / "out.cal"}
    for what in damages:
        path.write_bytes(spoilt(content, what))
        said = mistake(*[one.format(**places) for one in arguments])
        assert f"{path}: the recording was not closed, or is damaged (" in said, what
        cure = "it holds no intact message" if what == "short" else f"`shearloop recording repair {path}`"
        assert cure in said, what
        assert what != "cut" or "(it has no index at its end)" in said
        assert "Traceback" not in said


@pytest.mark.parametrize("where", ["metadata", "statistics"])
def test_a_wrong_byte_that_all_readers_would_accept_is_found_by_its_checksum(where, content, tmp_path):
    path = tmp_path / "x.mcap"
    first_ns = make_reader(io.BytesIO(content)).get_summary().statistics.message_start_time
    # The last place of the first time is in the statistics, at the end of the file.
    at = content.index(b"a test") if where == "metadata" else content.rindex(first_ns.to_bytes(8, "little"))
    path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    with pytest.raises(UserError, match="is damaged"):
        read_recording(path)


@settings(max_examples=80, deadline=None)
@given(where=st.floats(0, 0.9999), bit=st.integers(0, 7))
def test_what_readers_refuse_info_calls_damaged_and_repair_mends(content, tmp_path_factory, where, bit):
    at = int(where * len(content))
    path = tmp_path_factory.mktemp("flipped") / "x.mcap"
    path.write_bytes(content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :])
    try:
        with open_recording(path):
            refused = ""
    except UserError as error:
        refused = str(error)
    assert "the recording is whole" not in refused
    if refused.endswith(("nothing to read", "nothing can be saved")):
        return
    # A reader does not look at each length.
    assert summarise(path).is_damaged or not refused
    copy = repair(path, path.with_name("copy.mcap"))
    assert copy.was_damaged or not refused
    with open_recording(copy.path):
        pass


def test_a_damaged_index_changes_no_channel_and_no_identity(content, tmp_path):
    """The index repeats each channel with the recording's identity."""
    index = int.from_bytes(content[-28:-20], "little")
    for repeated in (b"load.torque", basic_identity("a test")["channel_table_hash"].encode()):
        at = content.index(repeated, index)
        path = tmp_path / f"{at}.mcap"
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        copy = repair(path, tmp_path / f"{at}.copy.mcap")
        with open_recording(copy.path) as recording:
            assert "load.torque" in recording.counts


@pytest.mark.parametrize(
    ("place", "said"), [("header", "A part outside of its messages is damaged"), ("index", "Its index is damaged")]
)
def test_info_names_damage_outside_of_the_messages(place, said, content, tmp_path, ran):
    path = tmp_path / "x.mcap"
    # The length of the header's first text begins after the magic bytes and the head of the record.
    at = 8 + 9 + 3 if place == "header" else len(content) - 200
    path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    shown = ran("recording", "info", path).out
    assert said in shown
    assert f"`shearloop recording repair {path}` makes a copy" in shown
    repaired_text = ran("recording", "repair", path).out
    assert "needs no repair" not in repaired_text
    assert "damaged" in repaired_text


def test_records_of_a_kind_that_is_unknown_here_are_no_damage(tmp_path):
    """MCAP leaves the numbers from 128 on to other programs."""
    path = recorded(tmp_path / "x.mcap", TORQUE, enable_data_crcs=False)
    content = path.read_bytes()
    at = 8 + 9 + int.from_bytes(content[9:17], "little")
    private = bytes([0x80]) + (3).to_bytes(8, "little") + b"abc"
    cut = tmp_path / "cut.mcap.partial"
    cut.write_bytes(content[:at] + private + content[at:-60])
    assert not summarise(cut).damaged_elsewhere


def test_a_check_without_a_comparison_fails(config, imported, tmp_path, ran):
    arguments = ["--speed", "max", "--publish", f"ipc://{tmp_path}/replay", "--config", str(config())]
    played, compared = ran("recording", "replay", imported, *arguments).err.splitlines()
    assert re.fullmatch(rf"{imported}: replayed [1-9]\d* recorded messages\.", played)
    assert "Nothing was compared" in compared
    assert main(["recording", "replay", str(imported), *arguments, "--check"]) == 1


LINE = [0.25] * PAPER_TABLE.n_line_values
TORQUE = (schema.LOAD_TOPIC, {"torque_nm": 0.1})
FRAME = ("eit.frame.right", {"line": LINE, "arrival_unix_ns": 10**18})


def recorded(path, *messages, attachments=(), end=None, **options):
    """Write a sound MCAP file with these messages, whatever they say."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("x")
        writer.add_metadata(schema.METADATA, schema.basic_identity("a test"))
        for name, data in attachments:
            writer.add_attachment(1, 1, name, "x", data)
        for number, (topic, content) in enumerate(messages):
            data = content if isinstance(content, bytes) else json.dumps(content).encode()
            t_ns = 10**18 + number * 10**9
            writer.add_message(writer.register_channel(topic, "json", 0), t_ns, data, t_ns, number)
        if end is not None:
            writer.add_metadata(schema.END_METADATA, end)
        writer.finish()
    return path


EVALUATE = ["evaluate", "{calibration}", "{path}"]
CSV, LEROBOT, SLICES = (
    ["recording", "export", "{path}", "--format", form, "--out", "{out}"] for form in ("csv", "lerobot", "slices")
)
REPLAY = ["recording", "replay", "{path}", "--speed", "max", "--publish", "{address}"]
INFO = ["recording", "info", "{path}"]
BARE = json.dumps(CONFIGURATION).encode()


@pytest.mark.parametrize(
    ("arguments", "messages", "others", "problem"),
    [
        (EVALUATE, [(FRAME[0], {**FRAME[1], "line": ["x"] * len(LINE)})], {}, "could not convert"),
        (INFO, [TORQUE], {"end": {"dropped": "abc"}}, "invalid literal"),
        (CSV, [("eit.frame.a\0b", FRAME[1])], {}, r"it has the topic 'eit.frame.a\\x00b'"),
        (CSV, [("eit.frame.../../x", FRAME[1])], {}, "it has the topic 'eit.frame.../../x'"),
        (SLICES, [FRAME, TORQUE], {}, "nothing to export"),
        (LEROBOT, [(FRAME[0], {**FRAME[1], "arrival_unix_ns": 10**30})], {}, "not an integer of 64 bits"),
        (
            LEROBOT,
            [(FRAME[0], {**FRAME[1], "arrival_unix_ns": "noon"})],
            {},
            "arrival_unix_ns is 'noon', not an integer of 64 bits",
        ),
        (LEROBOT, [(FRAME[0], {**FRAME[1], "line": ["x"] * len(LINE)})], {}, "not a list of numbers"),
        (LEROBOT, [(FRAME[0], {})], {}, "it lacks the key 'arrival_unix_ns'"),
        (CSV, [("load.moment", {}), TORQUE], {}, "the recording has no schema of it"),
        (CSV, [("units", {}), TORQUE], {}, "no version has a topic 'units'"),
        (CSV, [("a b", {}), TORQUE], {}, "no version has a topic 'a b'"),
        (LEROBOT, [TORQUE], {"attachments": [("a\0b", b"")]}, "it has the attachment"),
        (LEROBOT, [TORQUE], {"attachments": [(schema.CONFIGURATION, b"[" * 100_000)]}, "recursion"),
        (REPLAY, [TORQUE], {"attachments": [("a\0b", b""), (schema.CONFIGURATION, BARE)]}, "it has the attachment"),
    ],
)
def test_a_sound_file_with_wrong_content_is_refused(
    arguments, messages, others, problem, tmp_path, tiny_calibration, mistake
):
    if arguments is LEROBOT:
        pytest.importorskip("pyarrow")
    path = recorded(tmp_path / "x.mcap", *messages, **others)
    places = {"path": path, "address": f"ipc://{tmp_path}/replay", "out": tmp_path / "out"}
    places["calibration"] = tiny_calibration
    said = mistake(*[one.format(**places) for one in arguments])
    assert re.search(problem, said), said
    assert str(path) in said


def test_a_long_name_of_an_attachment_is_no_hindrance(tmp_path):
    path = recorded(tmp_path / "x.mcap", TORQUE, attachments=[("a" * 3000, b""), (schema.CONFIGURATION, BARE)])
    with RecordedRun(path).configuration() as config:
        assert list(config.fingertips) == ["right"]


@pytest.mark.parametrize("packed", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_chunk_that_would_fill_the_memory_is_not_unpacked(packed, tmp_path):
    blanks = b'{"torque_nm": 0.1' + b" " * (70 << 20) + b"}"
    path = recorded(tmp_path / "x.mcap", (TORQUE[0], blanks), compression=packed, chunk_size=1 << 30)
    tracemalloc.start()
    with pytest.raises(UserError, match="a chunk of 70 MB, packed by"):
        read_recording(path)
    assert summarise(path).damaged_chunks == 1
    assert tracemalloc.get_traced_memory()[1] < 16e6
    tracemalloc.stop()


@pytest.mark.parametrize("packed", CompressionType)
@pytest.mark.parametrize("stated", [True, False])
def test_chunks_of_other_writers_are_read_however_they_are_packed(packed, stated, tmp_path, monkeypatch):
    if not stated:
        # As a streaming writer packs, which does not know the size when it begins.
        compress = lz4.frame.compress
        monkeypatch.setattr("lz4.frame.compress", lambda data: compress(data, store_size=False))
    path = recorded(tmp_path / "x.mcap", FRAME, TORQUE, compression=packed)
    found = read_recording(path)
    assert (len(found.sides["right"].lines), found.torque_nm.tolist()) == (1, [0.1])
    assert summarise(path).damaged_chunks == 0


def test_an_unknown_packing_is_named(tmp_path):
    path = recorded(tmp_path / "x.mcap", TORQUE, compression=CompressionType.LZ4, enable_crcs=False)
    path.write_bytes(path.read_bytes().replace(b"\x03\0\0\0lz4", b"\x03\0\0\0xyz"))
    with pytest.raises(UserError, match="packed by 'xyz', which is neither zstd nor lz4"):
        read_recording(path)


@pytest.mark.parametrize("cut", [0, 1, 400])
def test_recordings_that_were_joined_by_cat_are_refused(content, cut, tmp_path):
    """The numbers of channels are a file's own: messages of the second one would land under topics of the first."""
    with new_recording(tmp_path / "other.mcap", "a bench", {}) as writer:
        writer.add_torque(10**18, 0.01)
    other = (tmp_path / "other.mcap").read_bytes()
    for number, second in enumerate((content, other)):
        path = tmp_path / f"joined-{number}.mcap.partial"
        path.write_bytes(content[: len(content) - cut] + second)
        with pytest.raises(UserError, match="it holds several recordings"):
            repair(path)
