"""The command server: a ROUTER socket that answers every request exactly once.

Requests and replies are msgpack maps. A request is `{"command": NAME, …}`, a reply `{"ok": true, …}` or
`{"ok": false, "reason": SENTENCE}`. REQ and DEALER clients both work. The request rate is limited, except for `stop`.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

import structlog
import zmq
import zmq.asyncio

from shearloop.daemon.messaging.addresses import READ_ONLY
from shearloop.daemon.messaging.bound_sockets import bind
from shearloop.daemon.messaging.deadlines import NEVER_LATE, boot_ns
from shearloop.daemon.messaging.late_requests import LateRequests
from shearloop.daemon.messaging.messages import decode, encode
from shearloop.daemon.messaging.refusals import Refusals, TokenBucket

if TYPE_CHECKING:
    # Only a network address has keys.
    from shearloop.daemon.messaging.keys import KeyPair

# Of each frame. libzmq has no limit for the number of frames; more than one are refused.
LARGEST_REQUEST_BYTES = 4096
# Requests of each client that wait in memory; others wait in its own.
MAX_WAITING = 16
MAX_CONCURRENT = 16
STOP, STATUS, EXPERIMENTS = "stop", "status", "experiments"
# The event loop is asked at this interval whether it runs.
ALIVE_S = 0.2

# A person, a script and a polling page stay far below these limits. A client in an endless loop does not.
CLIENT_BURST, CLIENT_PER_S = 20.0, 10.0
TOTAL_BURST, TOTAL_PER_S = 100.0, 50.0
# A client that reconnects to reset its own limit still meets the total limit.
MAX_CLIENTS = 256

Request: TypeAlias = Mapping[str, Any]
Reply: TypeAlias = dict[str, Any]
Handler: TypeAlias = Callable[[Request], Awaitable[Reply]]


class CommandRefusedError(Exception):
    """A command is refused; the message is the reason that the operator reads, and `facts` are for his program."""

    def __init__(self, reason: str, **facts: Any) -> None:
        super().__init__(reason)
        self.facts = facts


class RateLimit:
    """Limits the requests of each client and of all clients together."""

    def __init__(self) -> None:
        self._total = TokenBucket(TOTAL_BURST, TOTAL_PER_S)
        # The number of remembered clients; the oldest are forgotten.
        self._bucket_of = lru_cache(MAX_CLIENTS)(lambda _client: TokenBucket(CLIENT_BURST, CLIENT_PER_S))

    @property
    def remembered(self) -> int:
        """How many clients have a limit of their own at present."""
        return self._bucket_of.cache_info().currsize

    def allow(self, client: bytes, t_ns: int) -> bool:
        """Return whether a client may send one more request at monotonic time t_ns.

        Requests above a client's own limit do not count against the total.
        """
        return self._bucket_of(client).allow(t_ns) and self._total.allow(t_ns)


class RequestExecutor:
    """Checks requests and executes commands; the sockets around it receive and reply."""

    def __init__(self, handlers: Mapping[str, Handler], refusals: Refusals, *, emulated: bool = False) -> None:
        """Begin without requests; replies of an `emulated` rig say that it is one."""
        self._handlers = handlers
        self._mark: Reply = {"emulated": True} if emulated else {}
        self._refusals = refusals
        self._limit = RateLimit()
        self._running = 0

    def check(
        self, client: bytes, frames: list[bytes], t_ns: int, why_late: str | None = None
    ) -> tuple[str, Request] | Reply:
        """Return the name and content of a valid request, or the refusal; t_ns is the monotonic time.

        `why_late` says that it may be too old to be carried out; some never are.
        """
        request, problem = {}, ""
        try:
            (frame,) = frames
            request = decode(frame)
        except ValueError as error:
            problem = str(error) if len(frames) == 1 else f"{len(frames)} frames, expected one"
        name = request.get("command")
        if name == STOP and STOP in self._handlers:
            return STOP, request
        if not self._limit.allow(client, t_ns):
            reason = f"too many requests; send at most {CLIENT_PER_S:g} a second"
            return self._refuse("too many requests", reason, frequent=True)
        if problem:
            return self._refuse("malformed request", f"the request is {problem}")
        if not isinstance(name, str) or name not in self._handlers:
            known, shown = ", ".join(sorted(self._handlers)), repr(name)[:40]
            return self._refuse("unknown command", f"there is no command {shown}; the commands are {known}")
        if why_late is not None and name not in NEVER_LATE:
            return self._refuse("late request", why_late)
        if self._running >= MAX_CONCURRENT:
            return self._refuse("too many at once", "too many commands at once; wait")
        return name, request

    async def execute(self, name: str, request: Request) -> Reply:
        """Call the handler and return the reply; a handler's exception becomes a refusal."""
        log = structlog.get_logger()
        self._running += 1
        try:
            reply = await self._handlers[name](request)
        except CommandRefusedError as error:
            return {**self._refuse(f"{name} refused", str(error), frequent=name == STOP), **error.facts}
        except Exception as error:
            # A bug in one handler must not stop the server.
            log.exception("command failed", command=name)
            reason = f"{name} failed ({type(error).__name__}: {error}); see the daemon's log"
            return self._refuse(f"{name} failed", reason)
        finally:
            self._running -= 1
        # Pages and scripts ask for the status every second. A question before a command carries nothing out.
        quiet = name in READ_ONLY or request.get("ask")
        (log.debug if quiet else log.info)("command executed", command=name)
        return {"ok": True, **reply, **self._mark}

    def _refuse(self, kind: str, reason: str, *, frequent: bool = False) -> Reply:
        self._refusals.add(kind, reason, frequent=frequent)
        return {"ok": False, "reason": reason, **self._mark}


