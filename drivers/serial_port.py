"""Serial ports in an asyncio loop: found by USB serial number or path, opened again when they come back. No thread.

A pseudo-terminal is a port like any other. What a device says over its port is its own module's business.
"""

import asyncio
import contextlib
import errno
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import serial
from serial.tools import list_ports

from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, DeviceUnavailableError, DriverError

DEFAULT_BAUD = 115_200
# One read takes what the kernel keeps for a port (4 kB for a pseudo-terminal, 64 kB at most for a USB port); after
# this much the other tasks have their turn, and the rest waits in the kernel.
READ_BYTES = 65_536
READS_AT_ONCE = 8
# A read that gives less than the kernel hands over at once gave all that there was.
SHORT_READ_BYTES = 4_000
# Commands to these devices are a few bytes long; a larger write is a mistake of ours.
LONGEST_WRITE_BYTES = 4_096
WRITE_TIMEOUT_S = 1.0


def find_port(*, serial_number: str | None = None, path: str | None = None) -> str:
    """Return the path of the port with this USB serial number, or the given path if there is something there.

    Raises DeviceNotFoundError, which lists the ports that there are.
    """
    if (serial_number is None) == (path is None):
        raise ValueError("a port is named either by its USB serial number or by its path")
    if path is not None:
        if not os.path.exists(path):
            raise DeviceNotFoundError(f"There is no serial port {path}; {_ports_there_are()}.")
        return path
    found = [port.device for port in list_ports.comports() if port.serial_number == serial_number]
    if not found:
        raise DeviceNotFoundError(f"No port with the USB serial number {serial_number} is there; {_ports_there_are()}.")
    if len(found) > 1:
        ports = " and ".join(sorted(found))
        raise DeviceNotFoundError(f"The USB serial number {serial_number} has the ports {ports}; name one by its path.")
    return str(found[0])


