"""Sends messages over ZeroMQ and hands them to whoever else listens in the process."""

import os
import socket as sockets
import stat
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeAlias

import zmq

from shearloop.daemon.clock import Clock
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.addresses import LARGEST_PORT, has_a_port, open_to_the_network, stays_on_this_machine
from shearloop.daemon.messaging.keys import KeyPair
from shearloop.daemon.messaging.messages import Message, encode, wire_map
from shearloop.daemon.messaging.topics import TOPICS

# Messages kept for a subscriber that reads too slowly; older ones are dropped for it, never delayed for others.
HIGH_WATER_MARK = 1000
# What a subscriber sends is a topic's beginning, and about 300 bytes of CURVE's handshake before it; a peer that sends
# more than this is cut off.
LARGEST_SUBSCRIPTION_BYTES = 1024
# Subscriptions taken in at a time, so that a peer that changes its mind without end keeps nothing waiting.
SUBSCRIPTIONS_AT_ONCE = 100
Listener: TypeAlias = Callable[[str, dict[str, Any]], None]


class Publisher:
    """A PUB socket that stamps and numbers every message, and knows which topics somebody subscribes to.

    Sending never waits: a subscriber that does not keep up loses messages, which it sees as gaps in `seq`.
    """

    def __init__(self, context: "zmq.Context[Any]", address: str, clock: Clock, keys: KeyPair | None = None) -> None:
        """Bind the socket; raises UserError when the address is taken, malformed, or needs keys and has none."""
        self._clock = clock
        self._numbers: Counter[tuple[str, str]] = Counter()
        self._listeners: list[Listener] = []
        # Beginnings of topics that are subscribed to at present.
        self._subscribed: set[bytes] = set()
        # To subscribers an XPUB is a PUB; to us it tells their subscriptions.
        self._socket: zmq.Socket[bytes] = zmq.Socket(context, zmq.XPUB)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_SUBSCRIPTION_BYTES)
        self._socket.setsockopt(zmq.SNDHWM, HIGH_WATER_MARK)
        self._socket.setsockopt(zmq.LINGER, 0)
        bind(self._socket, address, "publish", keys)

    def listen(self, listener: Listener) -> None:
        """Call the listener with topic and content of every message from now on (recorder, console)."""
        self._listeners.append(listener)

    def publish(self, message: Message) -> None:
        """Stamp and number one message, and send it to those who subscribe to it."""
        stream = (message.topic, message.source)
        number = self._numbers[stream]
        self._numbers[stream] = number + 1
        if self._listeners or self.wanted(message.topic):
            self.forward(message.topic, wire_map(message, self._clock.unix_s(message.t_mono_ns), number))

    def forward(self, topic: str, content: dict[str, Any]) -> None:
        """Send a message's map as it is, stamped and numbered already."""
        if self.wanted(topic):
            self._socket.send_multipart([topic.encode(), encode(content)], zmq.NOBLOCK)
        for listener in self._listeners:
            listener(topic, content)

    def wanted(self, topic: str) -> bool:
        """Return whether any subscriber asks for this topic: what is dear to compute waits for that."""
        self._hear_subscribers()
        return any(topic.encode().startswith(beginning) for beginning in self._subscribed)

    @property
    def subscribed(self) -> bool:
        """Whether anybody subscribes to anything."""
        self._hear_subscribers()
        return bool(self._subscribed)

    def close(self) -> None:
        """Close the socket; what is not yet sent is dropped."""
        self._socket.close()

    def _hear_subscribers(self) -> None:
        for _ in range(SUBSCRIPTIONS_AT_ONCE):
            if not int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                return
            message = self._socket.recv(zmq.NOBLOCK)
            kind, beginning = message[:1], message[1:]
            # Only beginnings of our own topics are kept: nobody can fill the memory with others.
            if kind == b"\x01" and any(topic.encode().startswith(beginning) for topic in TOPICS):
                self._subscribed.add(beginning)
            elif kind == b"\x00":
                self._subscribed.discard(beginning)


def bind(socket: "zmq.Socket[Any]", address: str, key: str, keys: KeyPair | None = None) -> None:
    """Bind a socket; a refusal becomes a sentence that names the configuration key and the address.

    Beyond this machine it is encrypted and authenticated by `keys`, or not bound at all.
    """
    try:
        if "://" in address and not stays_on_this_machine(address):
            if keys is None:
                raise UserError(open_to_the_network(address, key))
            keys.serve(socket)
        if not has_a_port(address):
            raise UserError(
                f"`{key}: {address}` ends in no port, which is a whole number up to {LARGEST_PORT}; "
                "use e.g. tcp://127.0.0.1:7761"
            )
        _leave_what_is_there(address, key)
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


def _leave_what_is_there(address: str, key: str) -> None:
    """Refuse an ipc address whose path is taken: libzmq would delete what lies there, whatever it is, and bind."""
    path = address.removeprefix("ipc://")
    if path == address or path.startswith(("@", "*")):
        return
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        return
    if not stat.S_ISSOCK(mode):
        raise UserError(f"`{key}: {address}` cannot be bound: {path} is there and is no socket; choose another address")
    with sockets.socket(sockets.AF_UNIX, sockets.SOCK_STREAM) as probe:
        # Not to wait for a listener whose queue is full: it is in use all the same.
        probe.setblocking(False)
        try:
            probe.connect(path)
        except ConnectionRefusedError:
            # What a daemon that was killed left behind.
            return
        except OSError as error:
            if not isinstance(error, BlockingIOError):
                raise UserError(
                    f"`{key}: {address}` cannot be bound ({error.strerror}); choose another address"
                ) from error
        raise _in_use(address, key)


def _in_use(address: str, key: str) -> UserError:
    return UserError(
        f"`{key}: {address}` is already in use; is another daemon running? Stop it, or choose another address"
    )
