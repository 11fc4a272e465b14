"""Bound sockets: which addresses may be bound, and how many clients may be connected."""

import asyncio
import contextlib
import ctypes
import errno
import itertools
import os
import resource
import select
import socket
import stat
import struct
from typing import Any

import zmq
import zmq.asyncio

from shearloop.daemon.messaging.addresses import LARGEST_PORT, has_valid_port, is_local, network_refusal, probe
from shearloop.daemon.messaging.keys import ZAP_DOMAIN, KeyPair
from shearloop.daemon.messaging.refusals import Refusals
from shearloop.errors import UserError

# Clients of one socket. Each takes a descriptor and some 50 kB.
MAX_CONNECTIONS, MIN_CONNECTIONS = 256, 16
# Descriptors that clients leave to files, devices and the robot's process.
RESERVED_DESCRIPTORS = 256
# A connection that has not introduced itself by then is closed; one without an acknowledgement for 60 s is closed too.
_OPTIONS = {
    zmq.HANDSHAKE_IVL: 2000,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 30,
    zmq.TCP_KEEPALIVE_INTVL: 10,
    zmq.TCP_KEEPALIVE_CNT: 3,
}
_EVENTS = zmq.EVENT_LISTENING | zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED
_EVENT = struct.Struct("=HI")
# Numbers of the events' addresses. libzmq frees an address some time after its socket is closed, so none is used twice.
_MONITORS = itertools.count()
EVENTS_AT_ONCE = 100
# socket(7) and linux/filter.h: the kernel drops every packet by a program of the one instruction "return 0".
_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
_DROP_ALL = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))
_FILTER = struct.pack("HP", 1, ctypes.addressof(_DROP_ALL))


