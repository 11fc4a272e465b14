"""A device on a pseudo-terminal that answers what it is sent: it can be unplugged, fall silent, and break off."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path

from shearloop.drivers.emulators.pty_port import PtyPort


class PtyServer(ABC):
    """One port. `on_port` hears its path whenever it appears."""

    def __init__(self, link: Path | None, on_port: Callable[[str], None], answer_s: float = 0.0) -> None:
        self._port = PtyPort(self._received, link)
        self._on_port = on_port
        self._answer_s = answer_s
        self._replies: asyncio.Queue[bytes] = asyncio.Queue()
        self.silent = False
        # Whether the next answer stops half-way, where the port hangs up and comes back.
        self.breaks_off = False

    @abstractmethod
    def _answer(self, data: bytes) -> bytes:
        """Return the reply to what has arrived; empty for none."""

    async def run(self) -> None:
        """Serve until cancelled."""
        await self.bring_back()
        with self._port:
            while True:
                reply = await self._replies.get()
                # Between question and answer lies a measurement.
                await asyncio.sleep(self._answer_s)
                try:
                    if self.breaks_off:
                        self.breaks_off = False
                        await self._break_off(reply)
                        continue
                    await self._port.write(reply)
                except ConnectionError:  # unplugged before the reply was out: nobody misses it
                    continue

    async def bring_back(self) -> None:
        """Plug it in, if it is not."""
        self._port.plug()
        self._on_port(self._port.path)

    async def lose(self) -> None:
        """Unplug it."""
        self._port.unplug()

    async def _break_off(self, reply: bytes) -> None:
        await self._port.write(reply[: len(reply) // 2])
        await self._port.break_off()
        await self.bring_back()

    def _received(self, data: bytes) -> None:
        reply = self._answer(data)
        if reply and not self.silent:
            self._replies.put_nowait(reply)
