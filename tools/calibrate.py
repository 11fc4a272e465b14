"""Calibrates an estimator on recordings."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from shearloop.bank.bank_file import Bank
from shearloop.estimation import TRUSTED, Calibration, FrameSeries, LoadTiming, Physics, adapt, fit, measure_timing
from shearloop.estimation.bank_match import find_numberings
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.estimation.gain_correction import GainCorrection
from shearloop.estimation.interval_regressor import IntervalRegressor
from shearloop.estimation.load_delay import MANY_CHANGES, count_load_changes
from shearloop.estimation.series import distinct
from shearloop.estimation.values import Measured
from shearloop.tools.frame_series import (
    check_no_copies,
    check_paths_differ,
    not_of_tool,
    part_of,
    read_series,
    series_of,
)
from shearloop.tools.recordings.frames import read_recording


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A calibration, the load cell's timing, named doubts about it, and the tools.

    `frames` counts those with a known torque or diameter.
    """

    calibration: Calibration
    frames: int
    timing: LoadTiming = TRUSTED
    doubts: Sequence[str] = ()
    tools: Sequence[Measured] = ()
    # The parts of recordings that it was fitted to, and the time in s that the fit took.
    parts: Sequence[FrameSeries] = ()
    fit_s: float = 0.0
    # What of the recordings was not used, and where the stated tool does not count, by their names.
    left_out: Sequence[str] = ()
    of_other_tools: Sequence[str] = ()

    @property
    def regressor(self) -> IntervalRegressor | None:
        """The torque's regressor, None without a torque."""
        return None if self.calibration.torque is None else self.calibration.torque.regressor

    @property
    def all_frames(self) -> int:
        """The frames of the parts, also those without a known torque or diameter."""
        return sum(len(part.t_s) for part in self.parts)

    @property
    def load_changes(self) -> int:
        """How many times the load came and went."""
        return sum(count_load_changes(part) for part in self.parts)

    @property
    def changes_often(self) -> bool:
        """Whether the load changes often enough to show its delay."""
        return self.load_changes >= MANY_CHANGES

    @property
    def tool_mm(self) -> float | None:
        """The diameter of the only tool in the recordings, None where it is not known."""
        return None if math.isnan(self.calibration.tool_mm) else self.calibration.tool_mm

    @property
    def widening(self) -> float | None:
        """The factor on the loads' intervals for unknown times, None where they are known."""
        one = self.regressor
        return round(one.timing_widening, 2) if one is not None and self.timing.uncertainty_s else None

    def figures(self) -> dict[str, object]:
        """Return the result for scripts."""
        calibration, timing = self.calibration, self.timing
        found: dict[str, object] = {
            "estimator": calibration.estimator.name,
            "quantities": list(calibration.outputs),
            "frames": self.frames,
            "all_frames": self.all_frames,
            "sides": list(calibration.sides),
            "source": calibration.source,
            "assumptions": list(calibration.assumptions),
        }
        if self.regressor is not None:
            found["sees_loads"] = not self.regressor.misses_loads
        if timing.references:
            found["load_cell_delay_s"] = [delay and round(delay.delay_s, 3) for delay in timing.delays]
            found["load_cell_warnings"] = list(self.doubts)
            found["timing_uncertainty_s"] = round(timing.uncertainty_s, 3)
        if self.left_out:
            found["readings_left_out"] = list(self.left_out)
        if self.of_other_tools:
            found["tool_mm_left_out"] = list(self.of_other_tools)
        if self.widening is not None:
            found["widening"] = self.widening
        return found | {"tool_mm": self.tool_mm}


def calibrate(
    paths: Sequence[Path],
    estimator: EstimatorName,
    physics: Physics,
    *,
    time_range: tuple[float, float],
    sides: tuple[str, ...] | None = None,
    load_cell_delay_s: float | None = None,
    tool_mm: float | None = None,
) -> CalibrationResult:
    """Fit an estimator to these fractions (0 to 1) of recordings, oldest first.

    A `load_cell_delay_s` is subtracted from the load cell's times, which are then not checked. Raises UserError for
    recordings that are given twice, and CalibrationError for those that determine no calibration.
    """
    read = read_parts(paths, time_range=time_range, sides=sides, load_cell_delay_s=load_cell_delay_s, tool_mm=tool_mm)
    source = source_text(paths, time_range, load_cell_delay_s)
    begun = time.perf_counter()
    calibration = fit(estimator, read.parts, source, physics, timing=read.timing)
    fit_s = time.perf_counter() - begun
    known = [np.isfinite(part.torque_at_frames()) | np.isfinite(part.diameter_mm) for part in read.parts]
    frames = sum(int(part.sum()) for part in known)
    tools = distinct([part.tool_mm for part in read.parts if part.tool_mm is not None])
    return CalibrationResult(
        calibration, frames, read.timing, read.doubts, tools, read.parts, fit_s, read.left_out, read.of_other_tools
    )


