"""Default ZeroMQ addresses and timeouts, and which addresses need CURVE keys."""

import errno
import ipaddress
import os
import socket
from pathlib import Path
from urllib.parse import urlsplit

from shearloop.files import expanded_path
from shearloop.words import is_whole_number

PUBLISH_ADDRESS = "tcp://127.0.0.1:7761"
COMMAND_ADDRESS = "tcp://127.0.0.1:7762"
# The daemon's keys and its folder of allowed clients, on the daemon's computer.
SERVER_KEYS = Path("/etc/shearloop/keys")
LARGEST_PORT = 65535
# Bytes of a Unix socket's path (unix(7)).
LONGEST_IPC = 107
# Of the stop socket's name, which has the same bound.
_NAME_BYTES = 80
# The key of the address that a client of the stop socket asks for, and of a reply from a daemon at another one.
ASKED, ELSEWHERE = "address", "elsewhere"
# A running daemon answers within milliseconds.
COMMAND_TIMEOUT_S = 2.0
# The robot may have to power up, release its brakes and start its program, and the gripper to activate.
UNLOCK_TIMEOUT_S = 150.0
# Commands that take longer than an answer: `start` reads a file, which a network drive may delay, and enables motion.
SLOW = ("start", "unlock", "release")
# Commands that change nothing.
READ_ONLY = ("status", "experiments")


def expanded(address: str) -> str:
    """Return an address with `~` and variables of an ipc one's path replaced; raises ValueError as `expanded_path`."""
    scheme, separator, path = address.partition("://")
    return f"ipc://{expanded_path(path)}" if scheme == "ipc" and separator and path else address


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
    return is_whole_number(port, len(str(LARGEST_PORT))) and 0 < int(port) <= LARGEST_PORT


def names_localhost(address: str) -> bool:
    """Return whether a tcp address has the name `localhost`, which a socket cannot be bound to."""
    return address.startswith("tcp://") and urlsplit(address).hostname == "localhost"


def ipc_size(address: str) -> int:
    """Return the bytes of an ipc address's path; 0 for other addresses."""
    return len(os.fsencode(address.removeprefix("ipc://"))) if address.startswith("ipc://") else 0


def needs_keys(address: str) -> bool:
    """Return whether a client needs keys for an address, because it is on another machine.

    A client may use the name `localhost`. A server may not bind to it.
    """
    return address.startswith("tcp://") and not names_localhost(address) and not is_local(address)


def probe(path: str) -> int:
    """Return the error number of a connection to a Unix socket, 0 where a program listens."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        # A listener with a full queue must not block.
        client.setblocking(False)
        error = client.connect_ex(path)
    return 0 if error == errno.EAGAIN else error


def usual(key: str) -> str:
    """Return the usual address of `commands`, or of `publish`."""
    return COMMAND_ADDRESS if key == "commands" else PUBLISH_ADDRESS


def network_refusal(address: str, key: str) -> str:
    """Return the error for a network address without keys; `key` is its key in the configuration."""
    return (
        f"`{key}: {address}` would open the robot to the network: use ipc or a loopback address such as "
        f"{usual(key)}, or add `curve` with keys from `sudo shearloop keys server`"
    )


def stop_name(address: str) -> bytes:
    """Return the abstract name of the stop socket of a daemon, by the port or the path of its `commands`."""
    return b"\0shearloop-stop-" + os.fsencode(address.rpartition(":")[2])[-_NAME_BYTES:]


def is_reached(bound: str, asked: str) -> bool:
    """Return whether a client of this machine that asks for an address means the server that is bound to another one.

    Both have the same port. Another loopback address is another daemon's; any other address of this machine is meant.
    """
    if not bound.startswith("tcp://"):
        return True
    own, host = urlsplit(bound).hostname, urlsplit(asked).hostname
    try:
        ip, asked_ip = ipaddress.ip_address(own or ""), ipaddress.ip_address(host or "")
    except ValueError:
        # A name, such as `localhost`, or all interfaces (`*`).
        return True
    return ip == asked_ip or not (ip.is_loopback and asked_ip.is_loopback)
