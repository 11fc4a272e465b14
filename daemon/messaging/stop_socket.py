"""The stop socket: a Unix datagram socket that accepts `stop` and `status` from every user of this machine.

A datagram needs no connection, so this socket works while ZeroMQ's sockets are flooded. Its abstract name follows from
the address of `commands`. Requests and replies are as on the command server, one datagram each, without keys.
"""

import asyncio
import errno
import os
import socket
import time
from collections.abc import Mapping
from typing import Any

from shearloop.daemon.messaging.addresses import ASKED, ELSEWHERE, is_reached, stop_name
from shearloop.daemon.messaging.command_server import Handler, Reply, Request, RequestExecutor
from shearloop.daemon.messaging.messages import encode
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.errors import UserError

LARGEST_DATAGRAM_BYTES = 1024


class NameTakenError(UserError):
    """Another program has the name of a stop socket."""


class StopSocket:
    """Receives requests and sends the replies, one at a time."""

    def __init__(
        self, address: str, handlers: Mapping[str, Handler], refusals: Refusals, *, emulated: bool = False
    ) -> None:
        """Bind the stop socket of the command address; raises UserError, NameTakenError if another daemon has it."""
        self._address = address
        self._requests = RequestExecutor(handlers, refusals, emulated=emulated)
        self._refusals = refusals
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            self._socket.bind(stop_name(address))
        except OSError as error:
            self._socket.close()
            cannot = f"the stop socket of `commands: {address}` cannot be bound ({error.strerror or error})"
            if error.errno == errno.EADDRINUSE:
                raise NameTakenError(
                    f"{cannot}; is another daemon running? Stop it, or choose another port; if another user holds its "
                    "name, `sudo ss -xlp` shows the process"
                ) from error
            raise UserError(f"{cannot}; choose another address") from error

    async def run(self) -> None:
        """Serve requests until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            data, client = await loop.sock_recvfrom(self._socket, LARGEST_DATAGRAM_BYTES)
            # A datagram that has already arrived does not yield to other tasks.
            await asyncio.sleep(0)
            checked = self._requests.check(os.fsencode(client or ""), [data], time.monotonic_ns())
            reply = checked if isinstance(checked, dict) else await self._execute(*checked)
            # A client without a name wants no reply.
            if client:
                self._reply(client, reply)

    async def _execute(self, name: str, request: Request) -> Reply:
        """Carry out a request that is meant for this daemon: one at another address may have the same port."""
        asked = request.get(ASKED)
        if isinstance(asked, str) and not is_reached(self._address, asked):
            return {"ok": False, "reason": f"this daemon is at {self._address}", ELSEWHERE: True}
        return await self._requests.execute(name, {key: value for key, value in request.items() if key != ASKED})

    def _reply(self, client: Any, reply: Reply) -> None:
        try:
            try:
                # Unread replies of a shared socket would fill its send buffer, and then no client could get one.
                own = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
            except OSError:
                # A flood of clients has taken every descriptor.
                self._socket.sendto(encode(reply), client)
            else:
                with own:
                    own.sendto(encode(reply), client)
        except OSError:
            self._refusals.counts["client does not read its replies"] += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
