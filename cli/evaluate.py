"""`shearloop evaluate CAL REC…`: compare estimates with the load cell of recordings, in numbers and as a figure."""

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.calibrations import add_recipe, check_recipe, of_slices, time_range
from shearloop.cli.options import add_cluster, add_json, add_option, number
from shearloop.cli.output_paths import output_path
from shearloop.cli.plots import require_matplotlib
from shearloop.cli.terminal import print_result, table
from shearloop.errors import UserError
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.estimator_names import DEFAULT
from shearloop.tools.outputs import writing
from shearloop.words import counted

if TYPE_CHECKING:
    from shearloop.tools.estimate_tracks import EstimateTrack
    from shearloop.tools.evaluate import Evaluation
    from shearloop.tools.figures import Figures
    from shearloop.tools.leave_out import Plan

# The kinds of figures, and how each begins.
_FIGURES: Mapping[str, bytes | re.Pattern[bytes]] = {
    ".png": b"\x89PNG",
    ".svg": re.compile(rb"<\?xml|<svg"),
    ".pdf": b"%PDF",
}
_MEANINGS = {
    "n": "frames with a known torque",
    "rmse_nm": "root mean square error, N·m",
    "baseline_zero_rmse_nm": "without a sensor: always 0",
    "baseline_profile_rmse_nm": (
        "without a sensor: the calibration's mean twist at the same phase of the motion; for slices the mean at the "
        "same place in the sequence"
    ),
    "baseline_ratio": "rmse_nm over the smaller of both; from 1 on the sensor adds nothing",
    "bias_nm": "mean error, N·m",
    "coverage_95": "fraction of the known values within their 95 % intervals",
    "interval_nm": "median width of these intervals, N·m",
    "winkler_nm": "mean width plus 40 times the distance of a known value outside; less is better",
    "valid_fraction": "fraction of the frames with a known torque that have an estimated one",
    "gain": "mean estimate along the known torque over the mean of its size",
    "r": "correlation of estimated and known torque",
    "latency_ms_p50": "time of an estimate, ms, median",
    "latency_ms_p99": "time of an estimate, ms, 99th percentile",
    "frames": "frames in all",
    "diameter_rmse_mm": "root mean square error of the diameter, mm",
    "diameter_coverage_95": "fraction of the known diameters within their 95 % intervals",
    "diameter_interval_mm": "median width of these intervals, mm",
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "calibration", Path, "CAL", "made by `shearloop calibrate`; with --leave-out a recording")
    # At least one without --leave-out, which `run` checks.
    add_option(parser, "recordings", Path, "REC", "recordings (.mcap) or folders of slices", nargs="*")
    text = "make a calibration without each of these in turn, and judge it there: no CAL, all are recordings"
    parser.add_argument("--leave-out", choices=("grips", "twists", "levels", "tools"), help=text)
    # `_refuse_recipe` refuses these without --leave-out.
    recipe = parser.add_argument_group("only with --leave-out, which makes calibrations")
    add_recipe(recipe)
    text = (
        "for recordings and the default estimator: each fit chooses its settings too, so that no choice has seen the "
        "block that judges it"
    )
    recipe.add_argument("--nested", action="store_true", help=text)
    text = "for recordings: adapt the gain to the first N twists of the judged grip, and judge the later ones"
    add_option(recipe, "--adapt-twists", number(1, 100, int), "N", text)
    add_option(parser, "--bank", Path, "FILE", "the bank of the calibration, if any")
    text = "fraction of each recording to use, e.g. 0.6:1 after calibrating on 0:0.6 (default: all)"
    add_option(parser, "--time-range", time_range, "FROM:TO", text, default="0:1")
    text = "minimum known torque of a frame that counts as loaded (default: %(default)s N·m)"
    add_option(parser, "--loaded-nm", number(0.0, 100.0), "NM", text, default=LOADED_NM)
    add_option(
        parser, "--estimates", output_path, "FILE.csv", "table to write with known torque and estimate of every frame"
    )
    add_cluster(parser)
    add_json(parser)
    figure = parser.add_argument_group("only without --leave-out")
    figure.add_argument("--plot", action="store_true", help="draw load cell and estimate over time into --out")
    add_option(figure, "--out", output_path, "FILE", "figure to draw (default with --plot: CAL.png)")
    parser.epilog = (
        "Prints each figure with its meaning, for frames with a load, for the others and for all, and why frames have "
        "no estimate. Errors and intervals are judged on frames with an estimate and a known torque or diameter."
    )


