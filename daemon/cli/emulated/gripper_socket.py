"""`shearloop emulate gripper-socket`: a 2F-140 behind the URCap's socket."""

import argparse
from functools import partial

from shearloop.daemon.cli.emulated import gripper as common


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `emulate gripper-socket`."""
    common.configure(parser, "the address that is listened on")
    parser.add_argument(
        "--bind", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: %(default)s)"
    )
    parser.add_argument("--port", type=int, default=63352, help="0 for a free one (default: %(default)s)")


def run(args: argparse.Namespace) -> int:
    """Play until told to stop."""
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.emulators.robotiq.urcap_face import UrcapServer

    if not 0 <= args.port <= 65535:
        raise UserError(f"--port {args.port} is no port; give 0 to 65535")
    on_port = partial(print, flush=True)
    return common.play_gripper(args, lambda gripper: UrcapServer(gripper, args.bind, args.port, on_port))
