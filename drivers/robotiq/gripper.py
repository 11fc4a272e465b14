"""The gripper over either connection: widths, activation, motion, state, reconnection."""

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, TypeVar

import numpy as np

from shearloop.drivers.connection import Diagnostics, LinkMonitor
from shearloop.drivers.errors import DriverError
from shearloop.drivers.robotiq import messages
from shearloop.drivers.robotiq.models import COUNTS_MAX, MODELS, GripperModel
from shearloop.drivers.robotiq.requests import RequestWatch
from shearloop.drivers.robotiq.widths import WidthCalibration
from shearloop.timeouts import timeout

if TYPE_CHECKING:
    from shearloop.drivers.robotiq.modbus_client import ModbusClient
    from shearloop.drivers.robotiq.socket_client import SocketClient

T = TypeVar("T")
# Each of its calls has a deadline; DeviceLostError closes the connection.
RobotiqClient: TypeAlias = "SocketClient | ModbusClient"

# It is asked as the last act before a request that moves the fingers, and raises where they may not move any more.
Permit: TypeAlias = Callable[[], None]

POLL_S = 0.1
# Without a readout of `states` for this number of poll periods, a command reads by itself.
_POLLS_WAITED = 3
# The pause between reset and activation that Robotiq's own clients keep, and after which a reset is repeated.
PAUSE_NS = 500_000_000
RESET_DEADLINE_NS = 3_000_000_000
# The fingers open and close once; a real gripper takes two to four seconds.
ACTIVATION_DEADLINE_NS = 15_000_000_000
# The full stroke at the slowest speed takes 4.7 s.
MOTION_DEADLINE_NS = 10_000_000_000
# The position of standing fingers may waver by this.
STANDING_COUNTS = 2
_NO_COMMUNICATION = 9


def permitted() -> None:
    """Permit a motion."""


class _TimedReadout(NamedTuple):
    """A readout, and when it began."""

    readout: messages.Readout
    began_ns: int


