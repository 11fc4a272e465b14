"""What must outlive the daemon's process: a stop, the experiment that runs, and the grip with its zeros.

There is a file for each robot.
"""

import asyncio
import contextlib
import fcntl
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import structlog
from pydantic import ConfigDict

from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.safety import Fault, FaultCode
from shearloop.drivers.load_cell import LoadCell
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.settings import Six
from shearloop.errors import UserError
from shearloop.files import replace_file
from shearloop.mistakes import validated

VERSION = 1
# The file is written at this interval, and at the start of each experiment.
FOLLOWS_S = 0.1


@dataclass(frozen=True, slots=True)
class Remembered:
    """The state of a rig; empty without a stop, an experiment and a grip."""

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid", allow_inf_nan=False)

    # The name of the experiment that runs.
    running: str = ""
    # Code and detail of each fault of the stop that waits for the operator.
    stop: tuple[tuple[str, str], ...] = ()
    # The wrist's angle at the grip, and the largest force of the fingers.
    origin_rad: float | None = None
    force_n: float | None = None
    # The load cell's zero in this grip, in the board's unit, and the torque of one unit, which names its calibration:
    # with a tool in the fingers nobody can take another zero.
    load_zero: float | None = None
    load_nm_per_count: float | None = None
    # The zero of the wrench in this grip.
    wrench_zero: Six | None = None

    @classmethod
    def of(cls, loop: ControlLoop) -> "Remembered":
        """Return the present state of a control loop."""
        running = loop.running.file.name if loop.running is not None else ""
        stop = tuple((fault.code.name, fault.detail) for fault in loop.safety.stop_faults)
        return cls(running, stop, *loop.grip)

    def restore(self, loop: ControlLoop) -> None:
        """Give the stored state to a new control loop; a restored stop keeps the grip, even if it had opened it."""
        for name, detail in self.stop:
            known = name in FaultCode.__members__
            loop.safety.stop(Fault(FaultCode[name], detail) if known else Fault(FaultCode.DAEMON_ENDED, detail))
        if self.running:
            ended = f"it was killed, it crashed or the power failed while {self.running!r} was under way"
            loop.safety.stop(Fault(FaultCode.DAEMON_ENDED, ended))
        loop.restore_grip(self.origin_rad, self.force_n)


@dataclass(slots=True)
class RigMemory:
    """Keeps a rig's state in a file, which is replaced as a whole; the task follows loop, load cell and robot."""

    path: Path
    loop: ControlLoop
    load_cell: LoadCell | None = None
    robot: UrRobot | None = None
    error: str = ""
    # The experiment that is about to begin.
    starting: str = ""
    _written: Remembered = field(default_factory=Remembered)
    _writing: asyncio.Lock = field(default_factory=asyncio.Lock)

    def __post_init__(self) -> None:
        """Restore what the last daemon of this robot has left."""
        remembered = read_memory(self.path)
        remembered.restore(self.loop)
        self._written = remembered
        cell, zero = self.load_cell, remembered.load_zero
        if cell is not None and zero is not None and cell.calibration.nm_per_count == remembered.load_nm_per_count:
            structlog.get_logger().info("the load cell keeps the zero of the present grip")
            cell.tare(zero)
        if self.robot is not None and remembered.wrench_zero is not None:
            structlog.get_logger().info("the wrench keeps the zero of the present grip")
            self.robot.restore_wrench_zero(remembered.wrench_zero)

    async def run(self) -> None:
        """Write every change until cancelled."""
        while True:
            await self.save_present()
            await asyncio.sleep(FOLLOWS_S)

    async def begins(self, experiment: str) -> str | None:
        """Write that an experiment begins, before anything moves; return None, or why it cannot be written."""
        self.starting = experiment
        await self.save_present()
        return self.error or None

    async def save_present(self) -> None:
        """Write the present state, unless the file has it already."""
        state = Remembered.of(self.loop)
        state = replace(state, running=state.running or self.starting)
        if self.load_cell is not None and self.loop.may_hold():
            calibration = self.load_cell.calibration
            state = replace(state, load_zero=calibration.tare_counts, load_nm_per_count=calibration.nm_per_count)
        if self.robot is not None and self.loop.may_hold():
            state = replace(state, wrench_zero=self.robot.wrench_zero)
        await self.save(state)

    async def save(self, state: Remembered) -> None:
        """Write a state, unless the file has it already; a failure is logged once, and tried again."""
        async with self._writing:
            if state == self._written and not self.error:
                return
            try:
                await asyncio.to_thread(write_memory, self.path, state)
            except OSError as error:
                if not self.error:
                    structlog.get_logger().warning("the rig's state cannot be kept", reason=str(error))
                self.error = (
                    f"the rig's state cannot be kept in {self.path} ({error.strerror}), and a stop would be forgotten "
                    "with this process: make room, or make the folder writable"
                )
            else:
                self.error, self._written = "", state

    def diagnostics(self) -> Mapping[str, str]:
        """Return the memory's part of `health`."""
        return {"error": self.error} if self.error else {}


def memory_path(host: str) -> Path:
    """Return the file of the robot at this address: in systemd's state folder, or in the user's."""
    # systemd separates several folders with colons; ours is one.
    folder = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if not folder:
        state = os.environ.get("XDG_STATE_HOME", "")
        folder = str((Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state") / "shearloop")
    return Path(folder) / f"robot-{re.sub(r'[^A-Za-z0-9.-]', '_', host)}.json"


@contextlib.contextmanager
def lock_robot(host: str, commands: str = "") -> Iterator[None]:
    """Keep other daemons of this user away from a robot; raises UserError if one of them has it.

    `commands` is the command address of this process, if it has one, which the sentence to another one names.
    Two daemons would share the robot's memory, and neither would know of the other's stops and grips. The lock ends
    with the process, however that ends. Where the file cannot be made, no experiment starts, and nothing is locked.
    """
    path = memory_path(host).with_suffix(".lock")
    with contextlib.ExitStack() as opened:
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            file = opened.enter_context(path.open("a+", encoding="utf-8"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                process, _, address = file.read().partition(" ")
                stop = (
                    f"with `shearloop command stop --connect {address}`" if address else "with Ctrl-C in its terminal"
                )
                raise UserError(
                    f"the robot at {host} is driven by another program of this computer (process {process}): "
                    f"stop that one first, {stop}, or name another robot in the configuration"
                ) from None
            file.truncate(0)
            file.write(f"{os.getpid()} {commands}".rstrip())
            file.flush()
        yield


def read_memory(path: Path) -> Remembered:
    """Return the state in a file; one that cannot be read counts as a stop, a missing one as none."""
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("version") != VERSION:
            raise ValueError("it has another version")
        return validated(content, Remembered, str(path), ValueError)
    except FileNotFoundError:
        return Remembered()
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        unreadable = f"what it left in {path} cannot be read: {error}"
        return Remembered(stop=((FaultCode.DAEMON_ENDED.name, unreadable),))


def write_memory(path: Path, state: Remembered) -> None:
    """Replace the file as a whole, on the disk when this returns; raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as file:
        file.write(json.dumps({"version": VERSION, **asdict(state)}).encode())
