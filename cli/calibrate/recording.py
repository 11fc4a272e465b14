"""`shearloop calibrate REC… --estimator NAME --out CAL`: fit an estimator to recordings."""

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.options import DELAY_S, TOOL_MM, add_json, add_option, time_range
from shearloop.cli.terminal import print_result
from shearloop.errors import UserError
from shearloop.estimation.estimator_names import DEFAULT, ESTIMATORS
from shearloop.tools.outputs import check_overwrite

if TYPE_CHECKING:
    from shearloop.estimation import Calibration
    from shearloop.estimation.interval_regressor import IntervalRegressor
    from shearloop.tools.calibrate import CalibrationResult


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "recordings", Path, "REC", "recordings (.mcap) or folders of slices, oldest first", nargs="+")
    text = "estimator to calibrate (default: %(default)s)"
    parser.add_argument("--estimator", choices=ESTIMATORS, default=DEFAULT, help=text)
    add_option(parser, "--out", Path, "CAL", "calibration to write", required=True)
    add_option(parser, "--bank", Path, "FILE", "a bank, which the estimators paper and bank need")
    add_option(parser, "--mesh", Path, "FILE", "a mesh, which the estimator reconstruction needs")
    add_option(parser, "--sides", _sides, "SIDE[,SIDE]", "sides to use, e.g. right (default: all)")
    text = "share of each recording to use, e.g. 0:0.5"
    add_option(parser, "--time-range", time_range, "FROM:TO", text, default="0:1")
    text = "delay of the load cell's timestamps, which is subtracted; 0 accepts them unchecked"
    add_option(parser, "--load-cell-delay-s", DELAY_S, "S", text)
    text = "no torque will exceed the slices: intervals do not extend beyond them"
    parser.add_argument("--assume-full-range", action="store_true", help=text)
    text = "diameter of the tool in recordings that do not name it; on another tool there is no torque"
    add_option(parser, "--tool-mm", TOOL_MM, "MM", text)
    add_json(parser)
    parser.epilog = (
        "A recording has to hold some seconds idle, the grip, several twists (best ten) with the load cell recorded, "
        "and some seconds idle after the release. docs/estimators.md describes the estimators and their needs."
    )


def _sides(text: str) -> tuple[str, ...]:
    from shearloop.daemon.recorder.schema import SIDES

    sides = tuple(text.split(","))
    if not set(sides) <= set(SIDES) or len(set(sides)) < len(sides):
        raise argparse.ArgumentTypeError(f"{text} is not {' or '.join(SIDES)}, or both with a comma between")
    return sides


def run(args: argparse.Namespace) -> int:
    """Fit, write, and print the report."""
    from shearloop.bank.bank_file import Bank
    from shearloop.bank.mesh import load_mesh
    from shearloop.estimation import Physics
    from shearloop.estimation.calibration import ARCHIVE_MAGIC
    from shearloop.tools.calibrate import calibrate

    _check_options(args)
    check_overwrite(args.out, "an estimator's calibration", ARCHIVE_MAGIC)
    physics = Physics(
        bank=Bank.open(args.bank) if args.bank else None, mesh=load_mesh(args.mesh) if args.mesh else None
    )
    result = calibrate(
        args.recordings, args.estimator, physics, time_range=args.time_range, sides=args.sides,
        load_cell_delay_s=args.load_cell_delay_s, assume_full_range=args.assume_full_range, tool_mm=args.tool_mm,
    )  # fmt: skip
    if args.assume_full_range and result.calibration.torque is None:
        raise UserError("--assume-full-range is about torques, and these slices have diameters only; leave it out")
    result.calibration.save(args.out)
    sentences = [*sentences_of(result), f"Written to {args.out}."]
    return print_result({"path": str(args.out), **result.figures()}, sentences, as_json=args.json)


def _check_options(args: argparse.Namespace) -> None:
    """Raise UserError for an option that has no effect on these recordings or folders of slices."""
    folders = [path.is_dir() for path in args.recordings]
    if args.assume_full_range and not all(folders):
        raise UserError("--assume-full-range is for slices; leave it out for recordings")
    for option, given, why in (
        ("--load-cell-delay-s", args.load_cell_delay_s, "each slice holds its torque itself"),
        ("--tool-mm", args.tool_mm, "a calibration of slices knows no tool"),
        ("--sides", args.sides, "slices do not name their side"),
    ):
        if given is not None and any(folders):
            raise UserError(f"{option} is for recordings: {why}; leave it out")