@dataclass(eq=False)
class RobotiqGripper:
    """One gripper: a connection, not yet open, and the meaning of its counts.

    Commands and polling may come from different tasks. Each exchange with the gripper is completed, even if its caller
    is cancelled. A lost connection raises DeviceLostError in the call that finds it; `latest` is None until the next
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
    _requests: RequestWatch = field(default_factory=RequestWatch, init=False)
    _loss: DriverError | None = field(default=None, init=False)
    # The latest readout since the last request.
    _latest: _TimedReadout | None = field(default=None, init=False)
    _news: asyncio.Event = field(default_factory=asyncio.Event, init=False)
    # The furthest position of the latest motion over this connection, and whether it has opened the fingers.
    _position: int | None = field(default=None, init=False)
    _opened: bool | None = field(default=None, init=False)
    # The latest fault that an activation has to end: a reset alone hides it, and leaves a gripper that does not move.
    _owed: messages.GripperFault | None = field(default=None, init=False)

    @property
    def model(self) -> GripperModel:
        """The gripper's model, for the widths of the calibration."""
        return MODELS[self.calibration.model]

    def diagnostics(self) -> Diagnostics:
        """Return the gripper's part of `health`; counts are since the process began.

        An open connection is not enough: a gripper without power lets its socket be opened and answers nothing.
        """
        return {**self.monitor.diagnostics(connected=self.latest is not None), "states": self._seq}

    async def connect(self) -> messages.GripperState:
        """Open the connection and return the first state; DeviceNotFoundError or DeviceLostError."""
        await self._exchange(self.client.connect)
        self.connected, self._loss = True, None
        self._position, self._opened = None, None
        self._requests.on_connection()
        return await self.read()

    async def close(self) -> None:
        """Close the connection; the gripper keeps its grip."""
        async with self._lock:
            self.connected, self.latest, self._latest = False, None, None
            await self.client.close()

    async def read(self) -> messages.GripperState:
        """Return the gripper's present state; each value is of now."""
        self.latest = self._state(*await self._read(whole=True))
        return self.latest

    async def poll(self) -> messages.GripperState:
        """Return a state as `states` reads it: object and position are of now, the other values come in turn."""
        self.latest = self._state(*await self._read())
        return self.latest

    async def activate(
        self, *, operator_confirmed: bool = False, may_drop: bool = False, permit: Permit = permitted
    ) -> messages.GripperState:
        """Return the state of the active gripper; an inactive gripper opens and closes its fingers once.

        An object in the fingers drops then. So an inactive gripper, or one that is too hot, is activated only if an
        object `may_drop`. After a major fault the operator has to confirm that the fingers are clear.
        `operator_confirmed` activates in any state. `permit` is as in `move`. Raises GripperFaultError if the
        activation is refused or fails: GripperInactiveError or GripperTooHotError if the object is the reason.
        """
        readout, t_ns = await self._recent()
        fault = self._owed or messages.fault_of(readout.flt)
        if not operator_confirmed:
            if fault.needs_activation:
                raise messages.GripperFaultError(
                    f"{fault.sentence} An operator has to confirm that the fingers are clear."
                )
            if fault.too_hot and not may_drop:
                raise messages.GripperTooHotError(fault.sentence)
            if not (blocking := blocking_fault(readout)):
                return self._state(readout, t_ns)
            if not may_drop:
                raise messages.GripperInactiveError(blocking)
        await self._write(messages.GripperAction.RESET, permit)
        not_reset = "The gripper does not take the reset; check that nothing else commands it."
        await self._wait_until(
            lambda now: not now.act and now.sta is messages.ActivationStatus.RESET,
            RESET_DEADLINE_NS,
            not_reset,
            again=messages.GripperAction.RESET,
        )
        resume_ns = time.monotonic_ns() + PAUSE_NS
        await self._wait_until(lambda _: time.monotonic_ns() >= resume_ns, RESET_DEADLINE_NS, not_reset)
        # A rising edge of ACT, which also ends every fault.
        await self._write(messages.GripperAction.ACTIVATE, permit)
        return await self._wait_until(
            _is_active,
            ACTIVATION_DEADLINE_NS,
            "The gripper's activation does not end; clear the fingers and activate it again.",
        )

    async def move(self, command: messages.GripperCommand, permit: Permit = permitted) -> messages.GripperMove:
        """Start a motion, clipped to the limits, and return it as sent; `finish` waits for its end.

        `permit` is asked as the request is sent: what was read before may have taken any time. Raises its error,
        GripperRefusedError for a command that is not finite, GripperFaultError when the gripper would not move.
        """
        sent = self.request_of(command)
        readout, _ = await self._recent()
        if blocking := blocking_fault(readout):
            raise messages.GripperFaultError(blocking)
        await self._write(sent, permit)
        return sent

    async def finish(self, sent: messages.GripperMove) -> messages.GripperState:
        """Return the state at the end of the motion: at its target, or on an object."""

        def has_finished(readout: messages.Readout) -> bool:
            if self._requests.sent is not sent:
                raise messages.GripperRefusedError(
                    "Another command took over before the gripper had finished its motion."
                )
            if self._requests.overtaken:
                raise messages.GripperRefusedError(
                    "Another program commanded the gripper before it had finished its motion; end that program, or "
                    "leave the gripper to it."
                )
            if blocking := blocking_fault(readout):
                raise messages.GripperFaultError(blocking)
            return self._requests.carries_out(readout) and readout.obj is not messages.ObjectStatus.MOVING

        return await self._wait_until(
            has_finished,
            MOTION_DEADLINE_NS,
            "The gripper does not finish its motion; check that nothing else commands it.",
        )

    async def _wait_until(
        self,
        done: Callable[[messages.Readout], bool],
        deadline_ns: int,
        failure: str,
        again: messages.GripperAction | None = None,
    ) -> messages.GripperState:
        """Return the first state that is `done`; GripperFaultError after the deadline.

        `again` is a request that some grippers do not take at once, and that is repeated.
        """
        since_ns = next_ns = sent_ns = time.monotonic_ns()
        while True:
            readout, t_ns = await self._readout_after(next_ns)
            if done(readout):
                return self._state(readout, t_ns)
            if t_ns - since_ns > deadline_ns:
                raise messages.GripperFaultError(failure)
            if again is not None and t_ns - sent_ns > PAUSE_NS:
                await self._write(again)
                sent_ns = t_ns
            next_ns = t_ns + 1

    async def halt(self) -> None:
        """Stop the fingers where they are; they keep their grip. An activation is ended by a reset."""
        await self._write(messages.GripperAction.HALT)
        readout, _ = await self._read(whole=True)
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
            return await self.poll()
        if self._loss is not None:
            raise self._loss
        state = await self.connect()
        self.monitor.connected(f"The gripper answers at {self.client.name}.", time.monotonic_ns())
        return state

    def request_of(self, command: messages.GripperCommand) -> messages.GripperMove:
        """Return the request of a command, within this gripper's limits; GripperRefusedError if it is not finite."""
        if not all(map(math.isfinite, (command.width_mm, command.speed_mm_per_s, command.force_n))):
            raise messages.GripperRefusedError(
                f"{command} is no command: width, speed and force must be finite numbers."
            )
        return messages.GripperMove(
            self.calibration.counts(command.width_mm),
            round(float(np.interp(command.speed_mm_per_s, self.model.speed_mm_per_s, (0, COUNTS_MAX)))),
            round(float(np.interp(command.force_n, self.model.force_n, (0, COUNTS_MAX)))),
        )

    async def _read(self, *, whole: bool = False) -> _TimedReadout:
        self._latest = _TimedReadout(*await self._exchange(partial(self.client.read, whole=whole)))
        readout = self._latest.readout
        fault = messages.fault_of(readout.flt)
        if fault.needs_activation:
            self._owed = fault
        elif readout.sta is messages.ActivationStatus.ACTIVE:
            self._owed = None
        self._requests.take(*self._latest)
        self._follow(readout.pos)
        self._news.set()
        self._news.clear()
        return self._latest

    def _follow(self, position: int) -> None:
        """Note which way the fingers have moved; more counts are closer together."""
        if self._position is None:
            self._position = position
        # In the present direction each count is followed; the other way, more than standing fingers waver by.
        goes_on = position < self._position if self._opened else position > self._position
        if (self._opened is not None and goes_on) or abs(position - self._position) > STANDING_COUNTS:
            self._position, self._opened = position, position < self._position

    def take_as_open(self) -> None:
        """Take the fingers as opened where they stand: a release to this width has nothing to do."""
        self._opened = True

    async def _recent(self) -> _TimedReadout:
        """Return the latest readout where `states` keeps it fresh, else a new one: each delays the next state."""
        if self._latest is not None and time.monotonic_ns() - self._latest.began_ns < 2 * self.poll_s * 1e9:
            return self._latest
        return await self._read(whole=True)

    async def _readout_after(self, since_ns: int) -> _TimedReadout:
        """Return a readout of `states` that began at `since_ns` or later; one of its own where none comes."""
        with contextlib.suppress(TimeoutError):
            async with timeout(_POLLS_WAITED * self.poll_s):
                while self._latest is None or self._latest.began_ns < since_ns:
                    await self._news.wait()
                return self._latest
        return await self._read()

    async def _write(self, request: messages.Request, permit: Permit | None = None) -> None:
        """Send a request. One with a permit is not sent where its caller is cancelled before."""

        def before() -> None:
            if permit is not None:
                if sending.cancelled():
                    raise asyncio.CancelledError
                permit()
            self._note(request)

        sending = self._exchange(partial(self.client.write, request, before))
        await sending
        # A readout may have come before the write.
        self._latest = None

    def _note(self, request: messages.Request) -> None:
        """Expect a request's echo from here on."""
        self._latest, t_ns = None, time.monotonic_ns()
        if isinstance(request, messages.GripperMove):
            self._requests.on_move(request, t_ns)
            if self._position is not None and request.position > self._position:
                # A short closing may not be told from a wavering position.
                self._opened = False
        else:
            self._requests.on_action(t_ns)

    def _exchange(self, exchange: Callable[[], Awaitable[T]]) -> asyncio.Future[tuple[T, int]]:
        """Return an exchange's result and its beginning. It goes on when its caller is cancelled.

        Breaking it off would cost the connection.
        """
        task = asyncio.ensure_future(self._locked(exchange))
        # `states` reports a failure that comes after its caller was cancelled.
        task.add_done_callback(lambda done: done.cancelled() or done.exception())
        return asyncio.shield(task)

    async def _locked(self, exchange: Callable[[], Awaitable[T]]) -> tuple[T, int]:
        """Exclude other exchanges, and note a loss, which `states` reports."""
        async with self._lock:
            t_ns = time.monotonic_ns()
            try:
                return await exchange(), t_ns
            except DriverError as error:
                if self.connected:
                    self._loss = error
                self.connected, self.latest, self._latest = False, None, None
                raise

    def _state(self, readout: messages.Readout, t_ns: int) -> messages.GripperState:
        state = messages.GripperState(
            t_ns=t_ns,
            position_counts=readout.pos,
            width_mm=self.calibration.width_mm(readout.pos),
            width_std_mm=self.calibration.width_std_mm,
            object=self._requests.object_status(readout),
            activation=readout.sta,
            current_ma=None if readout.current is None else readout.current * messages.MA_PER_COUNT,
            fault=self._owed or messages.fault_of(readout.flt),
            requested_counts=readout.pre,
            others_requests=self._requests.others,
            opened=self._opened,
        )
        self._seq += 1
        return state


def _is_active(readout: messages.Readout) -> bool:
    # Lower faults are normal during an activation, as is a silence before it.
    if readout.act and readout.flt >= messages.OVER_TEMPERATURE_CODE and readout.flt != _NO_COMMUNICATION:
        raise messages.GripperFaultError(messages.fault_of(readout.flt).sentence)
    return readout.act and readout.sta is messages.ActivationStatus.ACTIVE


def blocking_fault(readout: messages.Readout) -> str:
    """Return why the gripper would not move now, as a sentence, or an empty string."""
    fault = messages.fault_of(readout.flt)
    if fault.needs_activation or fault.too_hot:
        return fault.sentence
    if readout.sta is messages.ActivationStatus.ACTIVATING:
        return messages.fault_of(5).sentence
    if not readout.act or readout.sta is not messages.ActivationStatus.ACTIVE:
        return messages.fault_of(7).sentence
    return ""
