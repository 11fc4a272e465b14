"""`shearloop emulate DEVICE`: plays one device on its own port or socket."""

import argparse
import asyncio
import os
from collections.abc import Sequence
from pathlib import Path

from shearloop.cli import Parser
from shearloop.cli.emulate import devices, rig
from shearloop.errors import UserError

DEVICES = {**devices.DEVICES, **rig.DEVICES}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a sub-parser per device."""
    parsers = parser.add_subparsers(dest="device", metavar="DEVICE", required=True)
    for name, device in DEVICES.items():
        subparser = parsers.add_parser(name, help=device.summary, description=device.summary)
        subparser.set_defaults(play=device.play)
        device.configure(subparser)


def run(args: argparse.Namespace) -> int:
    """Play the device until Ctrl-C, SIGTERM, SIGHUP or the end of standard input.

    Raises UserError for an OSError, alone or in a group: an address, port or path is unusable.
    """
    try:
        asyncio.run(args.play(args))
    except (OSError, BaseExceptionGroup) as errors:
        error: BaseException = errors
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        if not isinstance(error, OSError):
            raise
        where = f"{error.filename}: " if error.filename else ""
        cure = "choose another address, port or path, or end what uses it"
        raise UserError(f"{args.device} cannot be played: {where}{error.strerror or error}; {cure}") from None
    return 0


def checked_arguments(device: str, arguments: Sequence[str], folder: Path) -> argparse.Namespace:
    """Return the parsed arguments of a device, as a configuration in `folder` gives them.

    Raises UserError for wrong arguments and for a missing bank.
    """
    parser = Parser(prog=f"shearloop emulate {device}", allow_abbrev=False, add_help=False)
    DEVICES[device].configure(parser)
    parser.set_defaults(device=device)
    args = parser.parse_args(arguments)
    named = [bank for _, bank in getattr(args, "fingertip", ())]
    for bank in filter(None, (getattr(args, "bank", None), *named)):
        if not (folder / bank).exists():
            from shearloop.bank.bank_file import how_to_build

            cure = how_to_build(Path(os.path.normpath(folder / bank)))
            raise UserError(f"--bank {bank}: there is no such file; {cure}")
    return args
