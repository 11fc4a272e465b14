"""`shearloop skin`: compare the shear skin's models with its paper, and calibrate a skin from a recorded table."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.options import add_json
from shearloop.daemon.cli.terminal import print_result

if TYPE_CHECKING:
    from shearloop.bank.skin.characterisation import FigureOfMerit

SEED = 2017
COLUMNS = ("quantity", "unit", "paper: computed", "measured", "closed form", "1-D", "2-D", "synthetic")
EXPLANATION = """\
Sensitivity: least squares through the origin over one loading in 0.1 N steps, from the first step up to Fn.
1-D: membrane with the paper's own F/(EA). 2-D: plane strain, 112 elements, nothing tuned; w = 20 mm is assumed.
Synthetic: the estimator's result on a synthetic recording with the paper's measured value."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add `characterise` and `calibrate`."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    characterise = actions.add_parser(
        "characterise",
        help="compare the paper's table with the models'",
        description="Compare the paper's table with the models'.",
    )
    characterise.add_argument("--out", type=Path, metavar="DIR", help="draw figures 5, 6 and 7 here, PNG and SVG")
    add_json(characterise)
    calibrate = actions.add_parser(
        "calibrate", help="fit a calibration to a recorded table", description="Fit a calibration to a recorded table."
    )
    calibrate.add_argument("table", type=Path, metavar="TABLE", help="CSV with r1_ohm, r2_ohm, shear_n, normal_n")
    calibrate.add_argument("--out", type=Path, required=True, metavar="YAML", help="the calibration file to write")
    calibrate.add_argument(
        "--friction", type=float, metavar="MU", help="coefficient of friction, if the table does not determine it"
    )
    add_json(calibrate)


def run(args: argparse.Namespace) -> int:
    """Run the action."""
    return _characterise(args.out, args.json) if args.action == "characterise" else _calibrate(args)


def _characterise(out: Path | None, as_json: bool) -> int:
    import numpy as np

    from shearloop.bank.skin.characterisation import characterise

    if out is not None:
        # First, to report a missing library at once.
        from shearloop.daemon.analysis.charts.skin_figures import draw
    found = characterise(np.random.default_rng(SEED))
    if as_json:
        print(json.dumps([asdict(row) for row in found.rows], indent=1, ensure_ascii=False))
    else:
        print(_table(found.rows))
    if out is not None:
        for path in draw(found, out):
            print(f"drawn: {path}", file=sys.stderr)
    return 0


def _table(rows: "tuple[FigureOfMerit, ...]") -> str:
    lines = [COLUMNS, *(tuple(_cell(value) for value in asdict(row).values()) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(COLUMNS))]
    printed = [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    ]
    printed.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join([*printed, "", EXPLANATION])


def _cell(value: str | float | None) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return f"{value:#.3g}" if value else "0"


def _calibrate(args: argparse.Namespace) -> int:
    from shearloop.bank.errors import CalibrationError
    from shearloop.bank.skin.calibration import fit_calibration, read_table, save_calibration
    from shearloop.daemon.cli.options import check_overwrite
    from shearloop.daemon.errors import UserError

    if args.friction is not None and not 0 <= args.friction <= 1:
        raise UserError(f"--friction is {args.friction}; a coefficient of friction lies between 0 and 1.")
    check_overwrite(args.out, "a calibration file")
    table = read_table(args.table)
    try:
        calibration = fit_calibration(table, friction=args.friction)
    except CalibrationError as error:
        raise UserError(f"{args.table}: {error}") from error
    save_calibration(calibration, args.out)
    source = "fitted" if args.friction is None else "given"
    result = {
        "path": str(args.out),
        "friction": calibration.friction,
        "friction_given": args.friction is not None,
        "slope_per_n": calibration.slope_per_n,
        "prediction_half_width_n": calibration.prediction_half_width_n,
        "linear_to_n": calibration.linear_to_n,
        "tension_n": [calibration.tension_n[0], calibration.tension_n[-1]],
        "rows": calibration.rows,
        "rows_beyond": calibration.rows_beyond,
    }
    sentences = [
        f"friction coefficient ({source})        {calibration.friction:.4f}",
        f"response per N of gauge tension      {calibration.slope_per_n:.4f} 1/N",
        f"95 % prediction interval             ± {calibration.prediction_half_width_n:.4f} N",
        f"straight to {calibration.linear_to_n} N; tension calibrated  "
        f"{calibration.tension_n[0]:.2f} … {calibration.tension_n[-1]:.2f} N",
        f"rows fitted                          {calibration.rows}",
        f"rows left out beyond the curve       {calibration.rows_beyond}",
        f"written: {args.out}",
    ]
    print_result(result, sentences, as_json=args.json)
    return 0
