"""Reads experiments: at the desk with every mistake; for an operator's request in a thread and within bounds.

Every user of this machine may send `start` with the name of a file. The daemon may have rights to read files that this
user may not read. So a request may name only files in the configured folders, and the reply contains nothing of a file
that is no experiment.

A thread that parses a file blocks the event loop for some ms at a time. So the files are small, and no file is read for
a request during a motion or the start of one (`Rig.reading_refusal`).
"""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TypeVar

import structlog

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.experiment_schema import STEP_KINDS, ExperimentFile, Mistake
from shearloop.daemon.errors import InvalidExperimentError
from shearloop.daemon.loaded_files import FileStamp, LoadedFiles
from shearloop.daemon.motion_cap import Commissioning, MotionCap
from shearloop.daemon.torques import TorqueSource
from shearloop.errors import UserError
from shearloop.files import read_file
from shearloop.timeouts import timeout
from shearloop.words import counted, shown
from shearloop.yaml_files import Document

# A file on a network drive may never answer.
READ_WITHIN_S = 5.0
# The packaged experiments have less than 2 kB.
MAX_BYTES = 1 << 15
# The longest path and the longest mistake in a message, in characters.
_LONGEST_NAME = 300
_LONGEST_MISTAKE = 500
# So many requests may wait for their file, which leaves room for other requests of the command socket.
_MAX_WAITING = 4
# The number of a folder's files that the list examines.
MAX_LISTED = 500
Found = TypeVar("Found")


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
    return without_mistakes(document, _mistakes_in(document, config, sources, robot))


def _mistakes_in(
    document: Document, config: DaemonConfig, sources: Mapping[str, TorqueSource], robot: Commissioning | None
) -> Sequence[Mistake]:
    # Only an experiment that is read needs it.
    from shearloop.daemon.control.experiment_check import experiment_mistakes

    return experiment_mistakes(document.content, config, sources, robot)


def read_document(path: Path) -> Document:
    """Return the content of an experiment's file; raises UserError."""
    return Document.read(path, UserError, ExperimentFile.what, most_bytes=MAX_BYTES, model=ExperimentFile)


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


class _Stamp(NamedTuple):
    """What the name in the list depends on: the file's content, its rights, and the robot's cap."""

    file: FileStamp
    rights_changed_ns: int
    cap: MotionCap | None


class Listing(NamedTuple):
    """The names of experiments by path, as they were read last, and why none were ever read; empty if they were."""

    names: Mapping[str, str]
    unread: str


class _Listed(NamedTuple):
    """A file of the folders, and the name of its experiment; None where `start` does not accept it."""

    stamp: _Stamp
    name: str | None


