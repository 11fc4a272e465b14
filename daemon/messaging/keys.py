"""CURVE keys: who the daemon is, and which clients it lets in over the network.

Key files are those of `zmq.auth` (ZeroMQ RFC 26): `NAME.key` with the public key, `NAME.key_secret` with both. The
allow-list is a folder of clients' `.key` files, read anew for every client that connects.
"""

import os
import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog
import zmq
import zmq.asyncio
from zmq.auth.base import Authenticator
from zmq.auth.certs import load_certificate
from zmq.utils import z85

from shearloop.daemon.errors import UserError

# systemd puts this in place of a key that has not been made (`SetCredential` in the unit).
_NO_CREDENTIAL = "none"
_DOMAIN = "shearloop"
KEY_LENGTH = 40


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A public key and its secret one, in Z85 (40 characters each)."""

    public: bytes
    secret: bytes = field(repr=False)

    def serve(self, socket: "zmq.Socket[Any]") -> None:
        """Let a socket that is not yet bound talk only to clients that the gatekeeper lets in."""
        socket.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN.encode())
        # Without a gatekeeper nobody comes in; libzmq's own default is to let everyone in.
        socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        socket.setsockopt(zmq.CURVE_SERVER, 1)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self.secret)


@dataclass(frozen=True, slots=True)
class ClientKeys:
    """What a client needs: its own pair, and the public key by which it knows the daemon."""

    own: KeyPair
    server_public: bytes

    def use(self, socket: "zmq.Socket[Any]") -> None:
        """Let a socket that is not yet connected talk only to that daemon."""
        socket.setsockopt(zmq.CURVE_SERVERKEY, self.server_public)
        socket.setsockopt(zmq.CURVE_PUBLICKEY, self.own.public)
        socket.setsockopt(zmq.CURVE_SECRETKEY, self.own.secret)


def load_public_key(path: Path) -> bytes:
    """Return the public key in a file; raises UserError where there is none."""
    return _load(path)[0]


def load_key_pair(path: Path) -> KeyPair:
    """Return the keys in a `.key_secret` file; raises UserError where there are none, or no pair."""
    public, secret = _load(path)
    if secret is None:
        raise UserError(f"{path} holds no secret key; give the file that ends in .key_secret")
    if zmq.curve_public(secret) != public:
        raise UserError(f"{path}: its public and its secret key are no pair; make new ones with `shearloop keys`")
    return KeyPair(public, secret)


def server_key_file(configured: Path) -> Path:
    """Return the configured file, or the credential of its name that systemd hands to the service."""
    folder = os.environ.get("CREDENTIALS_DIRECTORY")
    handed = Path(folder, configured.name) if folder else None
    return handed if handed is not None and handed.exists() else configured


def load_server_keys(configured: Path) -> KeyPair:
    """Return the daemon's own keys; raises UserError that says how to make them."""
    path = server_key_file(configured)
    if path != configured and path.read_text(encoding="utf-8", errors="replace").strip() == _NO_CREDENTIAL:
        raise UserError(f"{configured} has not been made; run `sudo shearloop keys server`, then restart the service")
    return load_key_pair(path)


def make_key_pair(folder: Path, name: str) -> tuple[Path, Path]:
    """Write NAME.key, for everyone to read, and NAME.key_secret, for its owner alone; return their paths.

    Raises UserError where they cannot be written or are there already: nobody is locked out by a second call.
    """
    public, secret = zmq.curve_keypair()
    open_path, secret_path = folder / f"{name}.key", folder / f"{name}.key_secret"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_new(secret_path, _text(public, secret), 0o600)
        write_public_key(open_path, public)
    except FileExistsError as error:
        raise UserError(f"{error.filename} is there already; remove it first if you want a new one") from error
    except OSError as error:
        raise cannot_write(error) from error
    return open_path, secret_path


def cannot_write(error: OSError) -> UserError:
    """Return the sentence for a file that cannot be written."""
    cure = "run it with sudo, or choose another --dir" if isinstance(error, PermissionError) else "choose another --dir"
    return UserError(f"{error.filename} cannot be written: {error.strerror}; {cure}")


