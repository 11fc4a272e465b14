"""Ports of emulated devices: pseudo-terminals and sockets that can be unplugged and fall silent."""

import asyncio
import contextlib
import os
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from copy import copy
from pathlib import Path
from typing import Any, Protocol, Self, TypeAlias

from shearloop.emulators.numbers import number_between

READ_BYTES = 4096
OUTAGES = "silence [SECONDS], unplug [SECONDS], slow MILLISECONDS, normal"


class PtyPort:
    """The device's end of a serial port; as a context it is plugged in, and unplugged at the end.

    `received` gets the other side's bytes, and `appearances` the port's path whenever it is plugged in. With `link`, a
    symbolic link of that name leads to the plugged-in port, as udev's links do. Use it in one event loop.
    """

    def __init__(self, link: Path | None = None) -> None:
        self.received: asyncio.Queue[bytes] = asyncio.Queue()
        self.appearances: asyncio.Queue[str] = asyncio.Queue()
        self._link = link
        self.master: int | None = None
        # Held open, so that the port outlives the programs that open it.
        self._slave = -1
        self.terminal = ""
        self._room = asyncio.Event()
        # Set while a write waits for the reader.
        self.held_up = asyncio.Event()

    @property
    def path(self) -> str:
        """The path for the other side."""
        return self.terminal if self._link is None else str(self._link)

    def __enter__(self) -> Self:
        """Plug the port in."""
        self.plug()
        return self

    def __exit__(self, *_: object) -> None:
        """Unplug the port."""
        self.unplug()

    def plug(self) -> None:
        """Make the port appear, under a new terminal; OSError if the link cannot be made."""
        if self.master is not None:
            return
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"{self._link} is a file")
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.terminal = os.ttyname(self._slave)
        if self._link is not None:
            fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            fresh.symlink_to(self.terminal)
            fresh.replace(self._link)
        asyncio.get_running_loop().add_reader(self.master, self._receive, self.master)
        self.appearances.put_nowait(self.path)

    def unplug(self) -> None:
        """Make the port disappear: its users are hung up on and unread bytes are lost."""
        if self.master is None:
            return
        loop = asyncio.get_running_loop()
        loop.remove_reader(self.master)
        loop.remove_writer(self.master)
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self.terminal:
            self._link.unlink()
        os.close(self.master)
        os.close(self._slave)
        self.master = None
        self._room.set()

    def _receive(self, master: int) -> None:
        with contextlib.suppress(BlockingIOError):
            self.received.put_nowait(os.read(master, READ_BYTES))

    async def write(self, data: bytes) -> None:
        """Write all of `data`, waiting for the reader; ConnectionError if unplugged."""
        while data:
            if self.master is None:
                raise ConnectionError("the port is unplugged")
            try:
                data = data[os.write(self.master, data) :]
            except BlockingIOError:
                self._room.clear()
                asyncio.get_running_loop().add_writer(self.master, self._on_room, self.master)
                self.held_up.set()
                await self._room.wait()
                self.held_up.clear()

    def _on_room(self, master: int) -> None:
        asyncio.get_running_loop().remove_writer(master)
        self._room.set()


class Session(Protocol):
    """A device as one connection sees it."""

    def feed(self, data: bytes) -> bytes:
        """Return the replies to received bytes, empty for none."""


