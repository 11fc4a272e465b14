"""`shearloop view`: show a running daemon as a page in the browser."""

import argparse
import asyncio
import sys
from typing import TYPE_CHECKING

from shearloop.cli.connection import MissingKeyError, add_connection, client_keys
from shearloop.cli.options import PORT, add_fingertip, add_option, load_fingertip
from shearloop.cli.output_paths import output_path
from shearloop.cli.terminal import print_result
from shearloop.daemon.messaging.addresses import COMMAND_ADDRESS, PUBLISH_ADDRESS, needs_keys
from shearloop.errors import UserError
from shearloop.extras import require

if TYPE_CHECKING:
    from shearloop.daemon.messaging.keys import ClientKeys

PAGE_PORT = 7760


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `view`."""
    add_connection(parser, PUBLISH_ADDRESS, "where the daemon publishes")
    text = "where the daemon takes commands (default: %(default)s)"
    add_option(parser, "--commands", str, "ADDRESS", text, default=COMMAND_ADDRESS)
    text = "the page's port on 127.0.0.1; 0 for any free one (default: %(default)s)"
    add_option(parser, "--port", PORT, "PORT", text, default=PAGE_PORT)
    text = "serve Foxglove at this port of 127.0.0.1 instead of the page; 0 for any free one"
    add_option(parser, "--foxglove", PORT, "PORT", text)
    add_fingertip(parser)
    text = "the token that permits motion (default: ~/.local/state/shearloop/view-token)"
    add_option(parser, "--token-file", output_path, "FILE", text)
    parser.add_argument("--new-token", action="store_true", help="make a new token; the old one becomes invalid")
    parser.add_argument("--json", action="store_true", help="print the page's address as JSON")
    parser.epilog = "Prints the address to open in a browser of this computer, and serves it until Ctrl-C."


def run(args: argparse.Namespace) -> int:
    """Serve the page until SIGINT, SIGTERM or SIGHUP."""
    if args.foxglove is None:
        return _serve_page(args)
    of_page = {
        "--commands": args.commands != COMMAND_ADDRESS,
        "--port": args.port != PAGE_PORT,
        "--fingertip": args.fingertip is not None,
        "--token-file": args.token_file is not None,
        "--new-token": args.new_token,
    }
    if unused := [option for option, given in of_page.items() if given]:
        raise UserError(f"{unused[0]} is of the page, and --foxglove serves Foxglove instead of it: leave one out")
    return _serve_foxglove(args)


def _serve_page(args: argparse.Namespace) -> int:
    require("aiohttp", "view", "the live view")
    from shearloop.daemon.logs import logging_to_stderr
    from shearloop.daemon.web.bridge import DaemonAddress
    from shearloop.daemon.web.server import serve
    from shearloop.daemon.web.tokens import default_token_path, load_token

    if (args.connect == PUBLISH_ADDRESS) != (args.commands == COMMAND_ADDRESS):
        raise UserError(
            f"the page would show the daemon at {args.connect} and stop the one at {args.commands}; give both "
            "--connect and --commands of the same daemon"
        )
    address = DaemonAddress(args.connect, args.commands, _keys(args, args.connect), _keys(args, args.commands))
    path = args.token_file or default_token_path()
    token = load_token(path, new=args.new_token)
    fingertip = load_fingertip(args.fingertip)

    def print_address(port: int) -> None:
        page = f"http://127.0.0.1:{port}/"
        result = {"url": page, "url_with_token": f"{page}#token={token}", "token_file": str(path)}
        without = f"Without the token the page shows everything and can stop, but moves nothing. Token: {path}"
        print_result(result, [result["url_with_token"], without], as_json=args.json)

    with logging_to_stderr():
        asyncio.run(serve(address, args.port, token, fingertip, print_address))
    return 0


def _keys(args: argparse.Namespace, address: str) -> "ClientKeys | None":
    """Return the keys for an address; without them a page on the daemon's own machine can still stop."""
    try:
        return client_keys(args, address)
    except MissingKeyError as error:
        if needs_keys(address):
            raise
        print(f"shearloop view: {error}. Without it the page can only stop.", file=sys.stderr, flush=True)
        return None


def _serve_foxglove(args: argparse.Namespace) -> int:
    from shearloop.daemon.messaging.client import receive_messages
    from shearloop.daemon.web.foxglove import FoxgloveServer

    with FoxgloveServer(args.foxglove) as server:
        url = f"ws://127.0.0.1:{server.port}"
        sentence = f"{url}: open this connection in Foxglove, with the layout foxglove.json of `shearloop init`"
        print_result({"url": url}, [sentence], as_json=args.json)
        for topic, content in receive_messages(args.connect, (), keys=client_keys(args)):
            server.publish(topic, content)
    return 0
