"""Default addresses and timeouts, which addresses need CURVE keys, and the client of the stop socket.

It imports little, so that `shearloop command stop` is quick on a busy computer.
"""

import errno
import ipaddress
import os
import socket
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

import msgpack

from shearloop.daemon.errors import UserError

PUBLISH_ADDRESS = "tcp://127.0.0.1:7761"
COMMAND_ADDRESS = "tcp://127.0.0.1:7762"
LARGEST_PORT = 65535
# A running daemon answers within milliseconds.
COMMAND_TIMEOUT_S = 2.0
# The robot may have to power up, release its brakes and start its program, and the gripper to activate.
UNLOCK_TIMEOUT_S = 60.0
# Of the stop socket's name; a whole name has at most 107 bytes (unix(7)).
_NAME_BYTES = 80
_LARGEST_REPLY_BYTES = 1 << 18


def is_local(address: str) -> bool:
    """Return whether only this machine can reach an address: ipc, or tcp on a loopback IP."""
    parts = urlsplit(address)
    if parts.scheme == "ipc":
        return bool(address.removeprefix("ipc://"))
    # libzmq accepts a second address after a semicolon.
    if parts.scheme != "tcp" or parts.hostname is None or ";" in address:
        return False
    try:
        return ipaddress.ip_address(parts.hostname).is_loopback
    except ValueError:
        return False


def has_valid_port(address: str) -> bool:
    """Return whether a tcp address ends in a port, or in `*` for any free port; other addresses need no port.

    libzmq ignores trailing characters and wraps large numbers: it would take 70000 for 4464.
    """
    port = address.rpartition(":")[2]
    if not address.startswith("tcp://") or port == "*":
        return True
    return port.isascii() and port.isdecimal() and len(port) <= len(str(LARGEST_PORT)) and int(port) <= LARGEST_PORT


def needs_keys(address: str) -> bool:
    """Return whether a client needs keys for an address, because it is on another machine.

    A client may use the name `localhost`. A server may not bind to it.
    """
    return address.startswith("tcp://") and urlsplit(address).hostname != "localhost" and not is_local(address)


def probe(path: str) -> int:
    """Return the error number of a connection to a Unix socket, 0 where a program listens."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        # A listener whose queue is full must not block.
        client.setblocking(False)
        error = client.connect_ex(path)
    return 0 if error == errno.EAGAIN else error


def network_refusal(address: str, key: str) -> str:
    """Return the error for a network address without keys; `key` is its key in the configuration."""
    return (
        f"`{key}: {address}` would open the robot to the network: use ipc or a loopback address such as "
        "tcp://127.0.0.1:7761, or add `curve` with keys from `shearloop keys`"
    )


def stop_name(address: str) -> bytes:
    """Return the abstract name of the stop socket of a daemon, by the port or the path of its `commands`."""
    return b"\0shearloop-stop-" + os.fsencode(address.rpartition(":")[2])[-_NAME_BYTES:]


def send_to_stop_socket(address: str, content: Mapping[str, Any], timeout_s: float) -> dict[str, Any] | None:
    """Send `stop` or `status` to the local daemon with this command address; return its reply, None without a daemon.

    Raises TimeoutError if no reply comes in time, and UserError for a reply of another program.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
        client.settimeout(timeout_s)
        # The kernel chooses an abstract name.
        client.bind("")
        try:
            # Without `connect`, after which only the bound socket itself could reply.
            client.sendto(msgpack.packb(content), stop_name(address))
        except ConnectionError:
            return None
        data = client.recv(_LARGEST_REPLY_BYTES)
    try:
        # It has no arrays, for which `messages.decode` imports numpy.
        return dict(msgpack.unpackb(data))
    except (TypeError, ValueError) as error:
        raise foreign_reply(address, error) from error


def foreign_reply(address: str, error: Exception) -> UserError:
    """Return the error for a reply of another program."""
    return UserError(
        f"the program at {address} is not a shearloop daemon ({error}); give the address of the daemon's "
        "`commands` key with --connect"
    )
