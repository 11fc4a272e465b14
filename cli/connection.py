"""Options of the commands that talk to a daemon: its address, and the client's keys."""

import argparse
import os
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.options import add_option, expanded
from shearloop.daemon.messaging import addresses, stop_client
from shearloop.errors import UserError

if TYPE_CHECKING:
    from shearloop.daemon.messaging.keys import ClientKeys


def _daemon(text: str) -> str:
    return expanded(addresses.expanded, text)


def add_connection(parser: argparse.ArgumentParser, default: str, purpose: str) -> None:
    """Add `--connect`, `--key` and `--server-key`; `purpose` describes the address."""
    add_option(parser, "--connect", _daemon, "ADDRESS", f"{purpose} (default: %(default)s)", default=default)
    add_option(
        parser, "--key", Path, "FILE", "your .key_secret, for a daemon open to the network (default: in ~/.config)"
    )
    add_option(parser, "--server-key", Path, "FILE", "that daemon's .key (default: in ~/.config)")


def with_connection(text: str, args: argparse.Namespace, default: str) -> str:
    """Return a text in which each `shearloop command …` has this command's options of the connection."""
    connect = None if args.connect == default else args.connect
    given = {"--connect": connect, "--key": args.key, "--server-key": args.server_key}
    options = "".join(f" {name} {shlex.quote(str(value))}" for name, value in given.items() if value is not None)
    return re.sub(r"`(shearloop command [^`]+)`", lambda found: f"`{found[1]}{options}`", text)


def user_key_folder() -> Path:
    """Return the folder of the user's keys."""
    home = os.environ.get("XDG_CONFIG_HOME")
    return (Path(home) if home else Path.home() / ".config") / "shearloop"


class MissingKeyError(UserError):
    """A file of the client's keys does not exist."""


def client_keys(args: argparse.Namespace, address: str | None = None) -> "ClientKeys | None":
    """Return the keys for an address, by default that of `--connect`; None where the daemon needs none.

    A daemon that is open to the network needs them on a loopback address too. Raises MissingKeyError for missing keys.
    """
    address = address or args.connect
    why = ""
    if addresses.needs_keys(address):
        why = f"{address} is an address of the network"
    elif stop_client.is_open_to_network(address):
        why = f"the daemon at {address} is open to the network and answers only with keys"
    if not why and args.key is None and args.server_key is None:
        return None
    from shearloop.daemon.messaging.keys import COPIED_SERVER_CURE, OWN_CLIENT_CURE, ClientKeys

    folder = user_key_folder()
    key = args.key or folder / "client.key_secret"
    server_key = args.server_key or folder / "server.key"
    for path, option, cure in ((key, "--key", OWN_CLIENT_CURE), (server_key, "--server-key", COPIED_SERVER_CURE)):
        if not path.exists():
            needed = f"{why}, and " if why else ""
            raise MissingKeyError(f"{needed}there is no key {path}: {cure}, or give {option}")
    return ClientKeys.load(key, server_key)
