"""Receives messages over ZeroMQ, as any program on the network side would."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import zmq

from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.addresses import LARGEST_PORT, has_a_port, needs_keys
from shearloop.daemon.messaging.keys import ClientKeys
from shearloop.daemon.messaging.messages import decode

# The slowest topic of a daemon that runs, health, comes once a second.
QUIET_S = 3.0
# A day; what a poll takes at most is some weeks.
LONGEST_TIMEOUT_S = 86_400
_ENVELOPE = frozenset({"timestamp", "t_mono_ns", "seq", "source"})


def messages(
    address: str,
    topics: Iterable[str],
    timeout_s: float | None = None,
    keys: ClientKeys | None = None,
    on_quiet: Callable[[], None] = lambda: None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (topic, content) of every message whose topic starts with one of `topics` (all, when there is none).

    Without `timeout_s` it waits for ever; `on_quiet` is called when nothing has come in the first `QUIET_S`. Raises
    UserError for a malformed address, and when nothing has come for `timeout_s`.
    """
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        connect(socket, address, keys)
        for topic in tuple(topics) or ("",):
            socket.setsockopt(zmq.SUBSCRIBE, topic.encode())
        if timeout_s is None and not socket.poll(int(QUIET_S * 1000)):
            on_quiet()
        while True:
            if timeout_s is not None and not socket.poll(int(timeout_s * 1000)):
                raise UserError(
                    f"nothing was heard from {address} for {timeout_s:g} s; start the daemon with "
                    "`shearloop run CONFIG`, or give the address of its `publish` key with --connect"
                    f"{keys_hint(keys)}"
                )
            parts = socket.recv_multipart()
            try:
                name, payload = parts
                content = decode(payload)
                if missing := _ENVELOPE - content.keys():
                    raise ValueError(f"it lacks {', '.join(sorted(missing))}")
            except ValueError as error:
                raise UserError(
                    f"what {address} publishes is not shearloop's ({error}); give the address of the daemon's "
                    "`publish` key with --connect"
                ) from error
            yield name.decode(errors="replace"), content


def checked_timeout_s(timeout_s: float) -> float:
    """Return a time to wait that was given with --timeout; raises UserError for what is none."""
    if not 0 < timeout_s <= LONGEST_TIMEOUT_S:
        raise UserError(
            f"--timeout {timeout_s:g} is not a time to wait; give seconds above 0, up to {LONGEST_TIMEOUT_S}"
        )
    return timeout_s


def keys_hint(keys: ClientKeys | None) -> str:
    """Return what to look at besides when nobody answers: a daemon on the network says nothing to a wrong key."""
    if keys is None:
        return "; a daemon whose address is one of the network answers nobody without --key and --server-key"
    return "; it answers only keys that it was told of with `shearloop keys allow`"


def connect(socket: "zmq.Socket[Any]", address: str, keys: ClientKeys | None = None) -> None:
    """Connect a socket; a malformed address becomes a sentence, and so does one of the network without keys."""
    if not has_a_port(address):
        raise UserError(
            f"{address} ends in no port, which is a whole number up to {LARGEST_PORT}; give one such as "
            "tcp://127.0.0.1:7761"
        )
    if keys is not None:
        keys.use(socket)
    elif needs_keys(address):
        raise UserError(
            f"{address} is not on this machine: give your key with --key and the daemon's with --server-key, "
            "made by `shearloop keys`"
        )
    try:
        socket.connect(address)
    except zmq.ZMQError as error:
        raise UserError(
            f"{address!r} is not an address ({error.strerror}); it looks like tcp://127.0.0.1:7761"
        ) from error
