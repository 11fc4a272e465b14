"""The recorder: what it writes, what a kill costs, and that a full or slow disk loses nothing untold."""

import asyncio
import errno
import io
import json
import os
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq.asyncio
from mcap.reader import make_reader
from structlog.testing import capture_logs

from shearloop.bank.channels import PAPER_TABLE
from shearloop.daemon.app import Daemon
from shearloop.daemon.clock import Clock
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.messaging.messages import EitFrame, LoadTorque, LoopState, wire_map
from shearloop.daemon.recorder import recorder as recorder_module
from shearloop.daemon.recorder.recorder import AttachedFile, Identity, Recorder, slug_of
from shearloop.daemon.recorder.schema import basic_identity
from shearloop.daemon.recorder.writer import McapFile
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.errors import UserError
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.repair import repair
from shearloop.tools.recordings.summary import summarise
from shearloop.tools.recordings.tables import RecordedTopics
from tests.sample_messages import sample

IDENTITY = Identity(basic_identity("a test"), (AttachedFile("configuration.json", "application/json", b"{}"),))


def frame(number: int) -> dict:
    rng = np.random.default_rng(number)
    channels = np.round(rng.uniform(0.01, 0.5, len(PAPER_TABLE.line_slots)), 4)
    arrays = {"channels": channels, "line": PAPER_TABLE.line_of_channels(channels)}
    times = {"t_mono_ns": time.monotonic_ns() - 300_000_000, "age_s": 0.3}
    message = sample(EitFrame, source="right", frame=number, repeated=False, **arrays, **times)
    return wire_map(message, Clock().unix_s(message.t_mono_ns), number)


def torque(number: int, torque_nm: float = 0.1) -> dict:
    message = sample(LoadTorque, source="load_cell", torque_nm=torque_nm)
    return wire_map(message, Clock().unix_s(message.t_mono_ns), number)


