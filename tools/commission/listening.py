"""Listens to a board in a thread, while the stages move the robot."""

import asyncio
import threading
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing
from operator import attrgetter
from typing import Final, Protocol, TypeVar

from shearloop.tools.commission.arrivals import Arrivals
from shearloop.tools.commission.opened import Opened

# Opening the port resets an Uno, which starts within some seconds.
SILENT_S: Final = 15.0


class _Timed(Protocol):
    """A measurement with the middle of its conversion (monotonic, ns)."""

    @property
    def t_mid_ns(self) -> int: ...


TimedT = TypeVar("TimedT", bound=_Timed)


class BoardListener(Arrivals[TimedT], Opened):
    """What a board sends; a context, which opens and closes its port."""

    def __init__(self, name: str, readings: Callable[[], AsyncGenerator[TimedT]]) -> None:
        """Take the board's name and its measurements; the port is not opened yet."""
        silent = f"{name} is silent: `shearloop doctor CONFIG` examines it"
        super().__init__(attrgetter("t_mid_ns"), silent=silent)
        self._readings = readings
        self._loop = asyncio.new_event_loop()
        self._task: asyncio.Task[None] | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def open(self) -> None:
        """Begin to listen; raises UserError where the board is silent."""
        self._thread.start()
        self.take(1, SILENT_S)

    def close(self) -> None:
        """Close the port."""
        if self._task is not None:
            self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()

    def _run(self) -> None:
        self._task = self._loop.create_task(self._listen())
        try:
            self._loop.run_until_complete(asyncio.gather(self._task, return_exceptions=True))
        finally:
            self._loop.close()

    async def _listen(self) -> None:
        async with aclosing(self._readings()) as readings:
            async for reading in readings:
                self.add(reading)
