"""Connections to devices: serial ports and TCP sockets in an asyncio loop, reopened after a loss.

Pseudo-terminals work like any other port. Protocols belong to the device's own module.
"""

import asyncio
import contextlib
import errno
import os
import select
import time
from abc import abstractmethod
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Protocol, Self, TypeAlias

import serial
from serial.tools import list_ports

from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError, DeviceUnavailableError, DriverError
from shearloop.timeouts import timeout
from shearloop.words import without_digits

DEFAULT_BAUD = 115_200
# The kernel keeps 4 kB for a pseudo-terminal and up to 64 kB for a USB port.
READ_BYTES = 65_536
# Then the loop has them; the rest waits in the kernel.
READS_PER_TURN = 8
# A read shorter than one kernel buffer has emptied the port.
SHORT_READ_BYTES = 4_000
WRITE_TIMEOUT_S, WRITE_PAUSE_S = 1.0, 0.01
CONNECT_TIMEOUT_S = 2.0
# A deadline that passed by more is one that this process slept through.
STOOD_STILL_S = 0.1
# A reader that waits looks at its port at this interval. If it has not found the port empty for longer than `AWAY_NS`,
# something kept it from reading, and what it finds may have waited. So may what the kernel delivers within that time
# afterwards.
LOOK_INTERVAL_S, AWAY_NS = 0.1, 200_000_000