class Server(ABC):
    """A device that answers requests, after `answer_s`, and its outages.

    `appearances` gets the port's path or address whenever it can be opened. The session gets a request after the
    fraction `measures_at` of the answer's time.
    """

    appearances: asyncio.Queue[str]

    def __init__(self, answer_s: float, measures_at: float = 0.0) -> None:
        self.answer_s = self._usual_answer_s = answer_s
        self._measures_at = measures_at
        # normal, silence or unplug.
        self._state = "normal"
        self._changed = asyncio.Event()
        self._recovery: asyncio.TimerHandle | None = None

    async def run(self) -> None:
        """Serve until cancelled; OSError if the port is taken."""
        try:
            while True:
                self._changed.clear()
                await (self.disconnect() if self._state == "unplug" else self.restore())
                await self._changed.wait()
        finally:
            await self.disconnect()

    async def _reply(self, session: Session, data: bytes) -> bytes:
        """Return a session's reply once its measurement is over; empty for none, and in a silence."""
        if self._measures_at:
            await asyncio.sleep(self._measures_at * self.answer_s)
        reply = session.feed(data)
        if not reply or self._state == "silence":
            return b""
        await asyncio.sleep((1.0 - self._measures_at) * self.answer_s)
        return reply

    @abstractmethod
    async def restore(self) -> None:
        """Make the port available, unless it is; OSError if it is taken."""

    @abstractmethod
    async def disconnect(self) -> None:
        """Break every connection and make the port unavailable."""

    def command(self, text: str) -> None:
        """Begin or end an outage; ValueError, with a sentence, for another command."""
        match text.split():
            case ["silence" | "unplug" as kind, *seconds] if len(seconds) < 2:
                times_s = [
                    number_between(each, 0.0, 1e9, "no time in seconds; write for instance 2.5") for each in seconds
                ]
                self._begin(kind)
                for time_s in times_s:
                    self._recovery = asyncio.get_running_loop().call_later(time_s, self._begin, "normal")
            case ["slow", answer_ms]:
                self.answer_s = number_between(answer_ms, 0.0, 10_000.0, "no time in ms of at most 10000") / 1000
            case ["normal"]:
                self.answer_s = self._usual_answer_s
                self._begin("normal")
            case _:
                raise ValueError(f"{text!r} is no command; there are {OUTAGES}")

    def _begin(self, state: str) -> None:
        if self._recovery is not None:
            self._recovery.cancel()
        self._state = state
        self._changed.set()


class PtyServer(Server):
    """A device that answers requests on a pseudo-terminal."""

    def __init__(self, session: Session, link: Path | None = None, answer_s: float = 0.0) -> None:
        super().__init__(answer_s)
        self._session = session
        self._port = PtyPort(link)
        self.appearances = self._port.appearances

    async def run(self) -> None:
        """Serve until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(super().run())
            while True:
                data = await self._port.received.get()
                reply = await self._reply(self._session, data)
                if not reply:
                    continue
                with contextlib.suppress(ConnectionError):  # unplugged in between
                    await self._port.write(reply)

    async def restore(self) -> None:
        """Plug the port in."""
        self._port.plug()

    async def disconnect(self) -> None:
        """Unplug the port."""
        self._port.unplug()


# Open connections, by the tasks that serve them.
Connections: TypeAlias = dict[asyncio.Task[None], asyncio.StreamWriter]
Serve: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Coroutine[Any, Any, None]]


def accepting(serve: Serve, connections: Connections) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], None]:
    """Return what a server calls with each new connection: a task serves it, and closes it at its end.

    The connection is registered at once, so that a server that ends can wait for its task. A peer that breaks the
    connection ends the task quietly.
    """

    async def run(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            with contextlib.suppress(ConnectionError):
                await serve(reader, writer)
        finally:
            writer.close()

    def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.create_task(run(reader, writer))
        connections[task] = writer
        task.add_done_callback(connections.pop)

    return accept


class SocketServer(Server):
    """A device that answers requests on a socket; each connection gets a copy of `session`."""

    def __init__(
        self, session: Session, host: str = "127.0.0.1", port: int = 0, answer_s: float = 0.0, measures_at: float = 0.0
    ) -> None:
        super().__init__(answer_s, measures_at)
        self._session = session
        self._host = host
        self._server: asyncio.Server | None = None
        self._connections: Connections = {}
        self.appearances = asyncio.Queue()
        # With 0, a free port from the first start on.
        self.port = port

    async def restore(self) -> None:
        """Listen, unless it does already."""
        if self._server is None:
            self._server = await asyncio.start_server(accepting(self._serve, self._connections), self._host, self.port)
            self.port = self._server.sockets[0].getsockname()[1]
            self.appearances.put_nowait(f"{self._host}:{self.port}")

    async def disconnect(self) -> None:
        """Abort every connection and stop listening."""
        if self._server is None:
            return
        server, self._server = self._server, None
        server.close()
        for writer in self._connections.values():
            writer.transport.abort()
        await server.wait_closed()
        if self._connections:
            await asyncio.wait(self._connections)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        session = copy(self._session)
        while data := await reader.read(READ_BYTES):
            if replies := await self._reply(session, data):
                writer.write(replies)
                await writer.drain()
