"""Connects the page to the daemon's sockets: messages in, commands out."""

import asyncio
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import zmq
import zmq.asyncio

from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.addresses import COMMAND_TIMEOUT_S, UNLOCK_TIMEOUT_S, needs_keys, stop_address
from shearloop.daemon.messaging.client import connect, decode_reply, no_reply
from shearloop.daemon.messaging.keys import ClientKeys
from shearloop.daemon.messaging.messages import TOPICS, EitFrame, EitHeatmap, decode, encode
from shearloop.daemon.web.message_store import MessageStore

# The largest message is a heatmap of 200 × 200 float32.
MAX_MESSAGE_BYTES = 1 << 20
HIGH_WATER_MARK = 1000
MAX_PENDING_COMMANDS = 4


@dataclass(frozen=True, slots=True)
class DaemonAddress:
    """A daemon's sockets, with the keys if it is on the network."""

    publish: str
    commands: str
    keys: ClientKeys | None = None

    def stop_address(self) -> str:
        """Return where to send a stop: a local daemon accepts it even without valid keys."""
        return self.commands if needs_keys(self.commands) else stop_address(self.commands)


class BusyError(Exception):
    """Too many commands are pending."""


class Bridge:
    """Receives the messages of one daemon and sends commands to it."""

    def __init__(self, context: zmq.asyncio.Context, address: DaemonAddress, latest: MessageStore) -> None:
        """Subscribe to the daemon, whether or not it runs; raise UserError for a malformed address."""
        self.latest = latest
        self._context = context
        self._address = address
        self._free = asyncio.Semaphore(MAX_PENDING_COMMANDS)
        self._stopping: asyncio.Future[dict[str, Any]] | None = None
        self._socket = context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        try:
            connect(self._socket, address.publish, address.keys)
            with self._command_socket(address.commands):
                pass
        except UserError:
            self._socket.close()
            raise
        for topic in TOPICS:
            # The daemon computes heatmaps only for subscribers: subscribe while a page is open.
            if topic not in (EitFrame.topic, EitHeatmap.topic):
                self._socket.subscribe(topic)

    async def run(self) -> None:
        """Receive messages until cancelled."""
        while True:
            parts = await self._socket.recv_multipart()
            try:
                topic, payload = parts
                content = decode(payload)
            except ValueError:
                self.latest.refused["malformed message"] += 1
                continue
            self.latest.add(topic.decode(errors="replace"), content, time.monotonic())

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Subscribe to heatmaps while a page is open."""
        # ZeroMQ counts the subscriptions of several pages.
        self._socket.subscribe(EitHeatmap.topic)
        try:
            yield
        finally:
            self._socket.unsubscribe(EitHeatmap.topic)

    async def command(self, name: str) -> dict[str, Any]:
        """Return the daemon's reply to a command; raise UserError without a reply, BusyError if too many wait."""
        if self._free.locked():
            raise BusyError
        async with self._free:
            timeout_s = UNLOCK_TIMEOUT_S if name == "unlock" else COMMAND_TIMEOUT_S
            return await self._request(self._address.commands, {"command": name}, timeout_s)

    async def stop(self) -> dict[str, Any]:
        """Return the daemon's reply to a stop of all motion; simultaneous calls share one request.

        Raises UserError without a reply.
        """
        if self._stopping is None or self._stopping.done():
            content = {"command": "stop", "spare_daemon": True}
            request = self._request(self._address.stop_address(), content, COMMAND_TIMEOUT_S)
            self._stopping = asyncio.ensure_future(request)
        # Shielded: a page that disappears has still requested the stop.
        return await asyncio.shield(self._stopping)

    async def _request(self, address: str, content: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        with self._command_socket(address) as socket:
            try:
                async with asyncio.timeout(timeout_s):
                    await socket.send(encode(content))
                    data = await socket.recv()
            except TimeoutError as error:
                raise no_reply(address, timeout_s, self._address.keys) from error
        return decode_reply(data, address)

    @contextmanager
    def _command_socket(self, address: str) -> "Iterator[zmq.asyncio.Socket]":
        # The local stop socket is not encrypted.
        keys = self._address.keys if address == self._address.commands else None
        with self._context.socket(zmq.DEALER) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            connect(socket, address, keys)
            yield socket

    async def close(self) -> None:
        """Close the socket; wait for a stop that is on its way."""
        self._socket.close()
        if self._stopping is not None:
            await asyncio.gather(self._stopping, return_exceptions=True)
