"""The steps of an installation: each says what it does, and does it."""

import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from shearloop.daemon.errors import UserError


class Step(Protocol):
    """One thing that is done to the system."""

    @property
    def acts(self) -> bool:
        """Whether `carry_out` would change anything now."""

    def sentence(self) -> str:
        """Return what `carry_out` would do now."""

    def carry_out(self) -> None:
        """Do it; raises UserError naming the file or the program that stood in the way."""


@dataclass(frozen=True, slots=True)
class PutFile:
    """A file of ours in its place; `keep` leaves one alone that is there already."""

    target: Path
    content: bytes
    keep: bool = False

    @property
    def acts(self) -> bool:
        """Whether the file is not there yet, or is another one that may be replaced."""
        return not self.target.exists() or not (self.keep or self.target.read_bytes() == self.content)

    def sentence(self) -> str:
        """Return whether it is new, changed, or as it should be."""
        if self.acts:
            return f"{'replace' if self.target.exists() else 'write'} {self.target}"
        return f"left as it is: {self.target}"

    def carry_out(self) -> None:
        """Write the file for everyone to read."""
        if not self.acts:
            return
        try:
            self.target.parent.mkdir(parents=True, exist_ok=True)
            self.target.write_bytes(self.content)
            self.target.chmod(0o644)
        except OSError as error:
            raise _refused(self.target, "written", error) from error


@dataclass(frozen=True, slots=True)
class TakeFile:
    """A file of ours taken away; with `unless_edited`, only while it has this content."""

    target: Path
    unless_edited: bytes | None = None

    @property
    def acts(self) -> bool:
        """Whether the file is there and may go."""
        return self.target.exists() and self.unless_edited in (None, self.target.read_bytes())

    def sentence(self) -> str:
        """Return whether it is there, and whether it goes."""
        if self.acts:
            return f"remove {self.target}"
        return f"left, having been edited: {self.target}" if self.target.exists() else f"not there: {self.target}"

    def carry_out(self) -> None:
        """Remove the file."""
        if not self.acts:
            return
        try:
            self.target.unlink()
        except OSError as error:
            raise _refused(self.target, "removed", error) from error


@dataclass(frozen=True, slots=True)
class TakeEmptyFolder:
    """A folder of ours that goes when nothing is left in it."""

    target: Path

    @property
    def acts(self) -> bool:
        """Whether the folder is there; what is in it may still go before its turn."""
        return self.target.is_dir()

    def sentence(self) -> str:
        """Return whether it is there."""
        return f"remove {self.target} if nothing is left in it" if self.acts else f"not there: {self.target}"

    def carry_out(self) -> None:
        """Remove the folder unless something is in it."""
        if not self.acts or any(self.target.iterdir()):
            return
        try:
            self.target.rmdir()
        except OSError as error:
            raise _refused(self.target, "removed", error) from error


@dataclass(frozen=True, slots=True)
class RunProgram:
    """A program of the system; `may_fail` is for what may already be so."""

    arguments: Sequence[str]
    purpose: str
    may_fail: bool = False
    acts = True

    def sentence(self) -> str:
        """Return the command line and what it is for."""
        return f"run `{' '.join(self.arguments)}`, which {self.purpose}"

    def carry_out(self) -> None:
        """Run it; its own words come with a failure."""
        program = shutil.which(self.arguments[0])
        if program is None:
            raise UserError(f"there is no program {self.arguments[0]} on this system; install it and try again")
        done = subprocess.run(
            [program, *self.arguments[1:]], capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
        )
        if done.returncode != 0 and not self.may_fail:
            said = " ".join((done.stderr or done.stdout).split())
            raise UserError(f"`{' '.join(self.arguments)}` failed with status {done.returncode}: {said}")


@dataclass(frozen=True, slots=True)
class Tell:
    """Something that is left as it is, or that the reader has to do."""

    text: str
    acts = False

    def sentence(self) -> str:
        """Return the text."""
        return self.text

    def carry_out(self) -> None:
        """Do nothing."""


def _refused(path: Path, what: str, error: OSError) -> UserError:
    cure = "; run it with sudo" if isinstance(error, PermissionError) else ""
    return UserError(f"{path} cannot be {what}: {error.strerror}{cure}")
