"""Counts the functions that a frame, a command and a calibration pass, and the lines that the daemon loads.

    shearloop demo --folder . --prepare
    python -m benchmarks.call_counts --rig run --out run/call_counts.json

A daemon runs in this process, with the default estimator. One frame is traced in all tasks and threads: from its first
byte to the subscriber's receipt of the estimate. Then the daemon runs an experiment on the emulated rig. One estimate
is traced from its arrival in the control loop to the speed that the robot's worker process gives to ur-rtde, with the
decisions that lie between. Of several frames and estimates the one with the fewest functions counts: messages that a
task publishes once a second do not belong to it. Generators count once, and comprehensions do not count.
"""

import asyncio
import contextlib
import json
import subprocess
import sys
import tempfile
import threading
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import msgpack
import yaml
import zmq
import zmq.asyncio

import shearloop
from benchmarks import common
from benchmarks.daemon_speed import by_default, recorded_lines
from shearloop.daemon.app import Daemon
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.loop_runner import ControlLoopRunner
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.drivers.ur import worker
from shearloop.drivers.ur.client import WorkerConnection
from shearloop.drivers.ur.command_handler import CommandHandler
from shearloop.estimation import Physics
from shearloop.estimation.estimator_names import DEFAULT
from shearloop.tools.calibrate import calibrate

PACKAGE = Path(shearloop.__file__).resolve().parent
# The rooms are links to neighbouring folders.
ROOMS = (PACKAGE, *(path.resolve() for path in PACKAGE.iterdir() if path.is_symlink()))
SIDE = "right"
TRACED = 5
RECEIVE_MS = 60_000
WORKER = "worker.json"
CALIBRATED_ON = ("rig-17.5mm.mcap", "rig-25mm.mcap", "rig-40mm.mcap")
EXPERIMENT = {
    "name": "hold 0.05 N·m",
    "torque_source": SIDE,
    "limits": {"torque_nm": 0.25, "angle_rad": 1.5},
    "steps": [
        {"do": "release", "timeout_s": 15},
        {"do": "tare", "timeout_s": 30},
        {"do": "grip", "width_mm": 5, "force_n": 60, "timeout_s": 15},
        {"do": "wait", "wait_s": 8},
        {"do": "identify", "amplitude_rad": 0.15, "timeout_s": 180},
        {"do": "hold_torque", "torque_nm": 0.05, "ramp_nm_per_s": 0.02, "hold_s": 60, "timeout_s": 120},
    ],
}

# A function of the package: its module, as a path in the repository, and its name.
Function = tuple[str, str]
Way = tuple[Function, ...]


@dataclass(frozen=True, slots=True)
class Loaded:
    """What an interpreter has loaded of the package: the modules' names, and their lines."""

    modules: tuple[str, ...]
    lines: int


class Trace:
    """Records the package's function calls in the threads that it is installed in, while `recording`."""

    def __init__(self) -> None:
        self.recording = False
        self.calls: list[CodeType] = []

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
            self.calls.append(frame.f_code)

    def take(self) -> Way:
        """Return the package's functions that were called, in the order of their first calls, and forget them."""
        calls, self.calls = self.calls, []
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
                self.calls, self._root = [], frame
            elif code in self._continues and self.calls:
                self._root = frame
        if self._root is None:
            return
        if event == "call":
            self.calls.append(code)
        elif event == "return" and self._ends(code):
            self.ways.append(self.take())
            self._root = None
        elif event == "return" and frame is self._root:
            self._root = None


def functions_of(calls: Iterable[CodeType]) -> Way:
    """Return the package's functions among calls, in the order of their first calls."""
    found: dict[Function, None] = {}
    for code in calls:
        path = Path(code.co_filename).resolve()
        room = next((room for room in ROOMS if room in path.parents), None)
        if room is not None and not code.co_name.startswith("<"):
            found[(str(path.relative_to(room.parent)), code.co_qualname)] = None
    return tuple(found)


def shortest(ways: Sequence[Way]) -> Way:
    """Return the path with the fewest functions; raises RuntimeError without one."""
    if not ways:
        raise RuntimeError("no way was traced from its beginning to its end")
    return min(ways, key=len)


