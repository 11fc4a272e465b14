"""The gripper over either connection: widths, activation, motion, state, reconnection."""

import asyncio
import math
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Self, TypeAlias, TypeVar

import numpy as np
from pydantic import model_validator

from shearloop.drivers.calibration_files import CalibrationModel, Finite, Positive
from shearloop.drivers.connection import Diagnostics, LinkMonitor
from shearloop.drivers.errors import DeviceCalibrationError, DriverError
from shearloop.drivers.robotiq import messages

if TYPE_CHECKING:
    from shearloop.drivers.robotiq.modbus_client import ModbusClient
    from shearloop.drivers.robotiq.socket_client import SocketClient

T = TypeVar("T")
# Each of its calls has a deadline; DeviceLostError closes the connection.
RobotiqClient: TypeAlias = "SocketClient | ModbusClient"

COUNTS_MAX = 255
STROKE_MM = 140.0
POLL_S = 0.1
# The pause between reset and activation that Robotiq's own clients keep.
PAUSE_NS = 500_000_000
RESET_DEADLINE_NS = 3_000_000_000
# The fingers open and close once; a real gripper takes two to four seconds.
ACTIVATION_DEADLINE_NS = 15_000_000_000
# The full stroke at the slowest speed takes 4.7 s.
MOTION_DEADLINE_NS = 10_000_000_000
_OVER_TEMPERATURE, _NO_COMMUNICATION = 8, 9


class WidthCalibration(CalibrationModel):
    """The line through two positions of known width: the width is taken as linear in counts.

    The fingers of a 2F-140 stop before the motor's spindle does: a real one goes from about 3 to about 230 counts, not
    from 0 to 255 (Robotiq knowledge base, "Encoder bytes, adaptive gripper"), and fingertips change that.
    `std_mm` is the standard deviation of the width about the line; `width_std_mm` adds the encoder's step of one count.
    """

    open_counts: Finite
    open_mm: Positive
    closed_counts: Finite
    closed_mm: Finite = 0.0
    std_mm: Positive

    @model_validator(mode="after")
    def _two_different_widths(self) -> Self:
        if self.open_counts >= self.closed_counts or self.open_mm <= self.closed_mm:
            raise ValueError("the open position must have fewer counts and more millimetres than the closed one")
        return self

    @classmethod
    def nominal(cls) -> Self:
        """Return the data sheet's line for a bare 2F-140: good enough to move, not to measure a diameter."""
        return cls(open_counts=3.0, open_mm=STROKE_MM, closed_counts=230.0, closed_mm=0.0, std_mm=3.0)

    @classmethod
    def of_gauges(cls, gauges: Sequence[tuple[float, float]]) -> Self:
        """Return the least-squares line through (counts, width in mm) pairs of gripped objects.

        From three pairs on, the scatter about the line is the standard deviation, and one count at least. Raises
        DeviceCalibrationError when no falling line fits.
        """
        if len({width for _, width in gauges}) < 2:
            raise DeviceCalibrationError("A width calibration needs objects of at least two different diameters.")
        counts, widths = (np.array(column, dtype=float) for column in zip(*gauges, strict=True))
        counts_per_mm, closed_counts = (float(value) for value in np.polyfit(widths, counts, 1))
        # Less than a quarter of the nominal slope means objects in the wrong order.
        if counts_per_mm > -0.25 * COUNTS_MAX / STROKE_MM:
            raise DeviceCalibrationError(
                "The fingers did not stop further closed on the smaller objects: were they measured in the order "
                "given, and did the fingers hold each of them?"
            )
        residuals = (counts - (closed_counts + counts_per_mm * widths)) / counts_per_mm
        scatter_mm = math.sqrt(float(residuals @ residuals) / (len(gauges) - 2)) if len(gauges) > 2 else 0.0
        if scatter_mm > 0.02 * STROKE_MM:
            raise DeviceCalibrationError(
                f"The diameters scatter by {scatter_mm:.1f} mm about a straight line: check them, and that each object "
                "was gripped at the same place of the fingertips."
            )
        return cls(
            open_counts=closed_counts + counts_per_mm * STROKE_MM,
            open_mm=STROKE_MM,
            closed_counts=closed_counts,
            std_mm=max(scatter_mm, -1 / counts_per_mm),
        )

    @property
    def mm_per_count(self) -> float:
        """The change of width per count, mm; negative."""
        return (self.open_mm - self.closed_mm) / (self.open_counts - self.closed_counts)

    def width_mm(self, counts: float) -> float:
        """Return the width at a position, mm."""
        return self.closed_mm + (counts - self.closed_counts) * self.mm_per_count

    def counts(self, width_mm: float) -> int:
        """Return the position nearest to a width, within 0…255."""
        exact = self.closed_counts + (width_mm - self.closed_mm) / self.mm_per_count
        return min(max(round(exact), 0), COUNTS_MAX)

    @property
    def width_std_mm(self) -> float:
        """The standard deviation of a measured width, mm: of the line and of the encoder's step."""
        return math.hypot(self.std_mm, self.mm_per_count / math.sqrt(12))