def _ports_there_are() -> str:
    ports = [
        f"{port.device} ({port.description}, serial number {port.serial_number})"
        for port in sorted(list_ports.comports())
        if port.serial_number
    ]
    return f"there are {', '.join(ports)}" if ports else "no USB serial port is plugged in"


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes, and when (monotonic, ns) all of them had arrived."""

    data: bytes
    t_arrival_ns: int


class SerialPort:
    """An open port: non-blocking, exclusive, eight bits, no parity, no flow control.

    Raises DeviceNotFoundError or DeviceUnavailableError when it cannot be opened.
    """

    def __init__(self, path: str, baud: int = DEFAULT_BAUD) -> None:
        self.path = path
        try:
            # An inter-byte timeout sets VMIN to 1: a read without data is then told from a hang-up.
            self._serial = serial.Serial(path, baud, timeout=0, inter_byte_timeout=0, exclusive=True)
        except serial.SerialException as error:
            raise _cannot_open(path, error) from error
        self._descriptor: int = self._serial.fileno()
        self._read: Received | DeviceLostError | None = None
        # The loop that tells when something has come, while it does, and what ends the wait for it.
        self._listening: asyncio.AbstractEventLoop | None = None
        self._over: asyncio.Future[None] | None = None

    def __enter__(self) -> Self:
        """Return the port itself, open."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port."""
        self.close()

    def close(self) -> None:
        """Give the port back; it may be gone already."""
        self._listen_no_more()
        with contextlib.suppress(OSError):
            self._serial.close()

    async def read(self, timeout_s: float) -> Received | None:
        """Return what has arrived, or None after a silence of `timeout_s`; a cancelled read loses nothing.

        Raises DeviceLostError when the port has gone.
        """
        if self._read is None:
            # Always by way of the loop: a device that never pauses must not keep the other tasks from running.
            await self._readable(timeout_s)
        if self._read is None:
            # The loop itself may have been late: silent is only what has nothing to read now.
            self._drain()
        result, self._read = self._read, None
        if isinstance(result, DeviceLostError):
            raise result
        return result

    async def _readable(self, timeout_s: float) -> None:
        """Wait until something was read, but no longer; a future and a timer, for every frame comes this way."""
        loop = asyncio.get_running_loop()
        if self._listening is not loop:
            self._listen_no_more()
            loop.add_reader(self._descriptor, self._arrived)
            self._listening = loop
        self._over = loop.create_future()
        timer = loop.call_later(timeout_s, self._end)
        try:
            await self._over
        finally:
            timer.cancel()
            self._over = None

    def _arrived(self) -> None:
        if self._over is None or self._over.done():
            # Nobody waits for it, and it is not read before: it stays in the kernel, and the loop is not told again.
            self._listen_no_more()
            return
        # Here rather than in the task, which runs later: the arrival is stamped as early as can be.
        self._drain()
        self._end()

    def _end(self) -> None:
        if self._over is not None and not self._over.done():
            self._over.set_result(None)

    def _listen_no_more(self) -> None:
        if self._listening is not None and not self._listening.is_closed():
            self._listening.remove_reader(self._descriptor)
        self._listening = None

    def _drain(self) -> None:
        parts: list[bytes] = []
        lost: DeviceLostError | None = None
        for _ in range(READS_AT_ONCE):
            try:
                part = os.read(self._descriptor, READ_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                lost = self._lost(error.strerror)
                break
            if not part:
                lost = self._lost("hung up")
                break
            parts.append(part)
            if len(part) < SHORT_READ_BYTES:
                break
        # What came before a hang-up is given first; the next read meets the hang-up again.
        self._read = Received(b"".join(parts), time.monotonic_ns()) if parts else lost

    async def write(self, data: bytes) -> None:
        """Write all of `data`; raises DeviceLostError when the port has gone or takes nothing for a second."""
        if len(data) > LONGEST_WRITE_BYTES:
            raise ValueError(f"{len(data)} bytes in one write; at most {LONGEST_WRITE_BYTES} are meant to be")
        try:
            async with asyncio.timeout(WRITE_TIMEOUT_S):
                while data:
                    try:
                        data = data[os.write(self._descriptor, data) :]
                    except BlockingIOError:
                        await self._writable()
        except TimeoutError as error:
            raise DeviceLostError(f"{self.path} takes no bytes any more; unplug the device and plug it in.") from error
        except OSError as error:
            raise self._lost(error.strerror) from error

    async def _writable(self) -> None:
        loop = asyncio.get_running_loop()
        writable = asyncio.Event()
        loop.add_writer(self._descriptor, writable.set)
        try:
            await writable.wait()
        finally:
            loop.remove_writer(self._descriptor)

    def _lost(self, why: str | None) -> DeviceLostError:
        return DeviceLostError(f"{self.path} has gone ({why}): unplugged, or without power.")


def _cannot_open(path: str, error: serial.SerialException) -> DriverError:
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO | errno.EIO:
            return DeviceNotFoundError(f"There is no serial port {path}; {_ports_there_are()}.")
        case errno.EACCES | errno.EPERM:
            return DeviceUnavailableError(f"{path} may not be opened by this user; add the user to the port's group.")
        case errno.EAGAIN | errno.EBUSY:
            return DeviceUnavailableError(f"{path} is in use by another program; close that first.")
    return DeviceUnavailableError(f"{path} cannot be opened as a serial port: {error}.")


@dataclass(frozen=True, slots=True)
class Retry:
    """When to try again, and whether this failure follows another one (and need not be told again)."""

    wait_s: float
    repeated: bool


class ReconnectPolicy:
    """How long to wait before the next attempt: `first_s`, then twice as long each time, up to `longest_s`. No I/O."""

    def __init__(self, first_s: float = 0.2, longest_s: float = 5.0) -> None:
        self._first_s = first_s
        self._longest_s = longest_s
        self._failures = 0
        self._connected_ns: int | None = None

    def connected(self, now_ns: int) -> None:
        """Note that the device is there."""
        self._connected_ns = now_ns

    def failed(self, now_ns: int) -> Retry:
        """Return what to do after a failed attempt or a lost connection.

        A connection that held for less than the longest wait counts as a further failure: a device that comes and goes
        is not opened five times a second for ever.
        """
        if self._connected_ns is not None and now_ns - self._connected_ns >= self._longest_s * 1e9:
            self._failures = 0
        self._connected_ns = None
        retry = Retry(min(self._first_s * 2.0 ** min(self._failures, 32), self._longest_s), self._failures > 0)
        self._failures += 1
        return retry


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """A port was opened (`up`) or lost or not found; `repeated` ones say it once more, for the debug log only."""

    up: bool
    sentence: str
    repeated: bool


class Port(Protocol):
    """What a device is reached through once it is open: a serial port, or a connection that behaves like one."""

    @property
    def path(self) -> str:
        """What it is called in sentences."""

    async def read(self, timeout_s: float) -> Received | None:
        """Return what has arrived, or None after a silence; DeviceLostError when it has gone."""

    async def write(self, data: bytes) -> None:
        """Write all of `data`; DeviceLostError when it has gone."""

    def close(self) -> None:
        """Give it back; it may be gone already."""


class Link(ABC):
    """Keeps a device connected: finds it, opens it, and does so again after it was lost.

    Use it as a context, which closes the port at the end. `port` is the open port or None; `openings` and `last_error`
    are for health, and `on_event` hears of each change.
    """

    def __init__(
        self, *, policy: ReconnectPolicy | None = None, on_event: Callable[[LinkEvent], None] = lambda _: None
    ) -> None:
        self._policy = policy or ReconnectPolicy()
        self._on_event = on_event
        self.port: Port | None = None
        self.openings = 0
        self.last_error = ""

    @abstractmethod
    async def _connect(self) -> Port:
        """Open the port once; DriverError when it cannot be."""

    def __enter__(self) -> Self:
        """Return the link itself; nothing is opened yet."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the port, if it is open."""
        self._close()

    async def open(self) -> Port:
        """Return the open port, waiting for the device for as long as it takes."""
        while self.port is None:
            try:
                self.port = await self._connect()
            except DriverError as error:
                await self.lost(error)
            else:
                self.openings += 1
                self._policy.connected(time.monotonic_ns())
                self._on_event(LinkEvent(up=True, sentence=f"{self.port.path} is open.", repeated=False))
        return self.port

    async def lost(self, error: DriverError) -> None:
        """Close the port for the reason given, and wait for as long as is sensible before it is opened again."""
        await asyncio.sleep(self.given_up(error).wait_s)

    def given_up(self, error: DriverError) -> Retry:
        """Close the port for the reason given, and tell it; return when it might be tried again."""
        self._close()
        before, self.last_error = self.last_error, str(error)
        retry = self._policy.failed(time.monotonic_ns())
        # Another reason is news, even if it came with no rest in between.
        repeated = retry.repeated and _without_numbers(before) == _without_numbers(self.last_error)
        self._on_event(LinkEvent(up=False, sentence=self.last_error, repeated=repeated))
        return retry

    def _close(self) -> None:
        if self.port is not None:
            self.port.close()
            self.port = None


def _without_numbers(sentence: str) -> str:
    return "".join(letter for letter in sentence if not letter.isdigit())


class SerialLink(Link):
    """Keeps a serial device connected, named by its USB serial number or by the path of its port."""

    def __init__(
        self,
        *,
        serial_number: str | None = None,
        path: str | None = None,
        baud: int = DEFAULT_BAUD,
        policy: ReconnectPolicy | None = None,
        on_event: Callable[[LinkEvent], None] = lambda _: None,
    ) -> None:
        if (serial_number is None) == (path is None):
            raise ValueError("a device is named either by its USB serial number or by its path")
        super().__init__(policy=policy, on_event=on_event)
        self._serial_number = serial_number
        self._path = path
        self._baud = baud

    async def _connect(self) -> Port:
        return SerialPort(find_port(serial_number=self._serial_number, path=self._path), self._baud)