def topics(path: Path) -> dict[str, list[dict]]:
    found: dict[str, list[dict]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages(log_time_order=False):
            content = json.loads(message.data)
            assert set(json.loads(schema.data)["required"]) <= set(content)
            found.setdefault(channel.topic, []).append(content)
    return found


def test_messages_are_recorded_with_schema_and_time(tmp_path):
    clock = Clock()
    recorder = Recorder(tmp_path / "new" / "folder", IDENTITY, clock)
    recorder.input_recorder("right").record(RawEvent(InputKind.OPENED, 5))
    recorder.input_recorder("right").record(RawEvent(InputKind.DATA, 7, bytes(range(256))))
    one = frame(0)
    recorder.record_message("eit.frame", one)
    recorder.record_message("load.torque", torque(0, float("nan")))
    recorder.close()
    assert recorder.failure == ""
    (path,) = recorder.closed_files
    found = topics(path)
    assert found["input.right"][0] == {"t_mono_ns": 5, "kind": "opened", "data": ""}
    assert found["input.right"][1]["data"].encode("latin-1") == bytes(range(256))
    assert found["input.clock"][0]["offset_ns"] == clock.offset_ns
    (kept,) = found["eit.frame.right"]
    np.testing.assert_array_equal(np.float32(kept["channels"]), np.frombuffer(one["channels"], "<f4"))
    assert kept["timestamp"] == clock.unix_s(one["t_mono_ns"])
    assert kept["arrival_unix_ns"] == one["t_mono_ns"] + clock.offset_ns + 300_000_000
    assert "channels_shape" not in kept
    assert "torque_nm" not in found["load.torque"][0], "NaN has no JSON form"
    with path.open("rb") as file:
        reader = make_reader(file)
        assert [one.name for one in reader.iter_attachments()] == ["configuration.json"]
    summary = summarise(path)
    assert (summary.closed, summary.dropped, summary.same_code) == (True, 0, True)
    assert summary.topics["input.right"].messages == 2
    assert summary.metadata["source"] == "a test"


def test_a_live_recording_is_read_like_an_import(tmp_path):
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    frames = [frame(n) for n in range(3)]
    for n, one in enumerate(frames):
        recorder.record_message("eit.frame", one)
        recorder.record_message("load.torque", torque(n))
    recorder.record_message("load.torque", {**torque(3, 9.0), "valid": False})
    recorder.close()
    found = read_recording(recorder.closed_files[0])
    wanted = np.round(np.array([np.frombuffer(one["line"], "<f4") for one in frames], dtype=np.float64), 4)
    np.testing.assert_array_equal(found.sides["right"].lines, wanted)
    assert found.torque_nm.tolist() == [0.1] * 3, "what is not valid is no truth"


def test_a_repeated_frame_is_read_once(tmp_path):
    clock = Clock()
    recorder = Recorder(tmp_path, IDENTITY, clock)
    frames = [frame(n) for n in range(2)]
    for one in (frames[0], frames[1], {**frames[1], "t_mono_ns": frames[1]["t_mono_ns"] + 10, "repeated": True}):
        recorder.record_message("eit.frame", one)
    recorder.close()
    found = read_recording(recorder.closed_files[0]).sides["right"]
    assert found.t_mid_ns.tolist() == [one["t_mono_ns"] + clock.offset_ns for one in frames]


def test_each_experiment_has_a_file_with_its_name(tmp_path):
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    recorder.record_message("load.torque", torque(0))
    recorder.record_experiment("Hold 0.10 N·m", Path("hold.yaml"), b"name: hold")
    recorder.record_message("load.torque", torque(1))
    recorder.write()
    recorder.record_experiment("again")
    recorder.record_message("load.torque", torque(2))
    recorder.close()
    first, second = recorder.closed_files
    assert first.name.endswith("_hold-0.10-n-m.mcap")
    assert second.name.endswith("_again.mcap")
    assert slug_of("Versuch Größe 1") == "versuch-grosse-1"
    assert slug_of("実験") == ""
    assert [one["seq"] for one in topics(first)["load.torque"]] == [0, 1], "what led to it is with it"
    assert [one["seq"] for one in topics(second)["load.torque"]] == [2]
    assert summarise(first).experiments == ["Hold 0.10 N·m"]
    assert summarise(first).attachments == ["configuration.json", "hold.yaml"]
    assert topics(second)["input.clock"], "each can be replayed by itself"


def test_a_clock_that_was_set_back_costs_no_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(Clock, "now_ns", lambda _: 0)
    monkeypatch.setattr(Clock, "offset_ns", 10**18)
    for number in range(3):
        recorder = Recorder(tmp_path, IDENTITY, Clock())
        recorder.record_experiment("hold")
        recorder.record_message("load.torque", torque(number))
        recorder.close()
    kept = [topics(path)["load.torque"] for path in sorted(tmp_path.iterdir())]
    assert sorted(one["seq"] for (one,) in kept) == [0, 1, 2]


def test_a_new_file_begins_after_an_hour_without_experiment(tmp_path, monkeypatch):
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    recorder.record_experiment("one")
    recorder.record_message("load.torque", torque(0))
    recorder.write()
    monkeypatch.setattr(recorder_module, "LONGEST_IDLE_FILE_S", -1.0)
    for number, phase in enumerate(("held", "done"), 1):
        message = sample(LoopState, source="loop", phase=phase)
        recorder.record_message("loop.state", wire_map(message, Clock().unix_s(message.t_mono_ns), number))
        recorder.record_message("load.torque", torque(number))
    recorder.close()
    assert [[one["seq"] for one in topics(path)["load.torque"]] for path in recorder.closed_files] == [[0, 1], [2]]


def test_a_daemon_without_a_message_leaves_no_file_and_no_folder_of_its_own(tmp_path):
    Recorder(tmp_path, IDENTITY, Clock()).close()
    assert list(tmp_path.iterdir()) == []
    Recorder(tmp_path / "recordings/emulated", IDENTITY, Clock()).close()
    assert list(tmp_path.iterdir()) == []
    refused = Recorder(tmp_path / "recordings/emulated", IDENTITY, Clock())
    (tmp_path / "recordings/notes.txt").touch()
    refused.close()
    assert list(tmp_path.rglob("*")) == [tmp_path / "recordings", tmp_path / "recordings/notes.txt"]


def test_a_recorder_that_cannot_begin_leaves_no_folder(tmp_path, monkeypatch):
    def full(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(McapFile, "flush", full)
    with pytest.raises(UserError, match="cannot record there: No space left on device"):
        Recorder(tmp_path / "recordings/emulated", IDENTITY, Clock())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_a_killed_recorder_loses_at_most_the_last_second(tmp_path):
    """Fifty recorders, each killed at a random moment of its first two seconds."""
    killed = subprocess.run(
        [sys.executable, "-m", "tests.daemon.recorder.killed_writers", str(tmp_path), "50", "2"],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    )
    folders = [Path(line) for line in killed.stdout.splitlines()]
    assert len(folders) == 50
    with_messages = 0
    for folder in folders:
        if not (folder / "times").exists() or not (times := (folder / "times").read_bytes()):
            # Killed before it recorded anything.
            continue
        began_ns, accepted_ns = struct.unpack("<qq", times)
        (partial,) = folder.glob("*.partial")
        kept = []
        if summarise(partial).topics:
            kept = topics(repair(partial).path)["eit.frame.right"]
        assert [one["seq"] for one in kept] == list(range(len(kept)))
        with_messages += bool(kept)
        last_ns = kept[-1]["t_mono_ns"] if kept else began_ns
        assert (accepted_ns - last_ns) / 1e9 < 1.0
    assert with_messages > 20


def nested(depth: int) -> dict:
    content: dict = {}
    for _ in range(depth):
        content = {"inner": content}
    return content


ENDLESS: dict = {}
ENDLESS["itself"] = ENDLESS


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (object(), "TypeError: object is no JSON type"),
        ("caf\udce9", "surrogates not allowed"),
        (nested(500), "depth exceeded"),
        (nested(5000), "depth exceeded"),
        (ENDLESS, "Circular reference"),
    ],
    ids=["object", "no UTF-8", "500", "5000", "endless"],
)
def test_a_message_without_a_json_form_is_counted(raw, why, tmp_path):
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    recorder.record_experiment("first")
    recorder.record_message("load.torque", {**torque(0), "raw": nested(100)})
    recorder.record_message("load.torque", {**torque(1), "raw": raw})
    recorder.record_message("load.torque", torque(2))
    # In a thread, as it is live: its stack is what nesting takes up.
    asyncio.run(asyncio.to_thread(recorder.write))
    facts = recorder.diagnostics()
    assert facts["errors"] == {"unwritable": 1}
    assert facts["error"].startswith("a message of load.torque has no JSON form and is left out: ")
    assert why in facts["error"]
    assert facts["waiting_bytes"] == 0
    assert recorder.failure == "", "nothing is wrong with the disk"
    recorder.record_experiment("second")
    recorder.record_message("load.torque", torque(3))
    recorder.close()
    first, second = recorder.closed_files
    assert [one["seq"] for one in topics(first)["load.torque"]] == [0, 2]
    assert [summarise(path).dropped for path in (first, second)] == [1, 0]


