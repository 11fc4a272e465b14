"""CURVE keys: the daemon's own pair, and the clients' public keys.

Key files have the format of `zmq.auth` (ZeroMQ RFC 26): `NAME.key` holds the public key, `NAME.key_secret` both. The
folder of the allowed clients' `.key` files is read again for each new connection (`client_authenticator`).
"""

import os
import shlex
import stat
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import zmq
import zmq.asyncio
from zmq.auth.certs import load_certificate
from zmq.utils import z85

from shearloop.daemon.messaging.addresses import SERVER_KEYS
from shearloop.errors import UserError
from shearloop.files import is_missing, read_file

# The unit's `SetCredential` gives this value until the server key exists.
_NO_CREDENTIAL = "none"
# Cures by whose key is missing or damaged: a client's computer is usually another one than the daemon's.
OWN_CLIENT_CURE = "make one with `shearloop keys client`"
COPIED_SERVER_CURE = f"copy the daemon's server.key there, which its computer usually has in {SERVER_KEYS}"
CLIENTS_PUBLIC_CURE = "take the client.key that `shearloop keys client` has made on the client's computer"
_LARGEST_KEY_BYTES = 1 << 14


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A public key and its secret key, in Z85 (40 characters each)."""

    public: bytes
    secret: bytes = field(repr=False)

    def apply(self, socket: "zmq.Socket[Any]") -> None:
        """Make an unbound socket a CURVE server that asks the authenticator about each client."""
        # Without an authenticator, libzmq accepts every client by default.
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self.secret)


@dataclass(frozen=True, slots=True)
class ClientKeys:
    """The keys of a client: its own pair and the daemon's public key."""

    own: KeyPair
    server_public: bytes

    @classmethod
    def load(cls, key: str | Path, server_key: str | Path) -> Self:
        """Return the keys of `client.key_secret` and `server.key`; raises UserError if they are missing or damaged."""
        own = load_key_pair(Path(key), OWN_CLIENT_CURE)
        return cls(own, load_public_key(Path(server_key), COPIED_SERVER_CURE))

    def apply(self, socket: "zmq.Socket[Any]") -> None:
        """Make an unconnected socket a CURVE client of that daemon."""
        socket.setsockopt(zmq.CURVE_SERVERKEY, self.server_public)
        socket.setsockopt(zmq.CURVE_PUBLICKEY, self.own.public)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self.own.secret)


def keys_command(action: str, folder: Path) -> str:
    """Return the command for an action on the daemon's keys in their folder; root writes the usual one.

    Name the daemon's computer beside it: on a client's computer it would make keys of another daemon.
    """
    if folder == SERVER_KEYS:
        return f"`sudo shearloop keys {action}`"
    return f"`shearloop keys {action} --dir {shlex.quote(str(folder))}`"


def server_cure(folder: Path) -> str:
    """Return the cure for the daemon's keys in their folder, which may be read on the wrong computer."""
    return f"on the daemon's computer, {keys_command('server', folder)} makes the daemon's keys"


def load_public_key(path: Path, cure: str) -> bytes:
    """Return the public key of a file; raises UserError for a secret key, and with the cure where there is none."""
    public, secret = _load(path, cure)
    if secret is not None:
        raise UserError(
            f"{path} holds a secret key, which never leaves its computer: give the file that ends in .key, and make a "
            "new pair if another user may have read this one"
        )
    return public


def load_key_pair(path: Path, cure: str) -> KeyPair:
    """Return the keys of a `.key_secret` file; raises UserError with the cure if they are missing or do not match."""
    public, secret = _load(path, cure)
    if secret is None:
        raise UserError(f"{path} holds no secret key; give the file that ends in .key_secret")
    if path.stat().st_mode & stat.S_IROTH:
        raise UserError(
            f"{path}: every user of this machine can read the secret key: run "
            f"`chmod 600 {shlex.quote(str(path))}`, and make a new pair if another user may have read it; {cure}"
        )
    if zmq.curve_public(secret) != public:
        raise UserError(f"{path}: its public and its secret key do not match; {cure}")
    return KeyPair(public, secret)


def server_key_file(configured: Path) -> Path:
    """Return the configured file, or the systemd credential of the same name if there is one."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    credential = Path(folder, configured.name) if folder else None
    return credential if credential is not None and credential.exists() else configured


def load_server_keys(configured: Path) -> KeyPair:
    """Return the daemon's own keys; raises UserError if they do not exist yet."""
    path = server_key_file(configured)
    if path != configured and path.read_text(encoding="utf-8", errors="replace").strip() == _NO_CREDENTIAL:
        command = keys_command("server", configured.parent)
        raise UserError(f"{configured} does not exist; run {command}, then restart the service")
    return load_key_pair(path, server_cure(configured.parent))


