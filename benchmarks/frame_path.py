"""The functions that one frame passes from the port to a subscriber, and one estimate to a sent speed.

    python -m benchmarks.frame_path [--json]

A daemon runs in this process on a board that the benchmark plays, with the default estimator. One frame is traced in
all tasks and threads, from its first byte to the subscriber's receipt of the estimate. Then a daemon runs an experiment
on the emulated rig. One estimate is traced from the control loop's inputs to the speed that goes to the robot's
process; the decisions that lie between are traced from their beginning. Of several frames and estimates the shortest
way counts: messages that a task publishes once a second do not belong to it.
"""

import argparse
import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import textwrap
import threading
from collections.abc import AsyncIterator, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import msgpack
import numpy as np
import yaml
import zmq
import zmq.asyncio
from numpy.typing import NDArray

import shearloop
from benchmarks import common
from shearloop.daemon.app import Daemon
from shearloop.daemon.cli.emulated_calibration import calibrate, record
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.runner import ControlLoopRunner
from shearloop.drivers.emulators.rig import SIDES
from shearloop.drivers.ur.client import WorkerConnection

PACKAGE = str(Path(shearloop.__file__).parent) + os.sep
SIDE = "right"
SEED = 7
DIAMETERS_MM = (17.5, 20.0, 25.0)
TRACED = 5
RECEIVE_MS = 60_000
EXPERIMENT = Path("config/experiments/hold_torque.yaml")


class Trace:
    """Records the package's function calls in the threads that it is installed in, while `recording`."""

    def __init__(self) -> None:
        self.recording = False
        self.calls: list[CodeType] = []

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Watch this thread and all that begin later."""
        threading.setprofile(self._on_event)
        sys.setprofile(self._on_event)
        try:
            yield
        finally:
            threading.setprofile(None)
            sys.setprofile(None)

    def _on_event(self, frame: FrameType, event: str, _argument: object) -> None:
        if self.recording and event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            self.calls.append(frame.f_code)


class CommandTrace(Trace):
    """Records the calls within the taking of a torque and within decisions, until a speed is sent; then a new way."""

    _TORQUE = ControlLoop.on_torque.__code__
    _DECISION = ControlLoopRunner._decide.__code__
    _SENT = WorkerConnection.send.__code__

    def __init__(self) -> None:
        super().__init__()
        self.ways: list[list[CodeType]] = []
        self._root: FrameType | None = None

    def _on_event(self, frame: FrameType, event: str, _argument: object) -> None:
        if not self.recording:
            return
        code = frame.f_code
        if event == "call" and self._root is None:
            if code is self._TORQUE and frame.f_locals["torque"].source == SIDE:
                self.calls, self._root = [], frame
            elif code is self._DECISION and self.calls:
                self._root = frame
        if self._root is None:
            return
        if event == "call" and code.co_filename.startswith(PACKAGE):
            self.calls.append(code)
        elif event == "return" and code is self._SENT and code in self.calls:
            self.ways.append(self.calls)
            self.calls, self._root = [], None
        elif event == "return" and frame is self._root:
            self._root = None


def make_rig(folder: Path) -> list[NDArray[np.float64]]:
    """Write the emulated rig's bank, calibration and experiment; return frames of one board."""
    experiment = yaml.safe_load(EXPERIMENT.read_text())
    (folder / "hold.yaml").write_text(yaml.safe_dump({**experiment, "torque_source": SIDE}, allow_unicode=True))
    build = ("bank", "build", "--config", "config/banks/demo.yaml", "--out", str(folder / "demo.bank"))
    subprocess.run([sys.executable, "-m", "shearloop", *build], check=True, stdout=subprocess.DEVNULL)
    recorded = list(record(folder / "demo.bank", SEED, DIAMETERS_MM))
    calibrate([one.series(diameter_mm) for diameter_mm, one in recorded], (SIDE,)).save(folder / "right.cal")
    index = list(SIDES).index(SIDE)
    return [pair[index] for pair in recorded[-1][1].lines]


def fingertip(folder: Path, port: str, **more: float) -> dict[str, Any]:
    """Return the configuration of the fingertip with the default estimator."""
    return {SIDE: {"device": {"path": str(folder / port)}, "calibration": str(folder / "right.cal"), **more}}


