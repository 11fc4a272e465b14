"""Keeps daemons from starting while a desk command has their robot."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Thread

from shearloop.cli.other_daemon import refuse_second_daemon
from shearloop.daemon.messaging.addresses import stop_name
from shearloop.daemon.messaging.messages import encode
from shearloop.daemon.messaging.stop_socket import LARGEST_DATAGRAM_BYTES
from shearloop.errors import UserError


@contextmanager
def held_from_daemons(commands: str, holder: str) -> Iterator[None]:
    """Keep the daemons of every user of this computer away from an address of `commands`, as a daemon does.

    `holder` is the sentence for who asks there meanwhile. Raises UserError if a daemon, or another holder, has it.
    """
    refuse_second_daemon(commands, cure="")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as held:
        try:
            held.bind(stop_name(commands))
        except OSError as error:
            raise UserError(
                f"the stop socket of `commands: {commands}` is taken ({error.strerror}): a daemon of this or another "
                "user has it and does not answer; `sudo ss -xlp` says who: end it first"
            ) from error
        answering = Thread(target=_answer, args=(held, holder), name="address", daemon=True)
        answering.start()
        try:
            yield
        finally:
            held.shutdown(socket.SHUT_RDWR)
            answering.join()


def _answer(held: socket.socket, holder: str) -> None:
    """Refuse each request until the socket is shut down."""
    while True:
        data, client = held.recvfrom(LARGEST_DATAGRAM_BYTES)
        if not data and not client:
            return
        # A client may have gone, or have no name.
        with suppress(OSError, TypeError):
            held.sendto(encode({"ok": False, "reason": holder}), client)
