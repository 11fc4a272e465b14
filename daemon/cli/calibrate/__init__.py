"""`shearloop calibrate THING`: measures something known, step by step, and writes a calibration file.

`shearloop calibrate REC… --estimator NAME --out CAL` is `shearloop calibrate recording REC…`: an estimator is fitted to
what was recorded. A recording called as a THING is written with its folder, `./load`.

A thing is a module in `shearloop.daemon.cli.calibrated` with `configure(parser)` and `run(args) -> exit status`, as
a command is.
"""

import argparse
import importlib
from collections.abc import Sequence

THINGS = {
    "recording": ("shearloop.daemon.cli.calibrated.recording", "an estimator, on recordings or folders of slices"),
    "creep": ("shearloop.daemon.cli.calibrated.creep", "what a gel's torque loses under a held twist, on recordings"),
    "load": ("shearloop.daemon.cli.calibrated.load", "the load cell, with known masses on it"),
    "gripper": ("shearloop.daemon.cli.calibrated.gripper", "the gripper's width, with objects of known diameter"),
}


EPILOG = """
in this order, the first time (docs/first-calibration.md):
  shearloop calibrate load --serial-number NUMBER --mass-g 100 --mass-g 200 --out load.yaml
  shearloop calibrate gripper --host ADDRESS --diameter-mm 10 --diameter-mm 20 --out gripper.yaml
  shearloop calibrate recording REC.mcap --out right.cal
  shearloop calibrate creep HELD.mcap --calibration right.cal

Name each file as the `calibration` of its device or fingertip in the configuration;
`creep` prints the line to put there. Without a THING, recordings are meant:
`shearloop calibrate REC.mcap --out right.cal`. The shear skin has a command of its
own, `shearloop skin calibrate`.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a sub-parser per thing."""
    parser.description = "Measure something known, and write down what follows from it."
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    things = parser.add_subparsers(
        dest="thing", metavar="THING", required=True, help="`shearloop calibrate THING --help` explains one"
    )
    for name, (module, summary) in THINGS.items():
        part = things.add_parser(name, help=summary, description=f"Calibrate {summary}.")
        importlib.import_module(module).configure(part)


def expand_default_command(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with the thing in front: where none is named they are recordings."""
    if not arguments or arguments[0] in (*THINGS, "-h", "--help"):
        return list(arguments)
    return ["recording", *arguments]


def run(args: argparse.Namespace) -> int:
    """Calibrate."""
    status: int = importlib.import_module(THINGS[args.thing][0]).run(args)
    return status
