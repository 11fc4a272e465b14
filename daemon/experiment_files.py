"""Experiments: read with every mistake at the desk, and at an operator's request in a thread and within bounds.

Every user of this machine may send `start` with the name of a file, and the daemon may be allowed to read more than
they are. So a request names only files in the configured folders, and the reply names no content.
"""

import asyncio
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from typing import TypeVar

import structlog

from shearloop.daemon.commissioning import Commissioning
from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.experiment_check import check_steps, experiment_mistakes
from shearloop.daemon.control.experiment_schema import ExperimentFile, Mistake, outline
from shearloop.daemon.errors import InvalidExperimentError
from shearloop.daemon.torques import TorqueSource
from shearloop.drivers.robotiq.models import GripperModel
from shearloop.errors import UserError
from shearloop.files import read_file
from shearloop.mistakes import shown
from shearloop.words import counted
from shearloop.yaml_files import MOST_BYTES, Document

# A file on a network drive may never answer.
READ_WITHIN_S = 5.0
# Of a path, and of a mistake, in a message.
_LONGEST_NAME = 300
_LONGEST_MISTAKE = 500
# Files of a folder that are looked at for the list.
MOST_LISTED = 500
Found = TypeVar("Found")


def read_experiment(path: Path) -> ExperimentFile:
    """Return the experiment of a file; raises UserError for an invalid one, or one beyond its limits."""
    document = read_document(path)
    return without_mistakes(document, check_steps(outline(document.content)))


def check_experiment(
    config: DaemonConfig, sources: Mapping[str, TorqueSource], robot: Commissioning | None = None
) -> ExperimentFile | None:
    """Return the configured experiment, if any; raises UserError if the configured devices cannot run it.

    `sources` are all torques but the robot's; `robot` has its limits and its cap, where they are known.
    """
    path = config.experiment
    if path is None:
        return None
    document = read_document(path)
    return without_mistakes(document, experiment_mistakes(document.content, config, sources, robot))


def read_document(path: Path) -> Document:
    """Return the content of an experiment's file; raises UserError."""
    return Document.read(path, UserError, ExperimentFile.what)


def without_mistakes(document: Document, mistakes: Sequence[Mistake]) -> ExperimentFile:
    """Return the experiment of a file; raises UserError with these mistakes and the mistakes of its keys and values."""
    lines: list[str] = []
    try:
        file = document.model(ExperimentFile)
    except UserError as error:
        lines.append(str(error))
    lines += document.located(mistakes)
    if lines:
        raise UserError("\n".join(lines))
    return file


@dataclass(frozen=True, slots=True)
class ReadExperiment:
    """An experiment with the bytes of its file, as they were read once."""

    path: Path
    file: ExperimentFile
    data: bytes