async def test_a_recorder_that_fails_to_close_leaves_no_socket_open(config, tmp_path, monkeypatch):
    settings = load_daemon_config(config(recording={"folder": "recordings"}))
    # A context refuses to end while one of its sockets is open, and waits until their addresses are free.
    with zmq.asyncio.Context() as context:
        daemon = Daemon(settings, context)
        daemon.stop()
        monkeypatch.setattr(Recorder, "_write", lambda _: os.truncate(tmp_path / "nowhere", 0))
        with pytest.raises(FileNotFoundError):
            await daemon.run()
    monkeypatch.undo()
    with zmq.asyncio.Context() as context:
        again = Daemon(settings, context)
        again.stop()
        await again.run()
    (kept,) = (tmp_path / "recordings").iterdir()
    assert kept.suffix == ".mcap", "the second one's end"


class SmallDisk(io.FileIO):
    """A file on a disk that has room for so many bytes, and takes what it can, as a file system does."""

    room: int

    def write(self, data: Any, /) -> int:
        room = self.room - self.tell()
        if room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data[:room])


@pytest.fixture
def disks(monkeypatch) -> Callable[..., list[SmallDisk]]:
    """Lets the next files of recorders be on disks with so much room, one after the other; returns the list of them."""

    def make(*rooms: int) -> list[SmallDisk]:
        opened: list[SmallDisk] = []

        def open_file(path: Path, mode: str) -> SmallDisk:
            disk = SmallDisk(path, mode)
            disk.room = rooms[len(opened)]
            opened.append(disk)
            return disk

        monkeypatch.setattr(recorder_module, "FileIO", open_file)
        return opened

    return make


