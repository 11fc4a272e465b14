"""Keeps the state that must survive the daemon's process: a stop, the running experiment, and the grip with its zeros.

Each robot has a file.
"""

import asyncio
import errno
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar

import structlog
from pydantic import ConfigDict, Field

from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.faults import Fault, FaultCode
from shearloop.daemon.control.grip import NO_GRIP, Grip, OnJudged
from shearloop.daemon.robot_files import RobotFiles
from shearloop.daemon.torques import LOAD_CELL, WRENCH
from shearloop.daemon.wrench_zero import WrenchZero
from shearloop.drivers.load_cell import LoadCell
from shearloop.drivers.ur.settings import Six
from shearloop.files import read_file, replace_file
from shearloop.models import validated

VERSION = 1
# The file is written at this interval, and at the start of each experiment.
FOLLOWS_S = 0.1
# Nothing shows that another tool was clamped.
CLAMPED_ANOTHER = "if another tool is clamped, `shearloop command release --yes` lets its angle count from 0"
# A state takes some hundred bytes.
_MAX_BYTES = 1 << 16
# A Unix time in s that is a date in every time zone: the year 9999 ends a day later.
UnixTime = Annotated[float, Field(ge=0, le=253_402_214_400)]


@dataclass(frozen=True, slots=True)
class Remembered:
    """The state of a rig; empty without a stop, an experiment and a grip."""

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid", allow_inf_nan=False)

    # The name of the experiment that runs.
    running: str = ""
    # Code and detail of each fault of the stop that waits for the operator, and its Unix time in s, where it is known.
    stop: tuple[tuple[str, str], ...] = ()
    stopped_s: UnixTime | None = None
    # The grip, as `Grip` has it.
    origin_rad: float | None = None
    force_n: float | None = None
    width_mm: float | None = None
    requested_counts: int | None = None
    # The diameter that the latest experiment states of the tool.
    stated_tool_mm: float | None = None
    # The load cell's zero in this grip, in the board's unit, and the torque of one unit, which identifies its
    # calibration. With a tool in the fingers the load cell cannot get a new zero.
    load_zero: float | None = None
    load_nm_per_count: float | None = None
    # The zero of the wrench in this grip, and whether a tare took it. Otherwise the program's start set it.
    wrench_zero: Six | None = None
    wrench_tared: bool = False

    @property
    def grip(self) -> Grip:
        """The known facts of the grip."""
        return Grip(self.origin_rad, self.force_n, self.width_mm, self.requested_counts)

    @property
    def grips(self) -> bool:
        """Whether a tool may be held, by the gripper or a clamp."""
        return self.grip != NO_GRIP or self.load_zero is not None or self.wrench_zero is not None

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults of the stop that waits for the operator, one for each code; a killed experiment is one of them."""
        entries = list(self.stop)
        if self.running:
            ended = f"it was killed, it crashed, or power or disk failed while {self.running!r} was under way"
            entries.append((FaultCode.DAEMON_ENDED.name, ended))
        details: dict[FaultCode, list[str]] = {}
        for name, detail in entries:
            code = FaultCode.__members__.get(name, FaultCode.DAEMON_ENDED)
            of_code = details.setdefault(code, [])
            # A stored stop has details that the earlier process has joined.
            if not any(detail in one for one in of_code):
                of_code.append(detail)
        when = "" if self.stopped_s is None else f"stopped at {datetime.fromtimestamp(self.stopped_s):%Y-%m-%d %H:%M}"
        return tuple(Fault(code, "; ".join(of_code), when=when) for code, of_code in details.items())

    @classmethod
    def of(cls, loop: ControlLoop) -> "Remembered":
        """Return the present state of a control loop."""
        running = loop.running_experiment.file.name if loop.running_experiment is not None else ""
        faults = loop.safety.waiting.faults if loop.safety.waiting is not None else ()
        stop = tuple((fault.code.name, fault.detail) for fault in faults)
        return cls(running, stop, None, **asdict(loop.tool.grip), stated_tool_mm=loop.stated_tool_mm)

    def restore(self, loop: ControlLoop, on_judged: OnJudged = lambda _: None) -> None:
        """Give the stored state to a new control loop; a restored stop keeps the grip, even if it had opened it."""
        for fault in self.faults:
            loop.safety.stop(fault)
        if not loop.tool.has_gripper:
            loop.tool.restore_clamped(self.origin_rad)
        elif self.grips:
            loop.tool.restore_grip(self.grip, on_judged)
            loop.stated_tool_mm = self.stated_tool_mm


class NoMemory:
    """Keeps nothing, for emulated devices that end with the daemon: with them end every grip and stop."""

    error = ""

    async def begins(self, _experiment: str) -> str | None:
        """Begin an experiment: it needs no memory."""
        return None

    def begun(self) -> None:
        """End the beginning of an experiment, or its refusal."""

    async def save_present(self) -> str | None:
        """Write nothing."""
        return None


@dataclass(slots=True)
class RigMemory:
    """Writes the state of loop, load cell and robot to a file, which is replaced as a whole."""

    files: RobotFiles
    loop: ControlLoop
    load_cell: LoadCell | None
    wrench: WrenchZero
    clock: Clock
    error: str = ""
    # The experiment that is about to begin.
    _starting: str = ""
    # The state in the file.
    _written: Remembered | None = None
    # Whether a stop waits, and when it began; None for one of an earlier process that ended without writing its time.
    _stop_waits: bool = False
    _stopped_s: float | None = None
    # The load cell's zero in its calibration, and the restored zero.
    _calibrated_zero: float | None = None
    _load_restored: float | None = None
    # Whether the gripper has shown if it still has the earlier grip. Until then the restored zeros are kept.
    _judged: bool = False
    _writing: asyncio.Lock = field(default_factory=asyncio.Lock)

    def restore(self) -> None:
        """Give the state that the last daemon of this robot has left to loop, load cell and robot, before they run."""
        remembered = self._written = read_memories(self.files)
        remembered.restore(self.loop, self._on_judged)
        self._stop_waits, self._stopped_s = bool(remembered.faults), remembered.stopped_s
        clamped = not self.loop.tool.has_gripper
        if clamped and remembered.force_n is not None:
            # They are of a grip, and the configuration does not name that gripper any more.
            return
        # Until the gripper answers, its grip counts as the earlier one.
        cell, zero = self.load_cell, remembered.load_zero
        if cell is not None and zero is not None and cell.calibration.nm_per_count == remembered.load_nm_per_count:
            self._calibrated_zero, self._load_restored = cell.calibration.tare_counts, zero
            cell.tare(zero)
        if remembered.wrench_zero is not None:
            self.wrench.restore(remembered.wrench_zero, tared=remembered.wrench_tared)
        if clamped:
            # Nothing shows whether it is another tool: the operator says so with `release`.
            self._on_judged("")

    def _on_judged(self, why_another: str) -> None:
        """Keep the zeros of the earlier grip, or remove them if the gripper does not have that grip any more."""
        log = structlog.get_logger()
        self._judged = True
        zeros = [LOAD_CELL] if self._calibrated_zero is not None else []
        if not why_another:
            if self.wrench.keep():
                zeros.append(WRENCH)
            for name in zeros:
                self.loop.on_restored_zero(name)
            if zeros:
                another = {} if self.loop.tool.has_gripper else {"cure": CLAMPED_ANOTHER}
                log.info("the zeros of the present tool are kept", of=zeros, **another)
            return
        if self.wrench.forget():
            zeros.append(WRENCH)
        log.warning(
            "the gripper does not have the grip of the last daemon, whose angle, force and zeros are not used",
            reason=why_another,
            zeros=zeros,
            cure="check what it holds; `shearloop command release --yes` opens it, and then `shearloop command tare`",
        )
        cell = self.load_cell
        # Keep the zero of a later tare.
        if (
            cell is not None
            and self._calibrated_zero is not None
            and cell.calibration.tare_counts == self._load_restored
        ):
            cell.tare(self._calibrated_zero)

    async def run(self) -> None:
        """Write every change until cancelled."""
        while True:
            await self.save_present()
            await asyncio.sleep(FOLLOWS_S)

    async def begins(self, experiment: str) -> str | None:
        """Write that an experiment begins, before anything moves; return why it cannot be written, or None."""
        self._starting = experiment
        return await self.save_present()

    def begun(self) -> None:
        """Leave it to the loop from now on to say which experiment runs, also where its start was refused."""
        self._starting = ""

    async def save_present(self) -> str | None:
        """Write the present state, unless the file has it already; return why it cannot be written, or None."""
        self.wrench.watch()
        state = Remembered.of(self.loop)
        stop_waits = bool(state.stop)
        if not stop_waits:
            self._stopped_s = None
        elif not self._stop_waits:
            self._stopped_s = self.clock.unix_s(self.clock.now_ns())
        self._stop_waits = stop_waits
        state = replace(state, running=state.running or self._starting, stopped_s=self._stopped_s)
        if self.load_cell is not None and self.loop.tool.may_be_loaded() and self._knows_load_zero:
            calibration = self.load_cell.calibration
            state = replace(state, load_zero=calibration.tare_counts, load_nm_per_count=calibration.nm_per_count)
        if self.loop.tool.may_be_loaded():
            state = replace(state, wrench_zero=self.wrench.zero, wrench_tared=self.wrench.tared)
        await self.save(state)
        return self.error or None

    @property
    def _knows_load_zero(self) -> bool:
        """Whether a tare took the load cell's zero; otherwise the zero is the calibration's, from another day."""
        cell = self.load_cell
        restored = cell is not None and cell.calibration.tare_counts == self._load_restored
        return self.loop.has_zero(LOAD_CELL) or (restored and not self._judged)

    async def save(self, state: Remembered) -> None:
        """Write a state, unless the file has it already; a failure is logged once, and the write is tried again.

        It goes on when its caller is cancelled, as by a stop: the next write must not meet it.
        """
        await asyncio.shield(asyncio.ensure_future(self._save(state)))

    async def _save(self, state: Remembered) -> None:
        async with self._writing:
            if state == self._written and not self.error:
                return
            try:
                await asyncio.to_thread(write_memory, self.files.state, state)
            except OSError as error:
                if not self.error:
                    structlog.get_logger().warning("the rig's state cannot be kept", reason=str(error))
                self.error = (
                    f"the rig's state cannot be kept in {self.files.state} ({error.strerror}), and a stop would be "
                    "forgotten with this process: make room, or make the folder writable"
                )
            else:
                self.error, self._written = "", state

    def diagnostics(self) -> Mapping[str, str]:
        """Return the memory's part of `health`."""
        return {"error": self.error} if self.error else {}


