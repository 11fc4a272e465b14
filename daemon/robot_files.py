"""The files of one robot, for all spellings of its address: its state, and the lock against other daemons."""

import contextlib
import fcntl
import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from shearloop.drivers.hosts import is_address, one_spelling
from shearloop.errors import UserError


@dataclass(frozen=True, slots=True)
class RobotFiles:
    """One robot's files in the folder of states; they are the same for all spellings of its address."""

    host: str

    @property
    def state(self) -> Path:
        """The file of its state."""
        return memory_path(self.host)

    @property
    def states_by_name(self) -> tuple[Path, ...]:
        """Files of states under a name, which no program writes: a name can have been any robot's."""
        states = state_folder().glob("robot-*.json")
        return tuple(sorted(path for path in states if not _is_of_address(path.name)))


def state_folder() -> Path:
    """Return systemd's state folder, or the user's."""
    # systemd separates several folders with colons; ours is one.
    folder = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if folder:
        return Path(folder)
    state = os.environ.get("XDG_STATE_HOME", "")
    return (Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state") / "shearloop"


def memory_path(host: str) -> Path:
    """Return the file of the state of the robot at an address."""
    return _file(one_spelling(host), ".json")


def _is_of_address(name: str) -> bool:
    """Return whether a file of a state is named by an address, or by `localhost`, which is one."""
    spelling = name.removeprefix("robot-").removesuffix(".json")
    # An address of IPv6 has `_` for its colons, and before its interface, whose name may have more of them.
    parts = spelling.split("_")
    return spelling == "localhost" or any(is_address(":".join(parts[:end])) for end in range(1, len(parts) + 1))


def _file(spelling: str, suffix: str, of: str = "robot") -> Path:
    return state_folder() / f"{of}-{re.sub(r'[^A-Za-z0-9.-]', '_', spelling)}{suffix}"


@contextlib.contextmanager
def lock_robot(files: RobotFiles, commands: str = "", gripper: tuple[str, int] | None = None) -> Iterator[None]:
    """Keep other daemons of this user away from a robot and its gripper; raises UserError if one of them has either.

    `commands` is the command address of this process, if it has one; the error of another process names it. `gripper`
    has the address and port of its socket. The socket may be another robot's by mistake, and serves any number of
    programs. Two daemons would write the same state of the robot, and neither would know the other's stops and grips.
    The lock ends with the process in any case. If the file cannot be made, no experiment starts, and nothing is locked.
    """
    with contextlib.ExitStack() as opened:
        _lock(_file(one_spelling(files.host), ".lock"), f"robot at {files.host}", commands, opened)
        if gripper is not None:
            opened.enter_context(lock_gripper(*gripper, commands))
        yield


@contextlib.contextmanager
def lock_gripper(host: str, port: int, commands: str = "") -> Iterator[None]:
    """Keep other programs of this user away from a gripper's socket; raises UserError as `lock_robot` does."""
    with contextlib.ExitStack() as opened:
        path = _file(f"{one_spelling(host)}-{port}", ".lock", of="gripper")
        _lock(path, f"gripper at {host}:{port}", commands, opened)
        yield


def _lock(path: Path, what: str, commands: str, opened: contextlib.ExitStack) -> None:
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = opened.enter_context(path.open("a+", encoding="utf-8"))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            process, _, address = file.read().partition(" ")
            command = f"shearloop command stop --connect {shlex.quote(address)}"
            stop = f"with `{command}`" if address else "with Ctrl-C in its terminal"
            raise UserError(
                f"the {what} is driven by another program of this computer (process {process}): "
                f"stop that one first, {stop}, or name another {what.split(maxsplit=1)[0]} in the configuration"
            ) from None
        file.truncate(0)
        file.write(f"{os.getpid()} {commands}".rstrip())
        file.flush()
