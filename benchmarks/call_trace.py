"""Records which functions of the package a thread calls, in this process and in the robot's.

It imports little: the worker has to answer within seconds.
"""

import inspect
import json
import sys
import threading
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from types import CodeType, FrameType

import shearloop
from shearloop.drivers.ur import worker
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.drivers.ur.motion import MotionExecutor

PACKAGE = Path(shearloop.__file__).resolve().parent
# The rooms are links to neighbouring folders.
ROOMS = (PACKAGE, *(path.resolve() for path in PACKAGE.iterdir() if path.is_symlink()))
WORKER = "worker.json"

# A function of the package: its module, as a path in the repository, and its name.
Function = tuple[str, str]
Way = tuple[Function, ...]


class Trace:
    """Records the package's function calls in the threads that it is installed in, while `recording`."""

    def __init__(self) -> None:
        self.recording = False
        # In the order of their first calls.
        self.calls: dict[CodeType, None] = {}

    def install(self) -> None:
        """Watch this thread and all that begin later."""
        threading.setprofile(self._on_event)
        sys.setprofile(self._on_event)

    def remove(self) -> None:
        """Watch nothing."""
        threading.setprofile(None)
        sys.setprofile(None)

    def _on_event(self, frame: FrameType, event: str, _argument: object) -> None:
        if self.recording and event == "call":
            self.calls[frame.f_code] = None

    def take(self) -> Way:
        """Return the package's functions that were called, in the order of their first calls, and forget them."""
        calls, self.calls = self.calls, {}
        return functions_of(calls)


class WayTrace(Trace):
    """Records ways that begin in one function, continue in others, and end when a last one returns."""

    def __init__(
        self, begins: Callable[[FrameType], bool], continues: Iterable[CodeType], ends: Callable[[CodeType], bool]
    ) -> None:
        super().__init__()
        self.ways: list[Way] = []
        self._begins, self._continues, self._ends = begins, frozenset(continues), ends
        self._root: FrameType | None = None

    def _on_event(self, frame: FrameType, event: str, _argument: object) -> None:
        if not self.recording:
            return
        code = frame.f_code
        if event == "call" and self._root is None:
            if self._begins(frame):
                self.calls, self._root = {}, frame
            elif code in self._continues and self.calls:
                self._root = frame
        if self._root is None:
            return
        if event == "call":
            self.calls[code] = None
        elif event == "return" and self._ends(code):
            self.ways.append(self.take())
            self._root = None
        elif event == "return" and frame is self._root:
            self._root = None


def functions_of(calls: Iterable[CodeType]) -> Way:
    """Return the package's functions among calls, in the order of their first calls.

    A module that is imported late calls the bodies of its classes too, which are no functions.
    """
    found: dict[Function, None] = {}
    for code in calls:
        if not code.co_flags & inspect.CO_OPTIMIZED:
            continue
        module = module_of(code.co_filename)
        if module is not None and not code.co_name.startswith("<"):
            found[module, code.co_qualname] = None
    return tuple(found)


@cache
def module_of(filename: str) -> str | None:
    """Return a module of the package as a path in the repository, None for another file."""
    path = Path(filename).resolve()
    room = next((room for room in ROOMS if room in path.parents), None)
    return str(path.relative_to(room.parent)) if room is not None else None


def run_worker(folder: Path) -> None:
    """Run the worker; write the shortest path of a wrist speed into a file of the folder."""
    trace = WorkerTrace(folder / WORKER)
    trace.recording = True
    trace.install()
    worker.main()


class WorkerTrace(WayTrace):
    """Records the ways of wrist speeds through the worker; the shortest one is in a file."""

    def __init__(self, path: Path) -> None:
        begun = worker.handle_commands.__code__
        super().__init__(
            lambda frame: frame.f_code is begun,
            [CommandHandler.tick.__code__],
            # Named, because ur-rtde is loaded later.
            lambda code: code.co_qualname == "UrArm.wrist",
        )
        self._path = path
        self._best: Way | None = None

    def take(self) -> Way:
        """Return the path, and write it if it is the shortest one."""
        way = super().take()
        # A stop ends in the same call.
        turns = any(name == MotionExecutor._keep_turning.__qualname__ for _, name in way)
        if turns and (self._best is None or len(way) < len(self._best)):
            self._best = way
            self._path.write_text(json.dumps(way))
        return way