def sentences_of(result: "CalibrationResult") -> list[str]:
    """Return what the user should know of a calibration."""
    calibration, regressor, timing = result.calibration, result.regressor, result.timing
    outputs, sides = " and ".join(calibration.outputs), " and ".join(calibration.sides)
    sentences = [f"Estimator {calibration.estimator.name}, {outputs} from {result.frames} frames of the {sides} side."]
    if regressor is not None and regressor.misses_loads:
        sentences.append(_misses_loads(regressor, calibration))
    if regressor is not None and result.reads_beyond is False:
        sentences.append(_range_ends(regressor))
    known = [f"{abs(one.delay_s):.2f} s {'before' if one.delay_s < 0 else 'after'}" for one in timing.delays if one]
    if known:
        probably = "probably " if timing.uncertainty_s else ""
        sentences.append(f"The load is {probably}stamped {', '.join(known)} the frames move.")
    sentences += [f"Warning: {doubt}." for doubt in result.doubts]
    if result.widening is not None:
        sentences.append(
            "Could not verify the load cell's timestamps: the load changed too few times. They may be "
            f"{timing.uncertainty_s:.2g} s off, so the intervals are wider, for loads {result.widening:.2g} times. "
            "Record more changes of load, such as ten twists, or confirm the load cell's clock with "
            "--load-cell-delay-s 0."
        )
    if calibration.kind == "raw":
        if result.tool_mm is not None:
            sentences.append(f"The tool's diameter is {result.tool_mm:.3g} mm.")
        elif (law := calibration.tools) is not None:
            sentences.append(
                f"The tools' diameters are {law.low_mm:.3g} to {law.high_mm:.3g} mm. Before a twist of known torque, "
                f"the torque on another tool may be off by a factor of {law.factor:.2g} either way, and the interval "
                "shows it; correct it with `shearloop adapt`."
            )
        elif result.tools:
            named = " and ".join(f"{one.value:.3g}" for one in result.tools)
            sentences.append(f"The tools of {named} mm have the torque in common.")
            if calibration.diameter is None:
                sentences.append("Diameters are not estimated: that takes recordings of three.")
        else:
            unnamed = "The recordings do not name one tool's diameter, and on another tool the torque would be wrong"
            sentences.append(f"{unnamed}: name it with --tool-mm.")
    return sentences


def _misses_loads(regressor: "IntervalRegressor", calibration: "Calibration") -> str:
    low_nm, high_nm = (round(limit, 3) + 0.0 for limit in (regressor.range.low, regressor.range.high))
    others = [] if calibration.estimator.name == DEFAULT else [f"with --estimator {DEFAULT}"]
    others += ["on both fingertips"] if len(calibration.sides) == 1 else []
    cure = f"Calibrate {' or '.join(others)}, or record" if others else "Record"
    return (
        "It does not see the load: too many of the loads left out for validation lay outside their intervals. So every "
        f"interval spans all calibrated torques, {low_nm:g} to {high_nm:g} N·m, and the torque is useless. "
        f"{cure} a grip in which the tool twists the gel more."
    )


def _range_ends(regressor: "IntervalRegressor") -> str:
    span = regressor.range
    limits = (span.low, span.high, span.low_end, span.high_end, span.lowest, span.highest)
    low_nm, high_nm, below_nm, above_nm, lowest_nm, highest_nm = (round(limit, 3) + 0.0 for limit in limits)
    ends = (("below", below_nm, lowest_nm), ("above", above_nm, highest_nm))
    reach = [
        f"of estimates {side} {end_nm:g} N·m reach to {reached_nm:g} N·m at least"
        for side, end_nm, reached_nm in ends
        if math.isfinite(end_nm)
    ]
    where = f"intervals {', and '.join(reach)}"
    if below_nm >= high_nm and above_nm <= low_nm:
        where = f"all intervals reach from {lowest_nm:g} to {highest_nm:g} N·m at least, and the torque is useless"
    return (
        f"Torques beyond the calibrated {low_nm:g} to {high_nm:g} N·m may be estimated within them, as the outermost "
        f"were when they were left out: {where}. Calibrate on all torques that will occur, and add --assume-full-range."
    )
