"""`shearloop keys`: the keys of daemon and clients, for addresses that can be reached from the network."""

import argparse
from pathlib import Path

from shearloop.daemon.cli.connection import own_key_folder
from shearloop.daemon.cli.options import add_json
from shearloop.daemon.cli.output import print_result

SERVER_FOLDER = Path("/etc/shearloop/keys")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the five actions and their arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    def action(name: str, summary: str, folder: Path) -> argparse.ArgumentParser:
        added = actions.add_parser(name, help=summary, description=summary)
        added.add_argument(
            "--dir", type=Path, default=folder, metavar="DIR", help="folder of the keys (default: %(default)s)"
        )
        add_json(added)
        return added

    action("server", "make the daemon's keys, and the folder of allowed clients", SERVER_FOLDER)
    action("client", "make your own keys, on the machine that you connect from", own_key_folder())
    allow = action("allow", "let a client in", SERVER_FOLDER)
    allow.add_argument("key", type=Path, metavar="FILE", help="the client's .key, which is no secret")
    allow.add_argument("--name", help="what the client is called in the daemon's log (default: the file's name)")
    revoke = action("revoke", "let a client in no more", SERVER_FOLDER)
    revoke.add_argument("name", metavar="NAME", help="as `shearloop keys list` shows it")
    action("list", "show the daemon's public key and the allowed clients", SERVER_FOLDER)


def run(args: argparse.Namespace) -> int:
    """Carry out one action and return the exit status."""
    {"server": _server, "client": _client, "allow": _allow, "revoke": _revoke, "list": _list}[args.action](args)
    return 0


def _server(args: argparse.Namespace) -> None:
    from shearloop.daemon.messaging.keys import cannot_write, make_key_pair

    public, secret = make_key_pair(args.dir, "server")
    clients = args.dir / "clients"
    try:
        clients.mkdir(exist_ok=True)
        clients.chmod(0o755)
    except OSError as error:
        raise cannot_write(error) from error
    sentences = [
        f"{secret}: the daemon's secret key, for its eyes alone",
        f"{public}: give this file to every client, as ~/.config/shearloop/server.key",
        "next: `shearloop keys allow CLIENT.key` for each client, then add to the configuration:",
        f"curve: {{server_key: {secret}, clients: {clients}}}",
    ]
    told = {"secret_file": str(secret), "public_file": str(public), "clients": str(clients)}
    print_result(told, sentences, as_json=args.json)


def _client(args: argparse.Namespace) -> None:
    from shearloop.daemon.messaging.keys import make_key_pair

    public, secret = make_key_pair(args.dir, "client")
    sentences = [
        f"{secret}: your secret key, which never leaves this machine",
        f"{public}: bring this file to the daemon's machine, and there `sudo shearloop keys allow FILE --name YOU`",
        f"bring the daemon's server.key back, as {args.dir / 'server.key'}",
    ]
    print_result({"secret_file": str(secret), "public_file": str(public)}, sentences, as_json=args.json)


def _allow(args: argparse.Namespace) -> None:
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.messaging.keys import allowed_clients, cannot_write, load_public_key, write_public_key

    public = load_public_key(args.key)
    name, clients = args.name or args.key.stem, args.dir / "clients"
    _check_name(name)
    known = allowed_clients(clients).get(public)
    if known is not None:
        raise UserError(f"{args.key} is allowed already, as {known}")
    try:
        write_public_key(clients / f"{name}.key", public)
    except FileExistsError as error:
        raise UserError(
            f"there is a client {name!r} already; choose another with --name, or revoke it first"
        ) from error
    except OSError as error:
        raise cannot_write(error) from error
    print_result({"allowed": name}, [f"{name} may connect from now on"], as_json=args.json)


def _revoke(args: argparse.Namespace) -> None:
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.messaging.keys import allowed_clients, cannot_write

    clients = args.dir / "clients"
    _check_name(args.name)
    try:
        (clients / f"{args.name}.key").unlink()
    except FileNotFoundError as error:
        known = ", ".join(sorted(allowed_clients(clients).values())) or "nobody"
        raise UserError(f"there is no client {args.name!r}; allowed is {known}") from error
    except OSError as error:
        raise cannot_write(error) from error
    sentence = f"{args.name} may connect no more; restart the daemon to end a connection that is open"
    print_result({"revoked": args.name}, [sentence], as_json=args.json)


def _list(args: argparse.Namespace) -> None:
    from shearloop.daemon.messaging.keys import allowed_clients, load_public_key

    server = load_public_key(args.dir / "server.key").decode()
    clients = {name: key.decode() for key, name in allowed_clients(args.dir / "clients").items()}
    sentences = [f"{server}  the daemon", *(f"{key}  {name}" for name, key in clients.items())]
    if not clients:
        sentences.append("nobody may connect yet; see `shearloop keys allow`")
    print_result({"server": server, "clients": clients}, sentences, as_json=args.json)


def _check_name(name: str) -> None:
    import re

    from shearloop.daemon.errors import UserError

    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", name):
        raise UserError(f"{name!r} is not a client's name; use letters, digits, `-`, `_` and `.`")
