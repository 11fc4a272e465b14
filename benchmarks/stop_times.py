"""The time from each cause of a stop to the wrist's standstill.

    python -m benchmarks.stop_times --out run/stop_times [--repeats 20] [--busy 8] [--only TEXT]

The real daemon in its own process and the real drivers, with the rig emulated over its real ports. The wrist turns a
gripped tool at 0.5 rad/s, or the tool centre moves straight at 0.1 m/s, when a process is killed, stopped or blocked,
or a device fails. The emulated robot reports when its true joints stand. The promise is 0.2 s, and for a device's fault
what the daemon needs to notice it: a period of a sensor that is unplugged and of the polled gripper, two of the load
cell for a jump within a reading, 2.5 of a sensor that falls silent. `--busy` runs that many busy processes.

Writes JSON and a chart.
"""

import contextlib
import json
import os
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.common import (
    emulated_rig,
    parser_of,
    running_daemon,
    subscription,
    table_head,
    table_row,
    write_rig_config,
)
from shearloop.bank.bank_file import BankDefinition, write_bank
from shearloop.daemon.messaging.bound_requests import meant_for
from shearloop.daemon.messaging.client import send_command
from shearloop.daemon.messaging.messages import STALE_AFTER_PERIODS, TOPICS, decode
from shearloop.drivers.defaults import FRAME_PERIOD_S, LOAD_CELL_RATE_HZ

PROMISE_S = 0.2
DEADLINE_S = 60.0
SPEED_RAD_PER_S, FAR_RAD = 0.5, 2.5
SPEED_M_PER_S, FAR_M = 0.1, 0.2


@dataclass(frozen=True, slots=True)
class Cause:
    """Signals to processes, or a command to the rig; `noticed_s` is the time until the daemon can know of it.

    `straight`: it comes during a straight move; else while the wrist turns.
    """

    name: str
    signals: tuple[tuple[str, signal.Signals], ...] = ()
    command: str = ""
    noticed_s: float = 0.0
    straight: bool = False

    @property
    def promise_s(self) -> float:
        """The longest time to standstill that docs/safety.md allows."""
        return PROMISE_S + self.noticed_s


def _periods_s(topic: str, count: float) -> float:
    return count / (TOPICS[topic].rate_hz or 1.0)


# What can happen to the processes, and to the link between them and the robot.
ENDINGS = (
    Cause("daemon killed", (("daemon", signal.SIGKILL),)),
    Cause("worker killed", (("worker", signal.SIGKILL),)),
    Cause("daemon and worker killed", (("daemon", signal.SIGKILL), ("worker", signal.SIGKILL))),
    Cause("daemon stopped (SIGSTOP)", (("daemon", signal.SIGSTOP),)),
    Cause("event loop blocked", (("daemon", signal.SIGUSR1),)),
    Cause("pipe to the worker dead", (("daemon", signal.SIGUSR2),)),
    Cause("protective stop", command="protective-stop"),
    Cause("emergency stop", command="emergency-stop"),
    Cause("RTDE lost", command="drop-rtde"),
    # Data from the robot is lost; data to the robot arrives.
    Cause("link open one way", command="silence robot 3"),
)
DEVICES = (
    Cause("EIT board unplugged", command="unplug right", noticed_s=_periods_s("eit.frame", 1)),
    Cause("EIT board silent", command="silence right 5", noticed_s=_periods_s("eit.frame", STALE_AFTER_PERIODS)),
    Cause("load cell unplugged", command="unplug load", noticed_s=_periods_s("load.torque", 1)),
    Cause("load cell silent", command="silence load 3", noticed_s=_periods_s("load.torque", STALE_AFTER_PERIODS)),
    Cause("gripper fault", command="gripper fault 14", noticed_s=_periods_s("gripper.state", 1)),
    Cause("tool dropped", command="gripper drop", noticed_s=_periods_s("gripper.state", 1)),
    Cause("torque beyond its limit", command="kick 0.4", noticed_s=_periods_s("load.torque", 2)),
)
CAUSES = (*ENDINGS, *(replace(one, name=f"straight: {one.name}", straight=True) for one in ENDINGS), *DEVICES)


