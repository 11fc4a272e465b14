"""`shearloop evaluate CAL REC…`: estimates against the truth of recordings, in numbers and as a figure."""

import argparse
import json
import sys
from pathlib import Path

from shearloop.daemon.cli.options import add_cluster

_FIGURES = (".png", ".svg", ".pdf")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("calibration", type=Path, metavar="CAL", help="made by `shearloop calibrate`")
    parser.add_argument(
        "recordings", nargs="+", type=Path, metavar="REC", help="recordings (.mcap) or folders of slices"
    )
    parser.add_argument("--bank", type=Path, metavar="FILE", help="the bank the calibration was made with, if any")
    parser.add_argument(
        "--part",
        metavar="FROM:TO",
        default="0:1",
        help="share of each recording to judge on, e.g. 0.6:1 of one that was calibrated on with 0:0.6 (default: all)",
    )
    add_cluster(parser)
    parser.add_argument("--json", action="store_true", help="print the figures as JSON, and nothing else, on stdout")
    parser.add_argument("--plot", action="store_true", help="draw truth against estimate over time into --out")
    parser.add_argument("--out", type=Path, metavar="FILE", help="figure to draw (default with --plot: CAL.png)")
    parser.epilog = (
        "Prints, of valid estimates whose truth is known: correlation (r), root mean square error and bias in N·m, "
        "the share of truths within the 95 % intervals (coverage_95), and how wide the median interval is from end to "
        "end (interval_nm, of diameters diameter_interval_mm), without which a coverage of 1 says little; of all "
        "frames: how many are valid, why others are not, and how many milliseconds an estimate takes."
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate, print, and draw where that is asked for."""
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.bank.estimation import Calibration
    from shearloop.bank.estimation.alignment import doubt
    from shearloop.daemon.analysis.copies import check_no_copies, check_paths_differ
    from shearloop.daemon.analysis.evaluation import followed, judge, reasons
    from shearloop.daemon.analysis.series import part_of, read_series
    from shearloop.daemon.cli.recorded import check_kind, parsed_part
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.workers import in_order, open_executor

    if args.out is not None and args.out.suffix not in _FIGURES:
        raise UserError(f"--out {args.out} is not the name of a figure; give one that ends in {', '.join(_FIGURES)}")
    check_paths_differ(args.recordings)
    calibration = Calibration.load(args.calibration)
    bank = Bank.open(args.bank) if args.bank else None
    start, stop = parsed_part(args.part)
    named = [(path, one) for path in args.recordings for one in read_series(path)]
    check_kind(args.calibration, calibration, [one for _, one in named])
    parts = [part_of(one, start, stop) for _, one in named]
    check_no_copies([(str(path), part) for (path, _), part in zip(named, parts, strict=True)])
    shared = (calibration, None if bank is None else str(args.bank.resolve()))
    with open_executor(args.cluster) as pool:
        tracks = in_order(pool.map(followed, shared, parts))
    figures = judge(tracks)
    if calibration.word:
        print(f"{args.calibration} was made on somebody's word {calibration.word}.", file=sys.stderr)
    for (path, _), part in zip(named, parts, strict=True):
        if why := doubt(part):
            print(f"Doubtful is {path.name}: {why}.", file=sys.stderr)
    if args.plot or args.out:
        out = args.out or args.calibration.with_suffix(".png")
        try:
            from shearloop.daemon.analysis.figure import draw
        except ModuleNotFoundError as error:
            raise UserError(f"the figure needs {error.name}: `pip install 'shearloop[plot]'`") from error
        try:
            titles = [f"{path.name}, {' and '.join(part.sides)}" for (path, _), part in zip(named, parts, strict=True)]
            draw(tracks, titles, f"{calibration.estimator}, fitted to {calibration.source}", out)
        except OSError as error:
            raise UserError(f"{out}: the figure cannot be written: {error.strerror}; choose another --out") from error
        print(f"The figure is in {out}.", file=sys.stderr)
    if args.json:
        print(json.dumps(figures))
        return 0
    width = max(map(len, figures))
    for name, value in figures.items():
        print(f"{name:<{width}}  {_shown(value)}")
    for reason in reasons(tracks):
        print(f"{reason.frames:>6} frames not valid{', e.g.' if reason.differ else ''}: {reason.sentence}")
    return 0


def _shown(value: float | None) -> str:
    if value is None:
        return "–"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
