"""The client of the stop socket; it imports little, so that `shearloop command stop` is quick on a busy computer."""

import ipaddress
import os
import socket
import struct
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, TypeAlias

import msgpack

from shearloop.daemon.messaging.addresses import ASKED, ELSEWHERE, is_local, stop_name
from shearloop.errors import UserError

_IpAddress: TypeAlias = ipaddress.IPv4Address | ipaddress.IPv6Address

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
    return found | {uid for _, uid in _reached_listeners(address)}


def is_open_to_network(address: str) -> bool:
    """Return whether a connection from this computer to a tcp address goes to a listener at all of its addresses.

    A daemon that listens there answers only with keys, also on a loopback address.
    """
    return any(ip.is_unspecified for ip, _ in _reached_listeners(address))


def other_listeners(address: str) -> list[str]:
    """Return the network addresses of this computer at which a program listens on the port of a loopback address.

    Empty where a program listens at that address itself.
    """
    if not is_local(address) or _reached_listeners(address):
        return []
    port = address.rpartition(":")[2]
    others = {ip for ip, _ in _port_listeners(address) if not ip.is_loopback}
    hosts = (f"[{ip}]" if ip.version == 6 else str(ip) for ip in others)
    return sorted(f"tcp://{host}:{port}" for host in hosts)


def _port_listeners(address: str) -> list[tuple[_IpAddress, int]]:
    """Return address and user of each listener on the port of a tcp address."""
    port = address.rpartition(":")[2]
    if not address.startswith("tcp://"):
        return []
    return [(ip, uid) for ip, listens_at, uid in _listeners() if str(listens_at) == port]


def _reached_listeners(address: str) -> list[tuple[_IpAddress, int]]:
    """Return the listeners that a connection to a tcp address of this computer may reach.

    It goes to the listener at this address, and only without one to a listener at all addresses. Any user may listen at
    another address of this computer, such as 127.0.0.2.
    """
    host, listeners = address.removeprefix("tcp://").rpartition(":")[0], _port_listeners(address)
    asked_ip = "127.0.0.1" if host == "localhost" else host.strip("[]")
    at_address = [listener for listener in listeners if str(listener[0]) == asked_ip]
    return at_address or [listener for listener in listeners if listener[0].is_unspecified]


def is_here(address: str) -> bool:
    """Return whether a tcp address has the number of an interface of this computer; no name is looked up."""
    host = address.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    try:
        ip = ipaddress.ip_address(host)
        with socket.socket(socket.AF_INET if ip.version == 4 else socket.AF_INET6, socket.SOCK_DGRAM) as probe:
            # It sends nothing, and fails for an address of another computer.
            probe.bind((host, 0))
    except (ValueError, OSError):
        return False
    return True


def _listeners() -> Iterator[tuple[_IpAddress, int, int]]:
    """Yield address, port and user of each listening TCP socket of this computer."""
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with suppress(OSError), open(table, encoding="ascii") as rows:
            for row in rows:
                columns = row.split()
                if len(columns) > _UID and columns[_STATE] == _LISTENS:
                    # Both are hexadecimal digits; the address has words of 32 bits in the computer's byte order.
                    digits, _, port = columns[_LOCAL].partition(":")
                    words = [int(digits[begin : begin + 8], 16) for begin in range(0, len(digits), 8)]
                    ip = ipaddress.ip_address(struct.pack(f"={len(words)}I", *words))
                    mapped = ip.ipv4_mapped if isinstance(ip, ipaddress.IPv6Address) else None
                    yield mapped or ip, int(port, 16), int(columns[_UID])


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
            client.sendto(msgpack.packb({**content, ASKED: address}), stop_name(address))
        except ConnectionError:
            return None
        data, ancillary, _, _ = client.recvmsg(_LARGEST_REPLY_BYTES, socket.CMSG_SPACE(_CREDENTIALS.size))
    for level, kind, credentials in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
            _, uid, _ = _CREDENTIALS.unpack(credentials)
            if uid not in owners(address):
                raise StopSocketTakenError(
                    f"the stop socket of {address} is held by the user {uid}, who does not run the daemon at this "
                    "address: its reply does not count as a stop; give the daemon's address with --connect, "
                    "or find the process with `sudo ss -xlp`, end it and restart the daemon"
                )
    try:
        # It has no arrays; `messages.decode` would import numpy.
        reply = dict(msgpack.unpackb(data))
    except (TypeError, ValueError) as error:
        raise foreign_reply(address, error) from error
    return None if reply.get(ELSEWHERE) else reply


def nothing_moved(reply: Mapping[str, Any]) -> str:
    """Return in words that a stop has found nothing that moved, and what may have moved when the person asked."""
    ended, stopped, because = (reply.get(key) for key in ("ended_by_itself", "stopped_before", "because"))
    if not (ended or stopped):
        return "nothing was moving"
    how = "had just ended by itself" if ended else "had just been stopped by an earlier stop"
    if because:
        how = f"had just been stopped, because {because}"
    return f"nothing moves any more: {ended or stopped!r} {how}"


def foreign_reply(address: str, error: Exception) -> UserError:
    """Return the error for a reply of another program."""
    return UserError(
        f"the program at {address} is not a shearloop daemon ({error}); give the address of the daemon's "
        "`commands` key with --connect"
    )
