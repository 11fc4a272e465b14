"""What an installed service consists of, as the steps that put it in place and take it away."""

import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

from shearloop.daemon.errors import UserError
from shearloop.daemon.service.steps import PutFile, RunProgram, Step, TakeEmptyFolder, TakeFile, Tell

UNIT = "shearloop.service"
EXAMPLE = "etc/shearloop/shearloop.yaml"
REAL_TIME = f"etc/systemd/system/{UNIT}.d/realtime.conf"
# Where each file of `systemd/` goes, from the root of the system.
PLACES = {
    "shearloop.sysusers.conf": "etc/sysusers.d/shearloop.conf",
    "shearloop.tmpfiles.conf": "etc/tmpfiles.d/shearloop.conf",
    "60-shearloop.rules": "etc/udev/rules.d/60-shearloop.rules",
    UNIT: f"etc/systemd/system/{UNIT}",
}
# The program's path as it stands in the unit of `systemd/`.
_PROGRAM = "/opt/shearloop/bin/shearloop"
# What the service does not see: ProtectHome and PrivateTmp in the unit.
_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")  # noqa: S108 - nothing is written there


def service_file(name: str) -> str:
    """Return the text of a file of `systemd/`, which an installed package carries as `shearloop/systemd/`."""
    return resources.files("shearloop").joinpath("systemd", name).read_text(encoding="utf-8")


def unit_for(program: Path) -> str:
    """Return the unit that runs this program."""
    return service_file(UNIT).replace(_PROGRAM, str(program))


def find_program() -> Path:
    """Return the program that runs now, as a service would start it.

    Raises UserError where there is none, and where the service could not see it.
    """
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


def hidden_folder(path: Path) -> str:
    """Return the folder, hidden from the service, that a path lies in; empty when it can be seen."""
    return next((folder for folder in _HIDDEN if path.is_relative_to(folder)), "")


def install_steps(root: Path, program: Path, *, real_time: bool, running: bool) -> Iterator[Step]:
    """Yield the steps that put the service in place below `root`; `running`: systemd is there to be told."""
    contents = {name: service_file(name).encode() for name in PLACES} | {UNIT: unit_for(program).encode()}
    for name, place in PLACES.items():
        yield PutFile(root / place, contents[name])
    if real_time:
        yield PutFile(root / REAL_TIME, service_file("realtime.conf").encode())
    else:
        yield from _without_real_time(root)
    yield PutFile(root / EXAMPLE, service_file("shearloop.yaml").encode(), keep=True)
    at_root = [] if root == Path("/") else [f"--root={root}"]
    yield RunProgram(["systemd-sysusers", *at_root, "shearloop.conf"], "makes the user and the group shearloop")
    yield RunProgram(["systemd-tmpfiles", *at_root, "--create", "shearloop.conf"], "makes the daemon's folders")
    if running:
        yield RunProgram(["udevadm", "control", "--reload"], "reads the rules for the boards")
        yield RunProgram(["udevadm", "trigger", "--subsystem-match=tty"], "applies them to boards plugged in already")
        yield RunProgram(["systemctl", "daemon-reload"], "reads the unit")
    yield Tell(
        f"next: put yourself in the group with `sudo usermod -aG shearloop $USER`, edit {root / EXAMPLE}, see that "
        f"`shearloop check {root / EXAMPLE}` is content, then `sudo systemctl enable --now shearloop`"
    )


def uninstall_steps(root: Path, *, running: bool) -> Iterator[Step]:
    """Yield the steps that take the service away; what was edited or made by hand stays, and is named."""
    if running:
        yield RunProgram(["systemctl", "disable", "--now", UNIT], "stops the service", may_fail=True)
    for place in reversed(PLACES.values()):
        yield TakeFile(root / place)
    yield from _without_real_time(root)
    yield TakeFile(root / EXAMPLE, unless_edited=service_file("shearloop.yaml").encode())
    for folder in ("keys/clients", "keys", ""):
        yield TakeEmptyFolder(root / "etc/shearloop" / folder)
    # With the user go its group and nothing else; an absent one is as good as removed.
    prefix = [] if root == Path("/") else ["--prefix", str(root)]
    yield RunProgram(["userdel", *prefix, "shearloop"], "removes the user and its group", may_fail=True)
    if running:
        yield RunProgram(["systemctl", "daemon-reload"], "forgets the unit")
        yield RunProgram(["udevadm", "control", "--reload"], "forgets the rules")
    yield Tell(f"left alone: {root / 'var/lib/shearloop'}, with your banks, calibrations and recordings")


def _without_real_time(root: Path) -> Iterator[Step]:
    if (root / REAL_TIME).exists():
        yield TakeFile(root / REAL_TIME)
        yield TakeEmptyFolder((root / REAL_TIME).parent)
