"""The ways in of the played instruments: a socket, or the RS-232 interface on a pseudo-terminal."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from shearloop.drivers.emulators.pty_server import PtyServer
from shearloop.drivers.emulators.socket_server import SocketServer

COMMANDS = (
    "silence [SECONDS], unplug [SECONDS], break-off (the next answer stops half-way, with the connection), normal"
)

Feed = Callable[[bytes], bytes]


class Server(Protocol):
    """A way in, as far as outages need it."""

    silent: bool
    breaks_off: bool

    async def run(self) -> None:
        """Serve until cancelled."""

    async def lose(self) -> None:
        """Break the connection."""

    async def bring_back(self) -> None:
        """Let it be made again."""


class ScpiSocket(SocketServer):
    """An instrument's socket."""

    def __init__(
        self,
        feed: Feed,
        host: str = "127.0.0.1",
        port: int = 0,
        on_port: Callable[[str], None] = lambda _: None,
        answer_s: float = 0.0,
    ) -> None:
        super().__init__(host, port, on_port, answer_s)
        self._feed = feed

    def _answerer(self) -> Feed:
        return self._feed


class ScpiSerial(PtyServer):
    """An instrument's serial port."""

    def __init__(
        self,
        feed: Feed,
        link: Path | None = None,
        on_port: Callable[[str], None] = lambda _: None,
        answer_s: float = 0.0,
    ) -> None:
        super().__init__(link, on_port, answer_s)
        self._feed = feed

    def _answer(self, data: bytes) -> bytes:
        return self._feed(data)


class Outages:
    """Lets a way in fall silent or go away, for a time or until it is mended, or break off once."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._wanted = True
        self._changed = asyncio.Event()
        self._timer: asyncio.TimerHandle | None = None

    def command(self, text: str) -> None:
        """Do what a line says; ValueError, with a sentence, for one that says nothing known."""
        match text.split():
            case ["silence" | "unplug" as kind, *seconds] if len(seconds) < 2:
                lasts_s = time_of(seconds[0]) if seconds else None
                self._end()
                if kind == "silence":
                    self._server.silent = True
                else:
                    self._want(there=False)
                if lasts_s is not None:
                    self._timer = asyncio.get_running_loop().call_later(lasts_s, self._end)
            case ["break-off"]:
                self._server.breaks_off = True
            case ["normal"]:
                self._end()
            case _:
                raise ValueError(f"{text!r} is no fault of the instrument; there are {COMMANDS}")

    async def run(self) -> None:
        """Serve until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._server.run())
            group.create_task(self._follow())

    async def _follow(self) -> None:
        while True:
            await self._changed.wait()
            self._changed.clear()
            await (self._server.bring_back() if self._wanted else self._server.lose())

    def _want(self, *, there: bool) -> None:
        self._wanted = there
        self._changed.set()

    def _end(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._server.silent = self._server.breaks_off = False
        if not self._wanted:
            self._want(there=True)


def time_of(text: str) -> float:
    """Return the seconds in a command; ValueError, with a sentence, when they are none."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise ValueError(f"{text!r} is no time in seconds; write for instance 2.5")
    return value