# The values that a device or a task reports in `health`, by name.
Diagnostics: TypeAlias = Mapping[str, bool | int | float | str | Mapping[str, int] | None]


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes, and the time when all of them had arrived (monotonic, ns).

    `waited_since_ns`: the reader was away, and any of them may have arrived since this time; None if it was not away.
    """

    data: bytes
    t_arrival_ns: int
    waited_since_ns: int | None = None


def find_port(*, serial_number: str | None = None, path: str | os.PathLike[str] | None = None) -> str:
    """Return the path of the port with this USB serial number, or the given path if it exists.

    Raises DeviceNotFoundError, which lists the available ports.
    """
    if path is not None:
        if not os.path.exists(path):
            raise DeviceNotFoundError(f"There is no serial port {path}; {_available_ports()}.")
        return os.fspath(path)
    found = [port.device for port in list_ports.comports() if port.serial_number == serial_number]
    if not found:
        raise DeviceNotFoundError(f"No port has the USB serial number {serial_number}; {_available_ports()}.")
    if len(found) > 1:
        ports = " and ".join(sorted(found))
        raise DeviceNotFoundError(f"The USB serial number {serial_number} has the ports {ports}; name one by its path.")
    return str(found[0])


def _serial_number_at(path: str) -> str | None:
    """Return the USB serial number of the board at a path, None without one."""
    device = os.path.realpath(path)
    return next((port.serial_number for port in list_ports.comports() if port.device == device), None)


def _available_ports() -> str:
    ports = [
        f"{port.device} ({port.description}, serial number {port.serial_number})"
        for port in sorted(list_ports.comports())
        if port.serial_number
    ]
    return f"available: {', '.join(ports)}" if ports else "no USB serial port is plugged in"


class SerialPort(contextlib.AbstractContextManager["SerialPort", None]):
    """An open serial port: exclusive, eight bits, no parity, no flow control.

    A thread reads it. Even a non-blocking read of a terminal waits until a worker of the kernel has delivered its
    bytes, and on a busy computer that worker can wait for tenths of a second.

    Raises DeviceNotFoundError or DeviceUnavailableError if it cannot be opened.
    """

    def __init__(self, path: str, baud: int = DEFAULT_BAUD) -> None:
        self.path = path
        try:
            # An inter-byte timeout sets VMIN to 1, so that an empty read means a hang-up.
            self._serial = serial.Serial(path, baud, timeout=0, inter_byte_timeout=0, exclusive=True)
        except serial.SerialException as error:
            raise _open_error(path, error) from error
        self._descriptor: int = self._serial.fileno()
        # Readable once the port is to be closed; -1 afterwards.
        self._closing = os.eventfd(0)
        self._reader = ThreadPoolExecutor(1, f"read {path}")
        # What the thread's read will bring; None for nothing in time.
        self._arrival: asyncio.Future[Received | DeviceLostError | None] | None = None
        # When the thread last found the port empty, or opened it.
        self._empty_ns = time.monotonic_ns()
        # Since when bytes that arrive until `_waited_until_ns` may have waited.
        self._waited_since_ns, self._waited_until_ns = 0, -1

    def __exit__(self, *_: object) -> None:
        """Close the port."""
        self.close()

    def close(self) -> None:
        """Close the port, also if it is gone already."""
        if self._closing < 0:
            return
        # The thread ends first: the number of a closed descriptor may soon be another file's.
        os.eventfd_write(self._closing, 1)
        self._reader.shutdown()
        os.close(self._closing)
        self._closing = -1
        with contextlib.suppress(OSError):
            self._serial.close()

    async def read(self, timeout_s: float) -> Received | None:
        """Return arrived bytes, or None after `timeout_s`; a cancelled read loses nothing.

        Raises DeviceLostError if the port is gone.
        """
        if self._arrival is None:
            until_s = time.monotonic() + timeout_s
            self._arrival = asyncio.get_running_loop().run_in_executor(self._reader, self._receive, until_s)
        await asyncio.wait({self._arrival})
        result, self._arrival = self._arrival.result(), None
        if isinstance(result, DeviceLostError):
            raise result
        return result

    def _receive(self, until_s: float) -> Received | DeviceLostError | None:
        """Return what has arrived, or the loss, in the thread; None for neither and when the port is to be closed."""
        ready = select.poll()
        ready.register(self._descriptor, select.POLLIN)
        ready.register(self._closing, select.POLLIN)
        result = None
        while result is None:
            now_ns = time.monotonic_ns()
            found = ready.poll(0)
            if not found:
                self._empty_ns = now_ns
                left_s = until_s - time.monotonic()
                # A late thread has looked once more.
                if left_s <= 0:
                    break
                found = ready.poll(1e3 * min(left_s, LOOK_INTERVAL_S))
            if any(descriptor == self._closing for descriptor, _ in found):
                break
            if found:
                result = self._drain()
        return result

    def _drain(self) -> Received | DeviceLostError | None:
        """Return what has arrived, or the loss; None for neither."""
        parts: list[bytes] = []
        now_ns = empty_ns = self._empty_ns
        try:
            while len(parts) < READS_PER_TURN and (not parts or len(parts[-1]) >= SHORT_READ_BYTES):
                now_ns = time.monotonic_ns()
                parts.append(os.read(self._descriptor, READ_BYTES))
        except OSError as error:
            # Bytes before a hang-up come first; the next read meets the hang-up again.
            if not parts:
                return None if isinstance(error, BlockingIOError) else self._lost(error.strerror)
        data = b"".join(parts)
        if not data:
            return self._lost("hung up")
        if len(parts[-1]) < SHORT_READ_BYTES:
            self._empty_ns = now_ns
        arrival_ns = time.monotonic_ns()
        if arrival_ns - empty_ns > AWAY_NS:
            self._waited_since_ns, self._waited_until_ns = empty_ns, arrival_ns + AWAY_NS
        waited = arrival_ns <= self._waited_until_ns
        return Received(data, arrival_ns, self._waited_since_ns if waited else None)

    async def write(self, data: bytes) -> None:
        """Write all of `data`; DeviceLostError if the port is gone or accepts nothing for a second."""
        try:
            async with timeout(WRITE_TIMEOUT_S):
                while data:
                    try:
                        data = data[os.write(self._descriptor, data) :]
                    except BlockingIOError:
                        await asyncio.sleep(WRITE_PAUSE_S)
        except TimeoutError as error:
            raise DeviceLostError(f"{self.path} takes no bytes any more; unplug the device and plug it in.") from error
        except OSError as error:
            raise self._lost(error.strerror) from error

    def _lost(self, reason: str | None) -> DeviceLostError:
        return DeviceLostError(f"{self.path} has gone ({reason}): unplugged, or without power.")


def _open_error(path: str, error: serial.SerialException) -> DriverError:
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO | errno.EIO:
            return DeviceNotFoundError(f"There is no serial port {path}; {_available_ports()}.")
        case errno.EACCES | errno.EPERM:
            return DeviceUnavailableError(f"This user may not open {path}; `shearloop ports` names the cure.")
        case errno.EAGAIN | errno.EBUSY:
            return DeviceUnavailableError(f"{path} is in use by another program; close that first.")
    return DeviceUnavailableError(f"{path} cannot be opened as a serial port: {error}.")


class TcpPort:
    """A TCP connection to a device."""

    def __init__(self, path: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.path = path
        self._reader = reader
        self._writer = writer

    @classmethod
    async def connect(cls, host: str, port: int) -> Self:
        """Return a new connection; OSError, also for a timeout, where nothing answers."""
        async with timeout(CONNECT_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(host, port)
        return cls(f"{host}:{port}", reader, writer)

    async def read(self, timeout_s: float) -> Received | None:
        """Return arrived bytes, or None after `timeout_s`; DeviceLostError if the other side is gone."""
        began_s, left_s = time.monotonic(), timeout_s
        for _ in range(2):
            # Twice: when this process stood still, bytes may have arrived together with the deadline.
            try:
                async with timeout(left_s):
                    data = await self._reader.read(READ_BYTES)
                    break
            except TimeoutError:
                # It did not wait meanwhile, so that it waits once more.
                stood_still = time.monotonic() - began_s > timeout_s + STOOD_STILL_S
                left_s = timeout_s if stood_still else 0.0
            except OSError as error:
                raise self._lost(error) from error
        else:
            return None
        if not data:
            raise DeviceLostError(f"{self.path} has closed the connection; see whether the device is still on.")
        return Received(data, time.monotonic_ns())

    async def write(self, data: bytes) -> None:
        """Write all of `data`; DeviceLostError if the other side is gone or accepts nothing for a second."""
        try:
            async with timeout(WRITE_TIMEOUT_S):
                self._writer.write(data)
                await self._writer.drain()
        except TimeoutError as error:
            raise DeviceLostError(f"{self.path} takes no bytes any more; switch the device off and on.") from error
        except OSError as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Drop the connection and all unsent bytes."""
        # close() would wait for bytes to a peer that may be gone.
        self._writer.transport.abort()

    def _lost(self, error: OSError) -> DeviceLostError:
        return DeviceLostError(f"The connection to {self.path} broke ({error.strerror or error}).")


