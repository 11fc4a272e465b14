"""`shearloop calibrate THING`: measures something known, step by step, and writes a calibration file.

`shearloop calibrate REC… --estimator NAME --out CAL` is `shearloop calibrate recording REC…`: an estimator is fitted to
what was recorded. A recording called as a THING is written with its folder, `./load`.

A thing is a module in `daemon.cli.calibrated` with `configure(parser)` and `run(args) -> exit status`, as a command is.
"""

import argparse
import importlib
from collections.abc import Sequence

THINGS = {
    "recording": ("daemon.cli.calibrated.recording", "an estimator, on recordings or folders of slices"),
    "creep": ("daemon.cli.calibrated.creep", "what a gel's torque loses under a held twist, on recordings"),
    "load": ("daemon.cli.calibrated.load", "the load cell, with known masses on it"),
    "gripper": ("daemon.cli.calibrated.gripper", "the gripper's width, with objects of known diameter"),
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a sub-parser per thing."""
    things = parser.add_subparsers(dest="thing", metavar="THING", required=True)
    for name, (module, summary) in THINGS.items():
        part = things.add_parser(name, help=summary, description=f"Calibrate {summary}.")
        importlib.import_module(module).configure(part)


def spelled_out(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with the thing in front: where none is named they are recordings."""
    if not arguments or arguments[0] in (*THINGS, "-h", "--help"):
        return list(arguments)
    return ["recording", *arguments]


def run(args: argparse.Namespace) -> int:
    """Calibrate."""
    status: int = importlib.import_module(THINGS[args.thing][0]).run(args)
    return status
