"""Who may do what with the page: hosts, origins and the token. Decided here, without I/O.

The page is on loopback, but a browser on this computer also runs pages of strangers. Such a page may bring the browser
to ask us by a name of its own that leads here (DNS rebinding: the Host header tells), or send requests across sites
(the Origin header tells). Reading and stopping are for everyone on this computer; what may move something needs the
token.
"""

import hmac
from urllib.parse import urlsplit

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
_BEARER = "Bearer "


def host_allowed(host: str | None) -> bool:
    """Return whether a Host header names this computer by loopback, on whatever port (a tunnel has its own)."""
    if not host or any(letter in host for letter in "@/?#\\"):
        return False
    try:
        parts = urlsplit(f"//{host}")
        name, _ = parts.hostname, parts.port
    except ValueError:
        return False
    return name in LOOPBACK_NAMES


def origin_allowed(origin: str | None, host: str | None) -> bool:
    """Return whether a request comes from the page itself, or from a program that is no browser and sends no Origin."""
    return origin is None or (host is not None and origin.lower() == f"http://{host.lower()}")


def token_given(authorization: str | None, token: str) -> bool:
    """Return whether an Authorization header carries the token; takes the same time for all that do not."""
    if authorization is None or not authorization.startswith(_BEARER):
        return False
    return hmac.compare_digest(authorization.removeprefix(_BEARER).encode(errors="replace"), token.encode())
