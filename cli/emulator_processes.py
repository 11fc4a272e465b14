"""The emulated devices of a configuration: their processes, the events of an experiment, and the true torque."""

import argparse
import contextlib
import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self

from shearloop.cli.temporary_folders import run_folder
from shearloop.errors import UserError

if TYPE_CHECKING:
    from shearloop.daemon.config import EmulatorConfig, EventConfig
    from shearloop.daemon.run_record import TorqueSeries

# An emulator prints a line once its ports are open, which takes about two seconds, and longer on a busy computer.
READY_S, POLL_S = 60.0, 0.02
# A device carries out a command within this, on a busy computer.
OBEYS_S = 10.0
# A process needs some of it to remove its port's link, to close its sockets, or to end its workers.
STOP_S = 2.0
_PR_SET_PDEATHSIG = 1
SHEARLOOP = (sys.executable, "-m", "shearloop")


@contextlib.contextmanager
def running(command: Sequence[str], **options: Any) -> "Iterator[subprocess.Popen[bytes]]":
    """Run a command in a process group of its own, which Ctrl-C does not reach, and end it; options are of Popen.

    It ends with this process, also if that is killed.
    """
    end = partial(_end_with_parent, os.getpid())
    # What runs before the command asks the kernel alone, so that it waits for no thread.
    with subprocess.Popen(command, process_group=0, bufsize=0, preexec_fn=end, **options) as process:  # noqa: PLW1509
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()


