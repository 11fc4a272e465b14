"""`shearloop calibrate REC… --estimator NAME --out CAL`: fit an estimator to recordings."""

import argparse
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.calibrations import add_recipe, check_recipe, of_slices, time_range
from shearloop.cli.options import add_json, add_option
from shearloop.cli.output_paths import output_path, written_to
from shearloop.cli.terminal import print_result
from shearloop.errors import UserError
from shearloop.estimation.estimator_names import DEFAULT
from shearloop.tools.outputs import check_overwrite

if TYPE_CHECKING:
    from collections.abc import Callable

    from shearloop.estimation import Calibration, Physics
    from shearloop.estimation.interval_regressor import IntervalRegressor
    from shearloop.tools.calibrate import CalibrationResult
    from shearloop.tools.estimate_tracks import EstimateTrack
    from shearloop.tools.leave_out import Plan

# A calibration on a smaller fraction of the frames is doubted.
_FEW_KNOWN = 0.5
# The refits without each block may take about this long, estimated from the time of one fit.
LEFT_OUT_WITHIN_S = 20.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_option(parser, "recordings", Path, "REC", "recordings (.mcap) or folders of slices, oldest first", nargs="+")
    add_recipe(parser)
    add_option(parser, "--out", output_path, "CAL", "calibration to write", required=True)
    add_option(parser, "--bank", Path, "FILE", "a bank, which the estimators paper and bank need")
    text = "fraction of each recording to use, e.g. 0:0.5"
    add_option(parser, "--time-range", time_range, "FROM:TO", text, default="0:1")
    add_json(parser)
    parser.epilog = (
        "A recording has to hold some seconds idle, the grip, several twists (best ten) with the load cell recorded, "
        "and some seconds idle after the release. docs/estimators.md describes the estimators and their needs."
    )


def run(args: argparse.Namespace) -> int:
    """Fit, write, and print the report."""
    from shearloop.bank.bank_file import Bank
    from shearloop.bank.mesh import load_mesh
    from shearloop.estimation import Physics
    from shearloop.estimation.archive import ARCHIVE_MAGIC

    check_recipe(args, args.recordings)
    check_overwrite(args.out, "an estimator's calibration", ARCHIVE_MAGIC)
    replaced = args.out.exists()
    physics = Physics(
        bank=Bank.open(args.bank) if args.bank else None, mesh=load_mesh(args.mesh) if args.mesh else None
    )
    made = _calibrate_slices if of_slices(args.recordings) else _calibrate_recordings
    figures, sentences = made(args, physics)
    sentences.append(written_to(args.out, replaced=replaced))
    return print_result({"path": str(args.out), **figures}, sentences, as_json=args.json)


def _calibrate_recordings(args: argparse.Namespace, physics: "Physics") -> tuple[dict[str, object], list[str]]:
    """Write a calibration on recordings; return its figures, and what the user should know of it."""
    from shearloop.tools.calibrate import UsedBank, calibrate
    from shearloop.tools.estimate_tracks import estimate_series
    from shearloop.tools.leave_out import MEAN_TWIST, Recipe, advice_unjudged, plan_left_out
    from shearloop.tools.left_out_blocks import usual_kind

    result = calibrate(
        args.recordings, args.estimator, physics, time_range=args.time_range, sides=args.sides,
        load_cell_delay_s=args.load_cell_delay_s, tool_mm=args.tool_mm,
    )  # fmt: skip
    result.calibration.save(args.out)
    figures, sentences = result.figures(), sentences_of(result)
    if result.calibration.bank_identity and physics.bank is not None:
        used = UsedBank.of(result.calibration, physics.bank)
        figures, sentences = {**figures, **used.figures()}, sentences + used.sentences()
    if result.calibration.torque is None:
        judged, said = _unjudged_diameters()
        return {**figures, **judged}, sentences + said
    kind = usual_kind(result.parts)
    recipe = Recipe(args.estimator, args.bank, args.mesh, result.timing.uncertainty_s)
    names = [path.name for path in args.recordings]
    trial = _Trial(
        kind,
        lambda: plan_left_out(kind, recipe, result.parts, names),
        lambda: [estimate_series(result.calibration, part, physics.bank) for part in result.parts],
        MEAN_TWIST,
        advice_unjudged(kind, result.parts),
    )
    judged, said = _judge_left_out(args, trial, result.fit_s)
    return {**figures, **judged}, sentences + said


