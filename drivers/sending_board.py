"""A board on a serial port that only ever sends: kept connected, and lost when it falls silent."""

import time
from collections.abc import AsyncGenerator, Callable, Sequence
from typing import Generic, TypeVar

from drivers.errors import DeviceLostError, DriverError
from drivers.raw_input import InputKind, RawInput, Tap, no_tap
from drivers.serial_port import Link, Received

# Opening the port resets an Uno, whose boot loader waits before it starts the sketch.
BOOT_S = 4.0
SILENT_PERIODS = 8

ValueT = TypeVar("ValueT")


class SendingBoard(Generic[ValueT]):
    """One board behind a link, and the parser that is told all that happens to it."""

    def __init__(
        self,
        link: Link,
        take: Callable[[RawInput], Sequence[ValueT]],
        *,
        period_s: float,
        silent: Callable[[str, float], str],
        tap: Tap = no_tap,
    ) -> None:
        """Take the link and the parser; nothing is opened yet. `tap` hears of all that the parser is told.

        `period_s` is between two lines; `silent` is the sentence for a port that has sent nothing for so many seconds.
        """
        self._link = link
        self._take = take
        self._silence_s = SILENT_PERIODS * period_s
        self._silent = silent
        self._tap = tap
        self._patience_s = BOOT_S

    async def values(self) -> AsyncGenerator[ValueT]:
        """Yield what the parser makes of every line, in order and for ever, whatever becomes of the board meanwhile.

        Iterate within `contextlib.aclosing`, so that the port is closed when the iteration is left.
        """
        with self._link:
            while True:
                try:
                    received = await self._receive()
                except DriverError as error:
                    await self._link.lost(error)
                    continue
                for value in self.tell(InputKind.DATA, received.t_arrival_ns, received.data):
                    yield value

    def tell(self, kind: InputKind, t_ns: int, data: bytes = b"") -> Sequence[ValueT]:
        """Tell the parser, and whoever listens, what has happened."""
        told = RawInput(kind, t_ns, data)
        self._tap(told)
        return self._take(told)

    async def _receive(self) -> Received:
        port = self._link.port
        if port is None:
            port = await self._link.open()
            self.tell(InputKind.OPENED, time.monotonic_ns())
            self._patience_s = BOOT_S
        received = await port.read(self._patience_s)
        if received is None:
            raise DeviceLostError(self._silent(port.path, self._patience_s))
        self._patience_s = self._silence_s
        return received

    def facts(self) -> dict[str, bool | int | str]:
        """Return what health tells of the connection."""
        return {
            "connected": self._link.port is not None,
            "openings": self._link.openings,
            "last_loss": self._link.last_error,
        }
