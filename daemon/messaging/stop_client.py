"""The client of the stop socket; it imports little, so that `shearloop command stop` is quick on a busy computer."""

import os
import socket
from collections.abc import Mapping
from typing import Any

import msgpack

from shearloop.errors import UserError

# Of the socket's name; a whole name has at most 107 bytes (unix(7)).
_NAME_BYTES = 80
_LARGEST_REPLY_BYTES = 1 << 18


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