@dataclass(slots=True)
class ExperimentFiles:
    """The experiments that a request may name: regular files of at most 32 kB in `folders`, or below them.

    Each can run on the rig of `config`, with its torque `sources`, but the robot's, and its `robot`, if that is known.
    None begins, and no file is read for the list, where a file of `loaded` has changed.
    """

    folders: tuple[Path, ...]
    config: DaemonConfig
    sources: Mapping[str, TorqueSource]
    robot: Commissioning | None
    loaded: LoadedFiles
    # Held by the one thread that reads, also after its request has given up.
    _turn: asyncio.Lock = field(default_factory=asyncio.Lock, init=False)
    _waiting: int = field(default=0, init=False)
    _abandoned: bool = field(default=False, init=False)
    # Each file is parsed again only once it has changed.
    _listed: dict[Path, _Listed] = field(default_factory=dict, init=False)
    # The latest complete list.
    _latest: Mapping[str, str] | None = field(default=None, init=False)

    async def read(self, path: Path) -> ReadExperiment:
        """Return the experiment of a file; raises UserError without the file's content, at the latest after 5 s."""
        async with _in_time(str(path)):
            return await self._in_thread(lambda: self._read(path))

    async def list(self, reading_refusal: Callable[[], str | None] = lambda: None) -> Listing:
        """Return the names of the experiments of `folders` that `read` accepts, by path; raises UserError.

        While `reading_refusal` has a reason, no file is read and the latest list is returned.
        """
        async with _in_time("the folders of experiments"):
            reason = await self._refresh(reading_refusal)
        if self._latest is None:
            return Listing({}, f"{reason}; the folders are read afterwards")
        return Listing(self._latest, "")

    async def _refresh(self, reading_refusal: Callable[[], str | None]) -> str | None:
        """Read the files that have changed and renew the list; return None, or why no file is read now."""
        if (reason := reading_refusal()) is not None:
            return reason
        # The first file that is read loads the check of experiments.
        if outdated := await self._in_thread(self.loaded.why_outdated):
            return outdated
        stamps = await self._in_thread(self._stamps)
        # Of files that are gone, nothing is kept.
        self._listed = {path: one for path, one in self._listed.items() if path in stamps}
        for path, stamp in stamps.items():
            known = self._listed.get(path)
            if known is not None and known.stamp == stamp:
                continue
            # Before each file: a start that has come meanwhile has the next turn, and then something moves.
            if (reason := reading_refusal()) is not None:
                return reason
            name = await self._in_thread(partial(self._name_of, path))
            self._listed[path] = _Listed(stamp, name)
        listed = ((str(path), self._listed[path].name) for path in stamps if path in self._listed)
        self._latest = {path: name for path, name in listed if name is not None}
        return None

    async def _in_thread(self, work: Callable[[], Found]) -> Found:
        """Return what a thread finds, one at a time: no drive keeps the event loop, or others' threads, from working.

        Raises UserError where others wait already, or wait in vain.
        """
        if self._abandoned or self._waiting >= _MAX_WAITING:
            raise UserError("the file of another request is being read; wait for its end")
        self._waiting += 1
        try:
            await self._turn.acquire()
        finally:
            self._waiting -= 1
        loop = asyncio.get_running_loop()
        result: asyncio.Future[Found] = loop.create_future()
        # A daemon thread: a drive that does not answer must not keep the process alive.
        reading = threading.Thread(
            target=_run, args=(work, loop, result, self._on_read), name="experiment", daemon=True
        )
        try:
            reading.start()
        except RuntimeError:
            self._on_read()
            raise
        try:
            await asyncio.wait({result})
        finally:
            # Its request gives up. A later result has no receiver.
            self._abandoned = not result.done()
            result.cancel()
        # Its work is done.
        reading.join()
        return result.result()

    def _on_read(self) -> None:
        """Give the turn to the next request: the thread has ended, whether or not its own request still waits."""
        self._abandoned = False
        self._turn.release()

    def _stamps(self) -> dict[Path, _Stamp]:
        """Return the files of the folders, with their stamps."""
        cap = self.robot.cap if self.robot is not None else None
        found: dict[Path, _Stamp] = {}
        for path in self._paths():
            with suppress(OSError):
                found[path] = _Stamp(FileStamp.of(path), path.stat().st_ctime_ns, cap)
        return found

    def _name_of(self, path: Path) -> str | None:
        """Return the name of the experiment in a file; None where `start` does not accept it."""
        # Configurations share the folder with experiments.
        with suppress(UserError, OSError):
            document = Document.parse(path, read_file(path, MAX_BYTES), UserError, ExperimentFile.what)
            if isinstance(document.content, dict) and "steps" in document.content:
                return without_mistakes(document, self._mistakes(document)).name
        return None

    def _paths(self) -> Iterator[Path]:
        """Yield the YAML files of the folders."""
        for folder in self.folders:
            own = folder.resolve()
            # A link may lead elsewhere.
            paths = (path for path in own.rglob("*.yaml") if path.is_file() and path.resolve().is_relative_to(own))
            yield from sorted(islice(paths, MAX_LISTED))

    def _mistakes(self, document: Document) -> Sequence[Mistake]:
        """Return what the experiment's own limits, or the rig, do not allow."""
        return _mistakes_in(document, self.config, self.sources, self.robot)

    def _meant(self, named: Path) -> str:
        """Return which file of the folders was probably meant, or an empty text."""
        known = {path.name: path for path in self._paths()}
        return "".join(f"; did you mean {known[name]}?" for name in get_close_matches(named.name, known, 1))

    def _refuse_outdated(self) -> None:
        """Raise UserError if a file has changed that the daemon has read, or a module that it may still load."""
        if outdated := self.loaded.why_outdated():
            raise UserError(outdated)

    def _read(self, named: Path) -> ReadExperiment:
        # The check below may be loaded only now.
        self._refuse_outdated()
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
            data = read_file(path, MAX_BYTES)
        except (OSError, ValueError, RuntimeError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error)
            meant = self._meant(named) if isinstance(error, FileNotFoundError) else ""
            raise UserError(f"{name}: the experiment cannot be read: {reason}{meant}") from error
        content: object = None
        try:
            document = Document.parse(path, data, UserError, ExperimentFile.what)
            content = document.content
            file = document.model(ExperimentFile)
        except UserError as error:
            structlog.get_logger().warning("the experiment is not valid", mistakes=str(error))
            if _is_experiment(content):
                raise _mistaken(str(error).splitlines()) from error
            raise InvalidExperimentError(
                f"{name} is not a valid experiment; the daemon's log names each mistake"
            ) from error
        if mistakes := document.located(self._mistakes(document)):
            structlog.get_logger().warning("the rig cannot run the experiment", mistakes="\n".join(mistakes))
            raise _mistaken(mistakes)
        self._refuse_outdated()
        return ReadExperiment(path, file, data)


def _is_experiment(content: object) -> bool:
    """Return whether a file's content has a step of an experiment; of any other file, a reply says nothing."""
    steps = content.get("steps") if isinstance(content, dict) else None
    kinds = (step.get("do") for step in steps if isinstance(step, dict)) if isinstance(steps, list) else ()
    return any(isinstance(kind, str) and kind in STEP_KINDS for kind in kinds)


def _mistaken(mistakes: Sequence[str]) -> InvalidExperimentError:
    """Return the error with an experiment's first mistake: `start` shows the plan of each to every user."""
    first = mistakes[0] if len(mistakes[0]) <= _LONGEST_MISTAKE else f"{mistakes[0][:_LONGEST_MISTAKE]} …"
    others = f" (and {counted(len(mistakes) - 1, 'more mistake')}: see the daemon's log)" if mistakes[1:] else ""
    return InvalidExperimentError(f"{first}{others}")


@asynccontextmanager
async def _in_time(what: str) -> AsyncIterator[None]:
    """Raise UserError in time for who waits for a thread."""
    try:
        async with timeout(READ_WITHIN_S):
            yield
    except TimeoutError as error:
        cure = "try again on a less busy computer; from a network drive, copy it to a local one"
        raise UserError(f"{what}: the experiment was not read within {READ_WITHIN_S:g} s; {cure}") from error


def _run(
    read: Callable[[], Found],
    loop: asyncio.AbstractEventLoop,
    result: "asyncio.Future[Found]",
    on_ended: Callable[[], None],
) -> None:
    """Read in a thread, and give the result or the error to the event loop, if it still waits."""
    try:
        deliver = partial(result.set_result, read())
    except Exception as error:  # noqa: BLE001 - it is raised in the event loop
        deliver = partial(result.set_exception, error)

    def hand_over() -> None:
        on_ended()
        if not result.done():
            deliver()

    # The loop may have ended meanwhile.
    with suppress(RuntimeError):
        loop.call_soon_threadsafe(hand_over)
