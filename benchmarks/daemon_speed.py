"""The daemon's latency, losses, processor time, memory, and time until it is ready.

    python -m benchmarks.daemon_speed --bank run/paper.bank --rig run --out run/daemon_speed.json

Each figure is measured on a daemon in its own process, through a pseudo-terminal and a subscriber's socket. Latency
counts from before the last byte is written until the subscriber has the estimate. `--rig` is the folder of
`shearloop.daemon.cli.demo_calibration`, with the default estimator's recording and calibrations, and the rig's bank.
"""

import argparse
import contextlib
import json
import os
import pty
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
import zmq
from numpy.typing import NDArray

from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import line_of_channels
from shearloop.daemon.messaging.client import send_command
from shearloop.daemon.messaging.messages import decode
from shearloop.daemon.recording.reader import read_recording
from shearloop.daemon.sensing.estimators import COMBINED
from shearloop.drivers.eit_kit import FRAME_PERIOD_S, TRANSFER_NS

MEASUREMENTS = ("commands", "latency", "flood", "rated", "twisting")
REPEATS = 5
READY_S = 30.0
# Between frames: long enough for the daemon to be idle again.
PAUSE_S = 0.03
FLOOD_HZ = 500.0
USB_PACKET_BYTES = 512
# Before processor time counts: until everything is connected, and until the experiment has gripped its tool.
SETTLING_S, GRIPPING_S = 10.0, 15.0
RIG_RECORDING, RIG_BANK, RIG_BOTH_CALIBRATION = "rig-25mm.mcap", "demo.bank", "rig.cal"
# The recording starts with idle frames and a grip; its 40th frame gives the first valid estimate.
FIRST_FRAME, FIRST_VALID_FRAME = 12, 39
TWISTS = {
    "name": "twists",
    "torque_source": "load_cell",
    "limits": {"torque_nm": 0.3, "angle_rad": 0.5},
    "steps": [
        {"do": "release", "timeout_s": 15},
        {"do": "tare", "timeout_s": 30},
        {"do": "approach", "along_tool_m": 0.03, "timeout_s": 15},
        {"do": "grip", "width_mm": 5, "force_n": 60, "timeout_s": 15},
        {"do": "twist", "angles_rad": [0.15, 0.0], "speed_rad_per_s": 0.2, "hold_s": 2, "repeats": 1000},
    ],
}
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class PlayedBoard:
    """An EIT board at the other end of a pseudo-terminal; the benchmark writes its lines."""

    def __init__(self, link: Path) -> None:
        """Open a pseudo-terminal and link to it."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        link.symlink_to(os.ttyname(self._slave))

    def wait_for_start(self) -> None:
        """Wait until the daemon has started the board."""
        os.read(self._master, 16)

    def send(self, line: bytes) -> int:
        """Write bytes; return the time in ns just before the last of them was written."""
        sent_ns = time.monotonic_ns()
        while line:
            sent_ns = time.monotonic_ns()
            line = line[os.write(self._master, line) :]
        return sent_ns

    def send_in_packets(self, line: bytes) -> int:
        """Write a line in high-speed USB packets, over the time that a Teensy 4 takes for it."""
        begun = time.monotonic_ns()
        for start in range(0, len(line), USB_PACKET_BYTES):
            # Busy: a sleep would be a tenth of a millisecond too long.
            while time.monotonic_ns() - begun < TRANSFER_NS * start // len(line):
                continue
            sent = self.send(line[start : start + USB_PACKET_BYTES])
        return sent

    def close(self) -> None:
        """Close both ends."""
        os.close(self._master)
        os.close(self._slave)


def lines_of_bank(bank: Bank, n: int, n_idle: int = 10) -> list[bytes]:
    """Return n lines of a board: idle ones, then contacts from the whole bank, with noise."""
    random = np.random.default_rng(0)
    cells = np.argwhere(bank.valid)
    # The bank's voltages have units of their own; the board sends up to 0.78 V.
    scale = 0.3 / np.abs(bank.homogeneous).max()
    volts = scale * np.abs(bank.homogeneous) + 0.02
    found = []
    for number in range(n):
        signal = np.zeros(len(volts))
        if number >= n_idle:
            signal = scale * bank.signals[tuple(cells[random.integers(len(cells))])].astype(np.float64)
            signal *= min(1.0, 0.25 / np.abs(signal).max())
        channels = np.clip(volts + signal + random.normal(0, 0.002, len(volts)), 0.002, 0.77)
        found.append(line_text(line_of_channels(channels)))
    return found


def line_text(values: NDArray[np.float64]) -> bytes:
    """Return the bytes that a board sends for 1024 values in volts."""
    return b"".join(b"%.4f, " % value for value in values.tolist()) + b"\n"


def write_config(folder: Path, **content: Any) -> Path:
    """Write a daemon configuration with sockets in the folder, and return its path."""
    path = folder / "daemon.yaml"
    sockets = {"publish": f"ipc://{folder}/publish", "commands": f"ipc://{folder}/commands"}
    path.write_text(yaml.safe_dump({**sockets, **content}))
    return path


@contextlib.contextmanager
def running_daemon(config: Path) -> Iterator[tuple[int, float]]:
    """Run a daemon in its own process; yield its process id and the seconds until it was ready."""
    folder = config.parent
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready, (folder / "daemon.log").open("wb") as log:
        ready.bind(str(folder / "notify"))
        ready.settimeout(READY_S)
        # Let Python keep its compiled modules, as an installation does.
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        begun = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "shearloop", "run", str(config)],
            env={**kept, "NOTIFY_SOCKET": str(folder / "notify")},
            stderr=log,
        )
        try:
            while b"READY=1" not in ready.recv(4096):
                continue
            yield process.pid, time.monotonic() - begun
        finally:
            process.terminate()
            process.wait(READY_S)


@contextlib.contextmanager
def subscription(folder: Path, topic: str) -> Iterator["zmq.Socket[bytes]"]:
    """Subscribe to a topic of the daemon; yields when the subscription works."""
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.setsockopt(zmq.RCVHWM, 0)
        subscriber.setsockopt(zmq.RCVTIMEO, 10_000)
        subscriber.connect(f"ipc://{folder}/publish")
        subscriber.setsockopt(zmq.SUBSCRIBE, topic.encode())
        # Health comes once a second and shows that the daemon knows the subscriptions.
        subscriber.setsockopt(zmq.SUBSCRIBE, b"health")
        while subscriber.recv_multipart()[0] != b"health":
            continue
        if topic != "health":
            subscriber.setsockopt(zmq.UNSUBSCRIBE, b"health")
        yield subscriber


def receive(subscriber: "zmq.Socket[bytes]") -> tuple[int, dict[str, Any]]:
    """Return the arrival time of the next message in ns, and its content."""
    _, payload = subscriber.recv_multipart()
    return time.monotonic_ns(), decode(payload)


def process_tree(pid: int) -> list[int]:
    """Return a process and its descendants."""
    found = [pid]
    for each in found:
        for task in Path(f"/proc/{each}/task").glob("*/children"):
            found += [int(child) for child in task.read_text().split()]
    return found


def cpu_s(pid: int) -> float:
    """Return the processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError(f"process {pid} has ended")


