"""An export that a later message ends leaves no file of its own, and changes none that was there."""

import errno
import gc
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from shearloop.tools.recordings import export, lerobot_export
from tests.tools.recordings.test_matlab_slices import Sweep

pytestmark = pytest.mark.usefixtures("rerun_runtime")
FORMS = ("csv", "parquet", "mat", "rrd", "lerobot", "slices")
# Each key is one that slices use.
STRANGE: list[tuple[str, dict[str, Any], str]] = [
    ("load.torque", {"other": 1}, "it has the unknown key 'other'"),
    ("eit.frame.right", {"line": [[1.0], 2.0]}, "line is [[1.0], 2.0]"),
    ("gripper.state", {"diameter_mm": "wide"}, "diameter_mm is 'wide', not a number"),
    ("loop.state", {"hold": 1.5}, "hold is 1.5"),
]
# A dataset has no states of the loop.
CASES = [(form, *one) for form in FORMS for one in STRANGE if (form, one[0]) != ("lerobot", "loop.state")]


def sweep(folder: Path) -> Sweep:
    """Begin a recording of two held angles."""
    folder.mkdir()
    begun = Sweep(folder)
    begun.gripped(20.0)
    begun.hold(1, 0.1)
    begun.hold(2, 0.2)
    return begun


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("form", "topic", "changes", "problem"), CASES, ids=[" ".join(case[:2]) for case in CASES])
def test_the_last_message_is_strange(form, topic, changes, problem, tmp_path, ran, mistake, monkeypatch):
    if form in ("parquet", "lerobot"):
        pytest.importorskip("pyarrow", reason="needs the extra `export`")
    # Several batches of rows, and several MATLAB files.
    monkeypatch.setattr(export, "_BATCH", 8000)
    monkeypatch.setattr(export, "_MAT_SIZE", 40_000)
    monkeypatch.setattr(lerobot_export, "_BATCH", 100)
    whole = sweep(tmp_path / "whole").end_with("load.torque")
    spoilt = sweep(tmp_path / "spoilt").end_with(topic, **changes)
    for was_there in (False, True):
        folder = tmp_path / f"out {was_there}"
        folder.mkdir()
        arguments = ("--format", form, "--out", folder / "x")
        before = {}
        if was_there:
            ran("recording", "export", whole, *arguments)
            before = files(folder)
            assert before
            # A second MATLAB file is refused at once.
            for part in folder.glob("x_*"):
                del before[part.name]
                part.unlink()
        said = mistake("recording", "export", spoilt, *arguments)
        assert f"{spoilt}: a message cannot be used: {topic}" in said
        assert problem in said
        assert files(folder) == before


@pytest.mark.parametrize("form", FORMS)
def test_the_disk_is_full(form, tmp_path, ran, mistake, monkeypatch):
    if form in ("parquet", "lerobot"):
        pytest.importorskip("pyarrow", reason="needs the extra `export`")
    whole, folder = sweep(tmp_path / "whole").end_with("load.torque"), tmp_path / "out"
    folder.mkdir()
    arguments = ("recording", "export", whole, "--format", form, "--out", folder / "x")
    ran(*arguments)
    before, flushed, fsync = files(folder), list[int](), os.fsync

    def full(handle: int) -> None:
        # The first file is on the disk, but for exports of a single one.
        flushed.append(handle)
        if stat.S_ISREG(os.fstat(handle).st_mode) and (len(flushed) > 2 or form in ("mat", "rrd")):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", full)
    assert "the export cannot be written: No space left on device" in mistake(*arguments)
    after = files(folder)
    assert not [name for name in after if name.endswith(".tmp")]
    if form == "slices":
        assert after == before
    assert after.keys() == before.keys()


@pytest.mark.parametrize("after", [0, 5, 20])
@pytest.mark.parametrize("form", FORMS)
def test_an_interrupt_leaves_nothing(form, after, tmp_path, ran, monkeypatch):
    if form in ("parquet", "lerobot"):
        pytest.importorskip("pyarrow", reason="needs the extra `export`")

    @contextmanager
    def interrupting(*_: object) -> Iterator[Callable[[int], None]]:
        def show(done: int) -> None:
            if done >= after:
                raise KeyboardInterrupt

        yield show

    monkeypatch.setattr("shearloop.cli.recording.progress_bar", interrupting)
    whole = sweep(tmp_path / "whole").end_with("load.torque")
    # A single file makes no folders.
    out = tmp_path / "x" if form in ("mat", "rrd") else tmp_path / "some" / "x"
    said = ran("recording", "export", whole, "--format", form, "--out", out, status=130).err
    assert said == "shearloop recording: interrupted before it was done\n"
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]


@pytest.mark.parametrize("at", [1, 2])
def test_an_interrupt_between_the_ends_of_two_parquet_files_is_silent(at, tmp_path, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    close, calls = parquet.ParquetWriter.close, []

    def interrupted(writer: object) -> None:
        calls.append(None)
        if len(calls) == at:
            raise KeyboardInterrupt
        close(writer)

    monkeypatch.setattr(parquet.ParquetWriter, "close", interrupted)
    whole = sweep(tmp_path / "whole").end_with("load.torque")
    with pytest.raises(KeyboardInterrupt):
        export.export(whole, "parquet", tmp_path / "x", ["eit.frame.right", "load.torque", "loop.state"])
    # A writer ends its file when it goes; an error in that would be printed.
    gc.collect()
    assert len(calls) > at
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("small_disk", ["16k"], indirect=True)
@pytest.mark.parametrize("form", FORMS)
def test_a_small_disk_has_no_folder_afterwards(form, small_disk, tmp_path, mistake):
    if form in ("parquet", "lerobot"):
        pytest.importorskip("pyarrow", reason="needs the extra `export`")
    whole = sweep(tmp_path / "whole").end_with("load.torque")
    out = small_disk / ("x.rrd" if form == "rrd" else "x")
    said = mistake("recording", "export", whole, "--format", form, "--out", out)
    assert "the export cannot be written: " in said
    assert "No space left on device" in said
    gc.collect()
    assert not list(small_disk.iterdir())


def test_a_later_matlab_file_is_not_overwritten(tmp_path, mistake, monkeypatch):
    monkeypatch.setattr(export, "_MAT_SIZE", 20_000)
    whole = sweep(tmp_path / "whole").end_with("load.torque")
    (tmp_path / "x_3.mat").write_bytes(b"mine")
    said = mistake("recording", "export", whole, "--format", "mat", "--out", tmp_path / "x.mat")
    assert f"{tmp_path}/x_3.mat exists and would look like a part of this export" in said
    assert [path.name for path in tmp_path.glob("x*")] == ["x_3.mat"]
    assert (tmp_path / "x_3.mat").read_bytes() == b"mine"


@pytest.mark.parametrize("small_disk", ["16k"], indirect=True)
def test_a_small_disk_refuses_a_file_of_rerun_in_a_sentence(small_disk, tmp_path, mistake):
    whole = sweep(tmp_path / "whole").end_with("load.torque")
    said = mistake("recording", "export", whole, "--format", "rrd", "--out", small_disk / "x.rrd")
    assert "x.rrd: the export cannot be written: No space left on device" in said
    assert not list(small_disk.iterdir())