def read_memory(path: Path) -> Remembered:
    """Return the state in a file; an unreadable file counts as a stop, a missing file as no stop."""
    try:
        content: Any = json.loads(read_file(path, _MAX_BYTES))
        if content.pop("version") != VERSION:
            raise ValueError("it has another version")
        return validated(content, Remembered, str(path), ValueError)
    except FileNotFoundError:
        return Remembered()
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        unreadable = f"its state in {path} cannot be read: {error}"
        return Remembered(stop=((FaultCode.DAEMON_ENDED.name, unreadable),))


def read_memories(files: RobotFiles) -> Remembered:
    """Return the state in the file of one robot, and every stop that is kept under a name, which may be its own."""
    stops = []
    for path in files.states_by_name:
        if faults := read_memory(path).faults:
            causes = "; ".join(fault.cause for fault in faults)
            kept = f"{path} keeps a stop of a robot by its name, which may be this one ({causes})"
            stops.append((FaultCode.DAEMON_ENDED.name, f"{kept}: remove the file once this robot is as it should be"))
    own = read_memory(files.state)
    return replace(own, stop=(*own.stop, *stops))


def write_memory(path: Path, state: Remembered) -> None:
    """Replace the file as a whole, on the disk when this returns; raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not path.is_file():
        # The opening of a pipe would wait for a reader.
        raise OSError(errno.EINVAL, "it is a folder, a device or a pipe")
    with replace_file(path) as file:
        file.write(json.dumps({"version": VERSION, **asdict(state)}).encode())
