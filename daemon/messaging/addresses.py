"""Where the daemon is found when nothing else is said, and which addresses are safe without keys."""

import ipaddress
import socket
from urllib.parse import urlsplit

PUBLISH_ADDRESS = "tcp://127.0.0.1:7761"
COMMAND_ADDRESS = "tcp://127.0.0.1:7762"
LARGEST_PORT = 65535


def stays_on_this_machine(address: str) -> bool:
    """Return whether a ZeroMQ address is ipc or a loopback IP: reachable from this machine alone."""
    parts = urlsplit(address)
    if parts.scheme == "ipc":
        return bool(address.removeprefix("ipc://"))
    # After a semicolon libzmq takes another address.
    if parts.scheme != "tcp" or parts.hostname is None or ";" in address:
        return False
    try:
        return ipaddress.ip_address(parts.hostname).is_loopback
    except ValueError:
        return False


def has_a_port(address: str) -> bool:
    """Return whether a tcp address ends in a port, or in `*` for one that is free; every other address needs none.

    libzmq reads a port up to what is no digit, and takes 65536 off what is too large: 70000 would be 4464.
    """
    port = address.rpartition(":")[2]
    if not address.startswith("tcp://") or port == "*":
        return True
    return port.isascii() and port.isdecimal() and len(port) <= len(str(LARGEST_PORT)) and int(port) <= LARGEST_PORT


def needs_keys(address: str) -> bool:
    """Return whether a client needs keys to speak to an address: it lies beyond this machine.

    The name `localhost` is as good as a loopback IP for one who connects; nobody binds to it.
    """
    return (
        address.startswith("tcp://")
        and urlsplit(address).hostname != "localhost"
        and not stays_on_this_machine(address)
    )


def open_stop_address(address: str) -> str:
    """Return where everyone on the machine can say `stop` to a daemon whose commands are on the network.

    An abstract socket, which has no permissions and leaves no file behind; named by the port of `commands`.
    """
    return f"ipc://@shearloop-stop-{address.rpartition(':')[2]}"


def open_to_the_network(address: str, key: str) -> str:
    """Return the sentence for an address that is not to be bound in the clear."""
    return (
        f"`{key}: {address}` would open the robot to the network: use ipc or a loopback address such as "
        "tcp://127.0.0.1:7761, or add `curve` with keys made by `shearloop keys`"
    )


def stop_address(address: str) -> str:
    """Return where `stop` is heard without a key: the address itself, or the open socket of a daemon on the network."""
    open_address = open_stop_address(address)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect("\0" + open_address.removeprefix("ipc://@"))
        except BlockingIOError:
            return open_address
        except OSError:
            return address
    return open_address