@dataclass(frozen=True, slots=True)
class UsedBank:
    """What is known of the bank of a calibration: only its geometry says whether it is of this fingertip.

    `likeness` is the correlation of its voltages without a touch with the idle frames of the first side, None for
    slices, which have none.
    """

    bank: Bank
    likeness: float | None = None

    @classmethod
    def of(cls, calibration: Calibration, bank: Bank) -> Self:
        """Return the bank of a calibration on recordings."""
        best = find_numberings(calibration.validators[0].idle, bank.homogeneous, bank.table)[0]
        return cls(bank, best.score)

    def figures(self) -> dict[str, object]:
        """Return the bank for scripts."""
        likeness = {} if self.likeness is None else {"idle_likeness": round(self.likeness, 3)}
        return {"bank": {"path": str(self.bank.path), "geometry_hash": self.bank.geometry_hash, **likeness}}

    def sentences(self) -> list[str]:
        """Return what the user should know of the bank."""
        bank = self.bank
        found = f"The bank {bank.path} has {bank.table.description} and the geometry {bank.geometry_hash[:12]}."
        if self.likeness is not None:
            found += (
                f" Its voltages without a touch correlate with the idle frames to {self.likeness:.2f}; another outline "
                "lowers this."
            )
        return [f"{found} `shearloop doctor CONFIG --geometry FILE` compares it with the file of your fingertip."]


@dataclass(frozen=True, slots=True)
class ReadParts:
    """Parts of recordings to calibrate on, the path of each, the load cell's timing, and named doubts about it."""

    parts: Sequence[FrameSeries]
    paths: Sequence[Path]
    timing: LoadTiming
    doubts: Sequence[str]
    # What of the recordings was not used, and where the stated tool does not count, by their names.
    left_out: Sequence[str] = ()
    of_other_tools: Sequence[str] = ()


def read_parts(
    paths: Sequence[Path],
    *,
    time_range: tuple[float, float],
    sides: tuple[str, ...] | None = None,
    load_cell_delay_s: float | None = None,
    tool_mm: float | None = None,
) -> ReadParts:
    """Return what `calibrate` fits to these fractions (0 to 1) of recordings.

    Raises UserError for recordings that are given twice, and CalibrationError for a load cell with a wrong clock.
    """
    check_paths_differ(paths)
    chosen: list[tuple[Path, FrameSeries]] = []
    others: list[tuple[str, FrameSeries]] = []
    all_live = True
    for path in paths:
        not_fitted: list[FrameSeries] = []
        recording = read_recording(path)
        all_live = all_live and recording.live
        if sides is not None and load_cell_delay_s is None:
            # Other sides may show the load cell's delay better.
            not_fitted = [series_of(recording, (side,), tool_mm) for side in recording.sides if side not in sides]
        chosen.append((path, part_of(series_of(recording, sides, tool_mm), *time_range)))
        others += [(f"{path.name}, {series.sides[0]}", part_of(series, *time_range)) for series in not_fitted]
    parts = [part for _, part in chosen]
    check_no_copies([(str(path), part) for path, part in chosen])
    if load_cell_delay_s:
        parts = [replace(part, torque_t_s=part.torque_t_s - load_cell_delay_s) for part in parts]
    timing = TRUSTED if load_cell_delay_s is not None else measure_timing(parts, [part for _, part in others])
    if all_live:
        # One clock stamped frames and torques at their arrival; the motion's delay does not count.
        timing = replace(timing, uncertainty_s=0.0)
    named = [*((path.name, part) for path, part in chosen), *others]
    warned = [pair for pair in zip(timing.references, timing.warnings, strict=True) if pair[1]]
    doubts = [f"{name}: {why}" for name, part in named for reference, why in warned if part is reference]
    left_out = [f"{path.name}: {'; '.join(part.left_out)}" for path, part in chosen if part.left_out]
    of_other_tools = not_of_tool([(path.name, part) for path, part in chosen], tool_mm)
    return ReadParts(parts, [path for path, _ in chosen], timing, doubts, left_out, of_other_tools)


def adapt_to_recordings(
    calibration: Calibration,
    paths: Sequence[Path],
    physics: Physics,
    *,
    time_range: tuple[float, float],
    load_cell_delay_s: float = 0.0,
    tool_mm: float | None = None,
) -> tuple[Calibration, GainCorrection]:
    """Return a calibration adapted to the twists within these fractions of recordings, and the correction of its gain.

    Raises UserError for recordings that are given twice, also as copies, and CalibrationError for those that show no
    gain, or frames that the calibration has learned from.
    """
    check_paths_differ(paths)
    start, stop = time_range
    named = [(str(path), recording) for path in paths for recording in read_series(path, calibration.sides, tool_mm)]
    check_no_copies(named)
    # Where it counts for some alone, the recordings are of several tools, which `adapt` refuses.
    not_of_tool(named, tool_mm)
    series = [recording for _, recording in named]
    # Earlier frames show the session the idle fingertip.
    until = [
        part_of(replace(recording, torque_t_s=recording.torque_t_s - load_cell_delay_s), 0.0, stop)
        for recording in series
    ]
    first = [part_of(recording, start, stop).first_frame for recording in series]
    source, names = source_text(paths, time_range, load_cell_delay_s), [str(path) for path in paths]
    return adapt(calibration, until, source, physics, first_frames=first, names=names)


def source_text(paths: Sequence[Path], time_range: tuple[float, float], delay_s: float | None = None) -> str:
    """Return what a calibration is made from, in words."""
    source = ", ".join(path.name for path in paths)
    if time_range != (0.0, 1.0):
        source += " from {:g} to {:g}".format(*time_range)
    return source + (f", load cell {delay_s:g} s late" if delay_s else "")
