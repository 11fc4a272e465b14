"""What the daemon's benches share: a board played by the bench itself, a daemon in a process, and what /proc tells."""

import contextlib
import os
import pty
import socket
import statistics
import subprocess
import sys
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
from shearloop.daemon.messaging.messages import decode
from shearloop.drivers.eit_kit import TRANSFER_NS

READY_S = 30.0
USB_PACKET_BYTES = 512
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Board:
    """An EIT-kit at the other end of a pseudo-terminal, whose lines the bench writes when it likes."""

    def __init__(self, link: Path) -> None:
        """Open a pseudo-terminal and name it by a link."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))

    def wait_for_start(self) -> None:
        """Wait until the daemon has started the board."""
        os.read(self._master, 16)

    def send(self, line: bytes) -> int:
        """Write a line, and return when its last byte was about to be taken, on the monotonic clock.

        Not after that: the daemon may be woken on our processor and be done before we go on.
        """
        sent_ns = time.monotonic_ns()
        while line:
            sent_ns = time.monotonic_ns()
            line = line[os.write(self._master, line) :]
        return sent_ns

    def send_in_packets(self, line: bytes) -> int:
        """Do the same in the packets of a USB port of high speed, over the time that a Teensy 4 takes for a line."""
        begun = time.monotonic_ns()
        for start in range(0, len(line), USB_PACKET_BYTES):
            # Not asleep: that would be a tenth of a millisecond too long each time.
            while time.monotonic_ns() - begun < TRANSFER_NS * start // len(line):
                continue
            sent = self.send(line[start : start + USB_PACKET_BYTES])
        return sent

    def close(self) -> None:
        """Close both ends."""
        os.close(self._master)
        os.close(self._slave)


def lines(bank: Bank, n: int, n_idle: int = 10, seed: int = 0) -> list[bytes]:
    """Return n lines of the board: idle ones, then contacts from all over the bank, with noise."""
    random = np.random.default_rng(seed)
    cells = np.argwhere(bank.valid)
    # The board sends magnitudes up to 0.78 V; the bank's homogeneous voltages are larger, in units of their own.
    volts = 0.3 * np.abs(bank.homogeneous) / np.abs(bank.homogeneous).max() + 0.02
    scale = 0.3 / np.abs(bank.homogeneous).max()
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
    """Return the bytes that a board sends of the 1024 values of a line, in volts."""
    return b"".join(b"%.4f, " % value for value in values.tolist()) + b"\n"


def configuration(folder: Path, bank: Path, names: Sequence[str], **fingertip: Any) -> Path:
    """Write a configuration of fingertips whose boards are links in the folder, and return its path."""
    path = folder / "daemon.yaml"
    path.write_text(
        yaml.safe_dump(
            {
                "publish": f"ipc://{folder}/publish",
                "commands": f"ipc://{folder}/commands",
                "fingertips": {
                    name: {"device": {"path": str(folder / name)}, "bank": str(bank.resolve()), **fingertip}
                    for name in names
                },
            }
        )
    )
    return path


@contextlib.contextmanager
def daemon(config: Path, folder: Path) -> Iterator[tuple[int, float]]:
    """Run a daemon in a process of its own; gives its process number and the seconds until it was ready."""
    notify = folder / "notify"
    notify.unlink(missing_ok=True)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
        ready.bind(str(notify))
        ready.settimeout(READY_S)
        log = (folder / "daemon.log").open("wb")
        # Some containers forbid Python to keep what it compiled, which pip has done where this is installed.
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        begun = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "shearloop", "run", str(config)],
            env={**kept, "NOTIFY_SOCKET": str(notify)},
            stderr=log,
        )
        try:
            while b"READY=1" not in ready.recv(4096):
                continue
            yield process.pid, time.monotonic() - begun
        finally:
            process.terminate()
            process.wait(READY_S)
            log.close()


@contextlib.contextmanager
def subscription(folder: Path, topic: str) -> Iterator["zmq.Socket[bytes]"]:
    """Subscribe to a topic of the daemon, with no bound on what waits; begins when the daemon knows of it."""
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.setsockopt(zmq.RCVHWM, 0)
        subscriber.setsockopt(zmq.RCVTIMEO, 10_000)
        subscriber.connect(f"ipc://{folder}/publish")
        subscriber.setsockopt(zmq.SUBSCRIBE, topic.encode())
        # Health comes once a second; when it comes here, so does all else that was subscribed to before.
        subscriber.setsockopt(zmq.SUBSCRIBE, b"health")
        while subscriber.recv_multipart()[0] != b"health":
            continue
        if topic != "health":
            subscriber.setsockopt(zmq.UNSUBSCRIBE, b"health")
        yield subscriber


def received(subscriber: "zmq.Socket[bytes]") -> tuple[int, dict[str, Any]]:
    """Return when the next message came, on the monotonic clock, and its content."""
    _, payload = subscriber.recv_multipart()
    return time.monotonic_ns(), decode(payload)


def tree(pid: int) -> list[int]:
    """Return a process and all that it has started."""
    found = [pid]
    for each in found:
        for task in Path(f"/proc/{each}/task").glob("*/children"):
            found += [int(child) for child in task.read_text().split()]
    return found


def cpu_s(pid: int) -> float:
    """Return the processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S


def cpu_of_threads_s(pid: int) -> dict[str, float]:
    """Return the processor time of every thread that a process has at present, the first being its main one."""
    found = {}
    for task in sorted(Path(f"/proc/{pid}/task").iterdir(), key=lambda each: int(each.name)):
        with contextlib.suppress(FileNotFoundError):
            found[f"{task.name} {(task / 'comm').read_text().strip()}"] = (
                int((task / "schedstat").read_text().split()[0]) / 1e9
            )
    return found


def memory_mb(pid: int) -> dict[str, float]:
    """Return the resident memory of a process, and its proportional share of what it shares with others."""
    found = {}
    for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]:
        key, value = line.split(":")
        found[key] = int(value.split()[0]) / 1024
    return {"resident": found["Rss"], "proportional": found["Pss"]}


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return the median of some values, their quartiles, and how many there are."""
    low, middle, high = statistics.quantiles(values, n=4)
    return {"median": middle, "low": low, "high": high, "n": len(values)}
