"""Looks up the addresses of a computer's name."""

import contextlib
import socket
import threading

# A name server that is out of reach must not delay the message for longer.
RESOLVED_WITHIN_S = 2.0


def look_up(name: str) -> list[str]:
    """Return the present addresses of a name; none if it is not found in time."""
    found: list[str] = []

    def ask() -> None:
        with contextlib.suppress(OSError, UnicodeError):
            answers = socket.getaddrinfo(name, None, type=socket.SOCK_STREAM)
            found.extend(str(answer[4][0]) for answer in answers)

    # A look-up cannot be broken off, and must not keep the process from ending either.
    asking = threading.Thread(target=ask, name="look-up", daemon=True)
    asking.start()
    asking.join(RESOLVED_WITHIN_S)
    return list(found)
