"""How soon each fault ends in the safety table's response, and whether the rig recovers.

    python -m benchmarks.rig_faults --rig run --out run/rig_faults.json

The real daemon in its own process and the real drivers, with the rig emulated over its real ports. Something fails in
the middle of a slow twist. Measured is the time until `loop.state` reports the response, in periods of the failed
sensor's or device's topic, and whether the next experiment completes once the fault is gone. Finally the daemon is
killed with SIGKILL in the middle of a fast twist, and the emulated robot reports when it stood still. `--rig` is the
folder of `shearloop.daemon.cli.calibrate_demo`, with demo.bank and rig-right.cal.
"""

import argparse
import json
import os
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

import yaml
import zmq

from benchmarks.daemon_speed import write_config
from shearloop.daemon.messaging.client import send_command
from shearloop.daemon.messaging.messages import TOPICS, decode

DEADLINE_S = 90.0


@dataclass(frozen=True, slots=True)
class RigFault:
    """A command to the rig, the expected part of the operator's sentence, the topic that counts, and the cure.

    A fault that `passes` is over before the hold becomes a stop; the experiment then continues.
    """

    command: str
    sentence: str
    topic: str
    cure: str
    passes: bool = False


FAULTS = (
    RigFault("protective-stop", "protective stop", "robot.state", ""),
    RigFault("emergency-stop", "emergency stop", "robot.state", "release"),
    RigFault("drop-rtde", "robot", "robot.state", ""),
    RigFault("unplug right", "no new torque", "eit.estimate", "replug right"),
    # The default estimator needs seven seconds of the grip again, longer than a hold may last.
    RigFault("silence right 3", "no new torque", "eit.estimate", ""),
    RigFault("unplug load", "no new torque", "load.torque", "replug load"),
    RigFault("silence load 3", "no new torque", "load.torque", "", passes=True),
    RigFault("gripper fault 14", "gripper reports a fault", "gripper.state", "gripper normal"),
    RigFault("gripper drop", "no longer holds an object", "gripper.state", "object 20"),
    RigFault("kick 0.4", "beyond its limit", "load.torque", ""),
)


