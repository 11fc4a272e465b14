"""Where the skin's emulated instruments are to be found, as it is said on the command line."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.emulated.link import checked_link

if TYPE_CHECKING:
    from shearloop.drivers.emulators.skin import Place


def add_place(parser: argparse.ArgumentParser, prefix: str, link_help: str, port_help: str) -> None:
    """Add `--[PREFIX-]link` and `--[PREFIX-]port`, of which one may be given."""
    places = parser.add_mutually_exclusive_group()
    places.add_argument(f"--{prefix}link", type=Path, metavar="PATH", help=link_help)
    places.add_argument(f"--{prefix}port", type=int, metavar="N", help=port_help)


def place(args: argparse.Namespace, prefix: str) -> "Place | None":
    """Return the place that was given; None for a pseudo-terminal without a name. UserError when it cannot be one."""
    from shearloop.daemon.errors import UserError

    link, port = getattr(args, f"{prefix}link"), getattr(args, f"{prefix}port")
    if port is None:
        return checked_link(link)
    if not 0 <= port <= 65535:
        raise UserError(f"--{prefix.replace('_', '-')}port {port} is no port; give 0 to 65535")
    return args.bind, port


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add what all of the skin's emulators take."""
    parser.add_argument("--bind", default="127.0.0.1", metavar="ADDRESS", help="of the sockets (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of all noise (default: %(default)s)")
    parser.add_argument("--speed", type=float, default=1.0, metavar="N", help="times the instruments' own pace")


def check_speed(speed: float) -> None:
    """Raise UserError for a speed that nothing can be played at."""
    import math

    from shearloop.daemon.errors import UserError

    if not (math.isfinite(speed) and speed > 0):
        raise UserError(f"--speed {speed:g} is not above 0")
