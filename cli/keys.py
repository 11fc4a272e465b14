"""`shearloop keys`: make and manage the CURVE keys of daemon and clients for network addresses."""

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

from shearloop.cli.connection import user_key_folder
from shearloop.cli.options import add_action, add_json, add_option, run_action
from shearloop.cli.terminal import print_result
from shearloop.daemon.messaging.addresses import SERVER_KEYS
from shearloop.errors import UserError

run = run_action


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the five actions."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    def action(
        name: str, summary: str, run: Callable[[argparse.Namespace], int], folder: Path = SERVER_KEYS
    ) -> argparse.ArgumentParser:
        added = add_action(actions, name, summary, run)
        add_option(added, "--dir", Path, "DIR", "folder of the keys (default: %(default)s)", default=folder)
        add_json(added)
        return added

    action("server", "make the daemon's keys and the folder of allowed clients", _server)
    action("client", "make your own keys, on the client's machine", _client, user_key_folder())
    allow = action("allow", "allow a client", _allow)
    add_option(allow, "key", Path, "FILE", "the client's .key, which is public")
    allow.add_argument("--name", help="the client's name in the daemon's log (default: the file's name)")
    revoke = action("revoke", "remove a client", _revoke)
    revoke.add_argument("name", metavar="NAME", help="a name from `shearloop keys list`")
    action("list", "show the daemon's public key and the allowed clients", _list)


def _server(args: argparse.Namespace) -> int:
    from shearloop.daemon.messaging.keys import keys_command, make_key_pair, writing_keys

    # A configuration reads paths from its own folder, and this shell may stand in another one.
    folder = args.dir.absolute()
    public, secret = make_key_pair(folder, "server")
    clients = folder / "clients"
    with writing_keys():
        clients.mkdir(exist_ok=True)
        clients.chmod(0o755)
    sentences = [
        f"{secret}: the daemon's secret key; only the daemon may read it",
        f"{public}: give this file to every client, as ~/.config/shearloop/server.key",
        f"next: {keys_command('allow FILE', folder)} for each client's .key, then add to the configuration:",
        f"curve: {_in_braces({'server_key': str(secret), 'clients': str(clients)})}",
    ]
    content = {"secret_file": str(secret), "public_file": str(public), "clients": str(clients)}
    return print_result(content, sentences, as_json=args.json)


def _in_braces(section: dict[str, str]) -> str:
    """Return a section of a configuration in one line, with quotes where a text needs them."""
    import yaml

    text = yaml.safe_dump(section, default_flow_style=True, sort_keys=False, width=sys.maxsize, allow_unicode=True)
    return text.strip()


def _client(args: argparse.Namespace) -> int:
    from shearloop.daemon.messaging.keys import make_key_pair

    folder = args.dir.absolute()
    public, secret = make_key_pair(folder, "client")
    sentences = [
        f"{secret}: your secret key; it never leaves this machine",
        f"{public}: copy this file to the daemon's machine and run `sudo shearloop keys allow FILE --name YOU` there; "
        f"if its keys are not in {SERVER_KEYS}, add `--dir` with their folder",
        f"copy the daemon's server.key back to {folder / 'server.key'}",
    ]
    return print_result({"secret_file": str(secret), "public_file": str(public)}, sentences, as_json=args.json)


def _allow(args: argparse.Namespace) -> int:
    from shearloop.daemon.messaging.keys import (
        CLIENTS_PUBLIC_CURE,
        allowed_clients,
        load_public_key,
        server_cure,
        write_public_key,
    )

    public = load_public_key(args.key, CLIENTS_PUBLIC_CURE)
    name, clients = args.name or args.key.stem, args.dir / "clients"
    _check_name(name)
    allowed, server = allowed_clients(clients).names, args.dir / "server.key"
    if server.exists() and load_public_key(server, server_cure(args.dir.absolute())) == public:
        raise UserError(f"{args.key} is the daemon's own key: allow the client.key that `shearloop keys client` makes")
    if public in allowed:
        raise UserError(f"{args.key} is allowed already, as {allowed[public]}")
    if name in allowed.values():
        raise UserError(f"there is a client {name!r} already; choose another with --name, or revoke it first")
    write_public_key(clients / f"{name}.key", public)
    return print_result({"allowed": name}, [f"{name} may connect now"], as_json=args.json)


def _revoke(args: argparse.Namespace) -> int:
    from shearloop.daemon.messaging.keys import allowed_clients, writing_keys

    _check_name(args.name)
    path = args.dir / "clients" / f"{args.name}.key"
    if not path.exists():
        known = ", ".join(sorted(allowed_clients(path.parent).names.values())) or "none"
        raise UserError(f"there is no client {args.name!r}; the allowed clients are {known}")
    with writing_keys():
        path.unlink()
    sentence = f"{args.name} may not connect any more; restart the daemon to end an open connection"
    return print_result({"revoked": args.name}, [sentence], as_json=args.json)


def _list(args: argparse.Namespace) -> int:
    from shearloop.daemon.messaging.keys import allowed_clients, keys_command, load_public_key, server_cure

    server = load_public_key(args.dir / "server.key", server_cure(args.dir.absolute())).decode()
    allowed = allowed_clients(args.dir / "clients")
    clients = {name: key.decode() for key, name in allowed.names.items()}
    sentences = [f"{server}  the daemon", *(f"{key}  {name}" for name, key in clients.items()), *allowed.unusable]
    if not clients:
        sentences.append(f"no client may connect yet; allow one with {keys_command('allow FILE', args.dir.absolute())}")
    return print_result({"server": server, "clients": clients}, sentences, as_json=args.json)


def _check_name(name: str) -> None:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", name):
        raise UserError(f"{name!r} is not a client's name; use letters, digits, `-`, `_` and `.`")
