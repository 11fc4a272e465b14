"""A daemon that runs already at the addresses of a configuration."""

import shlex
from contextlib import suppress
from typing import Final

from shearloop.daemon.messaging.stop_client import send_to_stop_socket
from shearloop.errors import UserError
from shearloop.tools.running_daemon import whose_daemon

# A daemon on a busy computer answers within it.
STATUS_S: Final = 2.0
OTHER_ADDRESSES: Final = "give `publish` and `commands` other addresses in your configuration"


def refuse_second_daemon(commands: str, page: str = "", cure: str = OTHER_ADDRESSES) -> None:
    """Raise UserError if a daemon answers at this address of `commands`, with its process, its folder and its page.

    `cure` says how to run beside it; empty where nothing may.
    """
    reply = None
    with suppress(TimeoutError):
        reply = send_to_stop_socket(commands, {"command": "status"}, STATUS_S)
    if reply is None:
        return
    if "daemon" not in reply:
        # A desk command holds the address.
        raise UserError(str(reply.get("reason")))
    connect = f"--connect {shlex.quote(commands)}"
    shown = f", its page is {page}" if page else ""
    raise UserError(
        f"a daemon runs already at {commands}: {whose_daemon(reply)}{shown}; "
        f"`shearloop command stop {connect}` stops its experiment, and a second time ends it. While its "
        f"gripper holds a tool, or may hold one, open the fingers first with `shearloop command release {connect}`, or "
        f"end it with Ctrl-C in its terminal or `systemctl stop shearloop`"
        f"{f'. To run beside it, {cure}' if cure else ''}"
    )