def _end_with_parent(parent: int) -> None:
    """Let the kernel end this process by SIGTERM when its parent ends, also by SIGKILL (prctl(2)).

    To be called in the new process; `parent` is the process that has started it.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM))
    if os.getppid() != parent:
        # It has ended before.
        os.kill(os.getpid(), signal.SIGTERM)


def check_emulators(emulators: "tuple[EmulatorConfig, ...]", config: Path) -> list[argparse.Namespace]:
    """Return the parsed arguments of each emulator; raise UserError for an unknown device or invalid arguments."""
    from shearloop.cli.emulate import DEVICES, checked_arguments

    options = []
    for number, emulator in enumerate(emulators):
        device, where = emulator.device, f"{config}: `emulators[{number}]"
        if device not in DEVICES:
            raise UserError(f"{where}.device` is {device!r}; there are {', '.join(DEVICES)}")
        try:
            options.append(checked_arguments(device, (*emulator.arguments, *emulator.synthetic), config.parent))
        except UserError as error:
            raise UserError(f"{where}.arguments`: {device}: {error}") from error
    return options


class EmulatedDevices:
    """Runs each device in a process, as a context that begins once all are ready, and takes the daemon's messages.

    At each `loop.state` it sends the events that are due.
    """

    def __init__(self, emulators: "tuple[EmulatorConfig, ...]", folder: Path, recording: Path | None = None) -> None:
        """Take the configuration's folder, and a recording for the EIT boards to play."""
        self.sent: list[tuple[int, str]] = []
        self._emulators = emulators
        self._folder = folder
        self._recording = recording
        self._waiting: list[tuple[EventConfig, subprocess.Popen[bytes]]] = []
        self._devices: list[tuple[subprocess.Popen[bytes], IO[bytes]]] = []
        self._since_ns: dict[int, int] = {}
        self.truth: Path | None = None
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        """Start the devices; raises UserError if one does not start: another program may play one at its address."""
        with contextlib.ExitStack() as stack:
            if any(emulator.device == "rig" and "--truth" not in emulator.arguments for emulator in self._emulators):
                self.truth = stack.enter_context(run_folder()) / "truth.jsonl"
            devices: list[tuple[subprocess.Popen[bytes], IO[bytes]]] = []
            for emulator in self._emulators:
                output: IO[bytes] = stack.enter_context(tempfile.TemporaryFile())
                # An emulator ends when its standard input is closed. Without Ctrl-C the robot answers until the daemon
                # has stopped it.
                command = self._command(emulator)
                process = stack.enter_context(running(command, cwd=self._folder, stdin=subprocess.PIPE, stdout=output))
                devices.append((process, output))
                self._waiting += [(event, process) for event in emulator.events]
            until_s = time.monotonic() + READY_S
            for emulator, (process, output) in zip(self._emulators, devices, strict=True):
                _wait_until_ready(emulator.device, process, output, until_s)
            self._devices = devices
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the devices."""
        self._stack.close()

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Take one of the daemon's messages."""
        if topic == "loop.state" and content["phase"] == "running" and content["hold"]:
            self._send_events(content["t_mono_ns"], content["step"])

    def torques(self) -> "TorqueSeries | None":
        """Return the rig's true torque so far; None if it is unknown."""
        import numpy as np

        from shearloop.daemon.run_record import TorqueSeries

        if self.truth is None or not self.truth.exists():
            return None
        # The last line may be incomplete.
        lines = self.truth.read_text(encoding="utf-8").rpartition("\n")[0].splitlines()
        rows = [(row["t_mono_ns"], row["torque_nm"]) for row in map(json.loads, lines)]
        table = np.array(rows, dtype=float).reshape(-1, 2)
        return TorqueSeries(table[:, 0], table[:, 1])

    def order(self, command: str) -> None:
        """Have the emulated robot's process carry out a command; raises UserError where it does not.

        The robot is played by the last of the devices.
        """
        process, output = self._devices[-1]
        begin = os.fstat(output.fileno()).st_size
        # A process that has died has said why.
        with contextlib.suppress(BrokenPipeError):
            if process.stdin is not None and process.poll() is None:
                process.stdin.write(f"{command}\n".encode())
        until_s = time.monotonic() + OBEYS_S
        while not _has_obeyed(os.pread(output.fileno(), os.fstat(output.fileno()).st_size - begin, begin), command):
            if process.poll() is not None:
                raise UserError("an emulated device has ended; the line above says why")
            if time.monotonic() > until_s:
                raise UserError(f"the emulated devices did not carry out `{command}`: run it again")
            time.sleep(POLL_S)

    def _command(self, emulator: "EmulatorConfig") -> list[str]:
        source = emulator.synthetic
        if self._recording is not None and emulator.device == "eit-kit":
            source = ("--recording", str(self._recording.resolve()))
        if self.truth is not None and emulator.device == "rig":
            source = (*source, "--truth", str(self.truth))
        return [*SHEARLOOP, "emulate", emulator.device, *emulator.arguments, *source]

    def _send_events(self, now_ns: int, step: int) -> None:
        held_s = (now_ns - self._since_ns.setdefault(step, now_ns)) / 1e9
        for entry in [entry for entry in self._waiting if entry[0].step == step and held_s >= entry[0].held_for_s]:
            self._waiting.remove(entry)
            event, process = entry
            # A process that has died has said why.
            with contextlib.suppress(BrokenPipeError):
                if process.stdin is not None and process.poll() is None:
                    process.stdin.write(f"{event.command}\n".encode())
                    self.sent.append((time.monotonic_ns(), event.command))


def _wait_until_ready(device: str, process: "subprocess.Popen[bytes]", output: IO[bytes], until_s: float) -> None:
    """Wait for the line that an emulator prints once its ports are open; raises UserError without one."""
    while not os.fstat(output.fileno()).st_size:
        if process.poll() is not None:
            raise UserError(f"the emulated device `{device}` did not start; the line above says why. Nothing was begun")
        if time.monotonic() > until_s:
            raise UserError(f"the emulated device `{device}` did not start within {READY_S:g} s: run it again")
        time.sleep(POLL_S)


def _has_obeyed(printed: bytes, command: str) -> bool:
    """Return whether an emulator has printed that it carried out a command; its last line may be incomplete."""
    lines = [line for line in printed.rpartition(b"\n")[0].splitlines() if line.startswith(b"{")]
    return any((event := json.loads(line))["event"] == "obeyed" and event["detail"] == command for line in lines)