@contextlib.asynccontextmanager
async def running(config: Path, *topics: str) -> AsyncIterator["zmq.asyncio.Socket"]:
    """Run a daemon in this process; yield a socket that has subscribed to topics."""
    loaded = load_daemon_config(config)
    with zmq.asyncio.Context() as context:
        daemon = Daemon(loaded, context)
        ready = asyncio.Event()
        task = asyncio.create_task(daemon.run(ready.set))
        await ready.wait()
        with context.socket(zmq.SUB) as subscriber:
            subscriber.setsockopt(zmq.RCVHWM, 0)
            subscriber.setsockopt(zmq.RCVTIMEO, RECEIVE_MS)
            for topic in topics:
                subscriber.setsockopt(zmq.SUBSCRIBE, topic.encode())
            subscriber.connect(loaded.publish)
            try:
                yield subscriber
            finally:
                daemon.stop()
                await task


async def trace_frame(folder: Path, lines: Sequence[NDArray[np.float64]]) -> list[list[CodeType]]:
    """Return the calls of each frame, in order."""
    ways: list[list[CodeType]] = []
    trace = Trace()
    with contextlib.closing(common.PlayedBoard(folder / "board")) as board, trace.installed():
        config = common.write_config(folder, fingertips=fingertip(folder, "board", frame_period_s=common.PAUSE_S))
        async with running(config, "eit.estimate", "eit.frame") as subscriber:
            await asyncio.to_thread(board.wait_for_start)
            for number, line in enumerate(lines[common.FIRST_FRAME :]):
                await asyncio.sleep(common.PAUSE_S)
                trace.calls, trace.recording = [], number >= common.FIRST_VALID_FRAME
                await asyncio.to_thread(board.send, common.line_text(line))
                received = dict([await subscriber.recv_multipart() for _ in range(2)])
                trace.recording = False
                if trace.calls and msgpack.unpackb(received[b"eit.estimate"])["valid"]:
                    ways.append(trace.calls)
                if len(ways) == TRACED:
                    break
    return ways


async def trace_command(folder: Path) -> list[list[CodeType]]:
    """Return the calls from each estimate to a sent speed, in order."""
    fingertips = fingertip(folder, "eit-right")
    config = common.write_rig_config(folder, "config/demo_ur.yaml", fingertips=fingertips, experiment="hold.yaml")
    trace = CommandTrace()
    with common.emulated_rig(folder, folder / "demo.bank"), contextlib.ExitStack() as installed:
        async with running(config, "loop.state") as subscriber:
            while len(trace.ways) < TRACED:
                state = msgpack.unpackb((await subscriber.recv_multipart())[1])
                if state["phase"] not in ("idle", "running", "held"):
                    raise RuntimeError(f"the experiment ended before it was traced: {state['activity']}")
                if not trace.recording and state["step_name"] == "hold_torque":
                    trace.recording = True
                    # Not before: it slows the loop.
                    installed.enter_context(trace.installed())
    return trace.ways


def by_module(calls: Sequence[CodeType]) -> dict[str, dict[str, None]]:
    """Return the modules in the order of their first call, each with its functions in that order."""
    functions: dict[str, dict[str, None]] = {}
    for code in calls:
        functions.setdefault(code.co_filename.removeprefix(PACKAGE), {})[code.co_qualname] = None
    return functions


def main() -> None:
    """Trace both ways and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print the counts as JSON")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        lines = make_rig(folder)
        traced = {"": asyncio.run(trace_frame(folder, lines)), "command_": asyncio.run(trace_command(folder))}
    counts: dict[str, int] = {}
    for name, ways in traced.items():
        calls = min(ways, key=lambda way: len(set(way)))
        found = by_module(calls)
        counts |= {f"{name}functions": len(set(calls)), f"{name}modules": len(found), f"{name}calls": len(calls)}
        if not args.json:
            for module, functions in found.items():
                print(module, *textwrap.wrap(" · ".join(functions), 112, break_on_hyphens=False), sep="\n    ")
            print()
    print(json.dumps(counts))


if __name__ == "__main__":
    main()