@dataclass(slots=True)
class ExperimentFiles:
    """The experiments that a request may name: regular files of at most 128 kB in `folders`, or below them.

    Each can run on the rig of `config`, where it is given: with its torque `sources`, but the robot's, and its `robot`.
    """

    folders: tuple[Path, ...]
    config: DaemonConfig | None = None
    sources: Mapping[str, TorqueSource] = field(default_factory=dict)
    robot: Commissioning | None = None
    _reading: threading.Thread | None = field(default=None, init=False)

    @property
    def gripper(self) -> GripperModel | None:
        """The rig's gripper, if one is known."""
        return self.config.gripper_model if self.config is not None else None

    async def read(self, path: Path) -> ReadExperiment:
        """Return the experiment of a file; raises UserError without the file's content, at the latest after 5 s."""
        return await self._in_thread(lambda: self._read(path), str(path))

    async def list(self) -> dict[str, str]:
        """Return the names of the experiments of `folders` that `read` accepts, by path; raises UserError."""
        return await self._in_thread(self._list, "the folders of experiments")

    async def _in_thread(self, work: Callable[[], Found], what: str) -> Found:
        """Return what a thread finds, one at a time: no file keeps the event loop, or others' threads, from working."""
        if self._reading is not None and self._reading.is_alive():
            raise UserError("the file of another start is being read; wait for its end")
        loop = asyncio.get_running_loop()
        result: asyncio.Future[Found] = loop.create_future()
        # A daemon thread: a drive that does not answer must not keep the process alive.
        reading = self._reading = threading.Thread(
            target=_run, args=(work, loop, result), name="experiment", daemon=True
        )
        reading.start()
        try:
            await asyncio.wait({result}, timeout=READ_WITHIN_S)
            if not result.done():
                cure = "try again on a less busy computer; from a network drive, copy it to a local one"
                raise UserError(f"{what}: the experiment was not read within {READ_WITHIN_S:g} s; {cure}")
        finally:
            # A later result has no receiver.
            result.cancel()
        # Its work is done.
        reading.join()
        return result.result()

    def _list(self) -> dict[str, str]:
        found: dict[str, str] = {}
        for path in self._paths():
            # Configurations share the folder with experiments. The list has only the files that `start` accepts.
            with suppress(UserError, OSError):
                document = Document.parse(path, read_file(path, MOST_BYTES), UserError, ExperimentFile.what)
                if isinstance(document.content, dict) and "steps" in document.content:
                    found[str(path)] = without_mistakes(document, self._mistakes(document)).name
        return found

    def _paths(self) -> Iterator[Path]:
        """Yield the YAML files of the folders."""
        for folder in self.folders:
            own = folder.resolve()
            # A link may lead elsewhere.
            paths = (path for path in own.rglob("*.yaml") if path.is_file() and path.resolve().is_relative_to(own))
            yield from sorted(islice(paths, MOST_LISTED))

    def _mistakes(self, document: Document) -> Sequence[Mistake]:
        """Return what the experiment's own limits, or the rig where it is known, do not allow."""
        if self.config is None:
            return check_steps(outline(document.content))
        return experiment_mistakes(document.content, self.config, self.sources, self.robot)

    def _meant(self, named: Path) -> str:
        """Return which file of the folders was probably meant, or an empty text."""
        known = {path.name: path for path in self._paths()}
        return "".join(f"; did you mean {known[name]}?" for name in get_close_matches(named.name, known, 1))

    def _read(self, named: Path) -> ReadExperiment:
        name = str(named) if len(str(named)) <= _LONGEST_NAME else shown(str(named))
        try:
            path = named.resolve()
            if not any(path.is_relative_to(folder.resolve()) for folder in self.folders):
                folders = " and ".join(map(str, self.folders)) or "no folder"
                # The answer does not say whether the file exists: the daemon may see more than the person who asks.
                meant = self._meant(named)
                cure = f"{meant} Otherwise copy" if meant else "; copy"
                raise UserError(
                    f"{name} is in none of the folders of experiments ({folders}){cure} it there, or name its folder "
                    "under `experiments` in the configuration"
                )
            data = read_file(path, MOST_BYTES)
        except (OSError, ValueError, RuntimeError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            meant = self._meant(named) if isinstance(error, FileNotFoundError) else ""
            raise UserError(f"{name}: the experiment cannot be read: {reason}{meant}") from error
        try:
            document = Document.parse(path, data, UserError, ExperimentFile.what)
            file = document.model(ExperimentFile)
        except UserError as error:
            structlog.get_logger().warning("the experiment is not valid", mistakes=str(error))
            raise InvalidExperimentError(
                f"{name} is not a valid experiment; the daemon's log names each mistake"
            ) from error
        if mistakes := document.located(self._mistakes(document)):
            # The file is an experiment, whose plan `start` shows to every user: its first mistake may be named.
            structlog.get_logger().warning("the rig cannot run the experiment", mistakes="\n".join(mistakes))
            first = mistakes[0] if len(mistakes[0]) <= _LONGEST_MISTAKE else f"{mistakes[0][:_LONGEST_MISTAKE]} …"
            others = (
                f" (and {counted(len(mistakes) - 1, 'more mistake')}: see the daemon's log)" if mistakes[1:] else ""
            )
            raise InvalidExperimentError(f"{first}{others}")
        return ReadExperiment(path, file, data)


def _run(read: Callable[[], Found], loop: asyncio.AbstractEventLoop, result: "asyncio.Future[Found]") -> None:
    """Read in a thread, and give the result or the error to the event loop, if it still waits."""
    try:
        found, error = read(), None
    except Exception as raised:  # noqa: BLE001 - it is raised in the event loop
        found, error = None, raised

    def hand_over() -> None:
        if result.done():
            return
        if error is not None:
            result.set_exception(error)
        elif found is not None:
            result.set_result(found)

    # The loop may have ended meanwhile.
    with suppress(RuntimeError):
        loop.call_soon_threadsafe(hand_over)
