"""The publisher: sends messages over ZeroMQ and passes them to listeners in this process."""

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

import structlog
import zmq
import zmq.asyncio

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.bound_sockets import bind
from shearloop.daemon.messaging.messages import TOPICS, Message, encode, wire_map
from shearloop.daemon.messaging.refusals import is_logged

if TYPE_CHECKING:
    # Only a network address has keys.
    from shearloop.daemon.messaging.keys import KeyPair

# Messages kept for a slow subscriber. It loses later ones; others are not delayed.
HIGH_WATER_MARK = 1000
# A subscription is a topic's beginning, after 25 bytes of handshake or 300 with CURVE. Longer ones end the connection.
LARGEST_SUBSCRIPTION_BYTES, LARGEST_WITH_KEYS_BYTES = 64, 512
# The last messages may wait this long for their subscribers.
LINGER_MS = 200
# Subscriptions read at a time, so that a subscriber that keeps changing them cannot block the publisher.
SUBSCRIPTIONS_AT_ONCE = 8
# The kind of error in `health` of a listener that raised an exception.
LISTENER_FAILED = "listener failed"
Listener: TypeAlias = Callable[[str, dict[str, Any]], None]


class Publisher:
    """A PUB socket that stamps and numbers each message, and knows which topics have subscribers.

    Sending never blocks. A slow subscriber loses messages and sees gaps in `seq`.
    """

    def __init__(self, context: "zmq.Context[Any]", address: str, clock: Clock, keys: "KeyPair | None" = None) -> None:
        """Bind the socket; raises UserError if the address is in use, malformed, or needs keys."""
        self._clock = clock
        self._next_seq: Counter[tuple[str, str]] = Counter()
        # Each with whether its errors are raised.
        self._listeners: list[tuple[Listener, bool]] = []
        # Topic beginnings that have subscribers.
        self.prefixes: tuple[bytes, ...] = ()
        self._errors: Counter[str] = Counter()
        # An XPUB socket is a PUB socket that also receives the subscriptions.
        self._socket: zmq.Socket[bytes] = zmq.Socket(context, zmq.XPUB)
        largest = LARGEST_SUBSCRIPTION_BYTES if keys is None else LARGEST_WITH_KEYS_BYTES
        self._socket.setsockopt(zmq.MAXMSGSIZE, largest)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.RCVHWM, SUBSCRIPTIONS_AT_ONCE)
        # Every subscription is passed on, even if another client has the same.
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)
        self._socket.setsockopt(zmq.LINGER, 0)
        bind(self._socket, address, "publish", keys)

    async def run(self) -> None:
        """Read the subscriptions until cancelled."""
        arrived = zmq.asyncio.Socket.from_socket(self._socket)
        while True:
            await arrived.poll()
            self._read_subscriptions()
            # Subscriptions that have already arrived do not yield to other tasks.
            await asyncio.sleep(0)

    def diagnostics(self) -> Mapping[str, Mapping[str, int]]:
        """Return the listeners' errors for `health`."""
        return {"errors": dict(self._errors)}

    def add_listener(self, listener: Listener, *, raises: bool = False) -> None:
        """Call `listener` with topic and content of each message from now on.

        Its errors are logged and counted: they do not end the task that publishes. With `raises` they end it, for a
        command that has no use without the listener.
        """
        self._listeners.append((listener, raises))

    def publish(self, message: Message) -> None:
        """Stamp, number and send one message."""
        stream = (message.topic, message.source)
        seq = self._next_seq[stream]
        self._next_seq[stream] = seq + 1
        if self._listeners or self.has_subscriber(message.topic):
            self.forward(message.topic, wire_map(message, self._clock.unix_s(message.t_mono_ns), seq))

    def forward(self, topic: str, content: dict[str, Any]) -> None:
        """Send the map of a message that is stamped and numbered already."""
        if self.has_subscriber(topic):
            self._socket.send_multipart([topic.encode(), encode(content)], zmq.NOBLOCK)
        for listener, raises in self._listeners:
            try:
                listener(topic, content)
            except Exception:
                if raises:
                    raise
                self._on_listener_error(topic)

    def _on_listener_error(self, topic: str) -> None:
        """Count the present exception, and log it at counts 1, 10, 100 and so on."""
        self._errors[LISTENER_FAILED] += 1
        count = self._errors[LISTENER_FAILED]
        if is_logged(count):
            structlog.get_logger().exception("a listener of the messages failed", topic=topic, count=count)

    def has_subscriber(self, topic: str) -> bool:
        """Return whether there is a subscriber to this topic."""
        if int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            self._read_subscriptions()
        return topic.encode().startswith(self.prefixes)

    def has_subscribers(self) -> bool:
        """Return whether there is a subscriber to any topic."""
        self._read_subscriptions()
        return bool(self.prefixes)

    @property
    def address(self) -> str:
        """The bound address, with the port that a `*` stands for."""
        return str(self._socket.getsockopt_string(zmq.LAST_ENDPOINT))

    def close(self) -> None:
        """Close the socket; subscribers have a moment to take the last messages."""
        self._socket.close(linger=LINGER_MS)

    def _read_subscriptions(self) -> None:
        for _ in range(SUBSCRIPTIONS_AT_ONCE):
            if not int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                return
            message = self._socket.recv(zmq.NOBLOCK)
            kind, prefix = message[:1], message[1:]
            if kind == b"\x00":
                self.prefixes = tuple(one for one in self.prefixes if one != prefix)
            elif kind == b"\x01" and any(topic.encode().startswith(prefix) for topic in TOPICS):
                self.prefixes = tuple({*self.prefixes, prefix})
