"""An SCPI instrument that is set up once and then asked at a steady rate, whatever becomes of its connection."""

import asyncio
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import AsyncGenerator, Mapping
from typing import Generic, TypeVar

from shearloop.drivers.errors import DriverError, ProtocolError
from shearloop.drivers.raw_event import Tap, no_tap
from shearloop.drivers.serial_port import Link
from shearloop.drivers.shear_skin.scpi import ScpiSession

# Replies that are not understood, in a row, before the connection is opened anew.
STRIKES = 3

ReadingT = TypeVar("ReadingT")


class PolledInstrument(ABC, Generic[ReadingT]):
    """One instrument behind a link."""

    def __init__(self, link: Link, what: str, period_s: float, reply_deadline_s: float, tap: Tap = no_tap) -> None:
        self._link = link
        self._period_s = period_s
        self._session = ScpiSession(link, what, reply_deadline_s, tap)
        self._strikes = 0
        self._count = 0
        self._errors: Counter[str] = Counter()
        self._name = ""

    @property
    def period_s(self) -> float:
        """How often it is asked."""
        return self._period_s

    @abstractmethod
    async def _set_up(self) -> str:
        """Tell a freshly opened instrument what it has to do; return its name."""

    @abstractmethod
    async def _read(self) -> ReadingT:
        """Ask for one reading."""

    async def _leave(self) -> None:
        """Tell an instrument that it is no longer wanted; its port may have gone."""

    async def readings(self) -> AsyncGenerator[ReadingT]:
        """Yield a reading every period, for ever, whatever becomes of the instrument meanwhile.

        Iterate within `contextlib.aclosing`, so that the instrument is left as it should be when the iteration is.
        """
        pace = Pace(self._period_s)
        with self._link:
            try:
                while True:
                    try:
                        if self._link.port is None:
                            await self._link.open()
                            self._name = await self._set_up()
                        await pace.tick()
                        reading = await self._read()
                    except DriverError as error:
                        await self._failed(error)
                        continue
                    self._strikes = 0
                    self._count += 1
                    yield reading
            finally:
                await self._leave()

    def facts(self) -> Mapping[str, bool | int | float | str | Mapping[str, int] | None]:
        """Return what health tells of the instrument; counts are since the process began."""
        return {
            "connected": self._link.port is not None,
            "instrument": self._name,
            "readings": self._count,
            "errors": dict(self._errors + self._session.lines.refused),
            "openings": self._link.openings,
            "last_loss": self._link.last_error,
        }

    async def _failed(self, error: DriverError) -> None:
        """Take one reply that was not understood for noise on the line; open the connection anew for more than that."""
        not_understood = isinstance(error, ProtocolError)
        self._errors["not understood" if not_understood else "lost"] += 1
        self._strikes += 1
        if self._name and not_understood and self._strikes < STRIKES:
            return
        self._strikes, self._name = 0, ""
        self._session.lines.restart()
        await self._link.lost(error)


class Pace:
    """Ticks every `period_s`, counted from the first call; ticks that came too late are left out, not made up for."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._due_s: float | None = None

    async def tick(self) -> None:
        """Wait for the next tick."""
        now_s = asyncio.get_running_loop().time()
        due_s = now_s if self._due_s is None else self._due_s + self._period_s
        if due_s < now_s:
            due_s += (now_s - due_s) // self._period_s * self._period_s
        self._due_s = due_s
        await asyncio.sleep(max(due_s - now_s, 0.0))