def make_key_pair(folder: Path, name: str) -> tuple[Path, Path]:
    """Write NAME.key, readable by all, and NAME.key_secret, readable by its owner; return both paths.

    Raises UserError if they cannot be written or exist already.
    """
    public, secret = zmq.curve_keypair()
    public_path, secret_path = folder / f"{name}.key", folder / f"{name}.key_secret"
    with writing_keys():
        folder.mkdir(parents=True, exist_ok=True)
        _write_new(secret_path, _key_file(public, secret), 0o600)
    write_public_key(public_path, public)
    return public_path, secret_path


def write_public_key(path: Path, public: bytes) -> None:
    """Write a new public key file, readable by all; raises UserError if it exists or cannot be written."""
    with writing_keys():
        _write_new(path, _key_file(public), 0o644)


@contextmanager
def writing_keys() -> Iterator[None]:
    """Raise UserError where a key file or its folder exists already or cannot be written."""
    try:
        yield
    except FileExistsError as error:
        raise UserError(f"{error.filename} exists already; remove it first if you want a new one") from error
    except OSError as error:
        cure = (
            "run it with sudo, or choose another --dir"
            if isinstance(error, PermissionError)
            else "choose another --dir"
        )
        raise UserError(f"{error.filename} cannot be written: {error.strerror}; {cure}") from error


@dataclass(frozen=True, slots=True)
class AllowedClients:
    """The name of each allowed client by public key, and a sentence for each file that is no key."""

    names: dict[bytes, str]
    unusable: tuple[str, ...]


def allowed_clients(folder: Path) -> AllowedClients:
    """Return the allowed clients; a file that is no key concerns no other. Raises UserError without the folder."""
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == ".key")
    except OSError as error:
        raise UserError(
            f"{folder}: the allowed clients' keys cannot be read: {error.strerror}; "
            f"on the daemon's computer, {keys_command('server', folder.parent)} makes the folder"
        ) from error
    names: dict[bytes, str] = {}
    unusable: list[str] = []
    for path in paths:
        try:
            names[load_public_key(path, CLIENTS_PUBLIC_CURE)] = path.stem
        except UserError as error:
            unusable.append(str(error))
    return AllowedClients(names, tuple(unusable))


def check_allowed_clients(folder: Path) -> AllowedClients:
    """Return the allowed clients; raises UserError also where none could connect."""
    clients = allowed_clients(folder)
    if not clients.names:
        why = "; ".join(clients.unusable) or f"{folder} holds no key"
        command = keys_command("allow FILE", folder.parent)
        raise UserError(f"{why}, so no client could connect; allow one with {command}")
    return clients


def _load(path: Path, cure: str) -> tuple[bytes, bytes | None]:
    try:
        # A key file is small, no device, and not empty as files of the kernel are, which may have no end.
        if not read_file(path, _LARGEST_KEY_BYTES):
            raise ValueError
        public, secret = load_certificate(path)
    except PermissionError as error:
        raise UserError(f"{path}: this user may not read the key; run as its owner, or with sudo") from error
    except OSError as error:
        ending = f"; {cure}" if is_missing(error) else ""
        raise UserError(f"{path}: the key cannot be read: {error.strerror or error}{ending}") from error
    except ValueError as error:
        raise UserError(f"{path} is no key file; {cure}") from error
    try:
        sizes = {len(z85.decode(key)) for key in (public, secret) if key is not None}
    except (KeyError, ValueError, struct.error):
        sizes = set()
    if sizes != {32}:
        raise UserError(f"{path} holds a damaged key; {cure}")
    return public, secret


def _key_file(public: bytes, secret: bytes | None = None) -> str:
    lines = ["# shearloop: a ZeroMQ CURVE key. " + ("Keep it secret." if secret else "It is public.")]
    lines += ["metadata", "curve", f'    public-key = "{public.decode()}"']
    return "\n".join(lines + ([f'    secret-key = "{secret.decode()}"'] if secret else [])) + "\n"


def _write_new(path: Path, text: str, mode: int) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        # The umask must not make a key unreadable for the daemon.
        os.fchmod(descriptor, mode)
        file.write(text)
