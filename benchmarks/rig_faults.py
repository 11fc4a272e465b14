"""How soon each fault ends in the safety table's response, and whether the rig recovers.

    python -m benchmarks.rig_faults --rig run --out run/rig_faults.json

The real daemon in its own process and the real drivers, with the rig emulated over its real ports. Something fails in
the middle of a slow twist. Measured is the time until `loop.state` reports the response, in periods of the failed
sensor's or device's topic, and whether the next experiment completes once the fault is gone. Finally the daemon is
killed with SIGKILL in the middle of a fast twist, and the emulated robot reports when it stood still. `--rig` is the
folder `run` of `shearloop demo --prepare`, with demo.bank and rig-right.cal.
"""

import json
import os
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from benchmarks.common import emulated_rig, parser_of, running_daemon, subscription, write_figures, write_rig_config
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

    def __init__(self, folder: Path, rig: Path, stack: ExitStack) -> None:
        """Start both; `rig` is the folder with bank and calibration."""
        self.folder = folder
        waits = ("--unlock-wait-s", "0.5", "--power-on-s", "0.2")
        self._rig = stack.enter_context(emulated_rig(folder, rig / "demo.bank", "--paper-sketch", *waits))
        right = {"estimator": "motion_regression", "calibration": str((rig / "rig-right.cal").resolve())}
        config = write_rig_config(
            folder,
            "config/ur.yaml",
            fingertips={"right": {"device": {"path": "eit-right"}, **right}},
            load_cell={"device": {"path": "load-cell"}},
            # Estimates that disagree are no fault here.
            loop={"disagreement_nm": 1.0, "max_innovation_nm": 1.0},
        )
        self.daemon, _ = stack.enter_context(running_daemon(config))
        self._messages = stack.enter_context(subscription(folder, "loop.state", "robot.state", "gripper.state"))

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
        while self._messages.poll(0):
            self._messages.recv_multipart()
        end_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < end_s and self.daemon.poll() is None:
            name, payload = self._messages.recv_multipart()
            if name == topic.encode() and condition(content := decode(payload)):
                return content
        raise RuntimeError(f"no such {topic}; the daemon's status is {self.daemon.poll()}")

    def motion_stopped_ns(self, since_ns: int) -> int:
        """Return when the emulated robot next stood still, since a moment."""
        for line in self._rig.stdout or ():
            event: dict[str, Any] = json.loads(line) if line.startswith(b"{") else {}
            if event.get("event") == "motion-stopped" and event["t_mono_ns"] >= since_ns:
                return int(event["t_mono_ns"])
        raise RuntimeError("the rig ended before the robot stood still")

    def start(self, path: Path) -> None:
        """Start an experiment as soon as possible, unlocking as the operator does."""
        end_s = time.monotonic() + DEADLINE_S
        while not (reply := self.command("start", experiment=str(path)))["ok"]:
            if time.monotonic() > end_s:
                raise RuntimeError(reply["reason"])
            time.sleep(0.2)
            self.command("unlock")


def _experiment(folder: Path, name: str, *steps: dict[str, Any]) -> Path:
    path = folder / f"{name}.yaml"
    begin = [{"do": "release"}, {"do": "tare"}, {"do": "grip", "width_mm": 5, "force_n": 60}]
    content = {"name": name, "torque_source": "load_cell", "limits": {"torque_nm": 0.3}, "steps": [*begin, *steps]}
    path.write_text(yaml.safe_dump(content))
    return path


def measure_fault(rig: RunningRig, fault: RigFault, twist: Path, short: Path) -> dict[str, Any]:
    """Cause a fault in a slow twist, cure it, and run a short experiment."""
    rig.start(twist)
    rig.wait_for("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.003)
    began_ns = rig.tell_rig(fault.command)
    state = rig.wait_for(
        "loop.state", lambda state: fault.sentence in state["reasons"] and state["phase"] in ("held", "stopped")
    )
    after_s = (state["t_mono_ns"] - began_ns) / 1e9
    then = "running" if fault.passes else "stopped"
    if state["phase"] != then:
        rig.wait_for("loop.state", lambda later: later["phase"] == then)
    if fault.passes:
        rig.command("stop")
    if fault.cure:
        rig.tell_rig(fault.cure)
    rig.start(short)
    end = rig.wait_for("loop.state", lambda s: s["experiment"] == "short" and s["phase"] in ("done", "stopped"))
    return {
        "fault": fault.command,
        "after_s": after_s,
        "periods": after_s * (TOPICS[fault.topic].rate_hz or 1.0),
        "topic": fault.topic,
        "response": state["response"],
        "then": then,
        "sentence": state["reasons"],
        "next_experiment": end["phase"],
    }


def measure_kill(rig: RunningRig) -> float:
    """Kill the daemon in the middle of a twist; return the seconds until the robot stood still."""
    fast = {"do": "twist", "angles_rad": [3.0], "speed_rad_per_s": 0.5, "hold_s": 1}
    path = rig.folder / "fast.yaml"
    path.write_text(yaml.safe_dump({"name": "fast", "torque_source": "load_cell", "steps": [fast]}))
    rig.start(path)
    rig.wait_for("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.45)
    killed_ns = time.monotonic_ns()
    os.kill(rig.daemon.pid, signal.SIGKILL)
    return (rig.motion_stopped_ns(killed_ns) - killed_ns) / 1e9


def main() -> None:
    """Measure and write the figures."""
    parser = parser_of(__doc__)
    parser.add_argument("--rig", type=Path, required=True, help="folder with demo.bank and rig-right.cal")
    args = parser.parse_args()
    found = []
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        rig = RunningRig(Path(name), args.rig, stack)
        rig.wait_for("robot.state", lambda _: True)
        rig.wait_for("gripper.state", lambda _: True)
        slow = {"do": "twist", "angles_rad": [0.12], "speed_rad_per_s": 0.005, "hold_s": 60}
        twist = _experiment(rig.folder, "twist", slow)
        short = _experiment(rig.folder, "short", {"do": "wait", "wait_s": 0.2}, {"do": "release"})
        for fault in FAULTS:
            found.append(measure_fault(rig, fault, twist, short))
            print("{fault:18} {after_s:7.3f} s, {periods:5.1f} periods of {topic:14} {response:20} "
                  "then {next_experiment}".format(**found[-1]), flush=True)  # fmt: skip
        stopped_s = measure_kill(rig)
    print(f"SIGKILL: the robot stood still after {stopped_s:.3f} s")
    write_figures(args.out, {"faults": found, "sigkill_stopped_after_s": stopped_s})


if __name__ == "__main__":
    main()
