"""The token that lets the page's user move something: made once, kept in a file that only its owner reads."""

import os
import secrets
import stat
from pathlib import Path

from shearloop.daemon.errors import UserError

TOKEN_BYTES = 32
SHORTEST_TOKEN = 32
LONGEST_TOKEN = 200


def default_path() -> Path:
    """Return where the token is kept when nothing else is said (XDG Base Directory Specification)."""
    state = os.environ.get("XDG_STATE_HOME", "")
    folder = Path(state) if os.path.isabs(state) else Path.home() / ".local" / "state"
    return folder / "shearloop" / "view-token"


def kept_token(path: Path, *, anew: bool = False) -> str:
    """Return the token in a file, made where there is none, or `anew`.

    Raises UserError for a file that others may read, that is not a token, or that cannot be made.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if anew:
            path.unlink(missing_ok=True)
        try:
            return _read(path)
        except FileNotFoundError:
            return _made(path)
    except OSError as error:
        raise UserError(
            f"the token cannot be kept in {path} ({error.strerror}); name another file with --token-file"
        ) from error


def _made(path: Path) -> str:
    token = secrets.token_urlsafe(TOKEN_BYTES)
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    with os.fdopen(handle, "w") as file:
        file.write(f"{token}\n")
    return token


def _read(path: Path) -> str:
    # Not to wait where a pipe lies in the token's place.
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with os.fdopen(handle) as file:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode) or found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
            raise UserError(
                f"{path} must be a file of your own that nobody else may read; "
                "make a new token with --new-token, or name another file with --token-file"
            )
        text = file.read(LONGEST_TOKEN + 1).strip()
    if not (SHORTEST_TOKEN <= len(text) <= LONGEST_TOKEN and text.isascii() and text.isprintable() and " " not in text):
        raise UserError(f"{path} holds no token; make a new one with --new-token, or name another file")
    return text
