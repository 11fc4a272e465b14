"""Reports the daemon's state to systemd, by sd_notify(3)."""

import os
import socket


def notify(*states: str) -> bool:
    """Send states such as `READY=1` by sd_notify(3) without blocking; return False if systemd does not get them."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as manager:
        try:
            # A leading @ stands for the zero byte of an abstract address.
            manager.sendto("\n".join(states).encode(), f"\0{address[1:]}" if address[0] == "@" else address)
        except OSError:
            return False
    return True
