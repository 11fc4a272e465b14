"""The folders of runs: removed at their end, and those of killed runs at the next start."""

import os
import tempfile
from pathlib import Path

import pytest

from shearloop.cli.temporary_folders import run_folder


@pytest.fixture(autouse=True)
def own_tmp(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def make_old(folder: Path) -> None:
    os.utime(folder, (0, 0))


def test_a_folder_that_no_run_holds_is_removed_at_the_next_start(tmp_path):
    with run_folder() as running:
        make_old(running)
        killed, young, others = tmp_path / "shearloop-run-a", tmp_path / "shearloop-run-b", tmp_path / "else"
        for folder in (killed, young, others):
            folder.mkdir()
        (killed / "truth.jsonl").write_text("")
        for folder in (killed, others):
            make_old(folder)
        with run_folder() as second:
            assert {*tmp_path.iterdir()} == {running, second, young, others}
    assert {*tmp_path.iterdir()} == {young, others}
