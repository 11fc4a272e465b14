"""Answers commands: a ROUTER socket, msgpack maps in and out, every request answered exactly once.

A request is `{"command": NAME, …}`; the reply is `{"ok": true, …}` or `{"ok": false, "why": SENTENCE}`. Both REQ and
DEALER clients are understood. Requests are limited in number, `stop` excepted: it is carried out whatever else comes.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeAlias

import structlog
import zmq
import zmq.asyncio

from shearloop.daemon.messaging.keys import KeyPair
from shearloop.daemon.messaging.messages import decode, encode
from shearloop.daemon.messaging.publisher import bind
from shearloop.daemon.messaging.rate_limit import PER_CLIENT_PER_S, RateLimit

LARGEST_REQUEST_BYTES = 64 * 1024
MOST_AT_ONCE = 16
STOP, STATUS = "stop", "status"
_LONGEST_NAME = 40

Request: TypeAlias = Mapping[str, Any]
Reply: TypeAlias = dict[str, Any]
Handler: TypeAlias = Callable[[Request], Awaitable[Reply]]


class CommandRefusedError(Exception):
    """A command that will not be carried out; the message is the reason that the operator reads."""


class CommandServer:
    """Receives requests, lets handlers decide, and sends each reply back to whom it belongs."""

    def __init__(
        self,
        context: zmq.asyncio.Context,
        address: str,
        handlers: Mapping[str, Handler],
        keys: KeyPair | None = None,
    ) -> None:
        """Bind the socket; raises UserError when the address is taken, malformed, or needs keys and has none."""
        self._handlers = handlers
        self._limit = RateLimit()
        self.refused: Counter[str] = Counter()
        self._serving: set[asyncio.Task[None]] = set()
        self._socket = context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 100)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_REQUEST_BYTES)
        bind(self._socket, address, "commands", keys)

    async def run(self) -> None:
        """Serve requests until cancelled; a slow one, such as `unlock`, does not keep a `stop` waiting."""
        async with asyncio.TaskGroup() as group:
            while True:
                parts = await self._socket.recv_multipart()
                # A message that is there already is received without a turn of the loop.
                await asyncio.sleep(0)
                # Two frames from a DEALER, three from a REQ; whoever sends more is answered as a DEALER.
                route = parts[:2] if len(parts) == 3 and not parts[1] else parts[:1]
                ready = self.accept(parts[0], parts[len(route) :], time.monotonic_ns())
                if isinstance(ready, dict):
                    await self._reply(route, ready)
                else:
                    task = group.create_task(self._serve(route, *ready))
                    self._serving.add(task)
                    task.add_done_callback(self._serving.discard)

    def accept(self, client: bytes, frames: list[bytes], t_ns: int) -> tuple[str, Request] | Reply:
        """Return the name and the content of a request that is to be carried out, or the refusal of one that is not.

        Raises nothing for what a client may send. `t_ns` is the moment on the monotonic clock.
        """
        request, why = _read(frames)
        name = request.get("command")
        if name == STOP and STOP in self._handlers:
            return STOP, request
        if not self._limit.allows(client, t_ns):
            return self._refuse(
                "too many requests", f"too many requests; send at most {PER_CLIENT_PER_S:g} a second", often=True
            )
        if why:
            return self._refuse("malformed request", f"the request is {why}")
        if not isinstance(name, str) or name not in self._handlers:
            known, shown = ", ".join(sorted(self._handlers)), repr(name)[:_LONGEST_NAME]
            return self._refuse("unknown command", f"there is no command {shown}; the commands are {known}")
        if len(self._serving) >= MOST_AT_ONCE:
            return self._refuse("too many at once", "too many commands at once; wait")
        return name, request

    async def answer(self, name: str, request: Request) -> Reply:
        """Carry a request out and return the reply; never raises for what a client may send."""
        try:
            reply = await self._handlers[name](request)
        except CommandRefusedError as reason:
            return self._refuse(f"{name} refused", str(reason), often=name == STOP)
        except Exception as error:  # noqa: BLE001 - one request that a handler cannot bear must not leave the others unanswered
            structlog.get_logger().exception("command failed", command=name)
            return self._refuse(
                f"{name} failed", f"{name} failed ({type(error).__name__}: {error}); see the daemon's log"
            )
        log = structlog.get_logger()
        # What only asks, as pages and scripts do every second, is no news.
        (log.debug if name == STATUS else log.info)("command carried out", command=name)
        return {"ok": True, **reply}

    async def _serve(self, route: list[bytes], name: str, request: Request) -> None:
        await self._reply(route, await self.answer(name, request))

    async def _reply(self, route: list[bytes], reply: Reply) -> None:
        try:
            await self._socket.send_multipart([*route, encode(reply)], zmq.NOBLOCK)
        except zmq.Again:
            self.refused["a client that does not read its replies"] += 1

    def _refuse(self, kind: str, why: str, *, often: bool = False) -> Reply:
        """Count and tell a refusal; one that may come by the thousand is told at 1, 10, 100 … of its kind."""
        self.refused[kind] += 1
        count = self.refused[kind]
        if not often or str(count).strip("0") == "1":
            structlog.get_logger().warning("command refused", why=why, count=count)
        return {"ok": False, "why": why}

    def close(self) -> None:
        """Close the socket after the last replies are out."""
        self._socket.close()


def _read(frames: list[bytes]) -> tuple[Request, str]:
    """Return the content of a request, or nothing and what is wrong with it."""
    if len(frames) != 1:
        return {}, f"{len(frames)} frames where one is expected"
    try:
        return decode(frames[0]), ""
    except ValueError as error:
        return {}, str(error)
