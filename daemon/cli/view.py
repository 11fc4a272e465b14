"""`shearloop view`: show a running daemon as a page in the browser."""

import argparse
import asyncio
import json
from importlib import resources
from importlib.util import find_spec
from pathlib import Path

from shearloop.daemon.cli.options import add_connection, add_option, client_keys
from shearloop.daemon.errors import UserError
from shearloop.daemon.messaging.addresses import COMMAND_ADDRESS, PUBLISH_ADDRESS

PORT = 7760


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `view`."""
    add_connection(parser, PUBLISH_ADDRESS, "where the daemon publishes")
    text = "where the daemon takes commands (default: %(default)s)"
    add_option(parser, "--commands", str, "ADDRESS", text, default=COMMAND_ADDRESS)
    text = "the page's port on 127.0.0.1; 0 for any free one (default: %(default)s)"
    add_option(parser, "--port", int, "PORT", text, default=PORT)
    add_option(parser, "--fingertip", Path, "FILE", "the fingertip's dimensions; by default the paper's fingertip")
    text = "the token that permits motion (default: ~/.local/state/shearloop/view-token)"
    add_option(parser, "--token-file", Path, "FILE", text)
    parser.add_argument("--new-token", action="store_true", help="make a new token; the old one becomes invalid")
    parser.add_argument("--json", action="store_true", help="print the page's address as JSON")
    parser.epilog = "Prints the address to open in a browser of this computer, and serves it until Ctrl-C."


def run(args: argparse.Namespace) -> int:
    """Serve the page until SIGINT, SIGTERM or SIGHUP."""
    if find_spec("aiohttp") is None:
        raise UserError("the live view needs aiohttp; install it with `pip install 'shearloop[view]'`")
    if not 0 <= args.port <= 65535:
        raise UserError(f"--port {args.port} is not a port; give one from 1 to 65535, or 0 for any free one")
    from shearloop.daemon.bank_config import FingertipGeometryConfig
    from shearloop.daemon.config_file import load_yaml_model
    from shearloop.daemon.logs import logging_to_stderr
    from shearloop.daemon.web.server import DaemonAddress, default_token_path, load_token, serve

    address = DaemonAddress(args.connect, args.commands, client_keys(args))
    path = args.token_file or default_token_path()
    token = load_token(path, new=args.new_token)
    with resources.as_file(resources.files("shearloop.daemon.web") / "assets" / "fingertip.yaml") as paper:
        fingertip = load_yaml_model(args.fingertip or paper, FingertipGeometryConfig).fingertip()

    def print_address(port: int) -> None:
        page = f"http://127.0.0.1:{port}/"
        if args.json:
            result = {"url": page, "url_with_token": f"{page}#token={token}", "token_file": str(path)}
            print(json.dumps(result), flush=True)
        else:
            print(f"{page}#token={token}", flush=True)
            print(f"Without the token the page shows everything and can stop, but moves nothing. Token: {path}")

    with logging_to_stderr():
        asyncio.run(serve(address, args.port, token, fingertip, print_address))
    return 0
