"""Deadlines in coroutines."""

import asyncio
import sys
from contextlib import AbstractAsyncContextManager
from types import TracebackType
from typing import Self


def timeout(delay_s: float) -> AbstractAsyncContextManager[object]:
    """Return a context that raises TimeoutError if its block takes longer.

    This also holds in a task that is being cancelled, and puts its device into a safe state. Before Python 3.11.3
    `asyncio.timeout` raised CancelledError there (https://github.com/python/cpython/issues/102780), so that nothing
    after the deadline was done.
    """
    return asyncio.timeout(delay_s) if sys.version_info >= (3, 11, 3) else Deadline(delay_s)


class Deadline:
    """`asyncio.timeout` of Python 3.11.3, for earlier ones."""

    def __init__(self, delay_s: float) -> None:
        """Take the longest time of the block; it begins as the block does."""
        self._delay_s = delay_s
        self._passed = False

    async def __aenter__(self) -> Self:
        """Begin."""
        task = asyncio.current_task()
        if task is None:
            raise RuntimeError("a deadline needs a task")
        self._task, self._cancelled_before = task, task.cancelling()
        loop = asyncio.get_running_loop()
        self._timer = loop.call_soon(self._pass) if self._delay_s <= 0 else loop.call_later(self._delay_s, self._pass)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        """End; raises TimeoutError where only the deadline has cancelled the block."""
        self._timer.cancel()
        only_deadline = self._passed and self._task.uncancel() <= self._cancelled_before
        if only_deadline and kind is not None and issubclass(kind, asyncio.CancelledError):
            raise TimeoutError from error

    def _pass(self) -> None:
        self._passed = True
        self._task.cancel()
