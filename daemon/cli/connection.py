"""How a command finds a daemon, on this machine or by keys on another: `--connect`, `--key`, `--server-key`."""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.messaging.addresses import needs_keys

if TYPE_CHECKING:
    from shearloop.daemon.messaging.keys import ClientKeys


def own_key_folder() -> Path:
    """Return where a user's keys lie."""
    home = os.environ.get("XDG_CONFIG_HOME")
    return (Path(home) if home else Path.home() / ".config") / "shearloop"


def add_connection(parser: argparse.ArgumentParser, default: str, what: str) -> None:
    """Add the options of a command that speaks to a daemon; `what` says for what it is connected to."""
    parser.add_argument("--connect", default=default, metavar="ADDRESS", help=f"{what} (default: %(default)s)")
    parser.add_argument(
        "--key", type=Path, metavar="FILE", help="your .key_secret, for a daemon on the network (default: in ~/.config)"
    )
    parser.add_argument("--server-key", type=Path, metavar="FILE", help="that daemon's .key (default: in ~/.config)")


def client_keys(args: argparse.Namespace) -> "ClientKeys | None":
    """Return the keys to connect with, or None for an address on this machine; UserError for keys that are no good."""
    from shearloop.daemon.errors import UserError

    given = (args.key, args.server_key)
    if given == (None, None) and not needs_keys(args.connect):
        return None
    from shearloop.daemon.messaging.keys import ClientKeys, load_key_pair, load_public_key

    folder = own_key_folder()
    key = args.key or folder / "client.key_secret"
    server_key = args.server_key or folder / "server.key"
    for path, option, cure in (
        (key, "--key", "make one with `shearloop keys client`"),
        (server_key, "--server-key", "copy the daemon's server.key there"),
    ):
        if not path.exists():
            raise UserError(
                f"{args.connect} is not on this machine, and there is no key {path}: {cure}, or give {option}"
            )
    return ClientKeys(load_key_pair(key), load_public_key(server_key))
