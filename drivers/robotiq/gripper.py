"""The gripper: activation, motion, state, reconnection, over either connection."""

import asyncio
import math
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager
from typing import TypeVar

from shearloop.drivers.connection import LinkEvent, ReconnectPolicy
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq import messages
from shearloop.drivers.robotiq.width import COUNTS_MAX, WidthCalibration

T = TypeVar("T")

POLL_S = 0.1
# The pause between reset and activation that Robotiq's own clients keep.
PAUSE_NS = 500_000_000
RESET_DEADLINE_NS = 3_000_000_000
# The fingers open and close once; a real gripper takes two to four seconds.
ACTIVATION_DEADLINE_NS = 15_000_000_000
# The full stroke at the slowest speed takes 4.7 s.
MOTION_DEADLINE_NS = 10_000_000_000
_OVER_TEMPERATURE, _NO_COMMUNICATION = 8, 9


class RobotiqGripper:
    """One gripper.

    Commands and polling may come from different tasks. Each exchange with the gripper is whole, also when its caller
    is cancelled. A lost connection raises DeviceLostError in the call that meets it; `latest` is None until the next
    read.
    """

    def __init__(
        self,
        client: messages.GripperClient,
        calibration: WidthCalibration,
        *,
        poll_s: float = POLL_S,
        policy: ReconnectPolicy | None = None,
        on_event: Callable[[LinkEvent], None] = lambda _: None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Take a connection and the meaning of its counts; nothing is opened yet."""
        self._client = client
        self._calibration = calibration
        self._poll_s = poll_s
        self._policy = policy or ReconnectPolicy()
        self._on_event = on_event
        self._clock_ns = clock_ns
        self._lock = asyncio.Lock()
        self._seq = 0
        self._last_move: messages.GripperMove | None = None
        self._connections = 0
        self._loss: DriverError | None = None
        self.connected = False
        self.last_error = ""
        self.latest: messages.GripperState | None = None

    def diagnostics(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return the gripper's part of `health`; counts are since the process began."""
        return {
            "connected": self.connected,
            "states": self._seq,
            "connections": self._connections,
            "last_loss": self.last_error,
        }

    async def connect(self) -> messages.GripperState:
        """Open the connection and return the first state; DeviceNotFoundError or DeviceLostError."""
        await self._client.connect()
        self._connections += 1
        self.connected, self._loss = True, None
        # Another program may have commanded the gripper since.
        self._last_move = None
        return await self.read()

    async def close(self) -> None:
        """Close the connection; the gripper keeps its grip."""
        self.connected, self.latest = False, None
        await self._client.close()

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
        readout, t_ns = await _uninterrupted(self._read())
        fault = messages.fault_of(readout.flt)
        if not operator_confirmed:
            if fault.needs_activation:
                raise messages.GripperFaultError(
                    f"{fault.sentence} An operator has to confirm that the fingers are clear."
                )
            if not blocking_fault(readout):
                return self._state(readout, t_ns)
        self._last_move = None
        await _uninterrupted(self._write(messages.Reset()))
        not_reset = "The gripper does not take the reset; check that nothing else commands it."
        await self._wait_until(
            lambda now: not now.act and now.sta is messages.ActivationStatus.RESET, RESET_DEADLINE_NS, not_reset
        )
        resume_ns = self._clock_ns() + PAUSE_NS
        await self._wait_until(lambda _: self._clock_ns() >= resume_ns, RESET_DEADLINE_NS, not_reset)
        # A rising edge of ACT, which also ends every fault.
        await _uninterrupted(self._write(messages.Activate()))
        return await self._wait_until(
            _is_active,
            ACTIVATION_DEADLINE_NS,
            "The gripper's activation does not end; clear the fingers and activate it again.",
        )

    async def move(self, command: messages.GripperCommand) -> messages.SentCommand:
        """Start a motion and return the command as sent; `finish` waits for its end.

        Raises GripperRefusedError for a command that is not finite, GripperFaultError when the gripper would not move.
        """
        sent = self.clip(command)
        readout, _ = await _uninterrupted(self._read())
        if blocking := blocking_fault(readout):
            raise messages.GripperFaultError(blocking)
        self._last_move = sent.request
        await _uninterrupted(self._write(sent.request))
        return sent

    async def finish(self, sent: messages.SentCommand) -> messages.GripperState:
        """Return the state at the end of the motion: at its target, or on an object."""

        def has_finished(readout: messages.Readout) -> bool:
            if self._last_move is not sent.request:
                raise messages.GripperRefusedError(
                    "Another command took over before the gripper had finished its motion."
                )
            if blocking := blocking_fault(readout):
                raise messages.GripperFaultError(blocking)
            return object_status(readout, sent.request) is not messages.ObjectStatus.MOVING

        return await self._wait_until(
            has_finished,
            MOTION_DEADLINE_NS,
            "The gripper does not finish its motion; check that nothing else commands it.",
        )

    async def _wait_until(
        self, done: Callable[[messages.Readout], bool], deadline_ns: int, failure: str
    ) -> messages.GripperState:
        """Return the first state that is `done`; GripperFaultError after the deadline."""
        since_ns = self._clock_ns()
        while True:
            readout, t_ns = await _uninterrupted(self._read())
            if done(readout):
                return self._state(readout, t_ns)
            if t_ns - since_ns > deadline_ns:
                raise messages.GripperFaultError(failure)
            await asyncio.sleep(self._poll_s)

    async def halt(self) -> None:
        """Stop the fingers where they are; they keep their grip. An activation is ended by a reset."""
        self._last_move = None
        await _uninterrupted(self._write(messages.GripperHalt()))
        readout, _ = await _uninterrupted(self._read())
        if readout.sta is messages.ActivationStatus.ACTIVATING:
            await _uninterrupted(self._write(messages.Reset()))

    async def states(self) -> AsyncGenerator[messages.GripperState]:
        """Yield a state every poll period and reconnect after losses, for ever.

        Iterate within `contextlib.aclosing`, which closes the connection at the end.
        """
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        try:
            while True:
                # A missed period is skipped.
                due_s = max(due_s + self._poll_s, loop.time())
                try:
                    state = await self._next_state()
                except DriverError as error:
                    await self._wait_after(error)
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
        self._policy.connected(time.monotonic_ns())
        self._on_event(LinkEvent(up=True, sentence=f"The gripper answers at {self._client.name}.", repeated=False))
        return state

    async def _wait_after(self, error: DriverError) -> None:
        await self.close()
        self._loss = None
        self.last_error = str(error)
        retry = self._policy.failed(time.monotonic_ns())
        self._on_event(LinkEvent(up=False, sentence=self.last_error, repeated=retry.repeated))
        await asyncio.sleep(retry.wait_s)

    def clip(self, command: messages.GripperCommand) -> messages.SentCommand:
        """Return the command clipped to this gripper's limits and rounded to counts."""
        if not all(map(math.isfinite, (command.width_mm, command.speed_mm_s, command.force_n))):
            raise messages.GripperRefusedError(
                f"{command} is no command: width, speed and force must be finite numbers."
            )
        clipped: list[str] = []
        calibration = self._calibration
        narrowest_mm, widest_mm = calibration.width_mm(COUNTS_MAX), calibration.width_mm(0)
        width_mm = _clip("width", command.width_mm, narrowest_mm, widest_mm, "mm", clipped)
        speed_mm_s = _clip(
            "speed", command.speed_mm_s, messages.SPEED_MIN_MM_S, messages.SPEED_MAX_MM_S, "mm/s", clipped
        )
        force_n = _clip("force", command.force_n, messages.FORCE_MIN_N, messages.FORCE_MAX_N, "N", clipped)
        request = messages.GripperMove(
            calibration.counts(width_mm),
            round(
                (speed_mm_s - messages.SPEED_MIN_MM_S)
                / (messages.SPEED_MAX_MM_S - messages.SPEED_MIN_MM_S)
                * COUNTS_MAX
            ),
            round((force_n - messages.FORCE_MIN_N) / (messages.FORCE_MAX_N - messages.FORCE_MIN_N) * COUNTS_MAX),
        )
        return messages.SentCommand(
            width_mm=calibration.width_mm(request.position),
            speed_mm_s=messages.SPEED_MIN_MM_S
            + request.speed / COUNTS_MAX * (messages.SPEED_MAX_MM_S - messages.SPEED_MIN_MM_S),
            force_n=messages.FORCE_MIN_N + request.force / COUNTS_MAX * (messages.FORCE_MAX_N - messages.FORCE_MIN_N),
            request=request,
            clipped=tuple(clipped),
        )

    async def _read(self) -> tuple[messages.Readout, int]:
        async with self._exchange():
            t_ns = self._clock_ns()
            return await self._client.read(), t_ns

    async def _write(self, request: messages.Request) -> None:
        async with self._exchange():
            await self._client.write(request)

    @asynccontextmanager
    async def _exchange(self) -> AsyncIterator[None]:
        """Exclude other exchanges, and note a loss, which `states` reports."""
        async with self._lock:
            try:
                yield
            except DriverError as error:
                if self.connected:
                    self._loss = error
                self.connected, self.latest = False, None
                raise

    def _state(self, readout: messages.Readout, t_ns: int) -> messages.GripperState:
        state = messages.GripperState(
            t_ns=t_ns,
            seq=self._seq,
            position_counts=readout.pos,
            target_counts=readout.pre,
            width_mm=self._calibration.width_mm(readout.pos),
            width_std_mm=self._calibration.width_std_mm,
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


async def _uninterrupted(exchange: Coroutine[object, object, T]) -> T:
    """Await an exchange that goes on when its caller is cancelled: breaking it off would cost the connection."""
    task = asyncio.ensure_future(exchange)
    # `states` reports a failure that comes after its caller was cancelled.
    task.add_done_callback(lambda done: done.cancelled() or done.exception())
    return await asyncio.shield(task)


def _clip(name: str, value: float, low: float, high: float, unit: str, clipped: list[str]) -> float:
    inside = min(max(value, low), high)
    if inside != value:
        clipped.append(f"The {name} of {value:g} {unit} was limited to {inside:g} {unit}.")
    return inside
