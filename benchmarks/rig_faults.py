"""How soon each fault ends in the safety table's response, whether the rig recovers, and the loop's jitter.

    python -m benchmarks.rig_faults --bank run/demo.bank --calibration config/calibrations/rig.yaml --out DIR

The real daemon in a process of its own, the real drivers, the rig emulated over its real ports. In the middle of a slow
twist something fails; measured is the time until `loop.state` tells of it, in periods of the sensor or device that
failed, what the operator reads, and whether the next experiment runs to its end after the fault has gone. Then the
daemon is killed with SIGKILL in the middle of a twist, and the emulated robot says when it stood. Then the robot's
states are timed as they arrive, while as many busy processes as there are processors compete with the loop.
Writes rig_faults.json and rig_faults.png; `--only-draw` draws anew what the JSON says.
"""

import argparse
import asyncio
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zmq
from numpy.typing import NDArray

from benchmarks.rig_configuration import write_configuration
from shearloop.daemon.messaging.messages import decode
from shearloop.daemon.messaging.request import request
from shearloop.daemon.messaging.topics import TOPICS
from shearloop.daemon.service.realtime import high_priority
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.settings import UrSettings, read_settings

DEADLINE_S = 90.0
# A late machine's deadline; what is measured is told beside it.
STOPPED_WITHIN_S = 0.2
JITTER_S = 20.0
# A program as any other, whatever the bench itself may ask for.
BURN = "import os\nos.setpriority(os.PRIO_PROCESS, 0, 0)\nwhile True: pass"


@dataclass(frozen=True, slots=True)
class Fault:
    """A line for the rig, what is then read, whose topic's period counts, and the line that ends it.

    What `passes` is over before a hold becomes a stop: the experiment goes on by itself.
    """

    line: str
    sentence: str
    topic: str
    cure: str
    passes: bool = False


FAULTS = (
    Fault("protective-stop", "protective stop", "robot.state", ""),
    Fault("emergency-stop", "emergency stop", "robot.state", "release"),
    Fault("drop-rtde", "robot", "robot.state", ""),
    Fault("unplug right", "no new torque", "eit.estimate", "replug right"),
    Fault("silence right 3", "no new torque", "eit.estimate", "", passes=True),
    Fault("unplug load", "no new torque", "load.torque", "replug load"),
    Fault("silence load 3", "no new torque", "load.torque", "", passes=True),
    Fault("gripper fault 14", "gripper reports a fault", "gripper.state", "gripper normal"),
    Fault("gripper drop", "no longer holds an object", "gripper.state", "object 20"),
    Fault("kick 0.4", "beyond its limit", "load.torque", ""),
)


