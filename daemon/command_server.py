"""Answers commands: a ROUTER socket, msgpack maps in and out, every request answered exactly once.

A request is `{"command": NAME, …}`; the reply is `{"ok": true, …}` or `{"ok": false, "why": SENTENCE}`. Both REQ and
DEALER clients are understood.
"""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeAlias

import structlog
import zmq
import zmq.asyncio

from daemon.messages import decode, encode
from daemon.publisher import bind

LARGEST_REQUEST_BYTES = 64 * 1024
MOST_AT_ONCE = 16

Reply: TypeAlias = dict[str, Any]
Handler: TypeAlias = Callable[[Mapping[str, Any]], Awaitable[Reply]]


class CommandRefusedError(Exception):
    """A command that will not be carried out; the message is the reason that the operator reads."""


class CommandServer:
    """Receives requests, lets handlers decide, and sends each reply back to whom it belongs."""

    def __init__(self, context: zmq.asyncio.Context, address: str, handlers: Mapping[str, Handler]) -> None:
        """Bind the socket; raises UserError when the address is taken or malformed."""
        self._handlers = handlers
        self.refused: Counter[str] = Counter()
        self._serving: set[asyncio.Task[None]] = set()
        self._socket = context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 100)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_REQUEST_BYTES)
        bind(self._socket, address, "commands")

    async def run(self) -> None:
        """Serve requests until cancelled; a slow one, such as `unlock`, does not keep a `stop` waiting."""
        async with asyncio.TaskGroup() as group:
            while True:
                *route, payload = await self._socket.recv_multipart()
                if len(self._serving) >= MOST_AT_ONCE:
                    await self._reply(route, self._refuse("too many at once", "too many commands at once; wait"))
                    continue
                task = group.create_task(self._serve(route, payload))
                self._serving.add(task)
                task.add_done_callback(self._serving.discard)

    async def _serve(self, route: list[bytes], payload: bytes) -> None:
        await self._reply(route, await self.answer(payload))

    async def _reply(self, route: list[bytes], reply: Reply) -> None:
        try:
            await self._socket.send_multipart([*route, encode(reply)], zmq.NOBLOCK)
        except zmq.Again:
            self.refused["a client that does not read its replies"] += 1

    async def answer(self, payload: bytes) -> Reply:
        """Return the reply to one request; never raises for what a client may send."""
        try:
            request = decode(payload)
        except ValueError as error:
            return self._refuse("malformed request", f"the request is {error}")
        name = request.get("command")
        handler = self._handlers.get(name) if isinstance(name, str) else None
        if handler is None:
            known = ", ".join(sorted(self._handlers))
            return self._refuse("unknown command", f"there is no command {name!r}; the commands are {known}")
        try:
            reply = await handler(request)
        except CommandRefusedError as reason:
            return self._refuse(f"{name} refused", str(reason))
        except Exception as error:  # noqa: BLE001 - one request that a handler cannot bear must not leave the others unanswered
            structlog.get_logger().exception("command failed", command=name)
            return self._refuse(
                f"{name} failed", f"{name} failed ({type(error).__name__}: {error}); see the daemon's log"
            )
        structlog.get_logger().info("command carried out", command=name)
        return {"ok": True, **reply}

    def _refuse(self, kind: str, why: str) -> Reply:
        self.refused[kind] += 1
        structlog.get_logger().warning("command refused", why=why)
        return {"ok": False, "why": why}

    def close(self) -> None:
        """Close the socket after the last replies are out."""
        self._socket.close()