def bank_latency(bank: Path, matching: str, n_frames: int, pause_s: float) -> dict[str, float]:
    """Return the milliseconds from a frame's last byte to its estimate by matching in a bank."""
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as opened:
        folder = Path(name)
        board = PlayedBoard(folder / "right")
        opened.callback(board.close)
        fingertip = {"device": {"path": str(folder / "right")}, "bank": str(bank.resolve()), "matching": matching}
        config = write_config(folder, fingertips={"right": {**fingertip, "frame_period_s": pause_s}})
        _, ready_s = opened.enter_context(running_daemon(config))
        estimates = opened.enter_context(subscription(folder, "eit.estimate"))
        board.wait_for_start()
        taken = []
        for line in lines_of_bank(Bank.open(bank), n_frames + 10):
            time.sleep(pause_s)
            sent_ns = board.send_in_packets(line)
            arrived_ns, content = receive(estimates)
            if content["k"] is not None:
                taken.append((arrived_ns - sent_ns) / 1e6)
    return {**_percentiles(taken), "ready_s": ready_s}


def estimator_latency(rig: Path, sides: Sequence[str], n_frames: int, pause_s: float) -> dict[str, dict[str, float]]:
    """Return by source the milliseconds from a frame's last byte to a valid estimate by the default estimator.

    With two fingertips the combined estimate counts from the last byte of the later frame. Estimates that are not valid
    or do not come are counted and not timed.
    """
    recorded = read_recording(rig / RIG_RECORDING).sides
    frames = slice(FIRST_FRAME, FIRST_VALID_FRAME + n_frames)
    lines = {side: [line_text(one) for one in recorded[side].lines[frames]] for side in sides}
    taken: dict[str, list[float]] = {source: [] for source in ((*sides, COMBINED) if len(sides) > 1 else sides)}
    missed = dict.fromkeys(taken, 0)
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as opened:
        folder = Path(name)
        boards = {side: PlayedBoard(folder / side) for side in sides}
        for board in boards.values():
            opened.callback(board.close)
        content: dict[str, Any] = {
            "fingertips": {
                side: {
                    "device": {"path": str(folder / side)},
                    "frame_period_s": pause_s,
                    "calibration": str((rig / f"rig-{side}.cal").resolve()),
                    "estimator": "motion_regression",
                }
                for side in sides
            }
        }
        if len(sides) > 1:
            content[COMBINED] = {"calibration": str((rig / RIG_BOTH_CALIBRATION).resolve())}
        opened.enter_context(running_daemon(write_config(folder, **content)))
        estimates = opened.enter_context(subscription(folder, "eit.estimate"))
        estimates.setsockopt(zmq.RCVTIMEO, 1000)
        for board in boards.values():
            board.wait_for_start()
        for number in range(min(map(len, lines.values()))):
            time.sleep(0.5 * pause_s)
            for side, board in boards.items():
                # Two boards do not keep step.
                time.sleep(0.5 * pause_s / len(sides))
                sent_ns = board.send_in_packets(lines[side][number])
                awaited = {side, COMBINED} if side == sides[-1] and len(sides) > 1 else {side}
                while awaited:
                    try:
                        arrived_ns, estimate = receive(estimates)
                    except zmq.Again:
                        for source in awaited:
                            missed[source] += 1
                        break
                    source = estimate["source"]
                    if estimate["frame"] != number or source not in awaited:
                        continue
                    awaited.remove(source)
                    if estimate["valid"]:
                        taken[source].append((arrived_ns - sent_ns) / 1e6)
                    else:
                        missed[source] += number >= FIRST_VALID_FRAME - FIRST_FRAME
    if not all(taken.values()):
        raise RuntimeError("no estimate was valid: run shearloop.daemon.cli.demo_calibration again")
    return {source: {**_percentiles(found), "missed": missed[source]} for source, found in taken.items()}


