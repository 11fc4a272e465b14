"""`shearloop view`: what a daemon does, as a page in the browser."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.connection import add_connection, client_keys
from shearloop.daemon.messaging.addresses import COMMAND_ADDRESS, PUBLISH_ADDRESS, needs_keys, stop_address

if TYPE_CHECKING:
    from shearloop.bank.eit.fingertip import Fingertip

PORT = 7760


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `view`."""
    add_connection(parser, PUBLISH_ADDRESS, "where the daemon publishes")
    parser.add_argument(
        "--commands",
        default=COMMAND_ADDRESS,
        metavar="ADDRESS",
        help="where the daemon takes commands (default: %(default)s)",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=PORT,
        help="the page's, on 127.0.0.1; 0 for any that is free (default: %(default)s)",
    )
    parser.add_argument(
        "--fingertip", type=Path, metavar="FILE", help="the fingertip's measures; by default the paper's fingertip"
    )
    parser.add_argument(
        "--token-file",
        type=Path,
        metavar="FILE",
        help="what opens the buttons that move something (default: ~/.local/state/shearloop/view-token)",
    )
    parser.add_argument("--new-token", action="store_true", help="make the token anew; the one before opens nothing")
    parser.add_argument("--json", action="store_true", help="print the page's address as JSON")
    parser.epilog = "Prints the address to open in a browser of this computer, and serves it until Ctrl-C."


def run(args: argparse.Namespace) -> int:
    """Serve the page until SIGINT, SIGTERM or SIGHUP."""
    import asyncio
    import json
    from importlib.util import find_spec

    from shearloop.daemon.errors import UserError

    if find_spec("aiohttp") is None:
        raise UserError("the live view needs aiohttp; install it with `pip install 'shearloop[view]'`")
    if not 0 <= args.port <= 65535:
        raise UserError(f"--port {args.port} is not a port; give one from 1 to 65535, or 0 for any that is free")
    from shearloop.daemon.logs import logging_to_stderr
    from shearloop.daemon.web.bridge import Place
    from shearloop.daemon.web.serve import serve
    from shearloop.daemon.web.token_file import default_path, kept_token

    keys = client_keys(args)
    # Of a daemon on this machine a stop is heard whatever becomes of our keys.
    stop = None if needs_keys(args.commands) else lambda: stop_address(args.commands)
    place = Place(args.connect, args.commands, keys, stop)
    path = args.token_file or default_path()
    token = kept_token(path, anew=args.new_token)
    fingertip = _fingertip(args.fingertip)

    def ready(port: int) -> None:
        page = f"http://127.0.0.1:{port}/"
        if args.json:
            told = {"url": page, "url_with_token": f"{page}#token={token}", "token_file": str(path)}
            # At once: who reads it through a pipe waits for it.
            print(json.dumps(told), flush=True)
        else:
            print(f"{page}#token={token}", flush=True)
            print(f"Without what follows the slash the page shows all and stops, but moves nothing. Token: {path}")

    with logging_to_stderr():
        asyncio.run(serve(place, args.port, token, fingertip, ready))
    return 0


def _fingertip(path: Path | None) -> "Fingertip":
    """Return the fingertip that is drawn; raises UserError and GeometryError for a file that describes none."""
    from importlib import resources

    from shearloop.daemon.bank_config import FingertipGeometryConfig
    from shearloop.daemon.config_file import load_yaml_model

    if path is not None:
        return load_yaml_model(path, FingertipGeometryConfig).fingertip()
    with resources.as_file(resources.files("shearloop.daemon.web") / "assets" / "fingertip.yaml") as paper:
        return load_yaml_model(paper, FingertipGeometryConfig).fingertip()