@dataclass(eq=False)
class RobotiqGripper:
    """One gripper: a connection, not yet open, and the meaning of its counts.

    Commands and polling may come from different tasks. Each exchange with the gripper is whole, also when its caller
    is cancelled. A lost connection raises DeviceLostError in the call that meets it; `latest` is None until the next
    read.
    """

    client: RobotiqClient
    calibration: WidthCalibration
    _: KW_ONLY
    poll_s: float = POLL_S
    monitor: LinkMonitor = field(default_factory=LinkMonitor)
    connected: bool = field(default=False, init=False)
    latest: messages.GripperState | None = field(default=None, init=False)
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock, init=False)
    _seq: int = field(default=0, init=False)
    _last_move: messages.GripperMove | None = field(default=None, init=False)
    _loss: DriverError | None = field(default=None, init=False)

    def diagnostics(self) -> Diagnostics:
        """Return the gripper's part of `health`; counts are since the process began."""
        return {**self.monitor.diagnostics(connected=self.connected), "states": self._seq}

    async def connect(self) -> messages.GripperState:
        """Open the connection and return the first state; DeviceNotFoundError or DeviceLostError."""
        await self._exchange(self.client.connect)
        self.connected, self._loss = True, None
        # Another program may have commanded the gripper since.
        self._last_move = None
        return await self.read()

    async def close(self) -> None:
        """Close the connection; the gripper keeps its grip."""
        async with self._lock:
            self.connected, self.latest = False, None
            await self.client.close()

    async def read(self) -> messages.GripperState:
        """Return the gripper's present state."""
        readout, t_ns = await self._read()
        self.latest = self._state(readout, t_ns)
        return self.latest

    async def activate(self, *, operator_confirmed: bool = False) -> messages.GripperState:
        """Return the state of the active gripper; one that is not active opens and closes its fingers once.

        After a major fault the operator has to confirm that the fingers are clear. `operator_confirmed` activates in
        any state. Raises GripperFaultError when the activation is refused or fails.
        """
        readout, t_ns = await self._read()
        fault = messages.fault_of(readout.flt)
        if not operator_confirmed:
            if fault.needs_activation:
                raise messages.GripperFaultError(
                    f"{fault.sentence} An operator has to confirm that the fingers are clear."
                )
            if not blocking_fault(readout):
                return self._state(readout, t_ns)
        self._last_move = None
        await self._write(messages.GripperAction.RESET)
        not_reset = "The gripper does not take the reset; check that nothing else commands it."
        await self._wait_until(
            lambda now: not now.act and now.sta is messages.ActivationStatus.RESET, RESET_DEADLINE_NS, not_reset
        )
        resume_ns = time.monotonic_ns() + PAUSE_NS
        await self._wait_until(lambda _: time.monotonic_ns() >= resume_ns, RESET_DEADLINE_NS, not_reset)
        # A rising edge of ACT, which also ends every fault.
        await self._write(messages.GripperAction.ACTIVATE)
        return await self._wait_until(
            _is_active,
            ACTIVATION_DEADLINE_NS,
            "The gripper's activation does not end; clear the fingers and activate it again.",
        )

    async def move(self, command: messages.GripperCommand) -> messages.GripperMove:
        """Start a motion, clipped to the limits, and return it as sent; `finish` waits for its end.

        Raises GripperRefusedError for a command that is not finite, GripperFaultError when the gripper would not move.
        """
        sent = self.request_of(command)
        readout, _ = await self._read()
        if blocking := blocking_fault(readout):
            raise messages.GripperFaultError(blocking)
        self._last_move = sent
        await self._write(sent)
        return sent

    async def finish(self, sent: messages.GripperMove) -> messages.GripperState:
        """Return the state at the end of the motion: at its target, or on an object."""

        def has_finished(readout: messages.Readout) -> bool:
            if self._last_move is not sent:
                raise messages.GripperRefusedError(
                    "Another command took over before the gripper had finished its motion."
                )
            if blocking := blocking_fault(readout):
                raise messages.GripperFaultError(blocking)
            return object_status(readout, sent) is not messages.ObjectStatus.MOVING

        return await self._wait_until(
            has_finished,
            MOTION_DEADLINE_NS,
            "The gripper does not finish its motion; check that nothing else commands it.",
        )

    async def _wait_until(
        self, done: Callable[[messages.Readout], bool], deadline_ns: int, failure: str
    ) -> messages.GripperState:
        """Return the first state that is `done`; GripperFaultError after the deadline."""
        since_ns = time.monotonic_ns()
        while True:
            readout, t_ns = await self._read()
            if done(readout):
                return self._state(readout, t_ns)
            if t_ns - since_ns > deadline_ns:
                raise messages.GripperFaultError(failure)
            await asyncio.sleep(self.poll_s)

    async def halt(self) -> None:
        """Stop the fingers where they are; they keep their grip. An activation is ended by a reset."""
        self._last_move = None
        await self._write(messages.GripperAction.HALT)
        readout, _ = await self._read()
        # The status may not show an activation yet that has just been requested. A major fault stops the fingers, and
        # a reset would clear it without the operator.
        active = readout.sta is messages.ActivationStatus.ACTIVE
        if not (active or messages.fault_of(readout.flt).needs_activation):
            await self._write(messages.GripperAction.RESET)

    async def states(self) -> AsyncGenerator[messages.GripperState]:
        """Yield a state every poll period and reconnect after losses, for ever.

        Iterate within `contextlib.aclosing`, which closes the connection at the end.
        """
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        try:
            while True:
                # A missed period is skipped.
                due_s = max(due_s + self.poll_s, loop.time())
                try:
                    state = await self._next_state()
                except DriverError as error:
                    await self.close()
                    self._loss = None
                    await asyncio.sleep(self.monitor.failed(error, time.monotonic_ns()))
                    continue
                yield state
                await asyncio.sleep(due_s - loop.time())
        finally:
            await self.close()

    async def _next_state(self) -> messages.GripperState:
        if self.connected:
            return await self.read()
        if self._loss is not None:
            raise self._loss
        state = await self.connect()
        self.monitor.connected(f"The gripper answers at {self.client.name}.", time.monotonic_ns())
        return state

    def request_of(self, command: messages.GripperCommand) -> messages.GripperMove:
        """Return the request of a command, within this gripper's limits; GripperRefusedError if it is not finite."""
        if not all(map(math.isfinite, (command.width_mm, command.speed_mm_s, command.force_n))):
            raise messages.GripperRefusedError(
                f"{command} is no command: width, speed and force must be finite numbers."
            )
        speeds = messages.SPEED_MIN_MM_S, messages.SPEED_MAX_MM_S
        forces = messages.FORCE_MIN_N, messages.FORCE_MAX_N
        return messages.GripperMove(
            self.calibration.counts(command.width_mm),
            round(float(np.interp(command.speed_mm_s, speeds, (0, COUNTS_MAX)))),
            round(float(np.interp(command.force_n, forces, (0, COUNTS_MAX)))),
        )

    async def _read(self) -> tuple[messages.Readout, int]:
        return await self._exchange(self.client.read)

    async def _write(self, request: messages.Request) -> None:
        await self._exchange(partial(self.client.write, request))

    async def _exchange(self, exchange: Callable[[], Awaitable[T]]) -> tuple[T, int]:
        """Return an exchange's result and its beginning. It goes on when its caller is cancelled.

        Breaking it off would cost the connection.
        """
        task = asyncio.ensure_future(self._locked(exchange))
        # `states` reports a failure that comes after its caller was cancelled.
        task.add_done_callback(lambda done: done.cancelled() or done.exception())
        return await asyncio.shield(task)

    async def _locked(self, exchange: Callable[[], Awaitable[T]]) -> tuple[T, int]:
        """Exclude other exchanges, and note a loss, which `states` reports."""
        async with self._lock:
            t_ns = time.monotonic_ns()
            try:
                return await exchange(), t_ns
            except DriverError as error:
                if self.connected:
                    self._loss = error
                self.connected, self.latest = False, None
                raise

    def _state(self, readout: messages.Readout, t_ns: int) -> messages.GripperState:
        state = messages.GripperState(
            t_ns=t_ns,
            position_counts=readout.pos,
            width_mm=self.calibration.width_mm(readout.pos),
            width_std_mm=self.calibration.width_std_mm,
            object=object_status(readout, self._last_move),
            activation=readout.sta,
            current_ma=None if readout.current is None else readout.current * messages.MA_PER_COUNT,
            fault=messages.fault_of(readout.flt),
        )
        self._seq += 1
        return state


