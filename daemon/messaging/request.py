"""Sends one command to a daemon and waits for its reply."""

from collections.abc import Mapping
from typing import Any

import zmq

from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.keys import ClientKeys
from shearloop.daemon.messaging.messages import decode, encode
from shearloop.daemon.messaging.subscriber import connect, keys_hint


def request(
    address: str, content: Mapping[str, Any], timeout_s: float, keys: ClientKeys | None = None
) -> dict[str, Any]:
    """Return the daemon's reply; raises UserError when none comes in time."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SNDTIMEO, int(timeout_s * 1000))
        connect(socket, address, keys)
        if not (_sent(socket, encode(content)) and socket.poll(int(timeout_s * 1000))):
            raise no_reply(address, timeout_s, keys)
        return reply_of(socket.recv(), address)


def no_reply(address: str, timeout_s: float, keys: ClientKeys | None) -> UserError:
    """Return the error for a request that got no reply."""
    return UserError(
        f"no daemon answered at {address} within {timeout_s:g} s; start it with `shearloop run CONFIG`, "
        f"or give the address of its `commands` key with --connect{keys_hint(keys)}"
    )


def reply_of(data: bytes, address: str) -> dict[str, Any]:
    """Return the decoded reply; raise UserError if it is not a daemon's."""
    try:
        return decode(data)
    except ValueError as error:
        raise UserError(
            f"what answers at {address} is not a daemon of shearloop ({error}); give the address of its `commands` "
            "key with --connect"
        ) from error


def _sent(socket: "zmq.Socket[bytes]", data: bytes) -> bool:
    try:
        socket.send(data)
    except zmq.Again:
        return False
    return True
