"""Calibrates an estimator on recordings and reports on the result in sentences."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import isnan
from pathlib import Path

from shearloop.bank.estimation import Calibration, FrameSeries, Name, Physics, fit, load_delay
from shearloop.bank.estimation.interval_regressor import IntervalRegressor
from shearloop.daemon.analysis.series import check_no_copies, check_paths_differ, part_of, read_series, series_of
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.reader import read_recording

ESTIMATORS: tuple[Name, ...] = ("motion_regression", "regression", "bank", "paper", "reconstruction")


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """What the user says about the recordings.

    time_range are shares (0 to 1) of each recording. load_cell_delay_s is subtracted from the load cell's times, and
    then these are not checked. With assume_full_range no torque will exceed the slices.
    """

    sides: tuple[str, ...] | None = None
    time_range: tuple[float, float] = (0.0, 1.0)
    load_cell_delay_s: float | None = None
    assume_full_range: bool = False
    tool_mm: float | None = None


@dataclass(frozen=True, slots=True)
class CalibrationReport:
    """A calibration with the result for scripts and the sentences for the user."""

    calibration: Calibration
    result: dict[str, object]
    sentences: list[str]


def calibrate(
    paths: Sequence[Path], estimator: Name, physics: Physics, options: CalibrationOptions
) -> CalibrationReport:
    """Fit an estimator to recordings or folders of slices, oldest first.

    Raises UserError for options that do not fit the recordings, and CalibrationError for recordings that determine no
    calibration.
    """
    check_paths_differ(paths)
    delay_s = options.load_cell_delay_s
    series = [(path, one) for path in paths for one in read_series(path, options.sides, options.tool_mm)]
    parts = [part_of(one, *options.time_range) for _, one in series]
    check_no_copies([(str(path), part) for (path, _), part in zip(series, parts, strict=True)])
    _check_options(options, parts)
    if delay_s:
        parts = [replace(one, torque_t_s=one.torque_t_s - delay_s) for one in parts]
    others = _other_sides(paths, options) if options.sides is not None and delay_s is None else []
    find_delay = cache(load_delay.find_load_delay)
    calibration = fit(
        estimator,
        parts,
        _source(paths, options),
        physics,
        trust_times=delay_s is not None,
        full_range=options.assume_full_range,
        timed_by=[one for _, one in others],
        find_delay=find_delay,
    )
    if options.assume_full_range and calibration.torque is None:
        raise UserError("--assume-full-range is about torques, and these slices have diameters only; leave it out")
    frames = sum(len(one.t_s) for one in parts)
    quantities = [name for name in ("torque", "diameter") if getattr(calibration, name) is not None]
    result: dict[str, object] = {
        "estimator": estimator,
        "quantities": quantities,
        "frames": frames,
        "sides": list(calibration.sides),
        "source": calibration.source,
        "assumptions": list(calibration.assumptions),
    }
    sentences = [
        f"Estimator {estimator}, {' and '.join(quantities)} from {frames} frames of the "
        f"{' and '.join(calibration.sides)} side."
    ]
    report = CalibrationReport(calibration, result, sentences)
    _report_torque(report, options)
    if calibration.kind == "raw":
        if delay_s is None:
            named = [*((path.name, one) for (path, _), one in zip(series, parts, strict=True)), *others]
            references = load_delay.timing_references(parts, [one for _, one in others], find_delay)
            _report_timing(report, named, references, find_delay)
        _report_tool(report)
    return report


def _check_options(options: CalibrationOptions, parts: Sequence[FrameSeries]) -> None:
    """Raise UserError for an option that has no effect on these recordings."""
    if options.assume_full_range and any(one.kind == "raw" for one in parts):
        raise UserError("--assume-full-range is for slices; leave it out for recordings")
    if all(one.kind == "raw" for one in parts):
        return
    for option, given, why in (
        ("--load-cell-delay-s", options.load_cell_delay_s, "each slice holds its torque itself"),
        ("--tool-mm", options.tool_mm, "a calibration of slices knows no tool"),
        ("--sides", options.sides, "slices do not name their side"),
    ):
        if given is not None:
            raise UserError(f"{option} is for recordings: {why}; leave it out")


def _other_sides(paths: Sequence[Path], options: CalibrationOptions) -> list[tuple[str, FrameSeries]]:
    """Return the named series of the sides that are not calibrated: they may show the load cell's delay better."""
    return [
        (f"{path.name}, {side}", part_of(series_of(recording, (side,)), *options.time_range))
        for path in paths
        if not path.is_dir()
        for recording in (read_recording(path),)
        for side in recording.sides
        if side not in (options.sides or ())
    ]


