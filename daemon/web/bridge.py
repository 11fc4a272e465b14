"""The live page's bridge to one daemon's sockets: its messages in, commands and stops out."""

import asyncio
import contextlib
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import zmq
import zmq.asyncio

from shearloop.daemon.messaging import messages
from shearloop.daemon.messaging.addresses import COMMAND_TIMEOUT_S, SLOW, UNLOCK_TIMEOUT_S, needs_keys
from shearloop.daemon.messaging.bound_requests import CLICK_WITHIN_S, meant_for
from shearloop.daemon.messaging.callers import caller
from shearloop.daemon.messaging.client import UnansweredError, ask, connect
from shearloop.daemon.messaging.keys import ClientKeys
from shearloop.daemon.messaging.stop_client import StopSocketTakenError, send_to_stop_socket
from shearloop.daemon.web.message_store import MessageStore
from shearloop.daemon.web.moments import Moments
from shearloop.errors import UserError

# Names the page as the sender of its commands, together with the viewer's user.
PROGRAM = "the live page"
# The largest message is a heatmap of 200 × 200 float32.
MAX_MESSAGE_BYTES = 1 << 20
HIGH_WATER_MARK = 1000


@dataclass(frozen=True, slots=True)
class DaemonAddress:
    """A daemon's sockets, with the keys of each that is open to the network."""

    publish: str
    commands: str
    publish_keys: ClientKeys | None = None
    command_keys: ClientKeys | None = None


class Bridge:
    """Receives the messages of one daemon and sends commands to it."""

    def __init__(self, context: zmq.asyncio.Context, address: DaemonAddress, latest: MessageStore) -> None:
        """Subscribe to the daemon, whether or not it runs; raise UserError for a malformed address."""
        self.latest = latest
        self.moments = Moments()
        self._context = context
        self.address = address
        self._stopping: asyncio.Future[dict[str, Any]] | None = None
        self._socket = context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        try:
            connect(self._socket, address.publish, address.publish_keys)
            with context.socket(zmq.DEALER) as commands:
                connect(commands, address.commands, address.command_keys)
        except UserError:
            self._socket.close()
            raise
        for topic in messages.TOPICS:
            # The daemon computes heatmaps only for subscribers: subscribe while a page is open.
            if topic not in (messages.EitFrame.topic, messages.EitHeatmap.topic):
                self._socket.subscribe(topic)

    async def run(self) -> None:
        """Receive messages until cancelled."""
        while True:
            parts = await self._socket.recv_multipart()
            try:
                topic, payload = parts
                content = messages.decode(payload)
            except ValueError:
                self.latest.refused["malformed message"] += 1
                continue
            self.latest.add(topic.decode(errors="replace"), content, time.monotonic())

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Subscribe to heatmaps while a page is open."""
        # ZeroMQ counts the subscriptions of several pages.
        self._socket.subscribe(messages.EitHeatmap.topic)
        try:
            yield
        finally:
            self._socket.unsubscribe(messages.EitHeatmap.topic)

    async def experiments(self) -> dict[str, Any]:
        """Return the daemon's list of experiments; raise UserError without a reply."""
        return await self._request({"command": "experiments"}, COMMAND_TIMEOUT_S)

    async def command(self, name: str, clicked_ns: int | None, **arguments: bool | int | str) -> dict[str, Any]:
        """Return the daemon's reply to a command; `clicked_ns` is the time of its moment, None if it is never late.

        Raises LateRequestError if it is too old to be sent, UnansweredError if it was sent and no reply came, and
        UserError if no daemon answers.
        """
        content = {"command": name, "by": caller(PROGRAM), **arguments}
        try:
            status = await self._request({"command": "status"}, COMMAND_TIMEOUT_S)
        except UserError as error:
            raise UserError(f"{error}. `{name}` was not sent") from error
        if not status["ok"]:
            raise UserError(f"{status['reason']}. `{name}` was not sent")
        self._check_shown(status.get("daemon", {}), "nothing was sent to it")
        # The daemon, or this process, may have stood still since the click.
        age_s = self.moments.since_s(clicked_ns) if clicked_ns is not None else 0.0
        content |= meant_for(status, age_s, CLICK_WITHIN_S)
        return await self._request(content, UNLOCK_TIMEOUT_S if name in SLOW else COMMAND_TIMEOUT_S)

    def _check_shown(self, daemon: Mapping[str, Any], done: str) -> None:
        """Raise UserError if the page shows another daemon than this one; `done` says what that one did.

        After a restart of the daemon they differ for a second. Daemons in containers may have the same number of
        process, so their instances decide.
        """
        shown = self.latest.instance
        if shown is not None and daemon.get("instance") != shown:
            raise UserError(
                f"the page shows the daemon at {self.address.publish}, process {self.latest.process}, and the one at "
                f"{self.address.commands} is another one, process {daemon.get('process')}: {done}. After a restart of "
                "the daemon try again; else start the page with the addresses of one daemon"
            )

    async def stop(self) -> dict[str, Any]:
        """Return the daemon's reply to a stop of all motion; simultaneous calls share one request.

        Raises UserError without a reply.
        """
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.ensure_future(self._request_stop())
        # Shielded: a page that disappears has still requested the stop.
        return await asyncio.shield(self._stopping)

    async def _request_stop(self) -> dict[str, Any]:
        content: dict[str, Any] = {"command": "stop", "by": caller(PROGRAM), "spare_daemon": True}
        # It may be sent twice, and is one stop.
        content["request_id"] = self.moments.present()
        reply, waits, address = None, False, self.address.commands
        if not needs_keys(address):
            # A local daemon accepts it even without valid keys.
            with contextlib.suppress(StopSocketTakenError):
                try:
                    reply = await asyncio.to_thread(send_to_stop_socket, address, content, COMMAND_TIMEOUT_S)
                except TimeoutError:
                    waits = True
        try:
            reply = reply or await self._request(content, COMMAND_TIMEOUT_S)
        except UserError as error:
            if waits:
                raise UnansweredError(str(error)) from error
            raise
        # A refusal names no daemon, and stopped none.
        if reply["ok"]:
            self._check_shown(reply, "that one was stopped")
        return reply

    async def _request(self, content: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        return await ask(self._context, self.address.commands, content, timeout_s, self.address.command_keys)

    async def close(self) -> None:
        """Close the socket; wait for a stop that is on its way."""
        self._socket.close()
        if self._stopping is not None:
            await asyncio.gather(self._stopping, return_exceptions=True)
