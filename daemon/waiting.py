"""Those who wait for one thing that happens to all of them at once, such as a sensor's zero."""

import asyncio


class Waiting:
    """Any number of waiters; each hears the same text."""

    def __init__(self) -> None:
        self._futures: list[asyncio.Future[str]] = []

    def __bool__(self) -> bool:
        """Whether anybody waits."""
        return bool(self._futures)

    async def wait(self, seconds: float | None) -> str:
        """Return what is told; raises TimeoutError where nothing is within so many seconds, if there is a limit."""
        told: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._futures.append(told)
        try:
            async with asyncio.timeout(seconds):
                return await told
        finally:
            self._futures = [other for other in self._futures if other is not told]

    def tell(self, text: str) -> None:
        """Tell all that wait now."""
        for future in self._futures:
            # Who gave up waiting has cancelled it.
            if not future.done():
                future.set_result(text)