def _calibrate_slices(args: argparse.Namespace, physics: "Physics") -> tuple[dict[str, object], list[str]]:
    """Write a calibration on folders of slices; return its figures, and what the user should know of it."""
    from shearloop.studies.slices.calibrate import calibrate_slices
    from shearloop.studies.slices.evaluate import estimate_slices
    from shearloop.studies.slices.leave_out import LEVELS, MEAN_OF_PLACE, SliceRecipe, plan_levels
    from shearloop.tools.calibrate import UsedBank
    from shearloop.tools.leave_out import advice_unjudged

    result = calibrate_slices(
        args.recordings, args.estimator, physics,
        time_range=args.time_range, assume_full_range=args.assume_full_range,
    )  # fmt: skip
    result.calibration.save(args.out)
    figures, sentences = result.figures(), result.sentences()
    if result.calibration.estimator.needs == "bank" and physics.bank is not None:
        used = UsedBank(physics.bank)
        figures, sentences = {**figures, **used.figures()}, sentences + used.sentences()
    if result.calibration.torque is None:
        judged, said = _unjudged_diameters()
        return {**figures, **judged}, sentences + said
    recipe = SliceRecipe(args.estimator, args.bank, args.mesh, args.assume_full_range)
    trial = _Trial(
        LEVELS,
        lambda: plan_levels(LEVELS, recipe, result.parts),
        lambda: [estimate_slices(result.calibration, part, physics.bank) for part in result.parts],
        MEAN_OF_PLACE,
        advice_unjudged(LEVELS, ()),
    )
    judged, said = _judge_left_out(args, trial, result.fit_s)
    return {**figures, **judged}, sentences + said


@dataclass(frozen=True, slots=True)
class _Trial:
    """The judgement of a calibration: the kind of left-out blocks, their plan, and the tracks of the fit's own frames.

    `clock` names the guess without a sensor. `advice` is for a calibration without a block that can be left out.
    """

    kind: str
    plan: "Callable[[], Plan]"
    tracks: "Callable[[], list[EstimateTrack]]"
    clock: str
    advice: str

    def on_fitted(self) -> tuple[dict[str, object], list[str]]:
        """Return what frames of the fit show, as figures and in words."""
        from shearloop.tools.leave_out import figures_on_fitted, sentences_on_fitted

        figures = figures_on_fitted(self.tracks())
        return {"on_fitted": figures}, sentences_on_fitted(figures, self.clock)


def _unjudged_diameters() -> tuple[dict[str, object], list[str]]:
    """Return why no block is left out of a calibration without a torque, and the advice."""
    from shearloop.tools.leave_out import ON_ANOTHER

    why = "blocks are left out for torques, and this calibration has diameters only"
    return {"left_out": None, "left_out_refused": why, "advice": ON_ANOTHER}, [f"Not judged: {why}.", ON_ANOTHER]


def _judge_left_out(args: argparse.Namespace, trial: _Trial, fit_s: float) -> tuple[dict[str, object], list[str]]:
    """Return the figures of the blocks left out, and the advice for the user.

    Where the refits would take longer than some seconds, or the rest gives no calibration, it says so; then come the
    figures on frames of the fit, and the command or the advice.
    """
    from shearloop.bank.errors import CalibrationError
    from shearloop.tools.leave_out import sentences_of as sentences_of_left_out
    from shearloop.tools.parallel import SerialExecutor

    try:
        plan = trial.plan()
        takes_s = len(plan.blocks) * fit_s
        if takes_s > LEFT_OUT_WITHIN_S:
            command = shlex.join(_evaluate_command(args, trial.kind))
            figures, sentences = trial.on_fitted()
            why = f"Not judged yet: {len(plan.blocks)} fits take about {takes_s:.0f} s."
            advice = f"Judge it by {trial.kind} left out: {command}"
            later = {"left_out": None, "left_out_command": command, "advice": advice}
            return {**later, **figures}, [why, *sentences, advice]
        found = plan.judge(SerialExecutor())
    except (UserError, CalibrationError) as error:
        figures, sentences = trial.on_fitted()
        why = f"Not judged by {trial.kind} left out: {error}."
        refused = {"left_out": None, "left_out_refused": str(error), "advice": trial.advice}
        return {**refused, **figures}, [why, *sentences, trial.advice]
    except KeyboardInterrupt:
        print(f"{args.out} is written and whole; its trial with {trial.kind} left out has not ended", file=sys.stderr)
        raise
    return {"left_out": found.figures()}, sentences_of_left_out(found)


