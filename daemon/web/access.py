"""Access to the page: allowed hosts and origins, and the token that permits motion.

The page listens on loopback, but a browser on this computer also runs pages of other sites. Such a page may reach us
through a host name of its own (DNS rebinding, visible in the Host header) or send cross-site requests (visible in the
Origin header). Every program on this computer may read and stop; commands that move something need the token.
"""

import hmac
import os
import secrets
import stat
from pathlib import Path
from urllib.parse import urlsplit

from shearloop.daemon.errors import UserError

LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
TOKEN_BYTES = 32
TOKEN_LENGTHS = range(32, 201)


def host_allowed(host: str | None) -> bool:
    """Return whether a Host header names loopback, on any port (a tunnel has its own)."""
    if not host or any(letter in host for letter in "@/?#\\"):
        return False
    try:
        parts = urlsplit(f"//{host}")
        name, _ = parts.hostname, parts.port
    except ValueError:
        return False
    return name in LOOPBACK_NAMES


def origin_allowed(origin: str | None, host: str | None) -> bool:
    """Return whether a request comes from the page itself, or from a program that sends no Origin header."""
    return origin is None or (host is not None and origin.lower() == f"http://{host.lower()}")


def token_valid(authorization: str | None, token: str) -> bool:
    """Return whether an Authorization header carries the token; compares in constant time."""
    scheme, _, given = (authorization or "").partition(" ")
    return scheme == "Bearer" and hmac.compare_digest(given.encode(errors="replace"), token.encode())


def default_token_path() -> Path:
    """Return the token's default path (XDG Base Directory Specification)."""
    state = os.environ.get("XDG_STATE_HOME", "")
    folder = Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state"
    return folder / "shearloop" / "view-token"


def load_token(path: Path, *, new: bool = False) -> str:
    """Return the token in a file; create a missing one, and replace it with `new`.

    Raises UserError for a file that others may read, that holds no token, or that cannot be written.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if new:
            path.unlink(missing_ok=True)
        try:
            return _read_token(path)
        except FileNotFoundError:
            token = secrets.token_urlsafe(TOKEN_BYTES)
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
            with os.fdopen(handle, "w") as file:
                file.write(f"{token}\n")
            return token
    except OSError as error:
        raise UserError(
            f"the token cannot be kept in {path} ({error.strerror}); name another file with --token-file"
        ) from error


def _read_token(path: Path) -> str:
    # Without O_NONBLOCK, opening a pipe would block.
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with os.fdopen(handle) as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise UserError(
                f"{path} must be a file of your own that nobody else may read; "
                "make a new token with --new-token, or name another file with --token-file"
            )
        text = file.read(TOKEN_LENGTHS.stop).strip()
    if not (len(text) in TOKEN_LENGTHS and text.isascii() and text.isprintable() and " " not in text):
        raise UserError(f"{path} holds no token; make a new one with --new-token, or name another file")
    return text
