"""Files that are replaced whole, on file systems that cannot flush a folder."""

import errno
import os
import stat
from pathlib import Path

import pytest

from shearloop.daemon.recorder.writer import new_recording
from shearloop.files import replace_file


@pytest.fixture
def folder_fails(monkeypatch):
    """Return a function that lets the flush of every folder fail, as a network share's does, and that of no file."""
    fsync = os.fsync

    def fail_with(number: int) -> None:
        def flush(handle: int) -> None:
            if stat.S_ISDIR(os.fstat(handle).st_mode):
                raise OSError(number, os.strerror(number))
            fsync(handle)

        monkeypatch.setattr(os, "fsync", flush)

    return fail_with


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP])
def test_a_folder_that_cannot_be_flushed_is_no_error(number, folder_fails, tmp_path):
    folder_fails(number)
    with replace_file(tmp_path / "a.yaml") as file:
        file.write(b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.yaml"]
    assert (tmp_path / "a.yaml").read_bytes() == b"new"
    with new_recording(tmp_path / "a.mcap", "a bench") as recording:
        recording.add_torque(10**18, 0.1)
    assert (tmp_path / "a.mcap").exists()


def test_a_failing_disk_says_that_the_file_is_there(folder_fails, tmp_path):
    folder_fails(errno.EIO)
    said = "for its folder: the file is written, and a loss of power may undo that"
    with pytest.raises(OSError, match=said), replace_file(tmp_path / "a.yaml") as file:
        file.write(b"new")
    assert (tmp_path / "a.yaml").read_bytes() == b"new"


def test_a_file_that_cannot_be_written_is_named_as_the_person_named_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError) as refused, replace_file(Path("missing") / "table.csv"):
        pass
    assert refused.value.filename == "missing/table.csv"


def test_a_link_is_kept_and_its_target_written(tmp_path):
    folder = tmp_path / "targets"
    folder.mkdir()
    for name in ("a.yaml", "a.mcap"):
        (folder / name).touch()
        (tmp_path / name).symlink_to(folder / name)
    with replace_file(tmp_path / "a.yaml") as file:
        file.write(b"new")
    with new_recording(tmp_path / "a.mcap", "a bench") as recording:
        recording.add_torque(10**18, 0.1)
    assert [(tmp_path / name).readlink() for name in ("a.yaml", "a.mcap")] == [folder / "a.yaml", folder / "a.mcap"]
    assert (folder / "a.yaml").read_bytes() == b"new"
    assert (folder / "a.mcap").stat().st_size
    assert {path.name for path in (*tmp_path.iterdir(), *folder.iterdir())} == {"a.yaml", "a.mcap", "targets"}


def test_a_file_has_one_writer(tmp_path):
    table = tmp_path / "table.csv"
    with replace_file(table) as first:
        first.write(b"first")
        with pytest.raises(OSError, match="another program is writing it") as refused, replace_file(table):
            pass
    assert refused.value.filename == str(table)
    assert table.read_bytes() == b"first"
    with replace_file(table) as second:
        second.write(b"second")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("table.csv", b"second")]