class Bench:
    """One rig and one daemon, and what both say."""

    def __init__(self, folder: Path, args: argparse.Namespace, stack: ExitStack) -> None:
        self.folder = folder
        self._rig = stack.enter_context(
            _process(
                *("emulate", "rig", "--bank", str(args.bank), "--run-dir", str(folder), "--host", args.host),
                *("--paper-sketch", "--unlock-wait-s", "0.5", "--power-on-s", "0.2"),
                stdin=subprocess.PIPE,
            )
        )
        self._unread = b""
        self._events: list[dict[str, Any]] = []
        config = write_configuration(folder, args.bank, args.calibration, args.host)
        self.daemon = stack.enter_context(_process("run", str(config)))
        context = stack.enter_context(zmq.Context())
        self._socket: zmq.Socket[bytes] = stack.enter_context(context.socket(zmq.SUB))
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(f"ipc://{folder}/publish")
        for topic in ("loop.state", "robot.state", "gripper.state"):
            self._socket.setsockopt(zmq.SUBSCRIBE, topic.encode())

    def say(self, line: str) -> int:
        """Tell the rig something, and return when, in ns."""
        if self._rig.stdin is None:
            raise RuntimeError("the rig has no input")
        now_ns = time.monotonic_ns()
        self._rig.stdin.write(f"{line}\n".encode())
        self._rig.stdin.flush()
        return now_ns

    def command(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Send a command to the daemon and return its reply."""
        return request(f"ipc://{self.folder}/commands", {"command": name, **arguments}, DEADLINE_S)

    def until(
        self, topic: str, is_so: Callable[[dict[str, Any]], bool], within_s: float = DEADLINE_S
    ) -> dict[str, Any]:
        """Return the first message from now on of which something is so."""
        while self._socket.poll(0):
            self._socket.recv_multipart()
        end_s = time.monotonic() + within_s
        loop: dict[str, Any] = {}
        while time.monotonic() < end_s and self.daemon.poll() is None:
            if self._socket.poll(100):
                name, payload = self._socket.recv_multipart()
                content = decode(payload)
                if name == b"loop.state":
                    loop = content
                if name.decode() == topic and is_so(content):
                    return content
        if self.daemon.poll() is not None:
            raise RuntimeError(f"the daemon has ended with status {self.daemon.poll()}; its last words are above")
        said = ": ".join(filter(None, (loop.get("phase"), loop.get("doing"), loop.get("reasons"))))
        raise RuntimeError(f"{topic} never said so within {within_s:g} s; the loop is {said or 'silent'}")

    def until_phase(self, phase: str) -> dict[str, Any]:
        """Return the first state of the loop in a phase."""
        return self.until("loop.state", lambda state: state["phase"] == phase)

    def event(self, name: str, since_ns: int, within_s: float = 5.0) -> dict[str, Any]:
        """Return the first event of the robot of a name since a moment."""
        out = self._rig.stdout
        if out is None:
            raise RuntimeError("the rig has no output")
        end_s = time.monotonic() + within_s
        while True:
            for event in self._events:
                if event["event"] == name and event["t_mono_ns"] >= since_ns:
                    return event
            if time.monotonic() > end_s or not select.select([out], [], [], within_s)[0]:
                raise RuntimeError(f"the robot never said {name}")
            *lines, self._unread = (self._unread + os.read(out.fileno(), 1 << 16)).split(b"\n")
            self._events += [json.loads(line) for line in lines if line.startswith(b"{")]

    def start(self, path: Path) -> None:
        """Begin an experiment as soon as it can be begun; the operator unlocks what waits for it."""
        end_s = time.monotonic() + DEADLINE_S
        while not (reply := self.command("start", experiment=str(path)))["ok"]:
            if time.monotonic() > end_s:
                raise RuntimeError(reply["why"])
            time.sleep(0.2)
            self.command("unlock")


@contextmanager
def _process(*arguments: str, **options: Any) -> Iterator["subprocess.Popen[bytes]"]:
    process = subprocess.Popen(
        [sys.executable, "-m", "shearloop", *arguments], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, **options
    )
    if process.stdout is None:
        raise RuntimeError("a process without an output")
    if arguments[0] == "emulate" and not process.stdout.readline().startswith(b"rig ready"):
        raise RuntimeError("the rig did not start")
    try:
        yield process
    finally:
        process.terminate()
        process.wait(10)
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()


def _experiment(folder: Path, name: str, *steps: dict[str, Any]) -> Path:
    path = folder / f"{name}.yaml"
    begin = [{"do": "release"}, {"do": "tare"}, {"do": "grip", "width_mm": 5, "force_n": 60}]
    content = {"name": name, "drive": "load_cell", "limits": {"torque_nm": 0.3}, "steps": [*begin, *steps]}
    path.write_text(yaml.safe_dump(content))
    return path


def measure_faults(bench: Bench) -> list[dict[str, Any]]:
    """Let each fault befall a slow twist, end it, and carry a short experiment to its end."""
    slow = {"do": "twist", "angles_rad": [0.12], "speed_rad_per_s": 0.005, "hold_s": 60}
    twist = _experiment(bench.folder, "twist", slow)
    short = _experiment(bench.folder, "short", {"do": "wait", "wait_s": 0.2}, {"do": "release"})
    found = []
    for fault in FAULTS:
        bench.start(twist)
        bench.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.003)
        asked_ns = bench.say(fault.line)

        def tells(state: dict[str, Any], sentence: str = fault.sentence) -> bool:
            return sentence in state["reasons"] and state["phase"] in ("held", "stopped")

        state = bench.until("loop.state", tells)
        after_s = (state["t_mono_ns"] - asked_ns) / 1e9
        period_s = 1.0 / (TOPICS[fault.topic].rate_hz or 1.0)
        after = "running" if fault.passes else "stopped"
        last = state if state["phase"] == after else bench.until_phase(after)
        if fault.passes:
            bench.command("stop")
        if fault.cure:
            bench.say(fault.cure)
        bench.start(short)
        end = bench.until("loop.state", lambda s: s["experiment"] == "short" and s["phase"] in ("done", "stopped"))
        found.append(
            {
                "fault": fault.line,
                "after_s": after_s,
                "periods": after_s / period_s,
                "topic": fault.topic,
                "response": state["response"],
                "then": last["phase"],
                "sentence": state["reasons"],
                "next_experiment": end["phase"],
                "next_doing": end["doing"],
            }
        )
        print(f"{fault.line:18} {after_s * 1e3:7.0f} ms, {after_s / period_s:5.1f} periods of {fault.topic:14} "
              f"{state['response']:20} then {end['phase']} {end['doing'][:160]}", flush=True)  # fmt: skip
    return found


def measure_jitter(settings: UrSettings, busy: int) -> NDArray[np.float64]:
    """Return the times (n,) in s between the states of a resting arm, two of five cycles, beside busy processes."""
    burners = [subprocess.Popen([sys.executable, "-c", BURN]) for _ in range(busy)]
    try:
        return np.diff(asyncio.run(_arrivals(settings))) / 1e9
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


async def _arrivals(settings: UrSettings) -> list[int]:
    robot = UrRobot(settings)
    task = asyncio.create_task(robot.run())
    try:
        while (await robot.next_state()).recovering:
            pass
        end_s, times = time.monotonic() + JITTER_S, []
        while time.monotonic() < end_s:
            await robot.next_state()
            times.append(time.monotonic_ns())
        return times
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def measure_kill(bench: Bench) -> dict[str, Any]:
    """Kill the daemon in the middle of a twist, and return when the robot stood."""
    fast = {"do": "twist", "angles_rad": [3.0], "speed_rad_per_s": 0.5, "hold_s": 1}
    path = bench.folder / "fast.yaml"
    path.write_text(yaml.safe_dump({"name": "fast", "drive": "load_cell", "steps": [fast]}))
    bench.start(path)
    bench.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.45)
    killed_ns = time.monotonic_ns()
    os.kill(bench.daemon.pid, signal.SIGKILL)
    stopped = bench.event("motion-stopped", killed_ns)
    return {"stopped_after_s": (stopped["t_mono_ns"] - killed_ns) / 1e9, "asked_s": STOPPED_WITHIN_S}


def _draw(folder: Path) -> None:
    # Not loaded beside what is timed.
    from benchmarks.control_charts import draw_rig_faults

    told = json.loads((folder / "rig_faults.json").read_text())
    draw_rig_faults(folder / "rig_faults.png", told["faults"], told["gaps_ms"])


def main() -> None:
    """Measure, write the numbers, draw the chart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--bank", type=Path)
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--host", default="127.0.0.62")
    parser.add_argument("--only-draw", action="store_true", help="measure nothing, draw what rig_faults.json says")
    args = parser.parse_args()
    if args.only_draw:
        _draw(args.out)
        return
    if args.bank is None or args.calibration is None:
        parser.error("to measure, --bank and --calibration are needed")
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        bench = Bench(Path(folder), args, stack)
        bench.until("robot.state", lambda _: True)
        bench.until("gripper.state", lambda _: True)
        faults = measure_faults(bench)
        killed = measure_kill(bench)
        settings, processors = read_settings(Path(folder) / "ur.yaml"), os.cpu_count() or 1
        jitter = {
            "computer as it was": measure_jitter(settings, 0),
            "a busy process for each processor": measure_jitter(settings, processors),
        }
        with high_priority() as allowed:
            if allowed:
                jitter["the same, run first (as `shearloop run` asks)"] = measure_jitter(settings, processors)
    quantiles = {
        name: {f"p{q:g}_s": float(np.quantile(gaps, q / 100)) for q in (1, 50, 99, 99.9)} | {"n": len(gaps)}
        for name, gaps in jitter.items()
    }
    gaps_ms = {name: (np.sort(gaps) * 1e3).round(3).tolist() for name, gaps in jitter.items()}
    result = {"faults": faults, "between_states": quantiles, "sigkill": killed, "gaps_ms": gaps_ms}
    (args.out / "rig_faults.json").write_text(json.dumps(result, ensure_ascii=False) + "\n")
    _draw(args.out)
    print(json.dumps({"between_states": quantiles, "sigkill": killed}, indent=2))


if __name__ == "__main__":
    main()
