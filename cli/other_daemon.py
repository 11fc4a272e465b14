"""A daemon that runs already at the addresses of a configuration, or that starts while a desk command has its robot."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Thread
from typing import Final

from shearloop.daemon.messaging.addresses import stop_name
from shearloop.daemon.messaging.stop_client import send_to_stop_socket
from shearloop.errors import UserError
from shearloop.tools.running_daemon import whose_daemon

# A daemon on a busy computer answers within it.
STATUS_S: Final = 2.0
OTHER_ADDRESSES: Final = "give `publish` and `commands` other addresses in your configuration"


def refuse_second_daemon(commands: str, page: str = "", cure: str = OTHER_ADDRESSES) -> None:
    """Raise UserError if a daemon answers at this address of `commands`, with its process, its folder and its page.

    `cure` says how to run beside it.
    """
    reply = None
    with suppress(TimeoutError):
        reply = send_to_stop_socket(commands, {"command": "status"}, STATUS_S)
    if reply is None:
        return
    if "daemon" not in reply:
        # A desk command holds the address.
        raise UserError(str(reply.get("reason")))
    shown = f", its page is {page}" if page else ""
    raise UserError(
        f"a daemon runs already at {commands}: {whose_daemon(reply)}{shown}; "
        f"`shearloop command stop --connect {commands}` stops its experiment, and a "
        f"second time ends it. To run beside it, {cure}"
    )


@contextmanager
def held_from_daemons(commands: str, holder: str) -> Iterator[None]:
    """Keep the daemons of every user of this computer away from an address of `commands`, as a daemon does.

    `holder` is the sentence for who asks there meanwhile. Raises UserError if a daemon, or another holder, has it.
    """
    refuse_second_daemon(commands)
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
    from shearloop.daemon.messaging.messages import encode
    from shearloop.daemon.messaging.stop_socket import LARGEST_DATAGRAM_BYTES

    while True:
        data, client = held.recvfrom(LARGEST_DATAGRAM_BYTES)
        if not data and not client:
            return
        # A client may have gone, or have no name.
        with suppress(OSError, TypeError):
            held.sendto(encode({"ok": False, "reason": holder}), client)