def run(args: argparse.Namespace) -> int:
    """Evaluate, print, and draw on request."""
    from shearloop.cli.calibrations import judges_slices, read_judged
    from shearloop.tools.evaluate import ESTIMATES_MAGIC, evaluate_recordings, write_estimates
    from shearloop.tools.figures import figures_by_load, figures_of
    from shearloop.tools.outputs import check_overwrite
    from shearloop.tools.parallel import open_executor

    if args.leave_out is not None:
        return _leave_out(args)
    if not args.recordings:
        raise UserError("name recordings after the calibration, or judge a recipe with --leave-out")
    _refuse_recipe(args)
    figure = _checked_figure(args)
    if args.estimates is not None:
        check_overwrite(args.estimates, "a table of estimates", ESTIMATES_MAGIC)
    with open_executor(args.cluster) as pool:
        if judges_slices(args.calibration, args.recordings):
            from shearloop.studies.slices.evaluate import evaluate_slices

            found = evaluate_slices(args.calibration, args.recordings, args.bank, args.time_range, pool)
        else:
            calibration, named = read_judged(args.calibration, args.recordings)
            found = evaluate_recordings(calibration, named, args.bank, args.time_range, pool)
    tracks = found.tracks
    if args.estimates is not None:
        with writing(args.estimates, "the estimates"):
            write_estimates(tracks, [str(path) for path in found.paths], args.estimates)
    if found.assumptions:
        print(f"{args.calibration} assumes that {found.assumptions}.", file=sys.stderr)
    for doubt in found.doubts:
        print(f"Warning: {doubt}.", file=sys.stderr)
    for omission in found.left_out:
        print(f"Left out: {omission}.", file=sys.stderr)
    for name in found.emulated:
        print(f"EMULATED: every device of {name} was emulated.", file=sys.stderr)
    if figure is not None:
        _draw(found, figure)
    by_load, figures = figures_by_load(tracks, args.loaded_nm), figures_of(tracks)
    sentences = [f"Loaded frames have a known torque of {args.loaded_nm:g} N·m or more, unloaded frames less."]
    sentences += _lines({**by_load, "all": figures})
    sentences += _invalid_lines(tracks)
    if against := found.no_better_than_clock(tracks, args.loaded_nm):
        sentences.append(against)
    print_result({**by_load, **figures}, sentences, as_json=args.json)
    return _status(tracks)


def _checked_figure(args: argparse.Namespace) -> Path | None:
    """Return the figure to draw, or None; raises UserError for a path that is no figure's, or another file's."""
    if args.out is None and not args.plot:
        return None
    from shearloop.tools.outputs import check_apart, check_overwrite

    require_matplotlib("the figure")
    figure: Path = args.out or args.calibration.with_suffix(".png")
    if figure.suffix not in _FIGURES:
        raise UserError(f"--out {figure} is not the name of a figure; give one that ends in {', '.join(_FIGURES)}")
    # The parser does not know the default of `--out`.
    others = [("CAL", args.calibration), *(("REC", path) for path in args.recordings)]
    others += [] if args.estimates is None else [("--estimates", args.estimates)]
    check_apart("--out", figure, [(f"{name} {path}", path) for name, path in others])
    check_overwrite(figure, "a figure", _FIGURES[figure.suffix])
    return figure


def _status(tracks: "Sequence[EstimateTrack]") -> int:
    """Return the exit status; 1, with the reason, where no frame was judged."""
    from shearloop.tools.evaluate import why_nothing_judged
    from shearloop.tools.figures import judged_frames

    if any(judged_frames(track).any() for track in tracks):
        return 0
    print(f"Nothing was judged: {why_nothing_judged(tracks)}.", file=sys.stderr)
    return 1


def _refuse_recipe(args: argparse.Namespace) -> None:
    """Raise UserError for an option of a recipe: a calibration is made already."""
    for option, given in (
        ("--estimator", args.estimator != DEFAULT),
        ("--mesh", args.mesh is not None),
        ("--sides", args.sides is not None),
        ("--load-cell-delay-s", args.load_cell_delay_s is not None),
        ("--tool-mm", args.tool_mm is not None),
        ("--assume-full-range", args.assume_full_range),
        ("--nested", args.nested),
        ("--adapt-twists", args.adapt_twists is not None),
    ):
        if given:
            raise UserError(f"{option} is for --leave-out: the calibration is made already; leave it out")


