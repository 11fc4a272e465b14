"""Installs the daemon as a systemd service, and removes it."""

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from shearloop.errors import UserError

UNIT = "shearloop.service"
EXAMPLE = "etc/shearloop/shearloop.yaml"
_DROP_INS = f"etc/systemd/system/{UNIT}.d"
# systemd reads these in the order of their names, so that the override.conf of `systemctl edit` overrides it.
REAL_TIME = f"{_DROP_INS}/10-realtime.conf"
# Its name in 0.3.0, which systemd reads after override.conf.
_EARLIER_REAL_TIME = f"{_DROP_INS}/realtime.conf"
# Target of each file of `systemd/`, relative to the system's root.
PLACES = {
    "shearloop.sysusers.conf": "etc/sysusers.d/shearloop.conf",
    "shearloop.tmpfiles.conf": "etc/tmpfiles.d/shearloop.conf",
    "60-shearloop.rules": "etc/udev/rules.d/60-shearloop.rules",
    UNIT: f"etc/systemd/system/{UNIT}",
}
# The program's path in the unit file of `systemd/`.
_PROGRAM = "/opt/shearloop/bin/shearloop"
# Hidden from the service by ProtectHome and PrivateTmp.
_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - nothing is written there


class Step(NamedTuple):
    """One step: a sentence that says what `run` does. Without `run`, nothing needs to be done."""

    sentence: str
    run: Callable[[], object] | None = None


def service_file(name: str) -> str:
    """Return the text of a file of `systemd/`."""
    return resources.files("shearloop").joinpath("systemd", name).read_text(encoding="utf-8")


def unit_for(program: Path) -> str:
    """Return the unit file that runs this program."""
    return service_file(UNIT).replace(_PROGRAM, _systemd_word(str(program)))


def _systemd_word(path: str) -> str:
    """Return a path as one word of a systemd command line; raises UserError for a path that systemd refuses."""
    if refused := re.search(r"[\"'\\]|[^ -~\u0080-\U0010ffff]", path):
        raise UserError(
            f"the program {path} has {refused[0]!r} in its path, which systemd refuses: install shearloop in a folder "
            "with a plain name"
        )
    escaped = path.replace("%", "%%")
    return f'"{escaped}"' if " " in path else escaped


def find_program() -> Path:
    """Return the path of the running program; raise UserError if the service cannot start or see it."""
    program = Path(sys.executable).parent / "shearloop"
    if not program.exists():
        raise UserError(
            f"there is no program {program}: install the package with pip first, or give the program with --program"
        )
    for path in (program, Path(sys.base_prefix)):
        if hidden := hidden_folder(path):
            raise UserError(
                f"{path} lies in {hidden}, which the service is not allowed to see: make an environment elsewhere "
                "(`sudo /usr/bin/python3 -m venv /opt/shearloop`), install shearloop there, and run its own "
                "`/opt/shearloop/bin/shearloop install`"
            )
    return program


def in_system(root: Path, program: Path) -> Path:
    """Return a program's path in the system below `root`; raises UserError if it is not there.

    It is given as that system has it, or as this one does.
    """
    path = program.absolute()
    if path.is_relative_to(root):
        path = Path("/") / path.relative_to(root)
    if not (root / path.relative_to("/")).is_file():
        where = "" if root == Path("/") else f" below {root}"
        cure = "give the path of the installed `shearloop` with --program"
        if where:
            cure = f"install shearloop in that system, and {cure}, as that system has it"
        raise UserError(f"the program {program} is not a file{where}; {cure}")
    return path


def hidden_folder(path: Path) -> str:
    """Return the folder that hides a path from the service; empty if the service sees the path."""
    return next((folder for folder in _HIDDEN if path.is_relative_to(folder)), "")


def install_steps(root: Path, program: Path, *, real_time: bool | None, running: bool) -> Iterator[Step]:
    """Yield the steps that install the service below `root`; `running`: systemd runs there.

    `real_time` says whether with the real-time options; None keeps them as they are.

    Run each step before the next is taken: a step depends on the files that are there.
    """
    contents = {name: service_file(name).encode() for name in PLACES} | {UNIT: unit_for(program).encode()}
    for name, place in PLACES.items():
        yield _write(root / place, contents[name])
    yield from _real_time_steps(root, real_time)
    yield _write(root / EXAMPLE, service_file("shearloop.yaml").encode(), keep=True)
    at_root = [] if root == Path("/") else [f"--root={root}"]
    yield _program(["systemd-sysusers", *at_root, "shearloop.conf"], "makes the user and the group shearloop")
    yield _program(["systemd-tmpfiles", *at_root, "--create", "shearloop.conf"], "makes the daemon's folders")
    if running:
        yield _program(["udevadm", "control", "--reload"], "reads the rules for the boards")
        yield _program(["udevadm", "trigger", "--subsystem-match=tty"], "applies them to boards already plugged in")
        yield _program(["systemctl", "daemon-reload"], "reads the unit")
    group, check = "join the group with `sudo usermod -aG shearloop $USER`", f"run `shearloop check /{EXAMPLE}`"
    if at_root:
        enable = shlex.join(["sudo", "systemctl", *at_root, "enable", "shearloop"])
        yield Step(
            f"next: edit {root / EXAMPLE}, and let that system start the service with `{enable}`; once that system "
            f"runs, {group}, and {check} there"
        )
    else:
        yield Step(f"next: {group}, edit /{EXAMPLE}, {check}, then `sudo systemctl enable --now shearloop`")


