"""Support for demonstrations with emulated devices: events of an experiment, the true torque, and lost emulators."""

import contextlib
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from subprocess import Popen
from typing import TYPE_CHECKING, Any

import numpy as np
import structlog

if TYPE_CHECKING:
    from shearloop.daemon.config import EmulatorConfig
    from shearloop.daemon.run_summary import TorqueSeries


class TruthFile:
    """A temporary file for the true state of an emulated rig; `close` removes it."""

    def __init__(self, emulators: "tuple[EmulatorConfig, ...]") -> None:
        """Make the file's folder, unless no rig is emulated or it has a file already."""
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.path: Path | None = None
        if any(emulator.device == "rig" and "--truth" not in emulator.arguments for emulator in emulators):
            self._folder = tempfile.TemporaryDirectory(prefix="shearloop-")
            self.path = Path(self._folder.name) / "truth.jsonl"

    @property
    def arguments(self) -> tuple[str, ...]:
        """The emulator's arguments for the file."""
        return () if self.path is None else ("--truth", str(self.path))

    def torques(self) -> "TorqueSeries | None":
        """Return the true torque so far; None if it is unknown."""
        from shearloop.daemon.run_summary import TorqueSeries

        if self.path is None or not self.path.exists():
            return None
        # The last line may be incomplete.
        lines = self.path.read_text(encoding="utf-8").rpartition("\n")[0].splitlines()
        rows = [(row["t_mono_ns"], row["torque_nm"]) for row in map(json.loads, lines)]
        table = np.array(rows, dtype=float).reshape(-1, 2)
        return TorqueSeries(table[:, 0], table[:, 1])

    def close(self) -> None:
        """Remove the file."""
        if self._folder is not None:
            self._folder.cleanup()


class EventInjector:
    """A listener that sends the configured events to the emulators, each at its step of the experiment."""

    def __init__(self, emulators: "tuple[EmulatorConfig, ...]", processes: Sequence["Popen[bytes]"]) -> None:
        self._waiting = [
            (event, process)
            for emulator, process in zip(emulators, processes, strict=True)
            for event in emulator.events
        ]
        self._since_ns: dict[int, int] = {}
        self.sent: list[tuple[int, str]] = []

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Send the events that are due, at each `loop.state`."""
        if topic != "loop.state" or content["phase"] != "running" or not content["hold"]:
            return
        now_ns, step = content["t_mono_ns"], content["step"]
        held_s = (now_ns - self._since_ns.setdefault(step, now_ns)) / 1e9
        for entry in [entry for entry in self._waiting if entry[0].step == step and held_s >= entry[0].held_for_s]:
            self._waiting.remove(entry)
            event, process = entry
            # EmulatorMonitor reports a dead process.
            with contextlib.suppress(BrokenPipeError):
                if process.stdin is not None and process.poll() is None:
                    process.stdin.write(f"{event.command}\n".encode())
                    process.stdin.flush()
                    self.sent.append((time.monotonic_ns(), event.command))


class EmulatorMonitor:
    """A listener that reports once when an emulator's process has ended."""

    def __init__(self, emulators: "tuple[EmulatorConfig, ...]", processes: Sequence["Popen[bytes]"]) -> None:
        self._alive = [(emulator.device, process) for emulator, process in zip(emulators, processes, strict=True)]

    def __call__(self, topic: str, _: Mapping[str, Any]) -> None:
        """Check the processes at each `health`."""
        if topic != "health":
            return
        for entry in [entry for entry in self._alive if entry[1].poll() is not None]:
            self._alive.remove(entry)
            structlog.get_logger().error(
                "an emulated device has ended: restart the daemon to emulate it again",
                device=entry[0],
                status=entry[1].returncode,
            )