# An open port; its `read` and `write` raise DeviceLostError if the device is gone.
Port: TypeAlias = SerialPort | TcpPort


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """A port was opened (`up`), lost or not found; `repeated` events are for the debug log."""

    up: bool
    sentence: str
    repeated: bool


class LinkObserver(Protocol):
    """Receives the changes of a link."""

    def on_link_event(self, event: LinkEvent) -> None:
        """React to a change at once; never blocks."""

    def on_refusal(self, sentence: str) -> None:
        """Take the first refused data of a connection, which goes on; never blocks."""


class LinkMonitor:
    """Counts a device's connections, reports each change, and spaces the attempts. No I/O.

    The pauses are `first_s`, then twice as long each time, up to `longest_s`. `latest` is the last event.
    """

    def __init__(self, observer: LinkObserver | None = None, first_s: float = 0.2, longest_s: float = 5.0) -> None:
        self._observer = observer
        self._first_s = first_s
        self._longest_s = longest_s
        self._failures = 0
        self._connected_ns: int | None = None
        self._connections = 0
        self._last_error = ""
        self._told_refusal = False
        self.latest = LinkEvent(up=False, sentence="It has not been connected yet.", repeated=False)

    def connected(self, sentence: str, now_ns: int) -> None:
        """Note a new connection."""
        self._connected_ns = now_ns
        self._connections += 1
        self._told_refusal = False
        self._notify(LinkEvent(up=True, sentence=sentence, repeated=False))

    def failed(self, error: DriverError, now_ns: int) -> float:
        """Note a failed attempt or a lost connection; return the pause before the next attempt in s.

        A connection shorter than the longest pause counts as a further failure, so a flapping device is not reopened
        five times a second.
        """
        if self._connected_ns is not None and now_ns - self._connected_ns >= self._longest_s * 1e9:
            self._failures = 0
        self._connected_ns = None
        before, self._last_error = self._last_error, str(error)
        # A different error is news even without a pause in between.
        repeated = self._failures > 0 and without_digits(before) == without_digits(self._last_error)
        pause_s = min(self._first_s * 2.0 ** min(self._failures, 32), self._longest_s)
        self._failures += 1
        self._notify(LinkEvent(up=False, sentence=self._last_error, repeated=repeated))
        return pause_s

    def noted(self, sentence: str) -> None:
        """Report what a device says by itself."""
        if self._observer is not None:
            self._observer.on_refusal(sentence)

    def refused(self, sentence: str) -> None:
        """Note refused data, and report the first of each connection; later ones are counted by the driver."""
        if self._observer is not None and not self._told_refusal:
            self._observer.on_refusal(sentence)
        self._told_refusal = True

    def diagnostics(self, *, connected: bool) -> dict[str, bool | int | str]:
        """Return the connection's part of `health`; counts are since the process began."""
        return {"connected": connected, "connections": self._connections, "last_loss": self._last_error}

    def _notify(self, event: LinkEvent) -> None:
        self.latest = event
        if self._observer is not None:
            self._observer.on_link_event(event)