def uninstall_steps(root: Path, *, running: bool) -> Iterator[Step]:
    """Yield the steps that remove the service; edited files and the user's own data stay."""
    if running:
        yield _program(["systemctl", "disable", "--now", UNIT], "stops the service", may_fail=True)
    for place in reversed(PLACES.values()):
        yield _remove(root / place)
    yield from _remove_real_time(root)
    if (drop_ins := root / _DROP_INS).exists() and _own_drop_ins(root):
        yield Step(f"left alone: {drop_ins}, with options of your own")
    yield _remove(root / EXAMPLE, unless_edited=service_file("shearloop.yaml").encode())
    for folder in ("keys/clients", "keys", ""):
        yield _remove(root / "etc/shearloop" / folder)
    # The group goes with its user.
    if _has_user(root):
        prefix = [] if root == Path("/") else ["--prefix", str(root)]
        yield _program(["userdel", *prefix, "shearloop"], "removes the user and its group", may_fail=True)
    else:
        yield Step("not there: the user shearloop")
    if running:
        yield _program(["systemctl", "daemon-reload"], "forgets the unit")
        yield _program(["udevadm", "control", "--reload"], "forgets the rules")
    if (work := root / "var/lib/shearloop").exists():
        yield Step(f"left alone: {work}, with your banks, calibrations and recordings")


def _has_user(root: Path) -> bool:
    """Return whether the system below `root` has a user `shearloop`."""
    try:
        users = (root / "etc/passwd").read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return False
    return any(line.startswith("shearloop:") for line in users.splitlines())


def _real_time_steps(root: Path, wanted: bool | None) -> Iterator[Step]:
    """Yield the steps that add, renew or remove the real-time options; without a wish, those that are there stay."""
    earlier, content = root / _EARLIER_REAL_TIME, service_file("realtime.conf").encode()
    if wanted is False:
        yield from _remove_real_time(root)
    elif wanted or (root / REAL_TIME).exists() or earlier.exists():
        yield _write(root / REAL_TIME, content)
        if earlier.exists():
            yield Step(
                f"remove {earlier}, the same file of an earlier version{_besides(earlier, content)}", earlier.unlink
            )
        if wanted is None:
            yield Step("the real-time options stay; `install --no-real-time` removes them")


def _remove_real_time(root: Path) -> Iterator[Step]:
    for place in (REAL_TIME, _EARLIER_REAL_TIME):
        if (root / place).exists():
            yield _remove(root / place)
    if (root / _DROP_INS).exists() and not _own_drop_ins(root):
        yield _remove(root / _DROP_INS)


def _own_drop_ins(root: Path) -> bool:
    """Return whether a person has added options to the unit, as with `systemctl edit`."""
    return any(path not in (root / REAL_TIME, root / _EARLIER_REAL_TIME) for path in (root / _DROP_INS).iterdir())


def _besides(target: Path, content: bytes) -> str:
    """Return a clause on the lines of a file that its new content lacks, with the place for them; empty without any."""
    known = content.decode().splitlines()
    lines = [line.strip() for line in target.read_text(encoding="utf-8", errors="replace").splitlines()]
    own = [f"`{line}`" for line in lines if line and not line.startswith("#") and line not in known]
    if not own:
        return ""
    in_unit = target.name == UNIT or target.parent.name == f"{UNIT}.d"
    place = "`sudo systemctl edit shearloop`" if in_unit else f"a file of your own in {target.parent}"
    return f", which also has {', '.join(own)}; lines of your own go into {place}"


def _write(target: Path, content: bytes, *, keep: bool = False) -> Step:
    """Write a file, readable by everyone; with `keep`, leave an existing one alone."""
    exists = target.exists()
    if exists and (keep or target.read_bytes() == content):
        return Step(f"left as it is: {target}")

    def write() -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
        target.chmod(0o644)

    return Step(f"replace {target}{_besides(target, content)}" if exists else f"write {target}", write)


def _remove(target: Path, unless_edited: bytes | None = None) -> Step:
    """Remove an empty folder, or a file; with `unless_edited`, only if it has this content."""
    if not target.exists():
        return Step(f"not there: {target}")
    if target.is_dir():
        return Step(f"remove {target} if it is empty", partial(_remove_empty, target))
    if unless_edited not in (None, target.read_bytes()):
        return Step(f"left because it was edited: {target}")
    return Step(f"remove {target}", target.unlink)


def _remove_empty(folder: Path) -> None:
    if not any(folder.iterdir()):
        folder.rmdir()


def _program(arguments: list[str], purpose: str, *, may_fail: bool = False) -> Step:
    """Run a program of the system; `may_fail` ignores its exit status."""

    def run() -> None:
        program = shutil.which(arguments[0])
        if program is None:
            raise UserError(f"there is no program {arguments[0]} on this system; install it and try again")
        command = [program, *arguments[1:]]
        done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
        if done.returncode != 0 and not may_fail:
            output = " ".join((done.stderr or done.stdout).split())
            raise UserError(f"`{shlex.join(arguments)}` failed with status {done.returncode}: {output}")

    return Step(f"run `{shlex.join(arguments)}`, which {purpose}", run)
