"""Ports of emulated devices: pseudo-terminals and sockets that can be unplugged, fall silent, and break off."""

import asyncio
import contextlib
import os
import select
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Self, TypeAlias

# Turns received bytes into a reply, empty for none.
Answer: TypeAlias = Callable[[bytes], bytes]

READ_BYTES = 4096
# A reader that empties a full buffer in parts shows it as empty for a moment: look several times.
EMPTY_LOOKS = 3
# How long a port that is about to hang up waits for its reader.
UNREAD_S = 0.5


class Outage:
    """A pause of limited or unlimited time that can be ended early."""

    def __init__(self) -> None:
        self._ended = asyncio.Event()

    async def wait(self, seconds: float | None) -> None:
        """Wait for `seconds` (None: without limit) or until `end` is called."""
        self._ended.clear()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._ended.wait()

    def end(self) -> None:
        """End the current pause."""
        self._ended.set()


class PtyPort:
    """The device's end of a serial port; as a context it is plugged in, and unplugged at the end.

    `on_bytes` receives the other side's bytes. With `link`, a symbolic link of that name leads to the port while it is
    plugged in, as udev's links do. Plug and unplug it in the same event loop.
    """

    def __init__(self, on_bytes: Callable[[bytes], None], link: Path | None = None) -> None:
        self._on_bytes = on_bytes
        self._link = link
        self._master: int | None = None
        # Held open, so that the port outlives the programs that open it.
        self._slave = -1
        self._terminal = ""
        self._room = asyncio.Event()
        # Set while a write waits for the reader.
        self.held_up = asyncio.Event()

    @property
    def path(self) -> str:
        """The path for the other side."""
        return self._terminal if self._link is None else str(self._link)

    def __enter__(self) -> Self:
        """Plug the port in."""
        self.plug()
        return self

    def __exit__(self, *_: object) -> None:
        """Unplug the port."""
        self.unplug()

    def plug(self) -> None:
        """Make the port appear, under a new terminal."""
        if self._master is not None:
            return
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._terminal = os.ttyname(self._slave)
        if self._link is not None:
            fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            fresh.symlink_to(self._terminal)
            fresh.replace(self._link)
        asyncio.get_running_loop().add_reader(self._master, self._receive, self._master)

    def unplug(self) -> None:
        """Make the port disappear: its users are hung up on and unread bytes are lost."""
        if self._master is None:
            return
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._master)
        loop.remove_writer(self._master)
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._terminal:
            self._link.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master = None
        self._room.set()

    def _receive(self, master: int) -> None:
        with contextlib.suppress(BlockingIOError):
            self._on_bytes(os.read(master, READ_BYTES))

    @property
    def unread(self) -> bool:
        """Whether written bytes wait for the other side."""
        if self._master is None:
            return False
        # The kernel delivers late, on a busy machine by 0.1 s. poll waits for that (n_tty_poll), FIONREAD does not.
        poll = select.poll()
        poll.register(self._slave, select.POLLIN)
        return bool(poll.poll(0))

    async def write(self, data: bytes) -> None:
        """Write all of `data`, waiting for the reader; ConnectionError if unplugged."""
        while data:
            if self._master is None:
                raise ConnectionError("the port is unplugged")
            try:
                data = data[os.write(self._master, data) :]
            except BlockingIOError:
                self._room.clear()
                asyncio.get_running_loop().add_writer(self._master, self._on_room, self._master)
                self.held_up.set()
                await self._room.wait()
                self.held_up.clear()

    async def drain(self, timeout_s: float) -> None:
        """Wait until the other side has read everything, or for `timeout_s`."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + timeout_s
        empty_looks = 0
        # The kernel has no event for a buffer that was read.
        while empty_looks < EMPTY_LOOKS and loop.time() < end_s:
            await asyncio.sleep(0.001)
            empty_looks = 0 if self.unread else empty_looks + 1

    async def break_off(self) -> None:
        """Hang up once the other side has read everything; a pseudo-terminal would take unread bytes back."""
        await self.drain(UNREAD_S)
        self.unplug()

    def _on_room(self, master: int) -> None:
        asyncio.get_running_loop().remove_writer(master)
        self._room.set()


class PtyServer:
    """A device on a pseudo-terminal that answers requests. `on_port` receives its path whenever it appears.

    While `silent` it answers nothing; with `breaks_off` the next answer stops half-way and the port reappears.
    """

    def __init__(
        self,
        answer: Answer,
        link: Path | None = None,
        on_port: Callable[[str], None] = lambda _: None,
        answer_s: float = 0.0,
    ) -> None:
        self._answer = answer
        self._port = PtyPort(self._received, link)
        self._on_port = on_port
        self._answer_s = answer_s
        self._replies: asyncio.Queue[bytes] = asyncio.Queue()
        self.silent = False
        self.breaks_off = False

    async def run(self) -> None:
        """Serve until cancelled."""
        await self.restore()
        with self._port:
            while True:
                reply = await self._replies.get()
                # The time of the measurement.
                await asyncio.sleep(self._answer_s)
                with contextlib.suppress(ConnectionError):  # unplugged in between
                    if self.breaks_off:
                        self.breaks_off = False
                        await self._port.write(reply[: len(reply) // 2])
                        await self._port.break_off()
                        await self.restore()
                    else:
                        await self._port.write(reply)

    async def restore(self) -> None:
        """Plug the port in."""
        self._port.plug()
        self._on_port(self._port.path)

    async def disconnect(self) -> None:
        """Unplug the port."""
        self._port.unplug()

    def _received(self, data: bytes) -> None:
        reply = self._answer(data)
        if reply and not self.silent:
            self._replies.put_nowait(reply)


class SocketServer:
    """A device on a socket; `new_answer` returns a function for each connection. `on_port` receives its address.

    While `silent` it answers nothing; with `breaks_off` the next answer stops half-way and the connection closes.
    """

    def __init__(
        self,
        new_answer: Callable[[], Answer],
        host: str = "127.0.0.1",
        port: int = 0,
        on_port: Callable[[str], None] = lambda _: None,
        answer_s: float = 0.0,
    ) -> None:
        self._new_answer = new_answer
        self._host = host
        self._answer_s = answer_s
        self._on_port = on_port
        self._server: asyncio.Server | None = None
        self._connections: dict[asyncio.Task[None], asyncio.StreamWriter] = {}
        # With 0, a free port from the first start on.
        self.port = port
        self.silent = False
        self.breaks_off = False

    async def run(self) -> None:
        """Serve until cancelled; OSError if the port is taken."""
        await self.restore()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            await self.disconnect()

    async def restore(self) -> None:
        """Listen, unless it does already."""
        if self._server is None:
            self._server = await asyncio.start_server(self._serve, self._host, self.port)
            self.port = self._server.sockets[0].getsockname()[1]
            self._on_port(f"{self._host}:{self.port}")

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
        answer = self._new_answer()
        task = asyncio.current_task()
        if task is None:
            raise RuntimeError("a connection is served by a task")
        self._connections[task] = writer
        try:
            while data := await reader.read(READ_BYTES):
                replies = answer(data)
                if replies and not self.silent:
                    # The time of the measurement.
                    await asyncio.sleep(self._answer_s)
                    if self.breaks_off:
                        self.breaks_off = False
                        writer.write(replies[: len(replies) // 2])
                        break
                    writer.write(replies)
                    await writer.drain()
        except ConnectionError:
            pass
        finally:
            del self._connections[task]
            writer.close()