async def _stay_alive(late: LateRequests) -> None:
    """Note that the event loop runs, until cancelled."""
    while True:
        late.alive(boot_ns())
        await asyncio.sleep(ALIVE_S)


class CommandServer:
    """Receives requests, passes them to handlers and sends the replies."""

    def __init__(
        self,
        context: zmq.asyncio.Context,
        address: str,
        handlers: Mapping[str, Handler],
        refusals: Refusals,
        keys: "KeyPair | None" = None,
        *,
        emulated: bool = False,
    ) -> None:
        """Bind the socket; raises UserError if the address is in use, malformed, or needs keys."""
        self._requests = RequestExecutor(handlers, refusals, emulated=emulated)
        self._refusals = refusals
        self._socket = context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 100)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_REQUEST_BYTES)
        self._socket.setsockopt(zmq.RCVHWM, MAX_WAITING)
        bind(self._socket, address, "commands", keys)

    async def run(self) -> None:
        """Serve requests until cancelled; a slow command such as `unlock` does not delay a `stop`."""
        late = LateRequests(boot_ns())
        async with asyncio.TaskGroup() as group:
            group.create_task(_stay_alive(late))
            while True:
                parts = await self._socket.recv_multipart()
                why_late = late.why_late(boot_ns())
                # Receiving a message that has already arrived does not yield to other tasks.
                await asyncio.sleep(0)
                # A DEALER sends two frames, a REQ three. Other counts are answered like a DEALER's.
                route = parts[:2] if len(parts) == 3 and not parts[1] else parts[:1]
                checked = self._requests.check(parts[0], parts[len(route) :], time.monotonic_ns(), why_late)
                if isinstance(checked, dict):
                    await self._reply(route, checked)
                else:
                    group.create_task(self._serve(route, *checked))

    async def _serve(self, route: list[bytes], name: str, request: Request) -> None:
        await self._reply(route, await self._requests.execute(name, request))

    async def _reply(self, route: list[bytes], reply: Reply) -> None:
        try:
            await self._socket.send_multipart([*route, encode(reply)], zmq.NOBLOCK)
        except zmq.Again:
            self._refusals.counts["client does not read its replies"] += 1

    @property
    def address(self) -> str:
        """The bound address, with the port that a `*` stands for."""
        return str(self._socket.getsockopt_string(zmq.LAST_ENDPOINT))

    def close(self) -> None:
        """Close the socket after the last replies are sent."""
        self._socket.close()
