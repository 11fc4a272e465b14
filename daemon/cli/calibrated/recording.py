"""`shearloop calibrate REC… --estimator NAME --out CAL`: fit an estimator to recordings."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.options import add_json
from shearloop.daemon.cli.output import print_result

if TYPE_CHECKING:
    from shearloop.bank.estimation import Calibration, FrameSeries
    from shearloop.bank.estimation.alignment import Aligned
    from shearloop.bank.estimation.interval_regressor import IntervalRegressor

# A stamp that is further off belongs to another recording.
_LARGEST_LATE_S = 600.0
ESTIMATORS = ("fused", "regression", "bank", "paper", "reconstruction")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "recordings", nargs="+", type=Path, metavar="REC", help="recordings (.mcap) or folders of slices, oldest first"
    )
    parser.add_argument(
        "--estimator", choices=ESTIMATORS, default=ESTIMATORS[0], help="what to calibrate (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="CAL", help="calibration to write")
    parser.add_argument("--bank", type=Path, metavar="FILE", help="a bank, which the estimators paper and bank need")
    parser.add_argument("--mesh", type=Path, metavar="FILE", help="a mesh, which the estimator reconstruction needs")
    parser.add_argument("--sides", metavar="SIDE[,SIDE]", help="sides to use, e.g. right (default: all that are there)")
    parser.add_argument(
        "--part", metavar="FROM:TO", default="0:1", help="share of each recording to use, e.g. 0:0.5 (default: all)"
    )
    parser.add_argument(
        "--load-late",
        type=float,
        metavar="S",
        help="seconds that the load cell's stamps are late, which are taken off; 0 takes them for right unchecked",
    )
    parser.add_argument(
        "--all-torques",
        action="store_true",
        help="no torque will come beyond those of the slices: intervals are then not stretched to hold such ones",
    )
    parser.add_argument(
        "--tool-mm",
        type=float,
        metavar="MM",
        help="diameter of the tool in recordings that do not name it; on another tool no torque is told",
    )
    add_json(parser)
    parser.epilog = (
        "A recording has to hold some seconds idle, the grip, several twists (best ten) with the load cell read "
        "beside, and some seconds idle after letting go. docs/estimators.md says what the estimators are and need."
    )


def run(args: argparse.Namespace) -> int:
    """Fit, write, and say what was fitted."""
    from shearloop.bank.eit.bank_file import Bank
    from shearloop.bank.eit.mesh import load_mesh
    from shearloop.bank.estimation import Physics, fit
    from shearloop.bank.estimation.alignment import alignment, telling
    from shearloop.bank.estimation.archive import ARCHIVE_MAGIC
    from shearloop.daemon.analysis.copies import check_no_copies, check_paths_differ
    from shearloop.daemon.analysis.series import part_of, read_series, series_of
    from shearloop.daemon.cli.options import check_overwrite, parse_part, parse_sides
    from shearloop.daemon.errors import UserError
    from shearloop.daemon.recording.reader import read_recording
    from shearloop.daemon.recording.schema import LARGEST_DIAMETER_MM

    start, stop = parse_part(args.part)
    late_s = args.load_late
    if late_s is not None and not abs(late_s) <= _LARGEST_LATE_S:
        raise UserError(f"--load-late must be seconds from -{_LARGEST_LATE_S:g} to {_LARGEST_LATE_S:g}, not {late_s:g}")
    tool_mm = args.tool_mm
    if tool_mm is not None and not 0 < tool_mm < LARGEST_DIAMETER_MM:
        raise UserError(f"--tool-mm must be above 0 and below {LARGEST_DIAMETER_MM:g} mm, not {tool_mm:g}")
    sides = parse_sides(args.sides)
    check_overwrite(args.out, "an estimator's calibration", ARCHIVE_MAGIC)
    check_paths_differ(args.recordings)
    series = [(path, one) for path in args.recordings for one in read_series(path, sides, tool_mm)]
    parts = [part_of(one, start, stop) for _, one in series]
    check_no_copies([(str(path), part) for (path, _), part in zip(series, parts, strict=True)])
    _check_options(args, parts)
    if late_s:
        parts = [replace(one, torque_t_s=one.torque_t_s - late_s) for one in parts]
    # A fingertip that hardly moves with the load has its times from the other one, wherever both were recorded.
    beside = []
    if sides is not None and late_s is None:
        beside = [
            (f"{path.name}, {side}", part_of(series_of(recording, (side,)), start, stop))
            for path in args.recordings
            if not path.is_dir()
            for recording in (read_recording(path),)
            for side in recording.sides
            if side not in sides
        ]
    physics = Physics(
        bank=Bank.open(args.bank) if args.bank else None, mesh=load_mesh(args.mesh) if args.mesh else None
    )
    names = ", ".join(path.name for path in args.recordings)
    source = names if (start, stop) == (0.0, 1.0) else f"{names} from {start:g} to {stop:g}"
    source += f", load {late_s:g} s late" if late_s else ""
    aligned = cache(alignment)
    calibration = fit(
        args.estimator,
        parts,
        source,
        physics,
        trust_times=late_s is not None,
        all_torques=args.all_torques,
        timed_by=[one for _, one in beside],
        aligned=aligned,
    )
    if args.all_torques and calibration.torque is None:
        raise UserError("--all-torques vouches for torques, and these slices tell diameters alone; leave it out")
    calibration.save(args.out)
    quantities = [name for name in ("torque", "diameter") if getattr(calibration, name) is not None]
    frames = sum(len(one.t_s) for one in parts)
    told = {
        "path": str(args.out),
        "estimator": args.estimator,
        "quantities": quantities,
        "frames": frames,
        "sides": list(calibration.sides),
        "source": source,
        "vouched": list(calibration.vouched or ()),
    }
    sentences = [
        f"{args.out}: estimator {args.estimator}, {' and '.join(quantities)} from {frames} frames of the "
        f"{' and '.join(calibration.sides)} side."
    ]
    if calibration.torque is not None:
        told["sees_loads"] = not calibration.torque.reader.misses_loads
        if calibration.torque.reader.misses_loads:
            sentences.append(_blind(calibration.torque.reader, args.estimator, calibration.sides))
        if calibration.kind != "raw" and not args.all_torques:
            told["reads_beyond"] = beyond = not _reads_within(calibration.torque.reader)
            sentences += [] if beyond else [_ends(calibration.torque.reader)]
    if late_s is None and calibration.kind == "raw":
        named = [*((path.name, one) for (path, _), one in zip(series, parts, strict=True)), *beside]
        timed = telling(parts, [one for _, one in beside], aligned)
        of_times, said = _of_times(calibration, named, timed, aligned)
        told |= of_times
        sentences += said
    if calibration.kind == "raw":
        known_mm = None if isnan(calibration.tool_mm) else calibration.tool_mm
        told["tool_mm"] = known_mm
        unknown = (
            "The recordings do not name one tool's diameter, and on another tool the torque would be wrong: name it "
            "with --tool-mm."
        )
        sentences.append(unknown if known_mm is None else f"Its tool is of {known_mm:.3g} mm.")
    print_result(told, sentences, as_json=args.json)
    return 0


def _check_options(args: argparse.Namespace, parts: "Sequence[FrameSeries]") -> None:
    """Raise UserError for an option that does nothing for what is calibrated on."""
    from shearloop.daemon.errors import UserError

    if args.all_torques and any(one.kind == "raw" for one in parts):
        raise UserError("--all-torques is for slices: what is read of recordings has no such ends; leave it out")
    if all(one.kind == "raw" for one in parts):
        return
    for option, given, why in (
        ("--load-late", args.load_late, "each slice holds its torque itself"),
        ("--tool-mm", args.tool_mm, "a calibration of slices knows of no tool"),
        ("--sides", args.sides, "slices do not tell whose they are"),
    ):
        if given is not None:
            raise UserError(f"{option} is for recordings: {why}; leave it out")


def _of_times(
    calibration: "Calibration",
    named: Sequence[tuple[str, "FrameSeries"]],
    timed: Sequence["FrameSeries"],
    aligned: "Aligned",
) -> tuple[dict[str, object], list[str]]:
    """Return what is known of when the loads of recordings were measured, which `timed` tell: as JSON, and in words."""
    from shearloop.bank.estimation.alignment import doubt, unchecked_s

    late_s = [found and round(found.late_s, 3) for found in map(aligned, timed)]
    known = ", ".join(f"{each:.2f}" for each in late_s if each is not None)
    unsure_s = round(unchecked_s(timed, aligned), 3)
    stamped = "probably stamped" if unsure_s else "stamped"
    sentences = [f"The load is {stamped} {known} s after the frames move."] if known else []
    doubts = [f"{name}: {why}" for name, one in named if one in timed and (why := doubt(one, aligned))]
    sentences += [f"Doubtful is {why}." for why in doubts]
    told: dict[str, object] = {"load_late_s": late_s, "load_doubts": doubts, "load_unchecked_s": unsure_s}
    if calibration.torque is not None and unsure_s:
        told["widened"] = widened = round(calibration.torque.reader.widened, 2)
        sentences.append(
            f"When the load is stamped could not be checked, for it changes too seldom: it may be {unsure_s:.2g} s "
            f"off unseen, so the intervals are wider, those of loads {widened:.2g} times. Record more changes of load, "
            "as ten twists, or vouch for the load cell's clock with --load-late 0."
        )
    return told, sentences


def _blind(reader: "IntervalRegressor", estimator: str, sides: tuple[str, ...]) -> str:
    """Return what it means that loads are not seen, and what may help."""
    low_nm, high_nm = (round(limit, 3) + 0.0 for limit in (reader.low, reader.high))
    others = ["with --estimator fused"] if estimator != "fused" else []
    others += ["on both fingertips"] if len(sides) == 1 else []
    cure = f"Calibrate {' or '.join(others)}, or record" if others else "Record"
    return (
        "It does not see the load: of the loads that it was tried on, too many lay outside of their intervals. So "
        f"every interval spans all calibrated torques, {low_nm:g} to {high_nm:g} N·m, and no torque can be told by it. "
        f"{cure} a grip in which the tool twists the gel more."
    )


def _reads_within(reader: "IntervalRegressor") -> bool:
    """Return whether torques beyond those calibrated on may be read as some of them."""
    return reader.low_end > reader.low or reader.high_end < reader.high


def _ends(reader: "IntervalRegressor") -> str:
    """Return what it means that torques beyond the range are read within it, and what helps."""
    limits = (reader.low, reader.high, reader.low_end, reader.high_end, reader.lowest, reader.highest)
    low_nm, high_nm, below_nm, above_nm, lowest_nm, highest_nm = (round(limit, 3) + 0.0 for limit in limits)
    where = (
        f"intervals of what is read below {below_nm:g} N·m reach to {lowest_nm:g} at least, of what is read above "
        f"{above_nm:g} to {highest_nm:g} N·m"
    )
    if below_nm >= high_nm and above_nm <= low_nm:
        where = (
            f"all intervals reach from {lowest_nm:g} to {highest_nm:g} N·m at least, and no torque can be told by it"
        )
    return (
        f"Torques beyond the calibrated {low_nm:g} to {high_nm:g} N·m may be read within them, as the outermost were "
        f"when they were left out: {where}. Calibrate on all torques that will come, and say so with "
        "--all-torques."
    )
