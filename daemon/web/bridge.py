"""Between the daemon's sockets and the page: messages in, commands out."""

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import zmq
import zmq.asyncio

from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.keys import ClientKeys
from shearloop.daemon.messaging.messages import EitFrame, EitHeatmap, decode
from shearloop.daemon.messaging.patience import COMMAND_TIMEOUT_S, UNLOCK_TIMEOUT_S
from shearloop.daemon.messaging.subscriber import connect
from shearloop.daemon.messaging.topics import TOPICS
from shearloop.daemon.web.asked import Requests
from shearloop.daemon.web.latest import Latest

# The largest message is a heatmap of 200 × 200 float32.
LARGEST_MESSAGE_BYTES = 1 << 20
HIGH_WATER_MARK = 1000
COMMANDS_AT_ONCE = 4


@dataclass(frozen=True, slots=True)
class Place:
    """Where a daemon is found, with the keys for one on the network."""

    publish: str
    commands: str
    keys: ClientKeys | None = None
    # Where a stop is heard now: where commands need a key, a socket of this machine's own that needs none.
    stop_address: Callable[[], str] | None = None


class BusyError(Exception):
    """Too many commands are on their way already."""


class Bridge:
    """Keeps the latest messages of one daemon, and passes commands to it."""

    def __init__(self, context: zmq.asyncio.Context, place: Place, latest: Latest) -> None:
        """Connect to the daemon's PUB socket, whether or not it is there; raises UserError for a malformed address."""
        self.latest = latest
        self._place = place
        self._watchers = 0
        self._on_their_way = 0
        self._stopping: asyncio.Future[dict[str, Any]] | None = None
        # Each has a thread of its own: no command can be before a stop in a queue.
        self._requests = Requests()
        self._socket = context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_MESSAGE_BYTES)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        try:
            connect(self._socket, place.publish, place.keys)
            _check_address(context, place)
        except UserError:
            self.close()
            raise
        for topic in TOPICS:
            # Heatmaps only while somebody looks: the daemon computes them for that alone.
            if topic not in (EitFrame.topic, EitHeatmap.topic):
                self._socket.subscribe(topic)

    async def run(self) -> None:
        """Take messages in until cancelled."""
        while True:
            parts = await self._socket.recv_multipart()
            try:
                topic, payload = parts
                content = decode(payload)
            except ValueError:
                self.latest.refuse("malformed message")
                continue
            self.latest.take(topic.decode(errors="replace"), content, time.monotonic())

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Have heatmaps sent while a page is open."""
        self._watchers += 1
        if self._watchers == 1:
            self._socket.subscribe(EitHeatmap.topic)
        try:
            yield
        finally:
            self._watchers -= 1
            if self._watchers == 0:
                self._socket.unsubscribe(EitHeatmap.topic)

    async def command(self, name: str) -> dict[str, Any]:
        """Return the daemon's reply to a command; raises UserError where none comes, BusyError where too many wait."""
        if self._on_their_way >= COMMANDS_AT_ONCE:
            raise BusyError
        self._on_their_way += 1
        try:
            timeout_s = UNLOCK_TIMEOUT_S if name == "unlock" else COMMAND_TIMEOUT_S
            return await self._ask(self._place.commands, {"command": name}, timeout_s)
        finally:
            self._on_their_way -= 1

    async def stop(self) -> dict[str, Any]:
        """Return the daemon's reply to a stop of what moves; all that want it at the same time share one request.

        Raises UserError where no reply comes.
        """
        if self._stopping is None or self._stopping.done():
            place, content = self._place, {"command": "stop", "spare_daemon": True}
            address = place.commands if place.stop_address is None else place.stop_address()
            self._stopping = asyncio.ensure_future(self._ask(address, content, COMMAND_TIMEOUT_S))
        # Shielded: a page that goes away has still said stop.
        return await asyncio.shield(self._stopping)

    async def _ask(self, address: str, content: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        # A socket of this machine's own is spoken to in the clear.
        keys = self._place.keys if address == self._place.commands else None
        return await self._requests.ask(address, content, timeout_s, keys)

    def close(self) -> None:
        """Close the socket; commands on their way are waited for."""
        self._socket.close()
        self._requests.close()


def _check_address(context: zmq.asyncio.Context, place: Place) -> None:
    """Raise UserError for commands at an address that no socket can be connected to, before one is needed."""
    with context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        connect(socket, place.commands, place.keys)