def allowed_clients(folder: Path) -> dict[bytes, str]:
    """Return the name of each client by its public key; raises UserError for a folder or a file that is no good."""
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == ".key")
    except OSError as error:
        raise UserError(
            f"{folder}: the allowed clients' keys cannot be read: {error.strerror}; `shearloop keys server` makes it"
        ) from error
    return {load_public_key(path): path.stem for path in paths}


def admitted_clients(folder: Path) -> dict[bytes, str]:
    """Return what `allowed_clients` does; raises UserError for an allow-list that lets nobody in, too."""
    clients = allowed_clients(folder)
    if not clients:
        raise UserError(f"{folder} holds no key, so that nobody could connect; see `shearloop keys allow`")
    return clients


class CurveAuthenticator:
    """Lets in the clients whose keys are in the allow-list, and counts those that it turns away.

    It must be there before a socket is bound. ZAP, ZeroMQ RFC 27.
    """

    def __init__(self, context: "zmq.Context[Any]", clients: Path) -> None:
        """Raise UserError for an allow-list that cannot be read, or that lets nobody in."""
        admitted_clients(clients)
        self._clients = clients
        self.refused: Counter[str] = Counter()
        self._authenticator = Authenticator(context)
        self._authenticator.configure_curve_callback(_DOMAIN, self)
        self._authenticator.start()

    def callback(self, _domain: str, key: bytes) -> bool:
        """Return whether a client with this public key may come in; called by the authenticator."""
        log = structlog.get_logger()
        try:
            name = allowed_clients(self._clients).get(key)
        except UserError as error:
            self.refused["allow-list cannot be read"] += 1
            log.warning("client turned away", why=str(error))
            return False
        if name is None:
            self.refused["key is not allowed"] += 1
            if self.refused["key is not allowed"] == 1:
                log.warning("client turned away: its key is not in the allow-list", key=key.decode())
            return False
        log.info("client let in", client=name)
        return True

    async def run(self) -> None:
        """Answer libzmq's questions until cancelled."""
        asked = zmq.asyncio.Socket.from_socket(self._authenticator.zap_socket)
        while True:
            await self._authenticator.handle_zap_message(await asked.recv_multipart())

    def close(self) -> None:
        """Let nobody in any more."""
        self._authenticator.stop()


def _load(path: Path) -> tuple[bytes, bytes | None]:
    try:
        public, secret = load_certificate(path)
    except PermissionError as error:
        raise UserError(f"{path}: the key may not be read by this user; run as its owner, or with sudo") from error
    except OSError as error:
        why = error.strerror or "there is no such file"
        raise UserError(f"{path}: the key cannot be read: {why}; make it with `shearloop keys`") from error
    except ValueError as error:
        raise UserError(f"{path} is no key file; make one with `shearloop keys`") from error
    for key in (public, secret):
        if key is not None and not _is_key(key):
            raise UserError(f"{path} holds a damaged key; make a new one with `shearloop keys`")
    return public, secret


def _is_key(key: bytes) -> bool:
    if len(key) != KEY_LENGTH:
        return False
    try:
        z85.decode(key)
    except (KeyError, struct.error):
        return False
    return True


def _text(public: bytes, secret: bytes | None = None) -> str:
    lines = ["# shearloop: a ZeroMQ CURVE key. " + ("Keep it secret." if secret else "It may be shown to anyone.")]
    lines += ["metadata", "curve", f'    public-key = "{public.decode()}"']
    return "\n".join(lines + ([f'    secret-key = "{secret.decode()}"'] if secret else [])) + "\n"


def write_public_key(path: Path, public: bytes) -> None:
    """Write a file with a public key for everyone to read; raises OSError, of which one is that it is there already."""
    _write_new(path, _text(public), 0o644)


def _write_new(path: Path, text: str, mode: int) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        # Whatever the umask: a key that the daemon cannot read would let nobody in.
        os.fchmod(descriptor, mode)
        file.write(text)
