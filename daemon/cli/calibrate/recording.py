"""`shearloop calibrate REC… --estimator NAME --out CAL`: fit an estimator to recordings."""

import argparse
from pathlib import Path

from shearloop.daemon.cli.options import add_json, check_overwrite
from shearloop.daemon.cli.output import print_result

# A larger delay belongs to another recording.
_LARGEST_DELAY_S = 600.0
ESTIMATORS = ("motion_regression", "regression", "bank", "paper", "reconstruction")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "recordings", nargs="+", type=Path, metavar="REC", help="recordings (.mcap) or folders of slices, oldest first"
    )
    parser.add_argument(
        "--estimator", choices=ESTIMATORS, default=ESTIMATORS[0], help="estimator to calibrate (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="CAL", help="calibration to write")
    parser.add_argument("--bank", type=Path, metavar="FILE", help="a bank, which the estimators paper and bank need")
    parser.add_argument("--mesh", type=Path, metavar="FILE", help="a mesh, which the estimator reconstruction needs")
    parser.add_argument("--sides", metavar="SIDE[,SIDE]", help="sides to use, e.g. right (default: all)")
    parser.add_argument(
        "--time-range", metavar="FROM:TO", default="0:1", help="share of each recording to use, e.g. 0:0.5"
    )
    parser.add_argument(
        "--load-cell-delay-s",
        type=float,
        metavar="S",
        help="delay of the load cell's timestamps, which is subtracted; 0 accepts them unchecked",
    )
    parser.add_argument(
        "--assume-full-range",
        action="store_true",
        help="no torque will exceed the slices: intervals do not extend beyond them",
    )
    parser.add_argument(
        "--tool-mm",
        type=float,
        metavar="MM",
        help="diameter of the tool in recordings that do not name it; on another tool there is no torque",
    )
    add_json(parser)
    parser.epilog = (
        "A recording has to hold some seconds idle, the grip, several twists (best ten) with the load cell recorded, "
        "and some seconds idle after the release. docs/estimators.md describes the estimators and their needs."
    )


def run(args: argparse.Namespace) -> int:
    """Fit, write, and print the report."""
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.bank.eit.mesh import load_mesh
    from shearloop.bank.estimation import Physics
    from shearloop.bank.estimation.calibration import ARCHIVE_MAGIC
    from shearloop.daemon.analysis.calibrate import CalibrationOptions, calibrate
    from shearloop.daemon.cli.options import parse_sides, parse_time_range
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.recording.schema import LARGEST_DIAMETER_MM

    options = CalibrationOptions(
        sides=parse_sides(args.sides),
        time_range=parse_time_range(args.time_range),
        load_cell_delay_s=args.load_cell_delay_s,
        assume_full_range=args.assume_full_range,
        tool_mm=args.tool_mm,
    )
    delay_s, tool_mm = options.load_cell_delay_s, options.tool_mm
    if delay_s is not None and not abs(delay_s) <= _LARGEST_DELAY_S:
        raise UserError(
            f"--load-cell-delay-s must be from -{_LARGEST_DELAY_S:g} to {_LARGEST_DELAY_S:g} s, not {delay_s:g}"
        )
    if tool_mm is not None and not 0 < tool_mm < LARGEST_DIAMETER_MM:
        raise UserError(f"--tool-mm must be above 0 and below {LARGEST_DIAMETER_MM:g} mm, not {tool_mm:g}")
    check_overwrite(args.out, "an estimator's calibration", ARCHIVE_MAGIC)
    physics = Physics(
        bank=Bank.open(args.bank) if args.bank else None, mesh=load_mesh(args.mesh) if args.mesh else None
    )
    report = calibrate(args.recordings, args.estimator, physics, options)
    report.calibration.save(args.out)
    sentences = [*report.sentences, f"Written to {args.out}."]
    print_result({"path": str(args.out), **report.result}, sentences, as_json=args.json)
    return 0
