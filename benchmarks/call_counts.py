"""Counts the functions that a frame, a command and a calibration pass, and the lines that the daemon loads.

    shearloop demo --folder . --prepare
    python -m benchmarks.call_counts --rig run --out run/call_counts.json

A daemon runs in this process, with the default estimator. One frame is traced in all tasks and threads: from its first
byte to the subscriber's receipt of the estimate. Then the daemon runs an experiment on the emulated rig. One estimate
is traced from its arrival in the control loop to the speed that the worker gives to ur-rtde, with the
decisions that lie between. The frame and the estimate with the fewest functions count, because messages that a task
publishes once a second do not belong to them. Generators count once, and comprehensions do not count.
"""

import asyncio
import contextlib
import json
import multiprocessing
import signal
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import yaml
import zmq
import zmq.asyncio

from benchmarks import common
from benchmarks.call_trace import WORKER, Trace, Way, WayTrace
from benchmarks.daemon_speed import by_default, recorded_lines
from shearloop.daemon.app import Daemon
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.loop_runner import ControlLoopRunner
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.drivers.ur.client import WorkerConnection
from shearloop.estimation import Physics
from shearloop.estimation.estimator_names import DEFAULT, ESTIMATORS
from shearloop.tools.calibrate import calibrate

SIDE = "right"
TRACED = 5
# Each stage ends after this time in any case.
LONGEST_S = 120
LONGEST_FRAME_S = 5.0
CALIBRATED_ON = ("rig-17.5mm.mcap", "rig-25mm.mcap", "rig-40mm.mcap")
EXPERIMENT = {
    "name": "hold 0.05 N·m",
    "torque_source": SIDE,
    "limits": {"torque_nm": 0.25, "angle_rad": 1.5},
    "steps": [
        {"do": "release", "timeout_s": 15},
        {"do": "tare", "timeout_s": 30},
        {"do": "grip", "width_mm": 5, "force_n": 60, "timeout_s": 15},
        {"do": "identify", "amplitude_rad": 0.15, "timeout_s": 180},
        {"do": "hold_torque", "torque_nm": 0.05, "ramp_nm_per_s": 0.02, "hold_s": 60, "timeout_s": 120},
    ],
}


@dataclass(frozen=True, slots=True)
class Loaded:
    """What an interpreter has loaded of the package: the modules' names, and their lines."""

    modules: tuple[str, ...]
    lines: int


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
        try:
            await ready.wait()
            with context.socket(zmq.SUB) as subscriber:
                subscriber.setsockopt(zmq.RCVHWM, 0)
                # Health comes once a second and shows that the daemon knows the subscriptions.
                for topic in (*topics, "health"):
                    subscriber.setsockopt(zmq.SUBSCRIBE, topic.encode())
                subscriber.connect(loaded.publish)
                while (await subscriber.recv_multipart())[0] != b"health":
                    continue
                subscriber.setsockopt(zmq.UNSUBSCRIBE, b"health")
                yield daemon, subscriber
        finally:
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
            config = common.write_config(folder, **common.PLAYED, fingertips=fingertips)
            async with running(config, "eit.estimate", "eit.frame") as (_, subscriber):
                await asyncio.to_thread(board.wait_for_start)
                for number, line in enumerate(lines):
                    await asyncio.sleep(FRAME_PERIOD_S)
                    trace.calls, trace.recording = {}, number >= common.FIRST_VALID_FRAME
                    await asyncio.to_thread(board.send, line)
                    received: dict[str, Any] = {}
                    # A board that is opened again on a busy computer loses a line.
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(LONGEST_FRAME_S):
                            while len(received) < 2:
                                topic, payload = await subscriber.recv_multipart()
                                received[topic.decode()] = payload
                    trace.recording = False
                    way = trace.take()
                    if way and len(received) == 2 and msgpack.unpackb(received["eit.estimate"])["valid"]:
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
    """Let the worker be traced: the daemon starts it with a launcher that calls `run_worker`."""
    launcher, python = folder / "python", sys.executable
    call = f"from pathlib import Path; from benchmarks.call_trace import run_worker; run_worker(Path('{folder}'))"
    launcher.write_text(f'#!/bin/sh\nexec "{python}" -c "{call}"\n')
    launcher.chmod(0o755)
    sys.executable = str(launcher)
    try:
        yield
    finally:
        sys.executable = python


async def trace_calibration(rig: Path, folder: Path) -> Way:
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


def loaded_by_run(*, robot: bool) -> Loaded:
    """Return the package's modules that `shearloop run` loads, in a separate interpreter.

    The fingertips have a calibration of the default estimator, and no bank.
    """
    default, _, _ = ESTIMATORS[DEFAULT].partition(":")
    modules = ["shearloop.cli.run", "shearloop.daemon.app", default]
    if robot:
        modules += ["shearloop.daemon.rig", "shearloop.daemon.configured_experiment"]
    listing = (
        f"import json, sys, {', '.join(modules)}; "
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


STAGES: dict[str, Callable[[Path, Path], Coroutine[None, None, Way]]] = {
    "frame": trace_frame,
    "command": trace_command,
    "calibration": trace_calibration,
}


def trace(kind: str, rig: Path) -> Way:
    """Return the way of one stage; raises TimeoutError if it takes too long."""

    async def within() -> Way:
        async with asyncio.timeout(LONGEST_S):
            return await STAGES[kind](rig, Path(folder))

    # It also ends a calculation, which the event loop cannot.
    signal.alarm(LONGEST_S + 10)
    with tempfile.TemporaryDirectory() as folder:
        return asyncio.run(within())


def measure(rig: Path) -> dict[str, Any]:
    """Return the paths and the modules that `shearloop run` loads, after printing each path."""
    ways: dict[str, Way] = {}
    # Each in a process of its own: most of their time they wait for devices.
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"), max_tasks_per_child=1) as processes:
        traced = {kind: processes.submit(trace, kind, rig) for kind in STAGES}
        for kind, result in traced.items():
            way = ways[kind] = result.result()
            print("A {}: {functions} functions in {modules} modules".format(kind, **counts(way)))
            print(diagram(way), end="\n\n", flush=True)
    loaded = {
        "shearloop run, sensors alone": loaded_by_run(robot=False),
        "shearloop run, with a robot": loaded_by_run(robot=True),
    }
    return {kind: counts(way) for kind, way in ways.items()} | {
        rig: {"modules": len(found.modules), "lines": found.lines} for rig, found in loaded.items()
    }


def main() -> None:
    """Trace, print the ways, and write the counts."""
    parser = common.parser_of(__doc__)
    parser.add_argument("--rig", type=Path, required=True, help="folder with rig-*.mcap, rig*.cal and demo.bank")
    args = parser.parse_args()
    print(common.write_figures(args.out, measure(args.rig.resolve())))


if __name__ == "__main__":
    main()
