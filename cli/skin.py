"""`shearloop skin`: compare the shear skin's models with its paper, and calibrate a skin from a recorded table."""

import argparse
import sys
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.options import add_action, add_json, add_option, number, run_action
from shearloop.cli.output_paths import output_path, written_to
from shearloop.cli.plots import require_matplotlib
from shearloop.cli.terminal import print_result, table
from shearloop.errors import UserError
from shearloop.tools.outputs import YAML_KEYS, check_overwrite, new_folder, writing

if TYPE_CHECKING:
    from shearloop.studies.skin.characterisation import FigureOfMerit

run = run_action

COLUMNS = ("quantity", "unit", "paper: computed", "measured", "1-D", "2-D")
EXPLANATION = """\
Sensitivity: least squares through the origin over one loading in 0.1 N steps, from the first step up to 1.2 N.
1-D: membrane at finite strain, 0.88 mm thick, which the paper's F/(EA) needs.
2-D: plane strain, small strain, 112 elements, 0.70 mm thick, nothing tuned; w = 20 mm is assumed."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add `characterise` and `calibrate`."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    summary = "compare the paper's table with the models'"
    characterise = add_action(actions, "characterise", summary, _characterise)
    add_option(characterise, "--out", output_path, "DIR", "draw figures 4 to 8 and the deadband here, PNG and SVG")
    add_json(characterise)
    calibrate = add_action(actions, "calibrate", "fit a calibration to a recorded table", _calibrate)
    add_option(calibrate, "table", Path, "TABLE", "CSV with r1_ohm, r2_ohm, shear_n, normal_n")
    add_option(calibrate, "--out", output_path, "YAML", "the calibration file to write", required=True)
    text = "coefficient of friction, if the table does not determine it"
    add_option(calibrate, "--friction", number(0.0, 1.0), "MU", text)
    add_json(calibrate)


def _characterise(args: argparse.Namespace) -> int:
    from shearloop.studies.skin.characterisation import characterise

    if args.out is not None:
        # First, to report a missing library or folder at once.
        require_matplotlib("a figure")
        from shearloop.studies.charts.skin_figures import draw

    with ExitStack() as folder:
        if args.out is not None:
            folder.enter_context(writing(args.out, "the figures"))
            folder.enter_context(new_folder(args.out))
        found = characterise()
        print_result([asdict(row) for row in found.rows], [_table(found.rows)], as_json=args.json)
        if args.out is not None:
            written = draw(found, args.out)
            print(*(f"drawn: {path}" for path in written), sep="\n", file=sys.stderr)
    return 0


def _table(rows: "tuple[FigureOfMerit, ...]") -> str:
    cells = [["" if value is None else value for value in asdict(row).values()] for row in rows]
    shown = [[value if isinstance(value, str) else f"{value:#.3g}" if value else "0" for value in row] for row in cells]
    return "\n".join([*table(COLUMNS, shown), "", EXPLANATION])


def _calibrate(args: argparse.Namespace) -> int:
    from shearloop.bank.errors import CalibrationError
    from shearloop.estimation.skin.calibration import save_calibration
    from shearloop.estimation.skin.calibration_fit import fit_calibration, read_table

    check_overwrite(args.out, "a calibration file", YAML_KEYS)
    recorded = read_table(args.table)
    try:
        calibration = fit_calibration(recorded, friction=args.friction)
    except CalibrationError as error:
        raise UserError(f"{args.table}: {error}") from error
    replaced = args.out.exists()
    save_calibration(calibration, args.out)
    source = "fitted" if args.friction is None else "given"
    named = (
        "friction", "slope_per_n", "prediction_half_width_n", "linear_to_n", "slack_ratio", "gauge_depth_mm",
        "rows", "rows_beyond",
    )  # fmt: skip
    depth_mm = calibration.gauge_depth_mm
    depth = "not that of a depth in the paper's skin" if depth_mm is None else f"{1e3 * depth_mm:+.0f} µm"
    result = {
        "path": str(args.out),
        "friction_given": args.friction is not None,
        "tension_n": [calibration.tension_n[0], calibration.tension_n[-1]],
        "missing_side": calibration.missing_side,
        **{name: getattr(calibration, name) for name in named},
    }
    sentences = [
        f"friction coefficient ({source})        {calibration.friction:.4f}",
        f"response per N of gauge tension      {calibration.slope_per_n:.4f} 1/N",
        f"95 % prediction interval             ± {calibration.prediction_half_width_n:.4f} N",
        f"straight to {calibration.linear_to_n} N; tension calibrated  "
        f"{calibration.tension_n[0]:.2f} … {calibration.tension_n[-1]:.2f} N",
        f"slack gauge's share of the stretched {calibration.slack_ratio:+.3f}",
        f"gauge depth outwards from mid-skin    {depth}",
        f"rows fitted                          {calibration.rows}",
        f"rows left out beyond the curve       {calibration.rows_beyond}",
        written_to(args.out, replaced=replaced),
    ]
    if side := calibration.missing_side:
        sentences.insert(-1, f"The table has no {side} shear forces, and the skin measures none; record both signs.")
    return print_result(result, sentences, as_json=args.json)
