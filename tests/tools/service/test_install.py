"""`shearloop install` and `uninstall`, on the root of another system."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from shearloop.tools.service import (
    EXAMPLE,
    PLACES,
    REAL_TIME,
    UNIT,
    find_program,
    in_system,
    install_steps,
    service_file,
    uninstall_steps,
)

# In the other system, and not on this computer.
PROGRAM = "/opt/shearloop-of-the-image/bin/shearloop"
# The real-time options of 0.3.0.
EARLIER = f"etc/systemd/system/{UNIT}.d/realtime.conf"


def files(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()} - {PROGRAM[1:]}


@pytest.fixture(autouse=True)
def program(tmp_path) -> Path:
    path = tmp_path / PROGRAM[1:]
    path.parent.mkdir(parents=True)
    path.touch()
    return path


@pytest.fixture
def place(ran, tmp_path) -> Callable[..., str]:
    """Return a function that installs or uninstalls in `tmp_path`, and returns what it says."""

    def run(command: str, *options: str) -> str:
        program = ["--program", PROGRAM] if command == "install" else []
        return str(ran(command, "--root", tmp_path, *program, *options).out)

    return run


def without_the_users_tables(names: set[str]) -> set[str]:
    tables = ("etc/passwd", "etc/group", "etc/shadow", "etc/gshadow", "etc/.pwd.lock", "etc/subuid", "etc/subgid")
    return {name for name in names if not name.startswith(tables)}


@pytest.mark.skipif(os.geteuid() != 0, reason="making a user and folders of his needs root")
def test_install_and_uninstall(tmp_path, place):
    said = place("install")
    assert without_the_users_tables(files(tmp_path)) == {*PLACES.values(), EXAMPLE}
    for name in PLACES.values():
        assert f"write {tmp_path / name}" in said
    assert "shearloop:x:" in (tmp_path / "etc/passwd").read_text()
    dialout = next(row for row in (tmp_path / "etc/group").read_text().splitlines() if row.startswith("dialout:"))
    assert "shearloop" in dialout.split(":")[3].split(",")
    recordings = (tmp_path / "var/lib/shearloop/recordings").stat()
    assert recordings.st_mode & 0o777 == 0o750
    assert f"shearloop:x:{recordings.st_uid}:" in (tmp_path / "etc/passwd").read_text()
    assert (tmp_path / "etc/shearloop/keys/clients").is_dir()

    assert place("install").count("left as it is") == len(PLACES) + 1

    place("uninstall")
    assert without_the_users_tables(files(tmp_path)) == set()
    assert not (tmp_path / "etc/shearloop").exists()
    assert "shearloop" not in (tmp_path / "etc/passwd").read_text()
    assert (tmp_path / "var/lib/shearloop/banks").is_dir(), "the user's work stays"
    assert "not there: " in place("uninstall"), "nothing to do is no failure"


@pytest.mark.skipif(os.geteuid() != 0, reason="making a user and folders of his needs root")
def test_edited_files_stay(tmp_path, place):
    place("install", "--real-time")
    assert (tmp_path / REAL_TIME).read_text() == service_file("realtime.conf")
    edited = tmp_path / EXAMPLE
    edited.write_text("fingertips: {}\n")
    key = tmp_path / "etc/shearloop/keys/server.key_secret"
    key.write_text("secret")
    place("install", "--no-real-time")
    assert not (tmp_path / REAL_TIME).parent.exists()
    assert f"left because it was edited: {edited}" in place("uninstall")
    assert edited.read_text() == "fingertips: {}\n"
    assert key.exists()


@pytest.fixture
def installed(tmp_path) -> Callable[[bool | None], list[str]]:
    """Return a function that installs the files of the service in `tmp_path`, and returns the sentences."""

    def install(real_time: bool | None) -> list[str]:
        said = []
        for step in install_steps(tmp_path, Path(PROGRAM), real_time=real_time, running=False):
            said.append(step.sentence)
            if step.run is not None and not step.sentence.startswith("run "):
                step.run()
        return said

    return install


def uninstalled(root: Path) -> list[str]:
    said = []
    for step in uninstall_steps(root, running=False):
        said.append(step.sentence)
        if step.run is not None and not step.sentence.startswith("run "):
            step.run()
    return said


def test_an_upgrade_keeps_the_real_time_options_and_says_so(tmp_path, installed):
    options = tmp_path / REAL_TIME
    assert not any("real-time" in sentence for sentence in installed(None))
    assert not options.exists()
    installed(True)
    said = installed(None)
    assert f"left as it is: {options}" in said
    assert "the real-time options stay; `install --no-real-time` removes them" in said
    assert options.read_text() == service_file("realtime.conf")
    assert f"remove {options}" in installed(False)
    assert not options.parent.exists()


def test_options_of_a_persons_own_stay_and_count_more(tmp_path, installed):
    installed(True)
    # As `systemctl edit` names it.
    own = (tmp_path / REAL_TIME).with_name("override.conf")
    own.write_text("[Service]\nCPUAffinity=2 3\nCPUSchedulingPriority=20\n")
    for real_time in (True, None, False, True):
        installed(real_time)
        assert "CPUAffinity=2 3" in own.read_text()
    assert max(path.name for path in own.parent.iterdir()) == own.name, "systemd reads the last one last"
    assert f"left alone: {own.parent}, with options of your own" in uninstalled(tmp_path)
    assert list(own.parent.iterdir()) == [own]


@pytest.mark.parametrize("place", [REAL_TIME, EARLIER, PLACES["shearloop.service"], PLACES["60-shearloop.rules"]])
def test_lines_that_a_person_wrote_into_a_replaced_file_are_named(place, tmp_path, installed):
    installed(True)
    edited = tmp_path / place
    before = edited.read_text() if edited.exists() else service_file("realtime.conf")
    edited.write_text(before + "# a comment\nCPUAffinity=2 3\n")
    (sentence,) = [said for said in installed(None) if "CPUAffinity" in said]
    cure = f"a file of your own in {edited.parent}" if place.endswith(".rules") else "`sudo systemctl edit shearloop`"
    assert sentence.startswith(("replace ", "remove "))
    assert sentence.endswith(f", which also has `CPUAffinity=2 3`; lines of your own go into {cure}")
    assert not any("CPUAffinity" in said for said in installed(None))


def test_the_real_time_options_of_an_earlier_version_are_renewed(tmp_path, installed):
    earlier = tmp_path / EARLIER
    earlier.parent.mkdir(parents=True)
    earlier.write_text("[Service]\nCPUSchedulingPolicy=fifo\n")
    assert f"remove {earlier}, the same file of an earlier version" in installed(None)
    assert [path.name for path in earlier.parent.iterdir()] == [Path(REAL_TIME).name]


@pytest.mark.parametrize("command", ["install", "uninstall"])
def test_dry_run_prints_the_steps_and_changes_nothing(command, tmp_path, place):
    kept = tmp_path / PLACES["shearloop.service"]
    kept.parent.mkdir(parents=True)
    kept.write_text("something else")
    said = place(command, "--dry-run")
    assert f"would {'replace' if command == 'install' else 'remove'} {kept}" in said
    assert command == "uninstall" or "would run `" in said
    assert files(tmp_path) == {PLACES["shearloop.service"]}
    assert kept.read_text() == "something else"


def test_nothing_is_removed_where_nothing_was_installed(place):
    steps = json.loads(place("uninstall", "--json"))["steps"]
    assert not any(step["acts"] for step in steps)
    assert all(step["says"].startswith("not there: ") for step in steps)


def test_commands_of_the_steps_can_be_copied(tmp_path, ran):
    root = tmp_path / "an image"
    (root / "etc").mkdir(parents=True)
    (root / "etc/passwd").write_text("shearloop:x:998:998::/:/usr/sbin/nologin\n")
    (root / "program").touch()
    removed = ran("uninstall", "--root", root, "--dry-run").out
    assert f"would run `userdel --prefix '{root}' shearloop`" in removed
    made = ran("install", "--root", root, "--program", "/program", "--dry-run").out
    assert f"`systemd-sysusers '--root={root}' shearloop.conf`" in made
    assert f"`sudo systemctl '--root={root}' enable shearloop`" in made


def test_the_steps_as_json(tmp_path, place):
    result = json.loads(place("install", "--dry-run", "--json"))
    assert result["dry_run"] is True
    assert {"acts": True, "says": f"write {tmp_path / EXAMPLE}"} in result["steps"]
    steps = json.loads(place("uninstall", "--dry-run", "--json"))["steps"]
    assert {"acts": False, "says": f"not there: {tmp_path / EXAMPLE}"} in steps


@pytest.mark.parametrize("outside", [False, True])
def test_the_program_of_another_system_lies_below_its_root(outside, tmp_path, program, ran):
    """It is named as that system has it, or as this one does."""
    steps = json.loads(
        ran("install", "--root", tmp_path, "--program", program if outside else PROGRAM, "--dry-run", "--json").out
    )["steps"]
    assert in_system(tmp_path, program if outside else Path(PROGRAM)) == Path(PROGRAM)
    assert f"systemctl --root={tmp_path} enable shearloop`; once that system runs, join" in steps[-1]["says"]
    assert "--now" not in steps[-1]["says"]


def test_a_running_system_is_notified(tmp_path):
    sentences = [step.sentence for step in install_steps(tmp_path, Path(PROGRAM), real_time=False, running=True)]
    for command in ("udevadm control --reload", "udevadm trigger --subsystem-match=tty", "systemctl daemon-reload"):
        assert any(f"run `{command}`" in sentence for sentence in sentences)


def test_mistakes_are_one_sentence(tmp_path, ran, mistake, monkeypatch):
    said = mistake("install", "--root", tmp_path, "--program", "/usr/bin/true")
    assert f"the program /usr/bin/true is not a file below {tmp_path}; install shearloop in that system, and" in said
    assert "the program no/such/shearloop is not a file; give" in mistake("install", "--program", "no/such/shearloop")
    for command in ("install", "uninstall"):
        assert f"--root {tmp_path}/none is not a folder" in mistake(command, "--root", tmp_path / "none")
    monkeypatch.setenv("PATH", "")
    said = ran("install", "--root", tmp_path, "--program", PROGRAM, status=2).err
    assert "there is no program systemd-sysusers on this system" in said
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert "run it with sudo" in mistake("uninstall")


def test_a_program_hidden_from_the_service_is_refused(tmp_path, mistake, monkeypatch):
    monkeypatch.setattr("sys.executable", str(tmp_path / "bin/python3"))
    assert "there is no program" in mistake("install", "--dry-run")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/shearloop").touch()
    monkeypatch.setattr("shearloop.tools.service._HIDDEN", (str(tmp_path),))
    said = mistake("install", "--dry-run")
    assert f"lies in {tmp_path}, which the service is not allowed to see" in said
    monkeypatch.setattr("shearloop.tools.service._HIDDEN", ("/nowhere",))
    assert find_program() == tmp_path / "bin/shearloop"
