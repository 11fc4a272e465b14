"""The files of one robot, for all spellings of its address: its state, and the lock against other daemons."""

import contextlib
import fcntl
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from shearloop.drivers.hosts import addresses_of, is_address, one_spelling
from shearloop.errors import UserError
from shearloop.files import read_file, replace_file

# The addresses that a name had when it was last looked up.
ADDRESSES_SUFFIX = ".addresses"
_MAX_BYTES = 1 << 16
SUFFIXES = (".json", ".lock", ADDRESSES_SUFFIX)


@dataclass(frozen=True, slots=True)
class RobotFiles:
    """One robot's keys in the folder of states: its addresses, or its name where no address is known.

    Its names have files as well, so that a robot with a new address is found by its name.
    """

    host: str
    keys: tuple[str, ...]
    # Names that are found at its addresses.
    names: tuple[str, ...] = ()
    # Other spellings that have files: their state is of this robot as well.
    others: tuple[str, ...] = ()
    # Names that cannot be looked up at present, and had its addresses. Their state is of this robot or of another one.
    lapsed: tuple[str, ...] = ()
    # The addresses that its name had when its state was last written, if none of them is left.
    earlier: tuple[str, ...] = ()
    # Whether it is known which robot the name means; an address of an earlier look-up is enough.
    known: bool = True

    @classmethod
    def of(cls, host: str) -> "RobotFiles":
        """Look up the robot at a name or address, and the other names that have files here; takes at most 2 s."""
        name, stored = one_spelling(host), _stored_spellings()
        addresses = addresses_of((name, *stored))
        last = _last_addresses(name)
        own = addresses[name] or last
        keys = set(own) or {name}
        found = {one_spelling(spelling) for spelling in stored if own & addresses[spelling]}
        names = {spelling for spelling in {name, *found} if not is_address(spelling)} - keys
        lapsed = {spelling for spelling in stored if not addresses[spelling] and own & _last_addresses(spelling)}
        spelt = {spelling for spelling in stored if one_spelling(spelling) in keys | names}
        files = cls(
            host,
            keys=tuple(sorted(keys)),
            names=tuple(sorted(names)),
            others=tuple(sorted({host, *spelt} - keys - names)),
            lapsed=tuple(sorted(lapsed - keys - names - spelt)),
            earlier=() if own & last else tuple(sorted(last)),
            known=bool(own),
        )
        if files.known and not files.earlier:
            files.note_addresses()
        return files

    @property
    def states(self) -> tuple[Path, ...]:
        """The files of its state, which are written; the file of a name is written last."""
        return tuple(memory_path(spelling) for spelling in (*self.keys, *self.names))

    @property
    def other_states(self) -> tuple[Path, ...]:
        """Files of its state under other spellings, which are read once and then removed."""
        return tuple(memory_path(other) for other in self.others)

    @property
    def lapsed_states(self) -> tuple[Path, ...]:
        """Files that may be another robot's: they are read where they are the latest, and never written."""
        return tuple(memory_path(name) for name in self.lapsed)

    @property
    def earlier_states(self) -> tuple[Path, ...]:
        """Files of the addresses before, which are read where the name has no file of its own, and never written."""
        return tuple(memory_path(address) for address in self.earlier)

    @property
    def own_state(self) -> Path:
        """The file of its state under the name that it was asked for."""
        return memory_path(one_spelling(self.host))

    @property
    def locks(self) -> tuple[Path, ...]:
        """The files of its lock; the order is the same for all daemons."""
        spellings = {*self.keys, *self.names, *self.others, *self.lapsed}
        return tuple(_file(spelling, ".lock") for spelling in sorted(spellings))

    def note_addresses(self) -> bool:
        """Store the addresses of its name, for a start without a network; return whether it has any at present.

        A name whose addresses have changed keeps the earlier ones until the state is written under the new ones.
        """
        name = one_spelling(self.host)
        if is_address(name):
            return True
        found = addresses_of((name,))[name] if not self.known else frozenset(self.keys)
        # In a folder that cannot be written no experiment starts, and the refusal says so.
        with contextlib.suppress(OSError):
            path = _file(name, ADDRESSES_SUFFIX)
            if found and found != _last_addresses(name):
                path.parent.mkdir(parents=True, exist_ok=True)
                with replace_file(path) as file:
                    file.write("\n".join(sorted(found)).encode())
        return bool(found)


def state_folder() -> Path:
    """Return systemd's state folder, or the user's."""
    # systemd separates several folders with colons; ours is one.
    folder = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if folder:
        return Path(folder)
    state = os.environ.get("XDG_STATE_HOME", "")
    return (Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state") / "shearloop"


def memory_path(spelling: str) -> Path:
    """Return the file of a robot's state under one spelling of its address."""
    return _file(spelling, ".json")


def _file(spelling: str, suffix: str, of: str = "robot") -> Path:
    return state_folder() / f"{of}-{re.sub(r'[^A-Za-z0-9.-]', '_', spelling)}{suffix}"


def _stored_spellings() -> tuple[str, ...]:
    """Return the spellings that have files; an address of IPv6 is read back from its file's name."""
    found = set()
    with contextlib.suppress(OSError):
        for path in state_folder().glob("robot-*"):
            for suffix in SUFFIXES:
                if path.name.endswith(suffix):
                    spelling = path.name.removeprefix("robot-").removesuffix(suffix)
                    numbered = spelling.replace("_", ":")
                    found.add(numbered if is_address(numbered) else spelling)
    return tuple(sorted(found))


def _last_addresses(name: str) -> frozenset[str]:
    """Return the addresses that a name had when it was last looked up; none where it never was."""
    try:
        return frozenset(read_file(_file(name, ADDRESSES_SUFFIX), _MAX_BYTES).decode().split())
    except (OSError, UnicodeError):
        return frozenset()


@contextlib.contextmanager
def lock_robot(files: RobotFiles, commands: str = "", gripper: tuple[str, int] | None = None) -> Iterator[None]:
    """Keep other daemons of this user away from a robot and its gripper; raises UserError if one of them has either.

    `commands` is the command address of this process, if it has one; the error of another process names it. `gripper`
    has the address and port of its socket. The socket may be another robot's by mistake, and serves any number of
    programs. Two daemons would write the same state of the robot, and neither would know the other's stops and grips.
    The lock ends with the process in any case. If the file cannot be made, no experiment starts, and nothing is locked.
    """
    with contextlib.ExitStack() as opened:
        for path in files.locks:
            _lock(path, f"robot at {files.host}", commands, opened)
        if gripper is not None:
            opened.enter_context(lock_gripper(*gripper, commands))
        yield


@contextlib.contextmanager
def lock_gripper(host: str, port: int, commands: str = "") -> Iterator[None]:
    """Keep other programs of this user away from a gripper's socket; raises UserError as `lock_robot` does."""
    with contextlib.ExitStack() as opened:
        for address in sorted(addresses_of((host,))[host]) or [one_spelling(host)]:
            path = _file(f"{address}-{port}", ".lock", of="gripper")
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
            stop = f"with `shearloop command stop --connect {address}`" if address else "with Ctrl-C in its terminal"
            raise UserError(
                f"the {what} is driven by another program of this computer (process {process}): "
                f"stop that one first, {stop}, or name another {what.split(maxsplit=1)[0]} in the configuration"
            ) from None
        file.truncate(0)
        file.write(f"{os.getpid()} {commands}".rstrip())
        file.flush()