def test_a_full_disk_keeps_all_flushed_data(tmp_path, disks):
    for n, room in enumerate(np.random.default_rng(3).integers(2_000, 40_000, 50)):
        disks(int(room))
        recorder = Recorder(tmp_path / str(n), IDENTITY, Clock())
        safe = -1
        for number in range(12):
            recorder.record_message("eit.frame", frame(number))
            recorder.write()
            if not recorder.failure:
                safe = number
        recorder.close()
        assert "No space left on device" in recorder.failure
        (partial,) = (tmp_path / str(n)).iterdir()
        if safe < 0:
            continue
        repaired = repair(partial)
        assert repaired.torn_bytes == 0, "the file ends with its last whole chunk"
        numbers = [one["frame"] for one in topics(repaired.path)["eit.frame.right"]]
        assert numbers == list(range(safe + 1))


def test_a_failure_stays_known_while_the_next_flush_is_under_way(tmp_path, monkeypatch, disks):
    disks(5_000)
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    for number in range(5):
        recorder.record_message("eit.frame", frame(number))
    recorder.write()
    failure = recorder.failure
    assert "No space left on device" in failure
    said = []
    full = SmallDisk.write

    def write(disk: SmallDisk, data: Any, /) -> int:
        # As `health` may do while the writing thread waits for the disk.
        said.append(recorder.diagnostics()["error"])
        return full(disk, data)

    monkeypatch.setattr(SmallDisk, "write", write)
    recorder.record_message("eit.frame", frame(5))
    recorder.write()
    recorder.close()
    assert set(said) == {failure}


def test_no_data_is_missing_when_the_disk_has_room_again(tmp_path, disks):
    opened = disks(20_000)
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    for number in range(20):
        recorder.record_message("eit.frame", frame(number))
        recorder.write()
    assert "No space left on device" in recorder.failure
    facts = recorder.diagnostics()
    assert facts["error"] == recorder.failure
    assert facts["waiting_bytes"] > 0
    recorder.record_experiment("another")
    recorder.write()
    assert len(opened) == 1, "no other file is begun on a full disk"
    opened[0].room = 10_000_000
    recorder.write()
    assert recorder.failure == ""
    recorder.close()
    (path,) = recorder.closed_files
    assert [one["frame"] for one in topics(path)["eit.frame.right"]] == list(range(20))
    assert RecordedTopics(path).counts["eit.frame.right"] == 20, "the checksums are those of one write"


def test_a_file_that_cannot_be_started_is_removed(tmp_path, monkeypatch, disks):
    disks(0, 100_000, 0, 0, 0, 100_000)
    with pytest.raises(UserError, match="cannot record there: No space left on device"):
        Recorder(tmp_path, IDENTITY, Clock())
    assert list(tmp_path.iterdir()) == []
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    # Each item asks for another file, as all do after an hour; the disk has room for one at last.
    monkeypatch.setattr(recorder_module, "LONGEST_IDLE_FILE_S", -1.0)
    for number in range(3):
        recorder.record_message("load.torque", torque(number))
    recorder.write()
    assert "No space left on device" in recorder.failure
    assert list(tmp_path.iterdir()) == [recorder.path]
    recorder.record_message("load.torque", torque(3))
    recorder.write()
    assert recorder.failure == ""
    recorder.close()
    assert [[one["seq"] for one in topics(path)["load.torque"]] for path in recorder.closed_files] == [[0, 1, 2], [3]]


def test_the_queue_is_bounded_and_drops_are_counted_in_their_own_file(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_module, "MAX_WAITING_BYTES", 100_000)
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    for number in range(20):
        recorder.record_message("eit.frame", frame(number))
    dropped = recorder.diagnostics()["errors"]["dropped"]
    recorder.write()
    recorder.record_experiment("one")
    recorder.record_message("load.torque", torque(0))
    recorder.write()
    recorder.record_experiment("two")
    for number in range(20):
        recorder.record_message("eit.frame", frame(number))
    later = recorder.diagnostics()["errors"]["dropped"] - dropped
    recorder.write()
    recorder.record_experiment("three")
    recorder.close()
    assert 0 < dropped < 20
    assert later > 0
    assert [summarise(path).dropped for path in recorder.closed_files] == [dropped, later, 0]
    kept = topics(recorder.closed_files[0])["eit.frame.right"]
    assert [one["frame"] for one in kept] == list(range(20 - dropped))


def test_a_state_without_a_stored_form_is_logged_and_recorded_as_empty(tmp_path):
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    inputs = recorder.input_recorder("right")
    with capture_logs() as entries:
        inputs.record_state({"parser": object()}, {}, 7)
    recorder.close()
    assert [entry["event"] for entry in entries] == ["the recording cannot be replayed from its beginning"]
    (kept,) = topics(recorder.closed_files[0])["input.right"]
    assert (kept["kind"], kept["data"]) == ("state", "")


