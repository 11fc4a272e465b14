"""`shearloop calibrate THING`: measure a known quantity step by step and write a calibration file.

`shearloop calibrate REC… --out CAL` is short for `shearloop calibrate recording REC…`. Write a recording that is named
like a THING with its folder: `./load`.
"""

import argparse
import importlib
from collections.abc import Sequence

from shearloop.daemon.cli.options import add_action, run_action

run = run_action

THINGS = {
    "recording": "an estimator, on recordings or folders of slices",
    "creep": "the gel's creep under a held twist, on recordings",
    "load": "the load cell, with known masses on it",
    "gripper": "the gripper's width, with objects of known diameter",
}

_EPILOG = """
the first time, in this order (docs/first-calibration.md):
  shearloop calibrate load --serial-number NUMBER --mass-g 100 --mass-g 200 --out load.yaml
  shearloop calibrate gripper --host ADDRESS --diameter-mm 10 --diameter-mm 20 --out gripper.yaml
  shearloop calibrate recording REC.mcap --out right.cal
  shearloop calibrate creep HELD.mcap --calibration right.cal

Name each file as the `calibration` of its device or fingertip in the configuration;
`creep` prints its line. Without a THING, recordings are calibrated on:
`shearloop calibrate REC.mcap --out right.cal`. For the shear skin use
`shearloop skin calibrate`.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add a sub-parser per thing."""
    parser.description = "Measure a known quantity and write a calibration file."
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
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
