"""Zeros of the torque sensors: what every sensor offers, and tasks that wait for the same zero."""

import asyncio
from collections.abc import Iterable
from typing import Protocol, runtime_checkable

# The paper's ten frames take 5.4 s.
LONGEST_TARE_S = 30.0


class Tareable(Protocol):
    """A sensor with a zero."""

    def tare(self) -> None:
        """Take a new zero from what is measured from now on."""

    async def tare_and_wait(self, within_s: float) -> str:
        """Take a new zero and wait until it is done; return the reason of a failure, else an empty text."""


@runtime_checkable
class Adaptable(Protocol):
    """A sensor whose gain can be corrected by another sensor's torque."""

    async def adapt(self, reference: str) -> str:
        """Correct the gain by this source's torque during this grip; return why not, else an empty text."""


async def tare_all(sensors: Iterable[Tareable], within_s: float = LONGEST_TARE_S) -> str:
    """Zero every sensor at the same time; return the reasons of failures, or an empty text."""
    return " ".join(filter(None, await asyncio.gather(*(sensor.tare_and_wait(within_s) for sensor in sensors))))


class Waiters:
    """Any number of waiting tasks; all receive the same text."""

    def __init__(self) -> None:
        self._futures: list[asyncio.Future[str]] = []

    def __bool__(self) -> bool:
        """Whether any task waits."""
        return bool(self._futures)

    async def wait(self, timeout_s: float | None) -> str:
        """Return the text of the next `notify`; raises TimeoutError."""
        future: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._futures.append(future)
        try:
            async with asyncio.timeout(timeout_s):
                return await future
        finally:
            self._futures.remove(future)

    def notify(self, text: str) -> None:
        """Pass a text to all present waiters."""
        for future in self._futures:
            if not future.done():
                future.set_result(text)
