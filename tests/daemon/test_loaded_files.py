"""A daemon says that a file which it has read at its start has changed since."""

import importlib
import os
import sys
from pathlib import Path

import pytest
import yaml

from shearloop.daemon import loaded_files
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.experiment_files import ExperimentFiles
from shearloop.daemon.loaded_files import PACKAGE, LoadedFiles, code_of
from shearloop.daemon.torques import TorqueSource
from shearloop.errors import UserError

EXPERIMENT = {"name": "one", "steps": [{"do": "wait", "wait_s": 1}]}
OUTDATED = "has changed since the daemon began, and the daemon goes on with what it read then; restart the daemon"


@pytest.fixture
def rig(tmp_path):
    """Write a configuration with a robot's settings and a calibration; return its path."""
    (tmp_path / "ur.yaml").write_text("host: 10.0.0.2\n")
    (tmp_path / "right.cal").write_bytes(b"calibration")
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(EXPERIMENT))
    content = {
        "fingertips": {"right": {"device": {"path": "/dev/null"}, "calibration": "right.cal"}},
        "robot": "ur.yaml",
        "experiment": "one.yaml",
        "recording": {"folder": "recordings"},
    }
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize("name", ["rig.yaml", "ur.yaml", "right.cal"])
async def test_no_experiment_begins_once_a_file_of_the_rig_has_changed(rig, name):
    config = load_daemon_config(rig)
    sources = {name: TorqueSource(name=name, period_s=0.5) for name in ("right", "combined")}
    files = ExperimentFiles(config.experiment_folders, config, sources, None, LoadedFiles.of(config))
    assert (await files.read(rig.parent / "one.yaml")).file.name == "one"
    changed = rig.parent / name
    before = changed.read_bytes()
    changed.write_bytes(before + b"\n# tighter\n")
    with pytest.raises(UserError, match=f"^{changed} {OUTDATED}"):
        await files.read(rig.parent / "one.yaml")
    changed.write_bytes(before)
    assert (await files.read(rig.parent / "one.yaml")).file.name == "one"


@pytest.mark.parametrize("upgraded", ["faces.py", "daemon/control/experiment_check.py", "drivers/ur/arm.py"])
async def test_no_experiment_begins_after_an_upgrade_in_place(rig, upgraded):
    """The check, the plan and a new worker would be loaded of another version than the daemon."""
    package = rig.parent / "package"
    for module in ("faces.py", "daemon/control/experiment_check.py", "drivers/ur/arm.py", "tools/check.py"):
        path = package / module
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("VERSION = 1\n")
    config = load_daemon_config(rig)
    sources = {name: TorqueSource(name=name, period_s=0.5) for name in ("right", "combined")}
    loaded = LoadedFiles.of(config, package)
    files = ExperimentFiles(config.experiment_folders, config, sources, None, loaded)
    (package / "tools/check.py").write_text("VERSION = 2\n")
    assert (await files.read(rig.parent / "one.yaml")).file.name == "one"
    (package / upgraded).write_text("VERSION = 2\n")
    with pytest.raises(UserError, match=f"^{package / upgraded} {OUTDATED}"):
        await files.read(rig.parent / "one.yaml")
    # Also before the file is checked, with which the first experiment loads the check.
    (rig.parent / "one.yaml").write_text("name: one\n")
    with pytest.raises(UserError, match=f"^{package / upgraded} {OUTDATED}"):
        await files.read(rig.parent / "one.yaml")
    listed = await files.list()
    assert listed.names == {}
    assert listed.unread.startswith(f"{package / upgraded} {OUTDATED}")


def test_the_code_has_every_module_that_a_daemon_has_loaded():
    importlib.import_module("shearloop.daemon.operator_questions")
    rooms = ("shearloop.bank", "shearloop.estimation", "shearloop.drivers", "shearloop.daemon")
    modules = [module for name, module in sys.modules.items() if name.startswith(rooms)]
    assert "shearloop.daemon.control.plan" in [module.__name__ for module in modules]
    known = {path.resolve() for path in code_of(PACKAGE)}
    assert [module for module in modules if Path(module.__file__ or "").resolve() not in known] == []


def test_experiments_are_read_at_each_start_and_may_change(rig):
    loaded = LoadedFiles.of(load_daemon_config(rig))
    (rig.parent / "one.yaml").write_text("name: another\n")
    assert loaded.why_outdated() == ""


def test_a_file_with_the_same_content_has_not_changed(rig):
    loaded = LoadedFiles.of(load_daemon_config(rig))
    os.utime(rig, ns=(1, 1))
    assert loaded.why_outdated() == ""
    copy = rig.with_suffix(".new")
    copy.write_bytes(rig.read_bytes())
    copy.replace(rig)
    assert loaded.why_outdated() == ""


def test_of_a_large_file_time_and_size_count(rig, monkeypatch):
    monkeypatch.setattr(loaded_files, "_MAX_HASHED_BYTES", 4)
    loaded = LoadedFiles([rig])
    assert loaded.why_outdated() == ""
    os.utime(rig, ns=(1, 1))
    assert OUTDATED in loaded.why_outdated()


def test_a_file_that_is_gone_may_have_changed(rig):
    loaded = LoadedFiles([rig, rig.parent, Path("/dev/null"), rig.parent / "missing"])
    (rig.parent / "missing").write_text("new")
    assert loaded.why_outdated() == "", "it was not read at the start"
    kept = rig.rename(rig.with_suffix(".away"))
    assert loaded.why_outdated().startswith(f"{rig} cannot be read (No such file or directory), and may have changed")
    rig.mkdir()
    assert loaded.why_outdated().startswith(f"{rig} ")
    rig.rmdir()
    kept.rename(rig)
    assert loaded.why_outdated() == ""