@dataclass(eq=False, kw_only=True)
class Link(contextlib.AbstractContextManager["Link", None]):
    """Keeps a device connected: finds it, opens it, and reopens it after a loss.

    Use it as a context, which closes the port at the end. `port` is the open port or None.
    """

    monitor: LinkMonitor = field(default_factory=LinkMonitor)
    port: Port | None = field(default=None, init=False)

    @abstractmethod
    async def _connect(self) -> Port:
        """Open the port once; DriverError if that fails."""

    def __exit__(self, *_: object) -> None:
        """Close the port."""
        self._close()

    def diagnostics(self) -> dict[str, bool | int | str]:
        """Return the connection's part of `health`."""
        return self.monitor.diagnostics(connected=self.port is not None)

    async def open_once(self) -> Port:
        """Open the port and return it; DriverError if that fails."""
        self.port = await self._connect()
        return self.port

    async def open(self) -> Port:
        """Return the open port; waits until the device is there."""
        while self.port is None:
            try:
                port = await self.open_once()
            except DriverError as error:
                await self.lost(error)
            else:
                self.monitor.connected(f"{port.path} is open.", time.monotonic_ns())
        return self.port

    async def lost(self, error: DriverError) -> None:
        """Close the port, report the error, and pause before the next attempt."""
        await asyncio.sleep(self.give_up(error))

    def give_up(self, error: DriverError) -> float:
        """Close the port and report the error; return the pause before the next attempt in s."""
        self._close()
        return self.monitor.failed(error, time.monotonic_ns())

    def _close(self) -> None:
        if self.port is not None:
            self.port.close()
            self.port = None


@dataclass(eq=False, kw_only=True)
class SerialLink(Link):
    """Keeps a serial device connected, named by its USB serial number or the path of its port."""

    serial_number: str | None = None
    path: str | os.PathLike[str] | None = None
    baud: int = DEFAULT_BAUD
    # The USB serial number of the first board, None while none with a number was there.
    _first: str | None = field(default=None, init=False)

    async def _connect(self) -> Port:
        path = find_port(serial_number=self.serial_number, path=self.path)
        number = _serial_number_at(path)
        if self._first is not None and number not in (self._first, None):
            raise DeviceUnavailableError(
                f"Another board is at {path}: its USB serial number is {number}, and that of the first one was "
                f"{self._first}. Plug each board in where it was, or restart the daemon."
            )
        self._first = self._first or number
        return SerialPort(path, self.baud)