def most_connections(descriptors: int) -> int:
    """Return how many clients one of the two sockets may have, for a limit of descriptors (RLIMIT_NOFILE)."""
    return max(MIN_CONNECTIONS, min(MAX_CONNECTIONS, (descriptors - RESERVED_DESCRIPTORS) // 2))


class Connections:
    """Binds a socket and bounds the connections of its clients.

    libzmq accepts without a bound, and keeps a core busy once there are no descriptors left. At the bound, the kernel
    drops requests for new TCP connections; open ones continue. Clients of an ipc socket are not bounded: the
    permissions of its file decide who may connect.
    """

    def __init__(
        self, context: "zmq.Context[Any]", bound: "zmq.Socket[Any]", address: str, setting: str, refusals: Refusals
    ) -> None:
        """Bind the socket, named `setting` in the log; raises zmq.ZMQError."""
        self._bound = bound
        self._setting = setting
        self._refusals = refusals
        self._limit = most_connections(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
        self._open: set[int] = set()
        self._full = False
        # With a domain, libzmq asks the authenticator about each new client.
        bound.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN.encode())
        for option, value in _OPTIONS.items():
            bound.setsockopt(option, value)
        monitor = f"inproc://connections-{next(_MONITORS)}"
        bound.monitor(monitor, _EVENTS)
        self._events: zmq.Socket[bytes] = zmq.Socket(context, zmq.PAIR)
        # Without a bound: a full queue would stop libzmq's thread.
        self._events.setsockopt(zmq.RCVHWM, 0)
        self._events.connect(monitor)
        try:
            bound.bind(address)
        except zmq.ZMQError:
            self._stop_counting()
            raise
        _, descriptor = _EVENT.unpack(self._events.recv_multipart()[0])
        self._listener = socket.socket(fileno=os.dup(descriptor))

    async def run(self) -> None:
        """Count the connections until cancelled."""
        arrived = zmq.asyncio.Socket.from_socket(self._events)
        while True:
            await arrived.poll()
            self._count()
            self._limit_new()
            # Events that have already arrived do not yield to other tasks.
            await asyncio.sleep(0)

    def _count(self) -> None:
        for _ in range(EVENTS_AT_ONCE):
            if not int(self._events.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
                return
            kind, descriptor = _EVENT.unpack(self._events.recv_multipart(zmq.NOBLOCK)[0])
            (self._open.add if kind == zmq.EVENT_ACCEPTED else self._open.discard)(descriptor)

    def _limit_new(self) -> None:
        if not self._full and len(self._open) >= self._limit:
            self._full = True
            self._listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, _FILTER)
            reason = f"{self._limit} clients are connected to `{self._setting}`; others wait until one has disconnected"
            self._refusals.add("too many connections", reason, frequent=True)
        elif self._full and len(self._open) <= self._limit * 3 // 4:
            self._full = False
            self._listener.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)

    def disconnect(self, descriptor: int) -> bool:
        """Disconnect the client with this descriptor; return False if it has disconnected already."""
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as client:
            # The number may belong to another file by now; libzmq closes a disconnected client's some time later.
            if _port(client) == _port(self._listener) and not _is_shut(client):
                client.shutdown(socket.SHUT_RDWR)
                return True
        return False

    def close(self) -> None:
        """End the counting; the bound socket's owner closes it afterwards."""
        self._stop_counting()
        self._listener.close()

    def _stop_counting(self) -> None:
        # In this order: libzmq's thread waits forever for a queue that has no reader.
        self._bound.disable_monitor()
        self._events.close()


def _is_shut(one: socket.socket) -> bool:
    """Return whether a socket is shut down in both directions."""
    poll = select.poll()
    poll.register(one, 0)
    return bool(poll.poll(0))


def _port(one: socket.socket) -> Any:
    """Return a socket's own port, or its path."""
    name = one.getsockname()
    return name[1] if isinstance(name, tuple) else name


def bind(
    context: "zmq.Context[Any]",
    bound: "zmq.Socket[Any]",
    address: str,
    setting: str,
    refusals: Refusals,
    keys: KeyPair | None = None,
) -> Connections:
    """Bind a socket; a network address needs `keys`. Raises UserError that names `setting` of the configuration."""
    try:
        if "://" in address and not is_local(address):
            if keys is None:
                raise UserError(network_refusal(address, setting))
            keys.apply(bound)
        if not has_valid_port(address):
            raise UserError(
                f"`{setting}: {address}` has no valid port (a whole number up to {LARGEST_PORT}); "
                "use e.g. tcp://127.0.0.1:7761"
            )
        _check_ipc_path(address, setting)
        return Connections(context, bound, address, setting, refusals)
    except UserError:
        bound.close()
        raise
    except zmq.ZMQError as error:
        bound.close()
        if error.errno == zmq.EADDRINUSE:
            raise _in_use(address, setting) from error
        raise UserError(
            f"`{setting}: {address}` cannot be bound ({error.strerror}); use e.g. tcp://127.0.0.1:7761"
        ) from error


def _check_ipc_path(address: str, setting: str) -> None:
    """Raise UserError if an ipc path is in use or is another kind of file: libzmq would delete it and bind."""
    path = address.removeprefix("ipc://")
    if path == address or path.startswith(("@", "*")):
        return
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        # Nothing is there, or libzmq says why it cannot be reached. Another daemon may just have removed it.
        return
    if not stat.S_ISSOCK(mode):
        raise UserError(
            f"`{setting}: {address}` cannot be bound: {path} exists and is no socket; choose another address"
        )
    if (error := probe(path)) == 0:
        raise _in_use(address, setting)
    # A killed daemon leaves the socket behind, and one that ends removes it.
    if error not in (errno.ECONNREFUSED, errno.ENOENT):
        raise UserError(f"`{setting}: {address}` cannot be bound ({os.strerror(error)}); choose another address")


def _in_use(address: str, setting: str) -> UserError:
    return UserError(
        f"`{setting}: {address}` is already in use; is another daemon running? Stop it, or choose another address"
    )
