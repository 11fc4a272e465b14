"""A board on a serial port and the parser of what it says: kept connected, whatever becomes of the board."""

import time
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from typing import Generic, TypeVar

from shearloop.drivers.errors import DriverError
from shearloop.drivers.raw_event import InputKind, RawEvent, Tap
from shearloop.drivers.serial_port import Link, Port, Received

ValueT = TypeVar("ValueT")


class SerialSensor(ABC, Generic[ValueT]):
    """One board behind a link, and the parser that is told all that happens to it."""

    def __init__(self, link: Link, take: Callable[[RawEvent], Sequence[ValueT]], tap: Tap) -> None:
        """Take the link and the parser; nothing is opened yet. `tap` hears of all that the parser is told."""
        self._link = link
        self._take = take
        self._tap = tap

    async def values(self) -> AsyncGenerator[ValueT]:
        """Yield what the parser makes of every line, in order and for ever, whatever becomes of the board meanwhile.

        While the receiver is busy nothing is read and nothing is lost: the bytes wait in the kernel, then on the board.
        Iterate within `contextlib.aclosing`, so that the port is closed when the iteration is left.
        """
        with self._link:
            while True:
                try:
                    received = await self._receive()
                except DriverError as error:
                    await self._link.lost(error)
                    continue
                if received is not None:
                    for value in self.tell(InputKind.DATA, received.t_arrival_ns, received.data):
                        yield value

    def tell(self, kind: InputKind, t_ns: int, data: bytes = b"") -> Sequence[ValueT]:
        """Tell the parser, and whoever listens, what has happened."""
        told = RawEvent(kind, t_ns, data)
        self._tap(told)
        return self._take(told)

    async def _receive(self) -> Received | None:
        """Return what arrives next, or None after a silence that the board may get over."""
        port = self._link.port
        if port is None:
            port = await self._link.open()
            self.tell(InputKind.OPENED, time.monotonic_ns())
            await self._opened(port)
        patience_s = self._patience_s()
        received = await port.read(patience_s)
        if received is None:
            await self._silent(port, patience_s)
        else:
            self._heard()
        return received

    @abstractmethod
    async def _opened(self, port: Port) -> None:
        """Do what a board needs whose port was opened just now."""

    @abstractmethod
    def _patience_s(self) -> float:
        """Return how long it may say nothing."""

    @abstractmethod
    def _heard(self) -> None:
        """Take note that it has said something."""

    @abstractmethod
    async def _silent(self, port: Port, waited_s: float) -> None:
        """Do what helps a board that has said nothing for so long; DeviceLostError where nothing does."""

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the connection."""
        return {
            "connected": self._link.port is not None,
            "openings": self._link.openings,
            "last_loss": self._link.last_error,
        }