def _evaluate_command(args: argparse.Namespace, kind: str) -> list[str]:
    """Return the words of the command that judges the same recipe."""
    options = (
        ("--estimator", None if args.estimator == DEFAULT else args.estimator),
        ("--bank", args.bank),
        ("--mesh", args.mesh),
        ("--sides", args.sides and ",".join(args.sides)),
        ("--time-range", None if args.time_range == (0.0, 1.0) else "{:g}:{:g}".format(*args.time_range)),
        ("--load-cell-delay-s", args.load_cell_delay_s),
        ("--tool-mm", args.tool_mm),
    )
    words = ["shearloop", "evaluate", "--leave-out", kind, *map(str, args.recordings)]
    for option, value in options:
        words += [] if value is None else [option, str(value)]
    return words + ["--assume-full-range"] * args.assume_full_range


def sentences_of(result: "CalibrationResult") -> list[str]:
    """Return what the user should know of a calibration."""
    calibration, regressor, timing = result.calibration, result.regressor, result.timing
    outputs, sides = " and ".join(calibration.outputs), " and ".join(calibration.sides)
    sentences = [
        f"Estimator {calibration.estimator.name}, {outputs} from {result.frames} of {result.all_frames} frames of the "
        f"{sides} side: those with a known torque or diameter."
    ]
    if result.frames < _FEW_KNOWN * result.all_frames:
        sentences.append(
            f"Warning: only {result.frames / result.all_frames:.0%} of the frames have a known torque or diameter, so "
            "it knows little of the others. Record again with a load cell that measures all the time."
        )
    if regressor is not None and regressor.misses_loads:
        sentences.append(_misses_loads(regressor, calibration))
    if calibration.only_sign:
        own, other = ("positive", "negative") if calibration.only_sign > 0 else ("negative", "positive")
        sentences.append(
            f"It measures {own} torques alone, because the recordings have no others: a tool with a {other} torque may "
            "read as 0. Record twists both ways if a tool is turned both ways."
        )
    known = [
        f"{abs(delay.delay_s):.2f} s {'before' if delay.delay_s < 0 else 'after'}" for delay in timing.delays if delay
    ]
    if known:
        probably = "probably " if timing.uncertainty_s else ""
        sentences.append(f"The load is {probably}stamped {', '.join(known)} the frames move.")
    sentences += [f"Warning: {doubt}." for doubt in result.doubts]
    sentences += [f"Left out: {omission}." for omission in (*result.left_out, *result.of_other_tools)]
    if result.widening is not None:
        sentences.append(_unverified(result, result.widening))
    if result.tool_mm is not None:
        sentences.append(f"The tool's diameter is {result.tool_mm:.3g} mm.")
    elif (law := calibration.tools) is not None:
        sentences.append(
            f"The tools' diameters are {law.low_mm:.3g} to {law.high_mm:.3g} mm. Before a twist of known torque, "
            f"the torque on another tool may be off by a factor of {law.factor:.2g} either way, and the interval "
            "shows it; correct it with `shearloop adapt`."
        )
    elif result.tools:
        named = " and ".join(f"{tool.value:.3g}" for tool in result.tools)
        sentences.append(f"The tools of {named} mm have the torque in common.")
        if calibration.diameter is None:
            sentences.append("Diameters are not estimated: that takes recordings of three.")
    else:
        unnamed = "The recordings do not name one tool's diameter, and on another tool the torque would be wrong"
        sentences.append(f"{unnamed}: name it with --tool-mm.")
    return sentences


def _unverified(result: "CalibrationResult", widening: float) -> str:
    """Return the sentences on a load cell's times that are not verified: cause, effect and cure."""
    effect = "and the intervals of loaded frames do not allow for it"
    if widening > 1.0:
        effect = f"so the intervals of loaded frames are {widening:.2g} times wider"
    off = f"They may be {result.timing.uncertainty_s:.2g} s off, {effect}."
    unverified = "Could not verify the load cell's timestamps: the load changed"
    if not result.changes_often:
        return (
            f"{unverified} too few times. {off} Record more changes of load, such as ten twists, or confirm the load "
            "cell's clock with --load-cell-delay-s 0."
        )
    return (
        f"{unverified} {result.load_changes} times, and no one delay explains how the frames moved. {off} Either the "
        "clocks of the load cell and the frames do not agree, or the tool hardly moves the gel: stamp both with one "
        "clock, and record both fingertips."
    )


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
