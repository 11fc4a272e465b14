"""A disk that is full or slow: what is on it stays whole, what waits has a bound, what is lost is told."""

import errno
import io
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq.asyncio
from structlog.testing import capture_logs

from shearloop.daemon.app import Daemon
from shearloop.daemon.clock import Clock
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording import recorder as recorder_module
from shearloop.daemon.recording.reader import repair, summarise
from shearloop.daemon.recording.recorder import Recorder
from shearloop.daemon.recording.tables import RecordedTopics
from tests.daemon.recording.test_recorder import IDENTITY, frame, topics, torque


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


def test_an_unwritable_folder_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot record there"):
        Recorder(tmp_path / "file", IDENTITY, Clock())


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
