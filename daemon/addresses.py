"""Where the daemon is found when nothing else is said, and which addresses are safe without keys."""

import ipaddress
from urllib.parse import urlsplit

PUBLISH_ADDRESS = "tcp://127.0.0.1:7761"
COMMAND_ADDRESS = "tcp://127.0.0.1:7762"


def stays_on_this_machine(address: str) -> bool:
    """Return whether a ZeroMQ address is ipc or a loopback IP: reachable from this machine alone."""
    parts = urlsplit(address)
    if parts.scheme == "ipc":
        return bool(address.removeprefix("ipc://"))
    if parts.scheme != "tcp" or parts.hostname is None:
        return False
    try:
        return ipaddress.ip_address(parts.hostname).is_loopback
    except ValueError:
        return False
