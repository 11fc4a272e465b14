"""`shearloop bank`: solve, build, inspect and draw banks of simulated signals."""

import argparse
import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shearloop.daemon.cli import CommandModule

_ACTIONS = {
    "build": "build a bank, or go on with one whose build was interrupted",
    "design": "say how much bank a recording's noise asks for, as a configuration for `build`",
    "info": "check a bank's checksums and say what it is of",
    "plot": "draw a bank's signals, and the conductivities of the five models",
    "solve": "solve for the 896 voltages of one conductivity",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the actions and their arguments."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    for name, summary in _ACTIONS.items():
        action = actions.add_parser(name, help=summary, description=summary)
        _module(name).configure(action)


def run(args: argparse.Namespace) -> int:
    """Carry out one action and return the exit status."""
    return _module(args.action).run(args)


def _module(action: str) -> "CommandModule":
    module: CommandModule = importlib.import_module(f"shearloop.daemon.cli.bank.{action}")
    return module
