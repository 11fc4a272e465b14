"""The publisher: sends messages over ZeroMQ and passes them to listeners in this process."""

import errno
import os
import stat
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeAlias

import zmq

from shearloop.daemon.clock import Clock
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.addresses import LARGEST_PORT, has_valid_port, is_local, network_refusal, probe
from shearloop.daemon.messaging.keys import KeyPair
from shearloop.daemon.messaging.messages import TOPICS, Message, encode, wire_map

# Messages kept for a slow subscriber. It loses later ones; others are not delayed.
HIGH_WATER_MARK = 1000
# A subscription is a topic's beginning, after about 300 bytes of CURVE handshake. Longer ones end the connection.
LARGEST_SUBSCRIPTION_BYTES = 1024
# The last messages may wait this long for their subscribers.
LINGER_MS = 200
# Subscriptions read at a time, so that a subscriber that keeps changing them cannot block the publisher.
SUBSCRIPTIONS_AT_ONCE = 100
Listener: TypeAlias = Callable[[str, dict[str, Any]], None]


class Publisher:
    """A PUB socket that stamps and numbers each message, and knows which topics have subscribers.

    Sending never blocks. A slow subscriber loses messages and sees gaps in `seq`.
    """

    def __init__(self, context: "zmq.Context[Any]", address: str, clock: Clock, keys: KeyPair | None = None) -> None:
        """Bind the socket; raises UserError if the address is in use, malformed, or needs keys."""
        self._clock = clock
        self._next_seq: Counter[tuple[str, str]] = Counter()
        self._listeners: list[Listener] = []
        # Topic beginnings that have subscribers.
        self._prefixes: tuple[bytes, ...] = ()
        # An XPUB socket is a PUB socket that also receives the subscriptions.
        self._socket: zmq.Socket[bytes] = zmq.Socket(context, zmq.XPUB)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_SUBSCRIPTION_BYTES)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.LINGER, 0)
        bind(self._socket, address, "publish", keys)

    def add_listener(self, listener: Listener) -> None:
        """Call `listener` with topic and content of each message from now on."""
        self._listeners.append(listener)

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
        for listener in self._listeners:
            listener(topic, content)

    def has_subscriber(self, topic: str) -> bool:
        """Return whether there is a subscriber to this topic."""
        if int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            self._read_subscriptions()
        return topic.encode().startswith(self._prefixes)

    def has_subscribers(self) -> bool:
        """Return whether there is a subscriber to any topic."""
        self._read_subscriptions()
        return bool(self._prefixes)

    def close(self) -> None:
        """Close the socket; subscribers have a moment to take the last messages."""
        self._socket.close(linger=LINGER_MS)

    def _read_subscriptions(self) -> None:
        for _ in range(SUBSCRIPTIONS_AT_ONCE):
            if not int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                return
            message = self._socket.recv(zmq.NOBLOCK)
            kind, prefix = message[:1], message[1:]
            # Only beginnings of known topics are kept, which bounds the memory.
            if kind == b"\x01" and any(topic.encode().startswith(prefix) for topic in TOPICS):
                self._prefixes = (*self._prefixes, prefix)
            elif kind == b"\x00":
                self._prefixes = tuple(one for one in self._prefixes if one != prefix)


def bind(socket: "zmq.Socket[Any]", address: str, key: str, keys: KeyPair | None = None) -> None:
    """Bind a socket; a network address needs `keys`. Raises UserError that names `key` of the configuration."""
    try:
        if "://" in address and not is_local(address):
            if keys is None:
                raise UserError(network_refusal(address, key))
            keys.apply(socket)
        if not has_valid_port(address):
            raise UserError(
                f"`{key}: {address}` has no valid port (a whole number up to {LARGEST_PORT}); "
                "use e.g. tcp://127.0.0.1:7761"
            )
        _check_ipc_path(address, key)
        socket.bind(address)
    except UserError:
        socket.close()
        raise
    except zmq.ZMQError as error:
        socket.close()
        if error.errno == zmq.EADDRINUSE:
            raise _in_use(address, key) from error
        raise UserError(
            f"`{key}: {address}` cannot be bound ({error.strerror}); use e.g. tcp://127.0.0.1:7761"
        ) from error


def _check_ipc_path(address: str, key: str) -> None:
    """Raise UserError if an ipc path is in use or is another kind of file: libzmq would delete it and bind."""
    path = address.removeprefix("ipc://")
    if path == address or path.startswith(("@", "*")):
        return
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(mode):
        raise UserError(f"`{key}: {address}` cannot be bound: {path} exists and is no socket; choose another address")
    if (error := probe(path)) == 0:
        raise _in_use(address, key)
    # A killed daemon leaves the socket behind.
    if error != errno.ECONNREFUSED:
        raise UserError(f"`{key}: {address}` cannot be bound ({os.strerror(error)}); choose another address")


def _in_use(address: str, key: str) -> UserError:
    return UserError(
        f"`{key}: {address}` is already in use; is another daemon running? Stop it, or choose another address"
    )