def test_a_state_that_the_full_queue_drops_is_wanted_again(tmp_path, monkeypatch):
    recorder = Recorder(tmp_path, IDENTITY, Clock())
    inputs = recorder.input_recorder("right")
    for name in ("one", "two"):
        recorder.record_experiment(name)
    assert inputs.wants_state
    monkeypatch.setattr(recorder_module, "MAX_WAITING_BYTES", 2000)
    inputs.record(RawEvent(InputKind.STATE, 0, bytes(4000)))
    assert inputs.wants_state
    recorder.write()
    inputs.record(RawEvent(InputKind.STATE, 0, b"{}"))
    assert not inputs.wants_state
    recorder.close()
    (kept,) = topics(recorder.closed_files[1])["input.right"]
    assert kept["data"] == "{}"


def test_an_unwritable_folder_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot record there"):
        Recorder(tmp_path / "file", IDENTITY, Clock())
    (tmp_path / "link").symlink_to("missing")
    with pytest.raises(UserError, match="it is a link to missing, which does not exist"):
        Recorder(tmp_path / "link", IDENTITY, Clock())


@pytest.mark.parametrize("removed", ["file", "folder", "replaced"])
def test_a_removed_file_is_a_failure_and_a_new_one_begins(removed, tmp_path):
    folder = tmp_path / "recordings"
    recorder = Recorder(folder, IDENTITY, Clock())
    recorder.record_message("load.torque", torque(0))
    recorder.write()
    assert recorder.failure == ""
    if removed == "folder":
        shutil.rmtree(folder)
        for number in (1, 2):
            recorder.record_message("load.torque", torque(number))
            recorder.write()
            assert recorder.failure == f"{folder}: No such file or directory"
        folder.mkdir()
    else:
        recorder.path.unlink()
        if removed == "replaced":
            recorder.path.write_text("another's file")
        for number in (1, 2):
            recorder.record_message("load.torque", torque(number))
    replaced = recorder.path
    recorder.write()
    assert recorder.failure == f"{replaced}: the file was removed while it was written"
    recorder.write()
    assert recorder.failure == ""
    recorder.close()
    assert [[one["seq"] for one in topics(path)["load.torque"]] for path in recorder.closed_files] == [[1, 2]]
    assert summarise(recorder.closed_files[0]).dropped == 0
    assert not replaced.exists() or replaced.read_text() == "another's file"


@pytest.mark.parametrize("small_disk", ["256k"], indirect=True)
def test_deleting_the_recordings_makes_room_on_a_full_disk(small_disk):
    """Also the one that is being written, whose room is free only once the program lets go of it."""
    recorder = Recorder(small_disk, IDENTITY, Clock())
    while not recorder.failure:
        recorder.record_message("eit.frame", frame(0))
        recorder.write()
    assert "No space left on device" in recorder.failure
    recorder.path.unlink()
    recorder.write()
    recorder.record_message("load.torque", torque(1))
    recorder.write()
    assert recorder.failure == ""
    recorder.close()
    (path,) = recorder.closed_files
    assert [one["seq"] for one in topics(path)["load.torque"]] == [1]


def test_a_deleted_recording_whose_room_stays_taken_ends_no_recording(tmp_path, monkeypatch):
    def refuse(_: McapFile) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    recorder = Recorder(tmp_path, IDENTITY, Clock())
    recorder.path.unlink()
    monkeypatch.setattr(McapFile, "free_if_deleted", refuse)
    recorder.record_message("load.torque", torque(1))
    recorder.write()
    assert recorder.failure
    assert recorder.path.exists()
    recorder.write()
    assert recorder.failure == ""
    recorder.close()
    (path,) = recorder.closed_files
    assert [one["seq"] for one in topics(path)["load.torque"]] == [1]


async def test_a_removed_recording_is_not_logged_as_recorded(config):
    with zmq.asyncio.Context() as context, capture_logs() as logs:
        daemon = Daemon(load_daemon_config(config(recording={"folder": "recordings"})), context)
        daemon.recorder.record_experiment("one")
        daemon.recorder.record_experiment("two")
        daemon.recorder.write()
        daemon.recorder.closed_files[0].unlink()
        daemon.stop()
        await daemon.run()
    events = [one["event"] for one in logs if one.get("file") in map(str, daemon.recorder.closed_files)]
    assert events == ["the recorded file was removed", "recorded"]
