"""Instruments on the network, reached as serial ones are: a connection that is opened again when it comes back."""

import asyncio
import time
from collections.abc import Callable

from shearloop.drivers.errors import DeviceLostError, DeviceNotFoundError
from shearloop.drivers.serial_port import WRITE_TIMEOUT_S, Link, LinkEvent, Port, Received, ReconnectPolicy

CONNECT_DEADLINE_S = 2.0
# Replies of instruments are lines; what comes in longer pieces comes in several reads.
READ_BYTES = 4096


class TcpPort:
    """One connection. Made by `TcpLink`."""

    def __init__(self, name: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._name = name
        self._reader = reader
        self._writer = writer

    @property
    def path(self) -> str:
        """Host and port."""
        return self._name

    async def read(self, timeout_s: float) -> Received | None:
        """Return what has arrived, or None after a silence of `timeout_s`; a cancelled read loses nothing.

        Raises DeviceLostError when the other side has gone.
        """
        try:
            async with asyncio.timeout(timeout_s):
                data = await self._reader.read(READ_BYTES)
        except TimeoutError:
            return None
        except OSError as error:
            raise self._lost(error) from error
        if not data:
            raise DeviceLostError(f"{self._name} has closed the connection; see whether the instrument is still on.")
        return Received(data, time.monotonic_ns())

    async def write(self, data: bytes) -> None:
        """Write all of `data`; raises DeviceLostError when the other side has gone or takes nothing for a second."""
        try:
            async with asyncio.timeout(WRITE_TIMEOUT_S):
                self._writer.write(data)
                await self._writer.drain()
        except TimeoutError as error:
            raise DeviceLostError(f"{self._name} takes no bytes any more; switch the instrument off and on.") from error
        except OSError as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Give the connection up; what is not yet sent is lost."""
        # Not close(), which would wait for bytes to a peer that may be gone.
        self._writer.transport.abort()

    def _lost(self, error: OSError) -> DeviceLostError:
        return DeviceLostError(f"The connection to {self._name} broke ({error.strerror or error}).")


class TcpLink(Link):
    """Keeps a connection to an instrument open."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        policy: ReconnectPolicy | None = None,
        on_event: Callable[[LinkEvent], None] = lambda _: None,
    ) -> None:
        super().__init__(policy=policy, on_event=on_event)
        self._host = host
        self._port = port

    async def _connect(self) -> Port:
        name = f"{self._host}:{self._port}"
        try:
            async with asyncio.timeout(CONNECT_DEADLINE_S):
                reader, writer = await asyncio.open_connection(self._host, self._port)
        except OSError as error:  # a timeout is one
            raise DeviceNotFoundError(
                f"Nothing answers at {name} ({error or 'no answer'}); see that it is on and its address is right."
            ) from error
        return TcpPort(name, reader, writer)
