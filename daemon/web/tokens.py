"""The token that commands of the live page need: its file, and the check of those that pages send."""

import hmac
import os
import secrets
import stat
from pathlib import Path

from shearloop.daemon.messaging.refusals import TokenBucket
from shearloop.errors import UserError

TOKEN_BYTES = 32
TOKEN_LENGTHS = range(32, 201)
# Wrong tokens that are compared at once, and then per second.
WRONG_BURST, WRONG_PER_S = 20.0, 1.0


class TokenCheck:
    """Checks tokens; after WRONG_BURST wrong ones it refuses all, right or wrong, but for WRONG_PER_S."""

    def __init__(self, token: str) -> None:
        self._token = token
        self._wrong = TokenBucket(WRONG_BURST, WRONG_PER_S)

    def refusal(self, name: str, authorization: str | None, t_ns: int) -> tuple[int, str] | None:
        """Return status and reason if a command with this Authorization header is refused at monotonic time t_ns."""
        if not self._wrong.has_token(t_ns):
            return 429, "too many wrong tokens came; wait a second and try again, or use `shearloop command`"
        if token_valid(authorization, self._token):
            return None
        self._wrong.allow(t_ns)
        return 403, f"{name} needs the token: open the address that `shearloop view` printed"


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
            _check_small(path)
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


def _check_small(path: Path) -> None:
    """Raise UserError for a file that holds more than a token, and is therefore no token's."""
    if path.exists() and path.stat().st_size > TOKEN_LENGTHS.stop:
        raise UserError(
            f"{path} holds more than a token: it was not changed; remove it yourself, or name another file with "
            "--token-file"
        )


def _read_token(path: Path) -> str:
    # Without O_NONBLOCK, opening a pipe would block.
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    with os.fdopen(handle) as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise UserError(
                f"{path} must be a file of your own that no other user may read; "
                "make a new token with --new-token, or name another file with --token-file"
            )
        text = file.read(TOKEN_LENGTHS.stop).strip()
    if not (len(text) in TOKEN_LENGTHS and text.isascii() and text.isprintable() and " " not in text):
        raise UserError(f"{path} holds no token; make a new one with --new-token, or name another file")
    return text
