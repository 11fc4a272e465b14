"""`shearloop calibrate creep REC… --calibration CAL`: fit the gel's creep under a held twist."""

import argparse
from pathlib import Path

from shearloop.cli.calibrations import judges_slices, read_judged
from shearloop.cli.options import add_json, add_option
from shearloop.cli.terminal import print_result
from shearloop.errors import UserError
from shearloop.words import counted


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "recordings", Path, "REC", "recordings (.mcap) of held twists, best ten", nargs="+")
    add_option(parser, "--calibration", Path, "CAL", "calibration of the estimator for the loop", required=True)
    add_option(parser, "--bank", Path, "FILE", "the bank of the calibration, if any")
    add_json(parser)
    parser.epilog = "Prints the line `creep:` for the fingertip, or for `combined`, in the configuration."


def run(args: argparse.Namespace) -> int:
    """Estimate every frame, fit, and print the line for the configuration."""
    from shearloop.bank.bank_file import Bank
    from shearloop.tools.creep import fit_creep, grips_of
    from shearloop.tools.estimate_tracks import estimate_series
    from shearloop.tools.evaluate import known_data, why_nothing_judged
    from shearloop.tools.frame_series import check_no_copies

    judges_slices(args.calibration, args.recordings)
    calibration, named = read_judged(args.calibration, args.recordings)
    check_no_copies([(str(path), series) for path, series in named])
    bank = Bank.open(args.bank) if args.bank else None
    tracks = [estimate_series(calibration, series, bank) for _, series in named]
    grips = [grip for track in tracks for grip in grips_of(track)]
    if not grips:
        raise UserError(f"creep: {why_nothing_judged(tracks)}")
    found = fit_creep(grips)
    doubts = known_data(calibration.learned, tracks, [path for path, _ in named])
    share, time_s = round(found.creep.share, 3), round(found.creep.time_s, 1)
    low_s, high_s = (round(end_s, 1) for end_s in found.time_range_s)
    result = {
        "share": share,
        "time_s": time_s,
        "time_range_s": [low_s, high_s],
        "grips": len(grips),
        "frames": sum(grip.t_s.size for grip in grips),
        "error_before_nm": found.before_nm,
        "error_after_nm": found.after_nm,
        "scale": found.scale,
        "offset_nm": found.offset_nm,
        "warnings": doubts,
    }
    sentences = [
        f"creep: {{share: {share:g}, time_s: {time_s:g}}}",
        f"The time constant lies between {low_s} s and {high_s} s (95 % interval).",
        f"From {result['frames']} frames of {counted(len(grips), 'grip')}: the estimates, scaled by {found.scale:.3f} "
        f"and shifted by {1e3 * found.offset_nm:+.1f} mN·m, follow the load cell within {1e3 * found.after_nm:.1f} "
        f"mN·m instead of {1e3 * found.before_nm:.1f} (standard deviation).",
        *(f"Warning: {doubt}." for doubt in doubts),
        "The line `creep:` does not correct scale and zero. If the scale is far from 1, calibrate the estimator again; "
        "if the shift is far from 0, tare untouched.",
    ]
    return print_result(result, sentences, as_json=args.json)
