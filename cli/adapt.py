"""`shearloop adapt CAL REC… --out NEW`: correct a calibration's gain by twists of known torque."""

import argparse
import sys
from pathlib import Path

from shearloop.cli.calibrations import DELAY_S, load_calibration, time_range
from shearloop.cli.options import TOOL_MM, add_json, add_option
from shearloop.cli.output_paths import output_path, written_to
from shearloop.cli.terminal import print_result
from shearloop.tools.outputs import check_overwrite
from shearloop.words import counted


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "calibration", Path, "CAL", "made by `shearloop calibrate` on recordings")
    add_option(parser, "recordings", Path, "REC", "recordings (.mcap) of a grip with a twist or more", nargs="+")
    add_option(parser, "--out", output_path, "NEW", "calibration to write", required=True)
    add_option(parser, "--bank", Path, "FILE", "the bank of the calibration, if any")
    text = "fraction of each recording whose twists count, e.g. 0:0.2; earlier frames show the idle fingertip"
    add_option(parser, "--time-range", time_range, "FROM:TO", text, default="0:1")
    text = "delay of the load cell's timestamps, which is subtracted"
    add_option(parser, "--load-cell-delay-s", DELAY_S, "S", text, default=0.0)
    add_option(parser, "--tool-mm", TOOL_MM, "MM", "diameter of the tool, if the recording does not name it")
    add_json(parser)
    parser.epilog = (
        "The gain of each fingertip changes between grips. Twists of known torque correct it. Twists that disagree "
        "correct less, and the first twist after a grip counts less than the later ones. Use the result for this grip, "
        "and CAL for the next one."
    )


def run(args: argparse.Namespace) -> int:
    """Adapt, write, and print the gains."""
    from shearloop.bank.bank_file import Bank
    from shearloop.estimation import Physics
    from shearloop.estimation.archive import ARCHIVE_MAGIC
    from shearloop.estimation.learned_frames import CANNOT_TELL_FRAMES
    from shearloop.tools.calibrate import adapt_to_recordings

    check_overwrite(args.out, "an estimator's calibration", ARCHIVE_MAGIC)
    replaced = args.out.exists()
    physics = Physics(bank=Bank.open(args.bank) if args.bank else None)
    calibration = load_calibration(args.calibration)
    if not calibration.learned.complete:
        print(f"Warning: {CANNOT_TELL_FRAMES}.", file=sys.stderr)
    adapted, correction = adapt_to_recordings(
        calibration, args.recordings, physics,
        time_range=args.time_range, load_cell_delay_s=args.load_cell_delay_s, tool_mm=args.tool_mm,
    )  # fmt: skip
    adapted.save(args.out)
    factors, errors = correction.factors.tolist(), correction.errors.tolist()
    names = adapted.sides if len(factors) == len(adapted.sides) else (" and ".join(adapted.sides),)
    gains = {name: {"gain": gain, "error": error} for name, gain, error in zip(names, factors, errors, strict=True)}
    sentences = [f"{name}: torque times {entry['gain']:.2f} ± {entry['error']:.2f}." for name, entry in gains.items()]
    sentences.append(f"Offset: {correction.offset_nm:+.4f} N·m.")
    if correction.is_unchanged:
        sentences.append("The deviation may be chance; the gain is unchanged.")
    else:
        sentences.append(f"{counted(correction.twists, 'twist')} of known torque decided.")
    sentences.append(written_to(args.out, replaced=replaced))
    figures = {
        "path": str(args.out),
        "gains": gains,
        "gain_is_unchanged": correction.is_unchanged,
        "twists": correction.twists,
        "gain_spread": correction.spread.between,
        "offset_nm": correction.offset_nm,
    }
    return print_result(figures, sentences, as_json=args.json)
