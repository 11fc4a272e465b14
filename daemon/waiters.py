"""Tasks that wait for the same result, such as a sensor's new zero."""

import asyncio


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
