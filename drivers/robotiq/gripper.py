"""The gripper as the loop uses it, whichever way its bytes go."""

import asyncio
import math
import time
from collections.abc import AsyncGenerator, Callable, Coroutine, Mapping
from typing import TypeVar

from shearloop.drivers.connection import LinkEvent, ReconnectPolicy
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq.faults import GripperFaultError, GripperRefusedError, fault_of
from shearloop.drivers.robotiq.messages import (
    FORCE_MAX_N,
    FORCE_MIN_N,
    MA_PER_COUNT,
    SPEED_MAX_MM_S,
    SPEED_MIN_MM_S,
    ActivationStatus,
    GripperClient,
    GripperCommand,
    GripperHalt,
    GripperMove,
    GripperState,
    ObjectStatus,
    Readout,
    Request,
    Reset,
    SentCommand,
)
from shearloop.drivers.robotiq.sequences import ActivationSequence, MotionWatch, blocking_fault, object_status
from shearloop.drivers.robotiq.width import COUNTS_MAX, WidthCalibration

T = TypeVar("T")

POLL_S = 0.1
# Of so many polls of a gripper that stands one asks for the current too.
ASKED_WHOLE_EVERY = 5


class RobotiqGripper:
    """One gripper: activation, motion, state, reconnection.

    Commands and polling may come from different tasks: each exchange with the gripper is whole, that of a command also
    where who gave it is cancelled. A lost connection raises DeviceLostError in the call that meets it, and `latest` is
    None from then on until new registers were read.
    """

    def __init__(
        self,
        client: GripperClient,
        calibration: WidthCalibration,
        *,
        poll_s: float = POLL_S,
        policy: ReconnectPolicy | None = None,
        on_event: Callable[[LinkEvent], None] = lambda _: None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Name the way to the gripper and what its counts mean; nothing is opened yet."""
        self._client = client
        self._calibration = calibration
        self._poll_s = poll_s
        self._policy = policy or ReconnectPolicy()
        self._on_event = on_event
        self._clock_ns = clock_ns
        self._exchange = asyncio.Lock()
        self._seq = 0
        self._last_request: GripperMove | None = None
        self._openings = 0
        # The latest readout of a gripper that stands and of which nothing was asked since.
        self._standing: Readout | None = None
        # When everything was asked for last, current included.
        self._whole_ns = 0
        self._polls = 0
        self._loss: DriverError | None = None
        self.connected = False
        self.last_error = ""
        self.latest: GripperState | None = None

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the gripper; counts are since the process began."""
        return {
            "connected": self.connected,
            "states": self._seq,
            "openings": self._openings,
            "last_loss": self.last_error,
        }

    async def connect(self) -> GripperState:
        """Open the connection and return the first state; DeviceNotFoundError or DeviceLostError."""
        await self._client.connect()
        self._openings += 1
        self.connected, self._loss = True, None
        # What was asked for over an earlier connection may have been changed from elsewhere since.
        self._last_request = None
        return await self.read()

    async def close(self) -> None:
        """Close the connection; the gripper keeps its grip."""
        self.connected, self.latest = False, None
        await self._client.close()

    async def read(self) -> GripperState:
        """Return the gripper's state, asked for now."""
        readout, t_ns = await self._read()
        self.latest = self._state(readout, t_ns)
        return self.latest

    async def _poll(self) -> GripperState:
        """Return the gripper's state, asked for now; while it stands, its current only now and then."""
        self._polls += 1
        readout, t_ns = await self._read(again=self._polls % ASKED_WHOLE_EVERY != 0)
        self.latest = self._state(readout, t_ns)
        if self.latest.object is not ObjectStatus.MOVING:
            self._standing = readout
        return self.latest

    async def activate(self, *, operator_confirmed: bool = False) -> GripperState:
        """Return the state of the active gripper; when it is not active yet, the fingers open and close once.

        After a major fault the operator has to say that the fingers are clear: only then, with `operator_confirmed`,
        is ACT raised again, and in any state. Raises GripperFaultError when it is refused or fails.
        """
        readout, t_ns = await _whole(self._read())
        fault = fault_of(readout.flt)
        if not operator_confirmed:
            if fault.needs_activation:
                raise GripperFaultError(f"{fault.sentence} An operator has to confirm that the fingers are clear.")
            if blocking_fault(readout) is None:
                return self._state(readout, t_ns)
        sequence = ActivationSequence()
        while not sequence.done:
            request = sequence.step(readout, t_ns)
            if request is not None:
                self._last_request = None
                await _whole(self._write(request))
            elif not sequence.done:
                await asyncio.sleep(self._poll_s)
            if not sequence.done:
                readout, t_ns = await _whole(self._read())
        return self._state(readout, t_ns)

    async def move(self, command: GripperCommand) -> SentCommand:
        """Start a motion and return what was really sent; `finish` waits for its end.

        Raises GripperRefusedError for a command that is no number, GripperFaultError when the gripper would not move.
        """
        sent = self.clip(command)
        readout, _ = await _whole(self._read())
        blocking = blocking_fault(readout)
        if blocking is not None:
            raise GripperFaultError(blocking)
        self._last_request = sent.request
        await _whole(self._write(sent.request))
        return sent

    async def finish(self, sent: SentCommand) -> GripperState:
        """Return the state in which the motion ended: at its target, or on an object."""
        watch = MotionWatch(sent.request, self._clock_ns())
        while True:
            readout, t_ns = await _whole(self._read())
            if self._last_request is not sent.request:
                raise GripperRefusedError("Another command took over before the gripper had finished its motion.")
            if watch.finished(readout, t_ns):
                return self._state(readout, t_ns)
            await asyncio.sleep(self._poll_s)

    async def halt(self) -> None:
        """Stop the fingers where they are; they keep holding what they hold.

        An activation moves them by itself, and is ended by a reset: the gripper has to be activated again.
        """
        self._last_request = None
        await _whole(self._write(GripperHalt()))
        readout, _ = await _whole(self._read())
        if readout.sta is ActivationStatus.ACTIVATING:
            await _whole(self._write(Reset()))

    async def states(self) -> AsyncGenerator[GripperState]:
        """Yield a state every poll period, for ever, whatever becomes of the gripper meanwhile.

        Iterate within `contextlib.aclosing`, so that the connection is closed when the iteration is left.
        """
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        try:
            while True:
                # A period that was missed is left out, not made up for.
                due_s = max(due_s + self._poll_s, loop.time())
                try:
                    state = await self._next_state()
                except DriverError as error:
                    await self._lost(error)
                    continue
                yield state
                await asyncio.sleep(due_s - loop.time())
        finally:
            await self.close()

    async def _next_state(self) -> GripperState:
        if self.connected:
            return await self._poll()
        if self._loss is not None:
            raise self._loss
        state = await self.connect()
        self._policy.connected(time.monotonic_ns())
        self._on_event(LinkEvent(up=True, sentence=f"The gripper answers at {self._client.name}.", repeated=False))
        return state

    async def _lost(self, error: DriverError) -> None:
        await self.close()
        self._loss = None
        self.last_error = str(error)
        retry = self._policy.failed(time.monotonic_ns())
        self._on_event(LinkEvent(up=False, sentence=self.last_error, repeated=retry.repeated))
        await asyncio.sleep(retry.wait_s)

    def clip(self, command: GripperCommand) -> SentCommand:
        """Return what a command comes to on this gripper: within its limits, in whole counts."""
        if not all(map(math.isfinite, (command.width_mm, command.speed_mm_s, command.force_n))):
            raise GripperRefusedError(f"{command} is no command: width, speed and force must be finite numbers.")
        clipped: list[str] = []
        calibration = self._calibration
        narrowest_mm, widest_mm = calibration.width_mm(COUNTS_MAX), calibration.width_mm(0)
        width_mm = _clip("width", command.width_mm, narrowest_mm, widest_mm, "mm", clipped)
        speed_mm_s = _clip("speed", command.speed_mm_s, SPEED_MIN_MM_S, SPEED_MAX_MM_S, "mm/s", clipped)
        force_n = _clip("force", command.force_n, FORCE_MIN_N, FORCE_MAX_N, "N", clipped)
        request = GripperMove(
            calibration.counts(width_mm),
            round((speed_mm_s - SPEED_MIN_MM_S) / (SPEED_MAX_MM_S - SPEED_MIN_MM_S) * COUNTS_MAX),
            round((force_n - FORCE_MIN_N) / (FORCE_MAX_N - FORCE_MIN_N) * COUNTS_MAX),
        )
        return SentCommand(
            width_mm=calibration.width_mm(request.position),
            speed_mm_s=SPEED_MIN_MM_S + request.speed / COUNTS_MAX * (SPEED_MAX_MM_S - SPEED_MIN_MM_S),
            force_n=FORCE_MIN_N + request.force / COUNTS_MAX * (FORCE_MAX_N - FORCE_MIN_N),
            request=request,
            clipped=tuple(clipped),
        )

    async def _read(self, *, again: bool = False) -> tuple[Readout, int]:
        async with self._exchange:
            t_ns = self._clock_ns()
            standing, self._standing = self._standing, None
            try:
                if again and standing is not None:
                    readout = await self._client.read_again(standing)
                else:
                    readout = await self._client.read()
            except DriverError as error:
                self._note_loss(error)
                raise
            if readout is not standing:
                self._whole_ns = t_ns
            return readout, t_ns

    async def _write(self, request: Request) -> None:
        async with self._exchange:
            self._standing = None
            try:
                await self._client.write(request)
            except DriverError as error:
                self._note_loss(error)
                raise

    def _note_loss(self, error: DriverError) -> None:
        if self.connected:
            # Whichever call meets a loss, `states` tells it.
            self._loss = error
        self.connected, self.latest = False, None

    def _state(self, readout: Readout, t_ns: int) -> GripperState:
        state = GripperState(
            t_ns=t_ns,
            seq=self._seq,
            position_counts=readout.pos,
            target_counts=readout.pre,
            width_mm=self._calibration.width_mm(readout.pos),
            width_std_mm=self._calibration.width_std_mm,
            object=object_status(readout, self._last_request),
            activation=readout.sta,
            current_ma=None if readout.current is None else readout.current * MA_PER_COUNT,
            current_t_ns=self._whole_ns,
            fault=fault_of(readout.flt),
        )
        self._seq += 1
        return state


async def _whole(exchange: Coroutine[object, object, T]) -> T:
    """Return what an exchange does, which is not broken off with who waits for it: that would cost the connection."""
    return await asyncio.shield(asyncio.ensure_future(exchange))


def _clip(name: str, value: float, low: float, high: float, unit: str, clipped: list[str]) -> float:
    inside = min(max(value, low), high)
    if inside != value:
        clipped.append(f"The {name} of {value:g} {unit} was limited to {inside:g} {unit}.")
    return inside
