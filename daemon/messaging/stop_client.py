"""The client of the stop socket; it imports little, so that `shearloop command stop` is quick on a busy computer."""

import os
import socket
import struct
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import msgpack

from shearloop.daemon.messaging.addresses import stop_name
from shearloop.errors import UserError

_LARGEST_REPLY_BYTES = 1 << 18
# struct ucred: process, user, group.
_CREDENTIALS = struct.Struct("=3i")
# Columns of /proc/net/tcp (proc(5)), and the state of a listening socket.
_LOCAL, _STATE, _UID, _LISTENS = 1, 3, 7, "0A"


class StopSocketTakenError(UserError):
    """A user who does not run the daemon has taken the name of its stop socket."""


def owners(address: str) -> set[int]:
    """Return the users with a trusted reply: this one, root, and the owner of the command address."""
    found = {os.getuid(), 0}
    if address.startswith("ipc://"):
        with suppress(OSError):
            found.add(os.stat(address.removeprefix("ipc://")).st_uid)
        return found
    port = address.rpartition(":")[2]
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with suppress(OSError), open(table, encoding="ascii") as rows:
            for row in rows:
                # The address is IP:PORT in hexadecimal digits.
                columns = row.split()
                listens = len(columns) > _UID and columns[_STATE] == _LISTENS
                if listens and port.isdecimal() and columns[_LOCAL].rpartition(":")[2] == f"{int(port):04X}":
                    found.add(int(columns[_UID]))
    return found


def send_to_stop_socket(address: str, content: Mapping[str, Any], timeout_s: float) -> dict[str, Any] | None:
    """Send `stop` or `status` to the local daemon with this command address; return its reply, None without a daemon.

    Raises TimeoutError if no reply comes in time, UserError for a reply of another program, and
    StopSocketTakenError for a reply of a user who does not run the daemon.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
        client.settimeout(timeout_s)
        # The kernel names the sender of each datagram (unix(7)): another user can take the daemon's name first.
        client.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        # The kernel chooses an abstract name.
        client.bind("")
        try:
            # Without `connect`, after which only the bound socket itself could reply.
            client.sendto(msgpack.packb(content), stop_name(address))
        except ConnectionError:
            return None
        data, ancillary, _, _ = client.recvmsg(_LARGEST_REPLY_BYTES, socket.CMSG_SPACE(_CREDENTIALS.size))
    for level, kind, credentials in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
            _, uid, _ = _CREDENTIALS.unpack(credentials)
            if uid not in owners(address):
                raise StopSocketTakenError(
                    f"the stop socket of {address} is held by the user {uid}, who does not run the daemon: nothing was "
                    "stopped by it; `sudo ss -xlp` names the process, end it and restart the daemon"
                )
    try:
        # It has no arrays; `messages.decode` would import numpy.
        return dict(msgpack.unpackb(data))
    except (TypeError, ValueError) as error:
        raise foreign_reply(address, error) from error


def foreign_reply(address: str, error: Exception) -> UserError:
    """Return the error for a reply of another program."""
    return UserError(
        f"the program at {address} is not a shearloop daemon ({error}); give the address of the daemon's "
        "`commands` key with --connect"
    )
