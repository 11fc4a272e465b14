"""What several benchmarks share: their command line, a daemon in its own process, and its emulated devices."""

import argparse
import contextlib
import json
import os
import pty
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
import zmq

from shearloop.drivers.eit_kit import TRANSFER_NS

READY_S = 30.0
USB_PACKET_BYTES = 512
# Idle frames to skip, and the number of frames until the default estimator is valid in the grip.
FIRST_FRAME, FIRST_VALID_FRAME = 12, 28
# Keys of a configuration with boards that a benchmark plays: emulated calibrations, and the deadlines of a real rig.
PLAYED: dict[str, Any] = {"emulated": True, "emulated_deadlines": "real"}
# Every process has an address of its own, so that several can run at once.
HOST = f"127.{os.getpid() >> 14 & 63 | 192}.{os.getpid() >> 7 & 127}.{1 + os.getpid() % 128}"


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser that describes itself with a module's docstring, with `--out`."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="PATH", help="file for the figures, or its folder")
    return parser


def write_figures(path: Path, figures: object) -> str:
    """Write figures as JSON, and return the text."""
    text = json.dumps(figures, indent=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n")
    return text


def table_row(*cells: str | float | None) -> str:
    """Return a row of a Markdown table; numbers get four digits."""
    return f"| {' | '.join('–' if c is None else c if isinstance(c, str) else f'{c:.4g}' for c in cells)} |"


def table_head(*names: str) -> str:
    """Return the first two lines of a Markdown table."""
    return f"{table_row(*names)}\n{'|---' * len(names)}|"


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
        while line:
            sent_ns = time.monotonic_ns()
            line = line[os.write(self._master, line) :]
        return sent_ns

    def send_in_packets(self, line: bytes) -> int:
        """Write a line in high-speed USB packets, over a Teensy 4's transfer time."""
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


def write_config(folder: Path, **content: Any) -> Path:
    """Write a daemon configuration with sockets in the folder, and return its path."""
    path = folder / "daemon.yaml"
    sockets = {"publish": f"ipc://{folder}/publish", "commands": f"ipc://{folder}/commands"}
    path.write_text(yaml.safe_dump({**sockets, **content}))
    return path


def write_rig_config(folder: Path, settings: str, **content: Any) -> Path:
    """Write a daemon configuration for `emulated_rig`, with the robot's settings of a file; return its path."""
    robot = yaml.safe_load(Path(settings).read_text())
    (folder / "ur.yaml").write_text(yaml.safe_dump({**robot, "host": HOST}))
    return write_config(folder, robot="ur.yaml", gripper={"model": "2F-140", "socket": {"host": HOST}}, **content)


@contextlib.contextmanager
def emulated_rig(folder: Path, bank: Path, *options: str) -> Iterator["subprocess.Popen[bytes]"]:
    """Run the emulated rig in a process with ports in the folder; yield it when it is ready."""
    command = [sys.executable, "-m", "shearloop", "emulate", "rig", "--bank", str(bank.resolve())]
    with subprocess.Popen(
        [*command, "--run-dir", str(folder), "--host", HOST, *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as rig:
        try:
            if rig.stdout is None or not rig.stdout.readline().startswith(b"rig ready"):
                raise RuntimeError("the rig did not start")
            yield rig
        finally:
            rig.terminate()


@contextlib.contextmanager
def running_daemon(
    config: Path, module: str = "shearloop", environment: Mapping[str, str] | None = None
) -> Iterator[tuple["subprocess.Popen[bytes]", float]]:
    """Run a daemon in its own process, by the module's command line; yield it and the seconds until it was ready.

    `environment` has further variables of the process.
    """
    folder = config.parent
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready, (folder / "daemon.log").open("wb") as log:
        ready.bind(str(folder / "notify"))
        ready.settimeout(READY_S)
        # Let Python keep its compiled modules, as an installation does.
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        begun = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", module, "run", str(config)],
            env={**kept, **(environment or {}), "NOTIFY_SOCKET": str(folder / "notify")},
            stderr=log,
        )
        try:
            try:
                while b"READY=1" not in ready.recv(4096):
                    continue
            except TimeoutError as error:
                raise RuntimeError(f"the daemon is not ready: {(folder / 'daemon.log').read_text()}") from error
            yield process, time.monotonic() - begun
        finally:
            process.terminate()
            process.wait(READY_S)


@contextlib.contextmanager
def subscription(folder: Path, *topics: str) -> Iterator["zmq.Socket[bytes]"]:
    """Subscribe to topics of the daemon; yields when the subscription works."""
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.setsockopt(zmq.RCVHWM, 0)
        subscriber.setsockopt(zmq.RCVTIMEO, 10_000)
        subscriber.connect(f"ipc://{folder}/publish")
        # Health comes once a second and shows that the daemon knows the subscriptions.
        for topic in (*topics, "health"):
            subscriber.setsockopt(zmq.SUBSCRIBE, topic.encode())
        while subscriber.recv_multipart()[0] != b"health":
            continue
        if "health" not in topics:
            subscriber.setsockopt(zmq.UNSUBSCRIBE, b"health")
        yield subscriber