def _percentiles(taken_ms: Sequence[float]) -> dict[str, float]:
    p50, p99 = np.percentile(taken_ms, [50, 99])
    return {"p50_ms": float(p50), "p99_ms": float(p99), "n": len(taken_ms)}


def flood(bank: Path, n_frames: int) -> dict[str, Any]:
    """Return the losses and the load at five hundred frames a second."""
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as opened:
        folder = Path(name)
        board = PlayedBoard(folder / "right")
        opened.callback(board.close)
        fingertip = {"device": {"path": str(folder / "right")}, "bank": str(bank.resolve()), "matching": "zero_lag"}
        config = write_config(folder, fingertips={"right": {**fingertip, "frame_period_s": 1 / FLOOD_HZ}})
        played = lines_of_bank(Bank.open(bank), n_frames)
        pid, _ = opened.enter_context(running_daemon(config))
        estimates = opened.enter_context(subscription(folder, "eit.estimate"))
        board.wait_for_start()
        before, begun = cpu_s(pid), time.monotonic()

        def play() -> None:
            for number, line in enumerate(played):
                time.sleep(max(0.0, begun + number / FLOOD_HZ - time.monotonic()))
                board.send(line)

        player = threading.Thread(target=play)
        player.start()
        frames = [receive(estimates)[1]["frame"] for _ in played]
        took_s = time.monotonic() - begun
        player.join()
        busy = (cpu_s(pid) - before) / took_s
    return {
        "estimates_hz": n_frames / took_s,
        "lost": n_frames - len(set(frames)),
        "in_order": frames == sorted(frames),
        "cores_busy": busy,
    }


