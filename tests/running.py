"""Coroutines that run beside a test, and what it waits for in them."""

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine
from contextlib import aclosing, asynccontextmanager
from typing import Any, TypeVar

from shearloop.drivers.connection import LinkEvent, SerialPort

# Guards against a test that hangs; none waits for so long.
DEADLINE_S = 30
ValueT = TypeVar("ValueT")


@asynccontextmanager
async def running(*coroutines: Coroutine[Any, Any, None]) -> AsyncIterator[list[asyncio.Task[None]]]:
    """Run the coroutines until the end of the block; then raise the first error of one."""
    tasks = [asyncio.create_task(each) for each in coroutines]
    await asyncio.sleep(0)
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result


async def pass_on(values: AsyncGenerator[ValueT], on_value: Callable[[ValueT], object]) -> None:
    """Pass every value on, until cancelled."""
    async with aclosing(values) as arriving:
        async for value in arriving:
            on_value(value)


async def take(values: AsyncGenerator[ValueT], count: int) -> list[ValueT]:
    """Return the next values."""
    async with asyncio.timeout(DEADLINE_S), aclosing(values) as arriving:
        return [await anext(arriving) for _ in range(count)]


async def read_exactly(port: SerialPort, n_bytes: int) -> bytes:
    """Return the next bytes of a port, however they are cut."""
    data = b""
    while len(data) < n_bytes:
        received = await port.read(DEADLINE_S)
        data += received.data
    return data


class Changes:
    """Wakes a test whenever something is noted."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()

    def note(self) -> None:
        self._changed.set()

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(DEADLINE_S):
            while not condition():
                self._changed.clear()
                await self._changed.wait()


class LinkEvents(Changes):
    """The events of a link."""

    def __init__(self) -> None:
        super().__init__()
        self.events: list[LinkEvent] = []
        self.refusals: list[str] = []

    def on_refusal(self, sentence: str) -> None:
        self.refusals.append(sentence)
        self.note()

    async def refusal(self) -> str:
        """Wait for what a device says, and return the first of it."""
        await self.until(lambda: bool(self.refusals))
        return self.refusals[0]

    def on_link_event(self, event: LinkEvent) -> None:
        self.events.append(event)
        self.note()

    async def down(self, number: int = 1) -> LinkEvent:
        """Wait for the loss of this number and return it."""
        await self.until(lambda: len(self.losses) >= number)
        return self.losses[number - 1]

    @property
    def losses(self) -> list[LinkEvent]:
        return [event for event in self.events if not event.up]