class RunningRig:
    """One emulated rig and one daemon in processes of their own."""

    def __init__(self, folder: Path, args: argparse.Namespace, stack: ExitStack) -> None:
        """Start both."""
        self.folder = folder
        bank = args.rig / "demo.bank"
        self._rig = stack.enter_context(
            _process(
                *("emulate", "rig", "--bank", str(bank), "--run-dir", str(folder), "--host", args.host),
                *("--paper-sketch", "--unlock-wait-s", "0.5", "--power-on-s", "0.2"),
                stdin=subprocess.PIPE,
            )
        )
        if self._rig.stdout is None or not self._rig.stdout.readline().startswith(b"rig ready"):
            raise RuntimeError("the rig did not start")
        self.daemon = stack.enter_context(_process("run", str(self._write_config(args))))
        context = stack.enter_context(zmq.Context())
        self._socket: zmq.Socket[bytes] = stack.enter_context(context.socket(zmq.SUB))
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(f"ipc://{folder}/publish")
        for topic in ("loop.state", "robot.state", "gripper.state"):
            self._socket.setsockopt(zmq.SUBSCRIBE, topic.encode())

    def _write_config(self, args: argparse.Namespace) -> Path:
        shipped = yaml.safe_load(Path("config/ur.yaml").read_text())
        (self.folder / "ur.yaml").write_text(yaml.safe_dump({**shipped, "host": args.host}))
        calibration = str((args.rig / "rig-right.cal").resolve())
        return write_config(
            self.folder,
            fingertips={
                "right": {"device": {"path": "eit-right"}, "estimator": "motion_regression", "calibration": calibration}
            },
            load_cell={"device": {"path": "load-cell"}},
            robot="ur.yaml",
            gripper={"socket": {"host": args.host}},
            # Estimates that disagree are no fault here.
            loop={"disagreement_nm": 1.0, "max_innovation_nm": 1.0},
        )

    def tell_rig(self, command: str) -> int:
        """Send the rig a command; return the time in ns."""
        if self._rig.stdin is None:
            raise RuntimeError("the rig has no input")
        now_ns = time.monotonic_ns()
        self._rig.stdin.write(f"{command}\n".encode())
        self._rig.stdin.flush()
        return now_ns

    def command(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Send the daemon a command; return its reply."""
        return send_command(f"ipc://{self.folder}/commands", {"command": name, **arguments}, DEADLINE_S)

    def wait_for(self, topic: str, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Return the first new message of a topic that meets a condition."""
        while self._socket.poll(0):
            self._socket.recv_multipart()
        end_s = time.monotonic() + DEADLINE_S
        loop: dict[str, Any] = {}
        while time.monotonic() < end_s and self.daemon.poll() is None:
            if self._socket.poll(100):
                name, payload = self._socket.recv_multipart()
                content = decode(payload)
                if name == b"loop.state":
                    loop = content
                if name.decode() == topic and condition(content):
                    return content
        raise RuntimeError(f"no such {topic}; daemon's status {self.daemon.poll()}, latest loop.state {loop}")

    def wait_for_phase(self, phase: str) -> dict[str, Any]:
        """Return the first loop state in a phase."""
        return self.wait_for("loop.state", lambda state: state["phase"] == phase)

    def wait_for_event(self, name: str, since_ns: int) -> dict[str, Any]:
        """Return the first event of the emulated robot with a name, since a moment."""
        for line in self._rig.stdout or ():
            event: dict[str, Any] = json.loads(line) if line.startswith(b"{") else {}
            if event.get("event") == name and event["t_mono_ns"] >= since_ns:
                return event
        raise RuntimeError(f"the rig ended without an event {name} from the robot")

    def start(self, path: Path) -> None:
        """Start an experiment as soon as possible, unlocking as the operator does."""
        end_s = time.monotonic() + DEADLINE_S
        while not (reply := self.command("start", experiment=str(path)))["ok"]:
            if time.monotonic() > end_s:
                raise RuntimeError(reply["reason"])
            time.sleep(0.2)
            self.command("unlock")


@contextmanager
def _process(*arguments: str, **options: Any) -> Iterator["subprocess.Popen[bytes]"]:
    command = [sys.executable, "-m", "shearloop", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, **options) as process:
        try:
            yield process
        finally:
            process.terminate()


def _experiment(folder: Path, name: str, *steps: dict[str, Any]) -> Path:
    path = folder / f"{name}.yaml"
    # The estimator needs seven seconds of the grip.
    grip = [{"do": "grip", "width_mm": 5, "force_n": 60}, {"do": "wait", "wait_s": 8}]
    begin = [{"do": "release"}, {"do": "tare"}, *grip]
    content = {"name": name, "torque_source": "load_cell", "limits": {"torque_nm": 0.3}, "steps": [*begin, *steps]}
    path.write_text(yaml.safe_dump(content))
    return path


def measure_faults(rig: RunningRig) -> list[dict[str, Any]]:
    """Cause each fault in a slow twist, cure it, and run a short experiment."""
    slow = {"do": "twist", "angles_rad": [0.12], "speed_rad_per_s": 0.005, "hold_s": 60}
    twist = _experiment(rig.folder, "twist", slow)
    short = _experiment(rig.folder, "short", {"do": "wait", "wait_s": 0.2}, {"do": "release"})
    found = []
    for fault in FAULTS:
        rig.start(twist)
        rig.wait_for("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.003)
        began_ns = rig.tell_rig(fault.command)

        def reports(state: dict[str, Any], sentence: str = fault.sentence) -> bool:
            return sentence in state["reasons"] and state["phase"] in ("held", "stopped")

        state = rig.wait_for("loop.state", reports)
        after_s = (state["t_mono_ns"] - began_ns) / 1e9
        then = "running" if fault.passes else "stopped"
        last = state if state["phase"] == then else rig.wait_for_phase(then)
        if fault.passes:
            rig.command("stop")
        if fault.cure:
            rig.tell_rig(fault.cure)
        rig.start(short)
        end = rig.wait_for("loop.state", lambda s: s["experiment"] == "short" and s["phase"] in ("done", "stopped"))
        row = {
            "fault": fault.command,
            "after_s": after_s,
            "periods": after_s * (TOPICS[fault.topic].rate_hz or 1.0),
            "topic": fault.topic,
            "response": state["response"],
            "then": last["phase"],
            "sentence": state["reasons"],
            "next_experiment": end["phase"],
        }
        found.append(row)
        print(f"{fault.command:18} {after_s * 1e3:7.0f} ms, {row['periods']:5.1f} periods of {fault.topic:14} "
              f"{state['response']:20} then {end['phase']}", flush=True)  # fmt: skip
    return found


def measure_kill(rig: RunningRig) -> float:
    """Kill the daemon in the middle of a twist; return the seconds until the robot stood still."""
    fast = {"do": "twist", "angles_rad": [3.0], "speed_rad_per_s": 0.5, "hold_s": 1}
    path = rig.folder / "fast.yaml"
    path.write_text(yaml.safe_dump({"name": "fast", "torque_source": "load_cell", "steps": [fast]}))
    rig.start(path)
    rig.wait_for("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.45)
    killed_ns = time.monotonic_ns()
    os.kill(rig.daemon.pid, signal.SIGKILL)
    stopped_ns: int = rig.wait_for_event("motion-stopped", killed_ns)["t_mono_ns"]
    return (stopped_ns - killed_ns) / 1e9


def main() -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", type=Path, required=True, help="folder with demo.bank and rig-right.cal")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--host", default="127.0.0.62")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        rig = RunningRig(Path(folder), args, stack)
        rig.wait_for("robot.state", lambda _: True)
        rig.wait_for("gripper.state", lambda _: True)
        faults = measure_faults(rig)
        stopped_s = measure_kill(rig)
    print(f"SIGKILL: the robot stood still after {stopped_s:.3f} s")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"faults": faults, "sigkill_stopped_after_s": stopped_s}, indent=1) + "\n")


if __name__ == "__main__":
    main()
