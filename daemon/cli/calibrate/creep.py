"""`shearloop calibrate creep REC… --calibration CAL`: what a gel's torque loses under a held twist."""

import argparse
from pathlib import Path

from shearloop.daemon.cli.options import add_json
from shearloop.daemon.cli.output import print_result


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "recordings",
        nargs="+",
        type=Path,
        metavar="REC",
        help="recordings (.mcap) of twists that are held; best of ten twists",
    )
    parser.add_argument(
        "--calibration",
        type=Path,
        required=True,
        metavar="CAL",
        help="calibration of the estimator that is to drive the loop",
    )
    parser.add_argument("--bank", type=Path, metavar="FILE", help="the bank the calibration was made with, if any")
    add_json(parser)
    parser.epilog = "Prints the line `creep:` for the fingertip, or for `both`, in the configuration."


def run(args: argparse.Namespace) -> int:
    """Estimate every frame, fit, and say what to write into the configuration."""
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.bank.estimation import Calibration
    from shearloop.daemon.analysis.copies import check_no_copies, check_paths_differ
    from shearloop.daemon.analysis.evaluation import follow
    from shearloop.daemon.analysis.grips import grips_of
    from shearloop.daemon.analysis.series import read_series
    from shearloop.daemon.cli.recorded import check_kind
    from shearloop.daemon.control.creep import fit_creep

    check_paths_differ(args.recordings)
    calibration = Calibration.load(args.calibration)
    bank = Bank.open(args.bank) if args.bank else None
    named = [(str(path), one) for path in args.recordings for one in read_series(path, calibration.sides)]
    series = [one for _, one in named]
    check_kind(args.calibration, calibration, series)
    check_no_copies(named)
    grips = [grip for one in series for grip in grips_of(follow(calibration, one, bank))]
    found = fit_creep(grips)
    share, time_s = round(found.creep.share, 3), round(found.creep.time_s, 1)
    told = {
        "share": share,
        "time_s": time_s,
        "grips": len(grips),
        "frames": sum(grip.t_s.size for grip in grips),
        "error_before_nm": found.before_nm,
        "error_after_nm": found.after_nm,
        "scale": found.scale,
        "offset_nm": found.offset_nm,
    }
    sentences = [
        f"creep: {{share: {share:g}, time_s: {time_s:g}}}",
        f"From {told['frames']} frames of {len(grips)} grips: estimates, times {found.scale:.3f} and "
        f"{1e3 * found.offset_nm:+.1f} mN·m, follow the load cell within {1e3 * found.after_nm:.1f} mN·m instead of "
        f"{1e3 * found.before_nm:.1f} (standard deviation).",
        "Scale and zero are no creep, and the line above does not mend them: where they are far from 1 and 0, "
        "calibrate the estimator anew, and take the zero untouched.",
    ]
    print_result(told, sentences, as_json=args.json)
    return 0