def rated(bank: Path, rig_bank: Path, seconds: float, *, twisting: bool = False) -> dict[str, float]:
    """Return processor time and memory with the whole emulated rig at its rated speeds, recording.

    No experiment runs, or one that twists a tool to and fro.
    """
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as opened:
        folder = Path(name)
        host = f"127.{os.getpid() >> 14 & 63 | 192}.{os.getpid() >> 7 & 127}.{1 + os.getpid() % 128}"
        robot = yaml.safe_load(Path("config/demo_ur.yaml").read_text())
        (folder / "ur.yaml").write_text(yaml.safe_dump({**robot, "host": host}))
        fingertip = {"bank": str(bank.resolve()), "matching": "all_lags"}
        config = write_config(
            folder,
            fingertips={side: {"device": {"path": f"eit-{side}"}, **fingertip} for side in ("left", "right")},
            load_cell={"device": {"path": "load-cell"}},
            robot="ur.yaml",
            gripper={"socket": {"host": host}},
            recording={"folder": str(folder / "recordings")},
        )
        rig = opened.enter_context(
            subprocess.Popen(
                [
                    *(sys.executable, "-m", "shearloop", "emulate", "rig", "--bank", str(rig_bank.resolve())),
                    *("--run-dir", str(folder), "--host", host, "--paper-sketch"),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
        )
        opened.callback(rig.terminate)
        if rig.stdout is not None:
            rig.stdout.readline()
        pid, ready_s = opened.enter_context(running_daemon(config))
        health = opened.enter_context(subscription(folder, "health"))
        _listen(health, SETTLING_S)
        if twisting:
            (folder / "twists.yaml").write_text(yaml.safe_dump(TWISTS))
            _start(f"ipc://{folder}/commands", folder / "twists.yaml")
            _listen(health, GRIPPING_S)
        before, begun = {each: cpu_s(each) for each in process_tree(pid)}, time.monotonic()
        _listen(health, seconds)
        took_s = time.monotonic() - begun
        shares = {each: (cpu_s(each) - cpu) / took_s for each, cpu in before.items()}
        memory = {each: resident_mb(each) for each in before}
    return {
        "ready_s": ready_s,
        "core_share_of_daemon": shares[pid],
        "core_share_of_robot_worker": sum(shares.values()) - shares[pid],
        "memory_mb_of_daemon": memory[pid],
        "memory_mb_of_robot_worker": sum(memory.values()) - memory[pid],
    }


def _listen(health: "zmq.Socket[bytes]", seconds: float) -> None:
    """Read health messages for a time, as a client does."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        receive(health)


def _start(commands: str, experiment: Path) -> None:
    """Start an experiment, unlocking as the operator does."""
    until = time.monotonic() + SETTLING_S
    while not (reply := send_command(commands, {"command": "start", "experiment": str(experiment)}, SETTLING_S))["ok"]:
        if time.monotonic() > until:
            raise RuntimeError(reply["reason"])
        send_command(commands, {"command": "unlock"}, SETTLING_S)


def command_s(*arguments: str, repeats: int = 1) -> float:
    """Return the median seconds of a shearloop command."""
    taken = []
    for _ in range(repeats):
        begun = time.monotonic()
        subprocess.run([sys.executable, "-m", "shearloop", *arguments], check=True, stdout=subprocess.DEVNULL)
        taken.append(time.monotonic() - begun)
    return float(np.median(taken))


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of the chosen measurements."""
    found: dict[str, Any] = {"load_average": os.getloadavg()[0], "cores": os.cpu_count()}
    if "commands" in args.only:
        with tempfile.TemporaryDirectory() as folder:
            built = ("bank", "build", "--config", "config/banks/paper.yaml", "--out", f"{folder}/paper.bank")
            found["build_10000_cells_s"] = command_s(*built)
        found["help_s"] = command_s("--help", repeats=REPEATS)
    if "latency" in args.only:
        found["latency"] = {
            name: {
                "every_30_ms": latency(args.frames, PAUSE_S),
                "at_the_boards_rate": latency(args.frames // 3, FRAME_PERIOD_S),
            }
            for name, latency in (
                ("zero_lag", lambda n, pause_s: bank_latency(args.bank, "zero_lag", n, pause_s)),
                ("all_lags", lambda n, pause_s: bank_latency(args.bank, "all_lags", n, pause_s)),
                ("default_one_fingertip", lambda n, pause_s: estimator_latency(args.rig, ("right",), n, pause_s)),
                ("default_both", lambda n, pause_s: estimator_latency(args.rig, ("right", "left"), n, pause_s)),
            )
        }
    if "flood" in args.only:
        found["flood"] = flood(args.bank, 10 * args.frames)
    if "rated" in args.only:
        found["rated"] = rated(args.bank, args.rig / RIG_BANK, args.rated_s)
    if "twisting" in args.only:
        found["twisting"] = rated(args.bank, args.rig / RIG_BANK, args.rated_s, twisting=True)
    return found


def main() -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", type=Path, required=True, help="the fingertips' bank, of 100 × 100 cells")
    parser.add_argument("--rig", type=Path, required=True, help="folder with rig-25mm.mcap, rig*.cal and demo.bank")
    parser.add_argument("--frames", type=int, default=300, help="number of timed frames")
    parser.add_argument("--rated-s", type=float, default=30.0, help="seconds at rated speeds")
    parser.add_argument("--only", nargs="+", choices=MEASUREMENTS, default=MEASUREMENTS)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    text = json.dumps(measure(args), indent=2)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