def _source(paths: Sequence[Path], options: CalibrationOptions) -> str:
    source = ", ".join(path.name for path in paths)
    start, stop = options.time_range
    if (start, stop) != (0.0, 1.0):
        source += f" from {start:g} to {stop:g}"
    return source + (f", load cell {options.load_cell_delay_s:g} s late" if options.load_cell_delay_s else "")


def _report_torque(report: CalibrationReport, options: CalibrationOptions) -> None:
    """Report whether loads are seen, and whether torques beyond the calibrated ones are predicted within them."""
    calibration = report.calibration
    if calibration.torque is None or not isinstance(regressor := calibration.torque.regressor, IntervalRegressor):
        return
    report.result["sees_loads"] = not regressor.misses_loads
    if regressor.misses_loads:
        report.sentences.append(_misses_loads(regressor, calibration))
    if calibration.kind != "raw" and not options.assume_full_range:
        extrapolates = not (regressor.low_end > regressor.low or regressor.high_end < regressor.high)
        report.result["reads_beyond"] = extrapolates
        if not extrapolates:
            report.sentences.append(_range_ends(regressor))


def _misses_loads(regressor: IntervalRegressor, calibration: Calibration) -> str:
    low_nm, high_nm = (round(limit, 3) + 0.0 for limit in (regressor.low, regressor.high))
    others = [] if calibration.estimator == ESTIMATORS[0] else [f"with --estimator {ESTIMATORS[0]}"]
    others += ["on both fingertips"] if len(calibration.sides) == 1 else []
    cure = f"Calibrate {' or '.join(others)}, or record" if others else "Record"
    return (
        "It does not see the load: too many of the loads left out for validation lay outside their intervals. So every "
        f"interval spans all calibrated torques, {low_nm:g} to {high_nm:g} N·m, and the torque is useless. "
        f"{cure} a grip in which the tool twists the gel more."
    )


def _range_ends(regressor: IntervalRegressor) -> str:
    limits = (regressor.low, regressor.high, regressor.low_end, regressor.high_end, regressor.lowest, regressor.highest)
    low_nm, high_nm, below_nm, above_nm, lowest_nm, highest_nm = (round(limit, 3) + 0.0 for limit in limits)
    where = (
        f"intervals of estimates below {below_nm:g} N·m reach to {lowest_nm:g} at least, of estimates above "
        f"{above_nm:g} to {highest_nm:g} N·m"
    )
    if below_nm >= high_nm and above_nm <= low_nm:
        where = f"all intervals reach from {lowest_nm:g} to {highest_nm:g} N·m at least, and the torque is useless"
    return (
        f"Torques beyond the calibrated {low_nm:g} to {high_nm:g} N·m may be estimated within them, as the outermost "
        f"were when they were left out: {where}. Calibrate on all torques that will occur, and add --assume-full-range."
    )


def _report_timing(
    report: CalibrationReport,
    named: Sequence[tuple[str, FrameSeries]],
    references: Sequence[FrameSeries],
    find_delay: load_delay.DelayFinder,
) -> None:
    """Report the load cell's delay, doubts about it, and its effect on the intervals."""
    delays_s = [found and round(found.delay_s, 3) for found in map(find_delay, references)]
    known = ", ".join(f"{each:.2f}" for each in delays_s if each is not None)
    uncertainty_s = round(load_delay.timing_uncertainty_s(references, find_delay), 3)
    if known:
        probably = "probably " if uncertainty_s else ""
        report.sentences.append(f"The load is {probably}stamped {known} s after the frames move.")
    doubts = [
        f"{name}: {why}"
        for name, one in named
        if one in references and (why := load_delay.load_delay_warning(one, find_delay))
    ]
    report.sentences.extend(f"Warning: {doubt}." for doubt in doubts)
    report.result.update(load_cell_delay_s=delays_s, load_cell_warnings=doubts, timing_uncertainty_s=uncertainty_s)
    torque = report.calibration.torque
    if torque is not None and uncertainty_s and isinstance(torque.regressor, IntervalRegressor):
        report.result["widening"] = widening = round(torque.regressor.timing_widening, 2)
        report.sentences.append(
            f"Could not verify the load cell's timestamps: the load changed too few times. They may be "
            f"{uncertainty_s:.2g} s off, so the intervals are wider, for loads {widening:.2g} times. Record more "
            "changes of load, such as ten twists, or confirm the load cell's clock with --load-cell-delay-s 0."
        )


def _report_tool(report: CalibrationReport) -> None:
    known_mm = None if isnan(report.calibration.tool_mm) else report.calibration.tool_mm
    report.result["tool_mm"] = known_mm
    report.sentences.append(
        "The recordings do not name one tool's diameter, and on another tool the torque would be wrong: name it with "
        "--tool-mm."
        if known_mm is None
        else f"The tool's diameter is {known_mm:.3g} mm."
    )