def _leave_out(args: argparse.Namespace) -> int:
    """Judge a recipe on the blocks left out of each fit, and print the figures."""
    from shearloop.tools.evaluate import ESTIMATES_MAGIC, write_estimates
    from shearloop.tools.figures import figures_by_load, figures_of
    from shearloop.tools.leave_out import sentences_of
    from shearloop.tools.outputs import check_overwrite
    from shearloop.tools.parallel import open_executor

    paths = [args.calibration, *args.recordings]
    check_recipe(args, paths)
    if args.plot or args.out is not None:
        raise UserError("--plot and --out draw one calibration; leave them out with --leave-out")
    if args.nested and (args.estimator != DEFAULT or any(path.is_dir() for path in paths)):
        raise UserError(
            f"--nested is for recordings and the estimator {DEFAULT}: only its fit has settings; leave it out"
        )
    if args.adapt_twists is not None and (args.leave_out == "levels" or of_slices(paths)):
        raise UserError("--adapt-twists is for recordings: slices have no gain to adapt; leave it out")
    if args.estimates is not None:
        check_overwrite(args.estimates, "a table of estimates", ESTIMATES_MAGIC)
    plan, doubts, left_out = (_plan_slices if of_slices(paths) else _plan_recordings)(args, paths)
    with open_executor(args.cluster) as pool:
        found = plan.judge(pool)
    if args.estimates is not None:
        names = [name for name, tracks in zip(found.names, found.tracks, strict=True) for _ in tracks]
        with writing(args.estimates, "the estimates"):
            write_estimates(found.all_tracks, names, args.estimates)
    for doubt in doubts:
        print(f"Warning: {doubt}.", file=sys.stderr)
    for omission in left_out:
        print(f"Left out: {omission}.", file=sys.stderr)
    figures = found.figures(args.loaded_nm)
    by_load = figures_by_load(found.all_tracks, args.loaded_nm)
    sentences = _lines({**by_load, "all": figures_of(found.all_tracks)})
    sentences += _invalid_lines(found.all_tracks)
    return print_result(figures, [*sentences, *sentences_of(found, args.loaded_nm)], as_json=args.json)


def _plan_recordings(args: argparse.Namespace, paths: "Sequence[Path]") -> "tuple[Plan, Sequence[str], Sequence[str]]":
    """Return the plan of left-out blocks, doubts about the load cell, and the unused parts of the recordings."""
    from shearloop.tools.calibrate import read_parts
    from shearloop.tools.leave_out import Recipe, plan_left_out

    if args.leave_out == "levels":
        raise UserError("twists of a recording have no levels; leave out grips, twists or tools")
    read = read_parts(
        paths, time_range=args.time_range, sides=args.sides, load_cell_delay_s=args.load_cell_delay_s,
        tool_mm=args.tool_mm,
    )  # fmt: skip
    bank, mesh = _resolved(args)
    recipe = Recipe(args.estimator, bank, mesh, read.timing.uncertainty_s, nested=args.nested)
    names, twists = [path.name for path in read.paths], args.adapt_twists or 0
    plan = plan_left_out(args.leave_out, recipe, read.parts, names, adapt_twists=twists)
    return plan, read.doubts, [*read.left_out, *read.of_other_tools]


def _plan_slices(args: argparse.Namespace, paths: "Sequence[Path]") -> "tuple[Plan, Sequence[str], Sequence[str]]":
    """Return the plan of left-out blocks of folders of slices, without doubts."""
    from shearloop.studies.slices.leave_out import SliceRecipe, plan_levels
    from shearloop.studies.slices.series import read_parts

    recipe = SliceRecipe(args.estimator, *_resolved(args), full_range=args.assume_full_range)
    return plan_levels(args.leave_out, recipe, read_parts(paths, args.time_range)[1]), (), ()


def _resolved(args: argparse.Namespace) -> "tuple[Path | None, Path | None]":
    """Return bank and mesh by paths that workers find."""
    bank, mesh = (None if path is None else path.resolve() for path in (args.bank, args.mesh))
    return bank, mesh


def _lines(columns: "Mapping[str, Figures]") -> list[str]:
    """Return the figures of each group of frames as a table, with their meanings."""
    rows = [
        (name, *(_shown(group[name]) if name in group else "" for group in columns.values()), meaning)
        for name, meaning in _MEANINGS.items()
        if any(group.get(name) is not None for group in columns.values())
    ]
    return table(("figure", *columns, "meaning"), rows)


def _invalid_lines(tracks: "Sequence[EstimateTrack]") -> list[str]:
    """Return why frames have no estimate, or no torque though they are valid, with their numbers."""
    from shearloop.tools.evaluate import invalid_reasons

    lines: list[str] = []
    for reason in invalid_reasons(tracks):
        frames = f"{counted(reason.frames, 'frame'):>13} not valid{', e.g.' if reason.differ else ''}"
        lines.append(f"{frames}: {reason.sentence}")
    for track in tracks:
        if track.without_torque:
            frames = f"{counted(track.without_torque, 'frame'):>13} valid without a torque"
            lines.append(f"{frames}: {track.why_no_torque}")
    return lines


def _draw(found: "Evaluation", out: Path) -> None:
    from shearloop.tools.evaluation_figure import draw_tracks

    tracks = found.tracks
    names = [
        f"{path.name}, {' and '.join(track.series.sides)}" for path, track in zip(found.paths, tracks, strict=True)
    ]
    with writing(out, "the figure"):
        draw_tracks(tracks, names, found.title, out, found.draw)
    print(f"The figure is in {out}.", file=sys.stderr)


def _shown(value: float | None) -> str:
    if value is None:
        return "–"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
