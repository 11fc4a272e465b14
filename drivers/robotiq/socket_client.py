"""The gripper by way of the robot's controller: the URCap's socket."""

import asyncio
import contextlib
from collections.abc import Callable
from typing import TypeVar

from drivers.errors import DeviceLostError, DeviceNotFoundError
from drivers.robotiq.messages import Readout, Request
from drivers.robotiq.urcap import PORT, READ_ORDER, ReplyParser, get_line, readout_of, set_lines, value_of

CONNECT_DEADLINE_S = 2.0
# A reply takes some milliseconds; the controller serves the socket with a low priority.
REPLY_DEADLINE_S = 0.5

ReplyT = TypeVar("ReplyT")


class SocketClient:
    """One connection to the URCap. Any failure closes it: after one, replies would belong to other questions."""

    def __init__(self, host: str, port: int = PORT, *, reply_deadline_s: float = REPLY_DEADLINE_S) -> None:
        """Name the controller; nothing is opened yet."""
        self._host = host
        self._port = port
        self._deadline_s = reply_deadline_s
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._parser = ReplyParser()

    @property
    def name(self) -> str:
        """Where the gripper is, for sentences."""
        return f"{self._host}:{self._port}"

    async def connect(self) -> None:
        """Open the connection; DeviceNotFoundError when nothing listens there."""
        await self.close()
        try:
            async with asyncio.timeout(CONNECT_DEADLINE_S):
                self._streams = await asyncio.open_connection(self._host, self._port)
        except OSError as error:  # a timeout is one
            raise DeviceNotFoundError(
                f"There is no gripper socket at {self.name} ({error or 'no answer'}); check the robot's address and "
                "that the Robotiq URCap is installed and runs."
            ) from error
        self._parser = ReplyParser()

    async def close(self) -> None:
        """Close the connection; closing twice is allowed."""
        streams = self._streams
        self._abort()
        if streams is not None:
            with contextlib.suppress(OSError):
                await streams[1].wait_closed()

    def _abort(self) -> None:
        if self._streams is not None:
            # Not close(), which would wait for bytes to a peer that may be gone.
            self._streams[1].transport.abort()
        self._streams = None

    async def read(self) -> Readout:
        """Return the status registers, asked for one after the other; DeviceLostError or ProtocolError."""
        return readout_of({variable: value_of(variable, await self._get(variable)) for variable in READ_ORDER})

    async def write(self, request: Request) -> None:
        """Send a request and wait for its acknowledgements; DeviceLostError or ProtocolError."""
        for line in set_lines(request):
            await self._ask(line, lambda: self._parser.take_ack() or None)

    async def _get(self, variable: str) -> str:
        return await self._ask(get_line(variable), lambda: self._parser.take_value(variable))

    async def _ask(self, line: bytes, take: Callable[[], ReplyT | None]) -> ReplyT:
        if self._streams is None:
            raise DeviceLostError(f"There is no connection to the gripper at {self.name} at present.")
        reader, writer = self._streams
        whole = False
        try:
            async with asyncio.timeout(self._deadline_s):
                self._parser.expect_nothing()
                writer.write(line)
                while (reply := take()) is None:
                    data = await reader.read(64)
                    if not data:
                        raise DeviceLostError(f"The controller closed the gripper's socket at {self.name}.")
                    self._parser.feed(data)
            whole = True
        except TimeoutError as error:
            raise DeviceLostError(
                f"The gripper's socket at {self.name} gave no whole answer to {line.decode().strip()!r} "
                f"within {self._deadline_s:g} s."
            ) from error
        except OSError as error:
            raise DeviceLostError(f"The connection to the gripper at {self.name} broke: {error}.") from error
        finally:
            if not whole:
                self._abort()
        return reply
