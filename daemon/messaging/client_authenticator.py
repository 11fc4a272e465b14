"""The check of each new connection to the daemon's sockets.

Only a network address asks for keys, so `keys` is imported where a client has one.
"""

import asyncio
import time
from pathlib import Path
from typing import Any

import structlog
import zmq
import zmq.asyncio
from zmq.auth.base import Authenticator

from shearloop.daemon.messaging.bound_sockets import ZAP_DOMAIN
from shearloop.daemon.messaging.refusals import Refusals, TokenBucket
from shearloop.errors import UserError

# New clients that are admitted at once, and then per second.
NEW_BURST, NEW_PER_S = 50.0, 50.0


class ClientAuthenticator:
    """Admits new clients at a bounded rate; at a network address also by their keys (ZAP, ZeroMQ RFC 27).

    libzmq makes the event loop's thread work for each new client, but asks here first. It must exist before a socket
    is bound.
    """

    def __init__(self, context: "zmq.Context[Any]", clients: Path | None, refusals: Refusals) -> None:
        """Raise UserError if the folder `clients` is unreadable or empty."""
        self._clients = clients
        self._refusals = refusals
        self._new = TokenBucket(NEW_BURST, NEW_PER_S)
        self._authenticator = Authenticator(context)
        if clients is not None:
            from shearloop.daemon.messaging.keys import check_allowed_clients

            for why in check_allowed_clients(clients).unusable:
                structlog.get_logger().warning("a client's key cannot be used", reason=why)
            self._authenticator.configure_curve_callback(ZAP_DOMAIN, self)
        self._authenticator.start()

    async def callback(self, _domain: str, key: bytes) -> bool:
        """Return whether a client with this public key may connect; pyzmq's authenticator awaits it."""
        from shearloop.daemon.messaging.keys import allowed_clients

        log = structlog.get_logger()
        try:
            # In a thread: the folder may be on a slow drive.
            allowed = await asyncio.to_thread(allowed_clients, self._clients) if self._clients is not None else None
            name = allowed.names.get(key) if allowed is not None else None
        except UserError as error:
            self._refusals.counts["allow-list cannot be read"] += 1
            log.warning("client refused", reason=str(error))
            return False
        if name is not None:
            log.info("client accepted", client=name)
            return True
        self._refusals.counts["key is not allowed"] += 1
        if self._refusals.counts["key is not allowed"] == 1:
            log.warning("client refused: its key is not in the allow-list", key=key.decode())
        return False

    async def run(self) -> None:
        """Answer libzmq's authentication requests until cancelled."""
        requests = zmq.asyncio.Socket.from_socket(self._authenticator.zap_socket)
        while True:
            request = await requests.recv_multipart()
            if self._new.allow(time.monotonic_ns()):
                await self._authenticator.handle_zap_message(request)
            else:
                reason = f"more than {NEW_PER_S:g} clients a second connect; others wait"
                self._refusals.add("too many new clients", reason, frequent=True)
                # A temporary failure: the client tries again.
                await requests.send_multipart([b"1.0", request[1], b"300", b"", b"", b""])
            # Requests that have already arrived do not yield to other tasks.
            await asyncio.sleep(0)

    def close(self) -> None:
        """Stop; no client can connect any more."""
        self._authenticator.stop()
