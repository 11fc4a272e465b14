"""`shearloop evaluate CAL REC…`: compare estimates with the truth of recordings, in numbers and as a figure."""

import argparse
import json
import sys
from pathlib import Path

from shearloop.daemon.cli.options import add_cluster, add_json, add_option, writing
from shearloop.daemon.errors import UserError

_FIGURES = (".png", ".svg", ".pdf")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "calibration", Path, "CAL", "made by `shearloop calibrate`")
    add_option(parser, "recordings", Path, "REC", "recordings (.mcap) or folders of slices", nargs="+")
    add_option(parser, "--bank", Path, "FILE", "the bank of the calibration, if any")
    text = "share of each recording to use, e.g. 0.6:1 after calibrating on 0:0.6 (default: all)"
    add_option(parser, "--time-range", str, "FROM:TO", text, default="0:1")
    add_cluster(parser)
    add_json(parser)
    parser.add_argument("--plot", action="store_true", help="draw truth and estimate over time into --out")
    add_option(parser, "--out", Path, "FILE", "figure to draw (default with --plot: CAL.png)")
    parser.epilog = (
        "Prints for valid estimates with a known truth: correlation (r), root mean square error and bias in N·m, the "
        "share of truths within the 95 % intervals (coverage_95), and the median width of the intervals from end to "
        "end (interval_nm, for diameters diameter_interval_mm). Prints for all frames: the share that is valid, why "
        "others are not, and the milliseconds of an estimate."
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate, print, and draw on request."""
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.bank.estimation import Calibration
    from shearloop.bank.estimation.load_delay import load_delay_warning
    from shearloop.daemon.analysis.evaluate import draw_tracks, estimate_in_worker, figures_of, invalid_reasons
    from shearloop.daemon.analysis.series import check_no_copies, check_paths_differ, part_of, read_series
    from shearloop.daemon.cli.options import check_kind, parse_time_range
    from shearloop.daemon.workers import in_order, open_executor

    if args.out is not None and args.out.suffix not in _FIGURES:
        raise UserError(f"--out {args.out} is not the name of a figure; give one that ends in {', '.join(_FIGURES)}")
    check_paths_differ(args.recordings)
    calibration = Calibration.load(args.calibration)
    bank = Bank.open(args.bank) if args.bank else None
    start, stop = parse_time_range(args.time_range)
    named = [(path, one) for path in args.recordings for one in read_series(path)]
    check_kind(args.calibration, calibration, [one for _, one in named])
    parts = [part_of(one, start, stop) for _, one in named]
    check_no_copies([(str(path), part) for (path, _), part in zip(named, parts, strict=True)])
    shared = (calibration, None if bank is None else str(args.bank.resolve()))
    with open_executor(args.cluster) as pool:
        tracks = in_order(pool.map(estimate_in_worker, shared, parts))
    figures = figures_of(tracks)
    if calibration.assumptions:
        print(f"{args.calibration} assumes that {calibration.assumption_text}.", file=sys.stderr)
    for (path, _), part in zip(named, parts, strict=True):
        if warning := load_delay_warning(part):
            print(f"Warning: {path.name}: {warning}.", file=sys.stderr)
    if args.plot or args.out:
        out = args.out or args.calibration.with_suffix(".png")
        titles = [f"{path.name}, {' and '.join(part.sides)}" for (path, _), part in zip(named, parts, strict=True)]
        title = f"{calibration.estimator.name}, fitted to {calibration.source}"
        try:
            with writing(out, "the figure"):
                draw_tracks(tracks, titles, title, out)
        except ModuleNotFoundError as error:
            raise UserError(f"the figure needs {error.name}: `pip install 'shearloop[plot]'`") from error
        print(f"The figure is in {out}.", file=sys.stderr)
    if args.json:
        print(json.dumps(figures))
        return 0
    width = max(map(len, figures))
    for name, value in figures.items():
        print(f"{name:<{width}}  {_shown(value)}")
    for reason in invalid_reasons(tracks):
        print(f"{reason.frames:>6} frames not valid{', e.g.' if reason.differ else ''}: {reason.sentence}")
    return 0


def _shown(value: float | None) -> str:
    if value is None:
        return "–"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
