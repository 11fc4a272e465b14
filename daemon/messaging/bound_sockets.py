"""Binds sockets: the allowed addresses and the options of the sockets."""

import errno
import os
import stat
from typing import TYPE_CHECKING, Any

import zmq

from shearloop.daemon.messaging.addresses import LARGEST_PORT, has_valid_port, is_local, network_refusal, probe, usual
from shearloop.errors import UserError

if TYPE_CHECKING:
    # Only a network address has keys.
    from shearloop.daemon.messaging.keys import KeyPair

# libzmq asks the authenticator about each new client of this domain.
ZAP_DOMAIN = "shearloop"
# A connection that has not introduced itself by then is closed; one without an acknowledgement for 60 s is closed too.
_OPTIONS = {
    zmq.HANDSHAKE_IVL: 2000,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 30,
    zmq.TCP_KEEPALIVE_INTVL: 10,
    zmq.TCP_KEEPALIVE_CNT: 3,
}


def bind(bound: "zmq.Socket[Any]", address: str, setting: str, keys: "KeyPair | None" = None) -> None:
    """Bind a socket; a network address needs `keys`. Raises UserError that names `setting` of the configuration."""
    try:
        if "://" in address and not is_local(address):
            if keys is None:
                raise UserError(network_refusal(address, setting))
            keys.apply(bound)
        if not has_valid_port(address):
            raise UserError(
                f"`{setting}: {address}` has no valid port (a whole number from 1 to {LARGEST_PORT}); "
                f"use e.g. {usual(setting)}"
            )
        _check_ipc_path(address, setting)
        bound.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN.encode())
        for option, value in _OPTIONS.items():
            bound.setsockopt(option, value)
        bound.bind(address)
    except UserError:
        bound.close()
        raise
    except zmq.ZMQError as error:
        bound.close()
        if error.errno == zmq.EADDRINUSE:
            raise _in_use(address, setting) from error
        raise UserError(
            f"`{setting}: {address}` cannot be bound ({error.strerror}); use e.g. tcp://127.0.0.1:7761"
        ) from error


def _check_ipc_path(address: str, setting: str) -> None:
    """Raise UserError if an ipc path is in use or is another kind of file: libzmq would delete it and bind."""
    path = address.removeprefix("ipc://")
    if path == address or path.startswith(("@", "*")):
        return
    try:
        mode = os.lstat(path).st_mode
    except OSError:
        # Nothing is there, or libzmq says why it cannot be reached. Another daemon may just have removed it.
        return
    if not stat.S_ISSOCK(mode):
        raise UserError(
            f"`{setting}: {address}` cannot be bound: {path} exists and is no socket; choose another address"
        )
    if (error := probe(path)) == 0:
        raise _in_use(address, setting)
    # A killed daemon leaves the socket behind, and one that ends removes it.
    if error not in (errno.ECONNREFUSED, errno.ENOENT):
        raise UserError(f"`{setting}: {address}` cannot be bound ({os.strerror(error)}); choose another address")


def _in_use(address: str, setting: str) -> UserError:
    return UserError(
        f"`{setting}: {address}` is already in use; is another daemon running? Stop it, or choose another address"
    )