def _is_active(readout: messages.Readout) -> bool:
    # Lower faults are normal during an activation, as is a silence before it.
    if readout.act and readout.flt >= _OVER_TEMPERATURE and readout.flt != _NO_COMMUNICATION:
        raise messages.GripperFaultError(messages.fault_of(readout.flt).sentence)
    return readout.act and readout.sta is messages.ActivationStatus.ACTIVE


def object_status(readout: messages.Readout, last: messages.GripperMove | None) -> messages.ObjectStatus:
    """Return what the fingers met in the last motion requested.

    Until the gripper has taken up a target (GTO is 1 and the echo PRE equals it), OBJ belongs to the motion before.
    """
    if readout.sta is not messages.ActivationStatus.ACTIVE:
        return messages.ObjectStatus.UNKNOWN
    if last is not None and not (readout.gto and readout.pre == last.position):
        return messages.ObjectStatus.MOVING
    return readout.obj if readout.gto else messages.ObjectStatus.UNKNOWN


def blocking_fault(readout: messages.Readout) -> str:
    """Return why the gripper would not move now, as a sentence, or an empty string."""
    fault = messages.fault_of(readout.flt)
    if fault.needs_activation or fault.code == _OVER_TEMPERATURE:
        return fault.sentence
    if readout.sta is messages.ActivationStatus.ACTIVATING:
        return messages.fault_of(5).sentence
    if not readout.act or readout.sta is not messages.ActivationStatus.ACTIVE:
        return messages.fault_of(7).sentence
    return ""