def write_random_bank(path: Path) -> None:
    """Write a small bank of random signals: the emulated fingertips only need frames."""
    random, grid, cells = np.random.default_rng(1), np.linspace(1.0, 2.0, 8), np.ones((8, 8))
    definition = BankDefinition("ab" * 32, "gaussian_derivative", grid, grid)
    homogeneous, signals = random.normal(0.0, 0.3, 896), random.normal(0.0, 0.05, (8, 8, 896))
    write_bank(path, definition, homogeneous, cells, cells > 0, signals.astype(np.float32))


class RunningRig:
    """One emulated rig, and a daemon that is started again when it ends."""

    def __init__(
        self,
        folder: Path,
        stack: ExitStack,
        speed: int = 1,
        environment: Mapping[str, str] | None = None,
        **content: Any,
    ) -> None:
        """Start both; boards, gel and fingers are `speed` times as fast.

        `environment` has further variables of the daemon's process, and `content` further configuration keys.
        """
        self._environment = environment
        write_random_bank(folder / "rig.bank")
        os.mkfifo(folder / "cause")
        self._causes = stack.enter_context((folder / "cause").open("r+b", buffering=0))
        options = f"--paper-sketch --unlock-wait-s 0.5 --power-on-s 0.2 --gel-stiffness 0.02 --speed {speed}"
        rig: Any = stack.enter_context(emulated_rig(folder, folder / "rig.bank", *options.split()))
        self._orders, self._events = rig.stdin, rig.stdout
        os.set_blocking(self._events.fileno(), False)
        right = {"device": {"path": "eit-right"}, "bank": "rig.bank", "frame_period_s": FRAME_PERIOD_S / speed}
        load_cell = {"device": {"path": "load-cell"}, "rate_hz": LOAD_CELL_RATE_HZ * speed}
        self._config = write_rig_config(
            folder,
            "config/demo_ur.yaml",
            emulated=True,
            emulated_deadlines="real",
            fingertips={"right": right},
            load_cell=load_cell,
            **content,
        )
        self._folder = folder
        # The height of the middle of the straight moves.
        self._middle_m: float | None = None
        self._unread = b""
        self._daemons = stack.enter_context(ExitStack())
        self._start_daemon()
        self._messages = stack.enter_context(subscription(folder, "robot.state", "loop.state"))

    def _start_daemon(self) -> None:
        self._daemons.close()
        for name in ("notify", "daemon.log"):
            (self._folder / name).unlink(missing_ok=True)
        run = running_daemon(self._config, "benchmarks.breakable_daemon", self._environment)
        self.daemon, _ = self._daemons.enter_context(run)

    def worker_pid(self) -> int:
        """Return the worker."""
        children = Path(f"/proc/{self.daemon.pid}/task/{self.daemon.pid}/children").read_text().split()
        for pid in children:
            if b"shearloop.drivers.ur.worker" in Path(f"/proc/{pid}/cmdline").read_bytes():
                return int(pid)
        raise RuntimeError("the daemon has no process for the robot")

    def order(self, command: str) -> int:
        """Send the rig a command; return the time in ns."""
        now_ns = time.monotonic_ns()
        self._orders.write(f"{command}\n".encode())
        self._orders.flush()
        return now_ns

    def send(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Send the daemon a command; return its reply."""
        address, bound = f"ipc://{self._folder}/commands", {}
        if name != "stop":
            bound = meant_for(send_command(address, {"command": "status"}, DEADLINE_S), 0.0, DEADLINE_S)
        return send_command(address, {"command": name, **bound, **arguments}, DEADLINE_S)

    def wait_for(self, condition: Callable[[str, Mapping[str, Any]], bool]) -> Mapping[str, Any]:
        """Return the next new message that meets a condition on topic and content."""
        while self._messages.poll(0):
            self._messages.recv_multipart()
        end_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < end_s:
            if self._messages.poll(1000):
                topic, payload = self._messages.recv_multipart()
                if condition(topic.decode(), content := decode(payload)):
                    return content
        raise RuntimeError("no such message of the daemon")

    def begin(self, cause: Cause) -> None:
        """Turn the wrist, or move straight, as the cause needs; return at full speed."""
        if cause.straight:
            self.move_straight()
        else:
            self.turn()

    def move_straight(self) -> None:
        """Move the open gripper along the tool, to the other side of where it began; return at full speed."""
        self._run(self._line, _moves_or_ended)

    def turn(self) -> None:
        """Grip the tool and turn it from where the wrist is to the other side; return at full speed."""
        self._run(self._twist, _turns_or_ended)

    def _line(self) -> list[dict[str, Any]]:
        height_m = self.wait_for(lambda topic, _: topic == "robot.state")["tcp_pose"][2]
        if self._middle_m is None:
            self._middle_m = height_m - 0.5 * FAR_M
        # The tool points down.
        along_m = FAR_M if height_m > self._middle_m else -FAR_M
        approach = {"do": "approach", "along_tool_m": along_m, "speed_m_per_s": SPEED_M_PER_S}
        return [{"do": "release", "width_mm": 30}, approach]

    def _twist(self) -> list[dict[str, Any]]:
        wrist_rad = self.wait_for(lambda topic, _: topic == "robot.state")["wrist_rad"]
        twist = {"do": "twist", "angles_rad": [-FAR_RAD if wrist_rad > 0 else FAR_RAD], "absolute": True,
                 "speed_rad_per_s": SPEED_RAD_PER_S, "return_to_start": False}  # fmt: skip
        grip = {"do": "grip", "width_mm": 5, "speed_mm_per_s": 250, "force_n": 60}
        return [{"do": "release", "width_mm": 30}, {"do": "tare", "timeout_s": 30}, grip, twist]

    def _run(
        self, steps: Callable[[], list[dict[str, Any]]], condition: Callable[[str, Mapping[str, Any]], bool]
    ) -> None:
        """Start an experiment, again while it ends early; return once a robot's state meets the condition.

        The steps are chosen at each start: a motion that ended early has left the arm elsewhere.
        """
        limits = {"torque_nm": 0.3, "angle_rad": 6.28}
        path = self._folder / "motion.yaml"
        content = {"name": "motion", "torque_source": "load_cell", "limits": limits}
        end_s = time.monotonic() + DEADLINE_S
        while time.monotonic() < end_s:
            path.write_text(yaml.safe_dump({**content, "steps": steps()}))
            reply = self.send("start", experiment=str(path), confirmed=True)
            if reply["ok"] and "wrist_rad" in (reply := dict(self.wait_for(condition))):
                return
            # Devices come back at their own time.
            time.sleep(0.2)
            self.send("unlock", confirmed=True)
        raise RuntimeError(f"the experiment does not start: {reply}")

    def cause(self, cause: Cause) -> int:
        """Bring a cause about; return its time in ns."""
        if cause.command:
            return self.order(cause.command)
        pids = {"daemon": self.daemon.pid, "worker": self.worker_pid()}
        began_ns = time.monotonic_ns()
        for process, number in cause.signals:
            os.kill(pids[process], number)
        if {number for _, number in cause.signals} & {signal.SIGUSR1, signal.SIGUSR2}:
            return int(self._causes.readline())
        return began_ns

    def stood_ns(self, since_ns: int) -> int:
        """Return when the emulated robot's true wrist next stood, since a moment."""
        end_s = time.monotonic() + DEADLINE_S
        while (left_s := end_s - time.monotonic()) > 0:
            select.select([self._events], [], [], left_s)
            *lines, self._unread = (self._unread + (self._events.read() or b"")).split(b"\n")
            for line in lines:
                event = json.loads(line) if line.startswith(b"{") else {}
                if event.get("event") == "motion-stopped" and event["t_mono_ns"] >= since_ns:
                    return int(event["t_mono_ns"])
        raise RuntimeError("the wrist did not stand still")

    def recover(self, cause: Cause) -> None:
        """End the cause and the experiment."""
        self.order("normal")
        self.order("object 20")
        if any(process == "daemon" for process, _ in cause.signals):
            self.daemon.kill()
            self._start_daemon()
        else:
            self.send("stop", spare_daemon=True)


def _turns_or_ended(topic: str, content: Mapping[str, Any]) -> bool:
    if topic == "loop.state":
        return content["phase"] in ("stopped", "done")
    return bool(abs(content["wrist_speed_rad_per_s"]) > 0.95 * SPEED_RAD_PER_S)


def _moves_or_ended(topic: str, content: Mapping[str, Any]) -> bool:
    if topic == "loop.state":
        return content["phase"] in ("stopped", "done")
    return bool(content["tcp_speed_m_per_s"] > 0.95 * SPEED_M_PER_S)


@contextlib.contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Run processes that only compute."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def measure(causes: Sequence[Cause], repeats: int, busy: int) -> dict[str, list[float]]:
    """Return the times from each cause to standstill in s."""
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        rig = RunningRig(Path(name), stack)
        stack.enter_context(busy_processes(busy))
        print(table_head("cause", "promise, s", "median, s", "longest, s"))
        for cause in causes:
            times = found[cause.name] = []
            for _ in range(repeats):
                rig.begin(cause)
                began_ns = rig.cause(cause)
                times.append((rig.stood_ns(began_ns) - began_ns) / 1e9)
                rig.recover(cause)
            print(table_row(cause.name, cause.promise_s, statistics.median(times), max(times)), flush=True)
    return found


def draw(causes: Sequence[Cause], found: Mapping[str, Sequence[float]], busy: int, out: Path) -> None:
    """Draw the times of each cause with its promise, and write the figure."""
    from shearloop.tools import drawing

    made = drawing.figure(8.0, 0.8 + 0.32 * len(causes))
    axes = made.subplots()
    for row, cause in enumerate(causes):
        axes.plot(found[cause.name], [row] * len(found[cause.name]), "o", color=drawing.SHADES[1], markersize=4)
        axes.plot([cause.promise_s] * 2, [row - 0.4, row + 0.4], color=drawing.SHADES[2], linewidth=2)
    axes.set_yticks(range(len(causes)), [cause.name for cause in causes])
    axes.invert_yaxis()
    axes.set(xlabel="time to standstill, s; the bar is the promise", xlim=(0.0, None))
    axes.set_title(f"From the cause to standstill, {busy} busy processes" if busy else "From the cause to standstill")
    content = {cause.name: {"promise_s": cause.promise_s, "times_s": found[cause.name]} for cause in causes}
    drawing.save(made, {"busy": busy, "causes": content}, out, f"stop-times-busy-{busy}" if busy else "stop-times")


def main() -> None:
    """Measure, write the figures, draw the chart."""
    parser = parser_of(__doc__)
    parser.add_argument("--repeats", type=int, default=20, metavar="N", help="of each cause (default: %(default)s)")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="busy processes (default: %(default)s)")
    parser.add_argument("--only", default="", metavar="TEXT", help="causes with this text in their names")
    args = parser.parse_args()
    causes = [cause for cause in CAUSES if args.only in cause.name]
    found = measure(causes, args.repeats, args.busy)
    draw(causes, found, args.busy, args.out)
    late = [cause.name for cause in causes if max(found[cause.name]) > cause.promise_s]
    print(f"beyond the promise: {', '.join(late) or 'none'}")


if __name__ == "__main__":
    main()
