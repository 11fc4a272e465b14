"""Something that lasts for a time, or until it is ended."""

import asyncio
from contextlib import suppress


class Outage:
    """Waited for by the one who suffers it, ended early by the one who caused it."""

    def __init__(self) -> None:
        self._ended = asyncio.Event()

    async def last(self, seconds: float | None) -> None:
        """Wait for so long, without a number for ever, but no longer than until `end` is called."""
        self._ended.clear()
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._ended.wait()

    def end(self) -> None:
        """End what lasts at present, if anything does."""
        self._ended.set()