@contextlib.asynccontextmanager
async def running(config: Path, *topics: str) -> AsyncIterator["tuple[Daemon, zmq.asyncio.Socket]"]:
    """Run a daemon in this process; yield it and a socket that has subscribed to topics."""
    loaded = load_daemon_config(config)
    with zmq.asyncio.Context() as context:
        daemon = Daemon(loaded, context)
        ready = asyncio.Event()
        task = asyncio.create_task(daemon.run(ready.set))
        await ready.wait()
        with context.socket(zmq.SUB) as subscriber:
            subscriber.setsockopt(zmq.RCVHWM, 0)
            subscriber.setsockopt(zmq.RCVTIMEO, RECEIVE_MS)
            # Health comes once a second and shows that the daemon knows the subscriptions.
            for topic in (*topics, "health"):
                subscriber.setsockopt(zmq.SUBSCRIBE, topic.encode())
            subscriber.connect(loaded.publish)
            while (await subscriber.recv_multipart())[0] != b"health":
                continue
            subscriber.setsockopt(zmq.UNSUBSCRIBE, b"health")
            yield daemon, subscriber
        daemon.stop()
        await task


async def trace_frame(rig: Path, folder: Path) -> Way:
    """Return the functions of one frame, in order."""
    lines = recorded_lines(rig, SIDE, common.FIRST_VALID_FRAME + TRACED)
    ways: list[Way] = []
    trace = Trace()
    with contextlib.closing(common.PlayedBoard(folder / "board")) as board:
        fingertips = by_default(rig, (SIDE,))["fingertips"]
        fingertips[SIDE]["device"] = {"path": str(folder / "board")}
        trace.install()
        try:
            async with running(common.write_config(folder, fingertips=fingertips), "eit.estimate", "eit.frame") as (
                _,
                subscriber,
            ):
                await asyncio.to_thread(board.wait_for_start)
                for number, line in enumerate(lines):
                    await asyncio.sleep(FRAME_PERIOD_S)
                    trace.calls, trace.recording = [], number >= common.FIRST_VALID_FRAME
                    await asyncio.to_thread(board.send, line)
                    received: dict[str, Any] = {}
                    while len(received) < 2:
                        topic, payload = await subscriber.recv_multipart()
                        received[topic.decode()] = payload
                    trace.recording = False
                    way = trace.take()
                    if way and msgpack.unpackb(received["eit.estimate"])["valid"]:
                        ways.append(way)
        finally:
            trace.remove()
    return shortest(ways)


async def trace_command(rig: Path, folder: Path) -> Way:
    """Return the functions from an estimate to a speed that is given to ur-rtde, in order, of both processes."""
    (folder / "hold.yaml").write_text(yaml.safe_dump(EXPERIMENT, allow_unicode=True))
    fingertips = by_default(rig, (SIDE,))["fingertips"]
    fingertips[SIDE]["device"] = {"path": "eit-right"}
    config = common.write_rig_config(
        folder, "config/demo_ur.yaml", fingertips=fingertips, experiment="hold.yaml", emulated=True, autostart=True
    )
    taken = ControlLoop.on_torque.__code__
    trace = WayTrace(
        lambda frame: frame.f_code is taken and frame.f_locals["torque"].source == SIDE,
        [ControlLoopRunner._decide.__code__],
        lambda code: code is WorkerConnection.send.__code__,
    )
    with common.emulated_rig(folder, rig / "demo.bank"), traced_worker(folder):
        try:
            async with running(config, "loop.state") as (_, subscriber):
                trace.install()
                while len(trace.ways) < TRACED:
                    state = msgpack.unpackb((await subscriber.recv_multipart())[1])
                    trace.recording = state["step_name"] == "hold_torque" and state["phase"] == "running"
                    if state["phase"] in ("stopped", "done"):
                        raise RuntimeError(f"the experiment ended before it was traced: {state['activity']}")
        finally:
            trace.remove()
    in_worker = tuple((module, name) for module, name in json.loads((folder / WORKER).read_text()))
    return tuple(dict.fromkeys((*shortest(trace.ways), *in_worker)))


