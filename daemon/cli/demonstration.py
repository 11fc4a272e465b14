"""What a demonstration adds to a run: what befalls the emulated rig, the truth about it, and the summary's end."""

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
    from shearloop.daemon.run_summary import Known

RIG = "rig"


class Truth:
    """The file in which an emulated rig writes what is really so; removed with `close`."""

    def __init__(self, emulators: "tuple[EmulatorConfig, ...]") -> None:
        """Make room for it where a rig is emulated that does not write one anyway."""
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.path: Path | None = None
        if any(emulator.device == RIG and "--truth" not in emulator.arguments for emulator in emulators):
            self._folder = tempfile.TemporaryDirectory(prefix="shearloop-")
            self.path = Path(self._folder.name) / "truth.jsonl"

    @property
    def arguments(self) -> tuple[str, ...]:
        """What the emulator is told."""
        return () if self.path is None else ("--truth", str(self.path))

    def torques(self) -> "Known | None":
        """Return the true torque so far; None where nobody knows it."""
        from shearloop.daemon.run_summary import Known

        if self.path is None or not self.path.exists():
            return None
        # The last line may be half written.
        lines = self.path.read_text(encoding="utf-8").rpartition("\n")[0].splitlines()
        rows = [(row["t_mono_ns"], row["torque_nm"]) for row in map(json.loads, lines)]
        table = np.array(rows, dtype=float).reshape(-1, 2)
        return Known(table[:, 0], table[:, 1])

    def close(self) -> None:
        """Remove the file."""
        if self._folder is not None:
            self._folder.cleanup()


class EmulatorEvents:
    """Sends the configured events to the emulators, each at its step of the experiment."""

    def __init__(self, emulators: "tuple[EmulatorConfig, ...]", processes: Sequence["Popen[bytes]"]) -> None:
        """Take the emulators and their processes, in the same order."""
        self._left = [
            (event, process)
            for emulator, process in zip(emulators, processes, strict=True)
            for event in emulator.events
        ]
        self._since_ns: dict[int, int] = {}
        self.happened: list[tuple[int, str]] = []

    def __call__(self, topic: str, content: Mapping[str, Any]) -> None:
        """Send the events that are due at a `loop.state`."""
        if topic != "loop.state" or content["phase"] != "running" or not content["hold"]:
            return
        now_ns = content["t_mono_ns"]
        since_ns = self._since_ns.setdefault(content["step"], now_ns)
        due = [
            entry
            for entry in self._left
            if entry[0].step == content["step"] and now_ns - since_ns >= entry[0].held_for_s * 1e9
        ]
        for event, process in due:
            self._left.remove((event, process))
            # An emulator may end at this moment; `Deaths` reports it.
            with contextlib.suppress(BrokenPipeError):
                if process.stdin is not None and process.poll() is None:
                    process.stdin.write(f"{event.command}\n".encode())
                    process.stdin.flush()
                    self.happened.append((time.monotonic_ns(), event.command))


class Deaths:
    """Says once, for each emulated device, that its process has ended while the daemon runs."""

    def __init__(self, emulators: "tuple[EmulatorConfig, ...]", processes: Sequence["Popen[bytes]"]) -> None:
        """Take the emulators and their processes, in the same order."""
        self._alive = [(emulator.device, process) for emulator, process in zip(emulators, processes, strict=True)]

    def __call__(self, topic: str, _: Mapping[str, Any]) -> None:
        """Look at each message of `health`, which comes once a second, whether all of them live."""
        if topic != "health":
            return
        for entry in [entry for entry in self._alive if entry[1].poll() is not None]:
            self._alive.remove(entry)
            structlog.get_logger().error(
                "an emulated device has ended: what it played is gone until the daemon is started again",
                device=entry[0],
                status=entry[1].returncode,
            )
