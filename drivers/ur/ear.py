"""Listens to a descriptor from an asyncio loop, and can leave it for a while: what comes waits in the kernel."""

import asyncio
from collections.abc import Callable


class Ear:
    """Calls `heard` whenever there is something to read, from `listen` on until `close`."""

    def __init__(self, descriptor: int, heard: Callable[[], None]) -> None:
        """Take a descriptor that stays open until `close`, and who reads it, also where there is nothing to read."""
        self._descriptor = descriptor
        self._heard = heard
        self._open = True
        self._listening = False
        self._later: asyncio.TimerHandle | None = None

    def listen(self) -> None:
        """Listen from now on, even within a pause."""
        if self._listening or not self._open:
            return
        self._end_pause()
        self._listening = True
        asyncio.get_running_loop().add_reader(self._descriptor, self._heard)

    def pause(self, seconds: float) -> None:
        """Leave what comes in the next seconds for then: it costs one waking instead of one each."""
        if not self._open:
            return
        self._turn_away()
        self._end_pause()
        self._later = asyncio.get_running_loop().call_later(seconds, self._resume)

    def close(self) -> None:
        """Listen no more."""
        self._open = False
        self._turn_away()
        self._end_pause()

    def _resume(self) -> None:
        self.listen()
        self._heard()

    def _turn_away(self) -> None:
        if self._listening:
            self._listening = False
            asyncio.get_running_loop().remove_reader(self._descriptor)

    def _end_pause(self) -> None:
        if self._later is not None:
            self._later.cancel()
            self._later = None