@contextlib.contextmanager
def traced_worker(folder: Path) -> Iterator[None]:
    """Let the robot's process be traced: the daemon starts it with a launcher that calls `run_worker`."""
    launcher, python = folder / "python", sys.executable
    call = f"from pathlib import Path; from benchmarks.call_counts import run_worker; run_worker(Path('{folder}'))"
    launcher.write_text(f'#!/bin/sh\nexec "{python}" -c "{call}"\n')
    launcher.chmod(0o755)
    sys.executable = str(launcher)
    try:
        yield
    finally:
        sys.executable = python


def run_worker(folder: Path) -> None:
    """Run the robot's process; write the shortest path of a wrist speed into a file of the folder."""
    trace = WorkerTrace(folder / WORKER)
    trace.recording = True
    trace.install()
    worker.main()


class WorkerTrace(WayTrace):
    """Records the ways of wrist speeds through the robot's process; the shortest one is in a file."""

    def __init__(self, path: Path) -> None:
        begun = worker._handle_commands.__code__
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
        if self._best is None or len(way) < len(self._best):
            self._best = way
            self._path.write_text(json.dumps(way))
        return way


def trace_calibration(rig: Path, folder: Path) -> Way:
    """Return the functions of a calibration of the default estimator, from recordings to its file."""
    trace = Trace()
    trace.recording = True
    trace.install()
    try:
        result = calibrate([rig / name for name in CALIBRATED_ON], DEFAULT, Physics(), time_range=(0.0, 1.0))
        result.calibration.save(folder / "rig.cal")
    finally:
        trace.remove()
    return trace.take()


def loaded_by_run() -> Loaded:
    """Return the package's modules that `shearloop run` loads, in a separate interpreter."""
    listing = (
        "import json, sys, shearloop.cli.run, shearloop.daemon.app; "
        "print(json.dumps({name: module.__file__ for name, module in sys.modules.items() "
        "if name.split('.')[0] == 'shearloop' and module.__file__}))"
    )
    printed = subprocess.run([sys.executable, "-c", listing], check=True, capture_output=True, text=True).stdout
    files: dict[str, str] = json.loads(printed)
    return Loaded(tuple(sorted(files)), sum(len(Path(path).read_text().splitlines()) for path in files.values()))


def counts(way: Way) -> dict[str, int]:
    """Return the numbers of functions and modules."""
    return {"functions": len(way), "modules": len({module for module, _ in way})}


def diagram(way: Way) -> str:
    """Return the modules in the order of their first call, each with its functions in that order."""
    functions: dict[str, list[str]] = {}
    for module, name in way:
        functions.setdefault(module, []).append(name)
    width = max(map(len, functions))
    return "\n".join(f"  {module:<{width}}  {' · '.join(names)}" for module, names in functions.items())


def measure(rig: Path) -> dict[str, Any]:
    """Return the paths and the modules that `shearloop run` loads, after printing each path."""
    ways: dict[str, Way] = {}
    with tempfile.TemporaryDirectory() as name:
        for kind in ("frame", "command", "calibration"):
            (Path(name) / kind).mkdir()
        for kind, trace in (
            ("frame", lambda rig, folder: asyncio.run(trace_frame(rig, folder))),
            ("command", lambda rig, folder: asyncio.run(trace_command(rig, folder))),
            ("calibration", trace_calibration),
        ):
            way = ways[kind] = trace(rig, Path(name) / kind)
            print("A {}: {functions} functions in {modules} modules".format(kind, **counts(way)))
            print(diagram(way), end="\n\n", flush=True)
    loaded = loaded_by_run()
    return {kind: counts(way) for kind, way in ways.items()} | {
        "shearloop run": {"modules": len(loaded.modules), "lines": loaded.lines}
    }


def main() -> None:
    """Trace, print the ways, and write the counts."""
    parser = common.parser_of(__doc__)
    parser.add_argument("--rig", type=Path, required=True, help="folder with rig-*.mcap, rig*.cal and demo.bank")
    args = parser.parse_args()
    print(common.write_figures(args.out, measure(args.rig.resolve())))


if __name__ == "__main__":
    main()
