"""`shearloop calibrate THING`: fit recordings, or measure a known quantity step by step; write a calibration file.

`shearloop calibrate REC… --out CAL` is short for `shearloop calibrate recording REC…`. Write a recording that is named
like a THING with its folder: `./load`.
"""

import argparse
import importlib
from collections.abc import Sequence

from shearloop.cli.options import add_action, run_action

run = run_action

THINGS = {
    "recording": "an estimator, on recordings or folders of slices",
    "creep": "the gel's creep under a held twist, on recordings",
    "load": "the load cell, with known masses on it",
    "gripper": "the gripper's width, with objects of known diameter",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a sub-parser per thing."""
    parser.epilog = (
        "The first time, follow docs/calibrations.md: load, gripper, recording, creep. Without a THING, it "
        "calibrates on recordings: `shearloop calibrate REC.mcap --out right.cal`. See also `shearloop skin calibrate`."
    )
    explained = "`shearloop calibrate THING --help` explains one"
    things = parser.add_subparsers(dest="thing", metavar="THING", required=True, help=explained)
    for name, summary in THINGS.items():
        module = importlib.import_module(f"{__name__}.{name}")
        module.configure(add_action(things, name, f"calibrate {summary}", module.run))


def expand_default_command(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with the thing first: without one they are recordings."""
    if not arguments or arguments[0] in (*THINGS, "-h", "--help"):
        return list(arguments)
    return ["recording", *arguments]
