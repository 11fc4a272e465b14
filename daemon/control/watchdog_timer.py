"""A watch over something that is heard of again and again, such as a robot's state: it tells when that stays away."""

import asyncio
from collections.abc import Callable

# A timer is put off where no more is left of it than this share of the time.
SOON = 0.25


class WatchdogTimer:
    """Calls `broken_by` when nothing was heard for as long as was said when something was heard last."""

    def __init__(self, broken_by: Callable[[], None]) -> None:
        """Watch nothing until something is heard."""
        self._broken_by = broken_by
        self._timer: asyncio.TimerHandle | None = None
        self._due_s = 0.0
        self._loop: asyncio.AbstractEventLoop | None = None

    def heard(self, longest_s: float) -> None:
        """Take note that something was heard, and may stay away for so long."""
        loop = self._loop = self._loop or asyncio.get_running_loop()
        now_s = loop.time()
        self._due_s = now_s + longest_s
        # A timer that waits is not put off at every state, which is dear, but before it would wake us to look in vain,
        # which is dearer still.
        if self._timer is None or not now_s + SOON * longest_s < self._timer.when() <= self._due_s:
            self.end()
            self._timer = loop.call_at(self._due_s, self._look)

    def end(self) -> None:
        """Watch no more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _look(self) -> None:
        loop = asyncio.get_running_loop()
        self._timer = None
        if loop.time() < self._due_s:
            self._timer = loop.call_at(self._due_s, self._look)
        else:
            self._broken_by()
