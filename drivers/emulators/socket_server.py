"""A device's side of a socket: it can be lost, come back, fall silent, and break off in the middle of an answer."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Callable

LONGEST_READ = 256


class SocketServer(ABC):
    """Serves any number of connections, each with an answerer of its own.

    `on_port` hears the address whenever it begins to be listened on.
    """

    def __init__(self, host: str, port: int, on_port: Callable[[str], None], answer_s: float = 0.0) -> None:
        self._host = host
        self._answer_s = answer_s
        self._on_port = on_port
        self._server: asyncio.Server | None = None
        self._connections: dict[asyncio.Task[None], asyncio.StreamWriter] = {}
        # The port that is listened on: with 0, a free one from the first start on.
        self.port = port
        self.silent = False
        # Whether the next answer is the last one, and only its first half.
        self.breaks_off = False

    @abstractmethod
    def _answerer(self) -> Callable[[bytes], bytes]:
        """Return what turns the bytes of one connection into replies."""

    async def run(self) -> None:
        """Serve until cancelled; OSError when the port is taken."""
        await self.bring_back()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            await self.lose()

    async def bring_back(self) -> None:
        """Listen, if that is not done already."""
        if self._server is None:
            self._server = await asyncio.start_server(self._serve, self._host, self.port)
            self.port = self._server.sockets[0].getsockname()[1]
            self._on_port(f"{self._host}:{self.port}")

    async def lose(self) -> None:
        """Break every connection without a farewell, and listen no more."""
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
        answer = self._answerer()
        task = asyncio.current_task()
        if task is None:
            raise RuntimeError("a connection is served by a task")
        self._connections[task] = writer
        try:
            while data := await reader.read(LONGEST_READ):
                replies = answer(data)
                if replies and not self.silent:
                    # Between question and answer lies a measurement.
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
