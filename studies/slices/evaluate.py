"""Evaluates a calibration of slices on other slices."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from shearloop.bank.bank_file import Bank
from shearloop.estimation import TactileFrame
from shearloop.estimation.defaults import LOADED_NM
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.reader import SliceReader
from shearloop.studies.slices.series import SliceSeries, read_parts
from shearloop.tools.estimate_tracks import EstimateTrack
from shearloop.tools.evaluate import Evaluation, known_data
from shearloop.tools.evaluation_figure import loaded_text
from shearloop.tools.figures import Frames, beats_clock
from shearloop.tools.parallel import Executor

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def estimate_slices(calibration: SliceCalibration, series: SliceSeries, bank: Bank | None = None) -> EstimateTrack:
    """Estimate every slice; raises CalibrationError for slices of another side."""
    chosen = series.select_sides(calibration.sides)
    reader = SliceReader(calibration, bank)
    estimates, latency = [], []
    for t_s, channels in zip(chosen.t_s, chosen.channels, strict=True):
        begun = time.perf_counter()
        estimates.append(reader.estimate(TactileFrame.of(float(t_s), channels)))
        latency.append(1e3 * (time.perf_counter() - begun))
    profile_nm = None if calibration.profile is None else calibration.profile.predict(chosen)
    return EstimateTrack(chosen, tuple(estimates), np.array(latency), profile_nm)


def estimate_in_worker(shared: tuple[SliceCalibration, str | None], series: SliceSeries) -> EstimateTrack:
    """Return `estimate_slices` for a calibration and the bank's path, which the worker opens."""
    calibration, path = shared
    return estimate_slices(calibration, series, None if path is None else Bank.open(path))


def evaluate_slices(
    calibration: Path, folders: Sequence[Path], bank: Path | None, time_range: tuple[float, float], pool: Executor
) -> Evaluation:
    """Return the estimates of these fractions (0 to 1) of folders of slices, by a calibration's file."""
    made = SliceCalibration.load(calibration)
    if bank is not None:
        Bank.open(bank)
    paths, parts = read_parts(folders, time_range)
    shared = (made, None if bank is None else str(bank.resolve()))
    tracks = list(pool.map(estimate_in_worker, shared, parts))
    return Evaluation(
        tracks,
        paths,
        f"{made.estimator.name}, fitted to {made.source}",
        made.assumption_text,
        draw_slices,
        no_better_than_place,
        known_data(made.learned, tracks, paths),
    )


def no_better_than_place(tracks: Sequence[EstimateTrack], loaded_nm: float = LOADED_NM) -> str:
    """Return a sentence against an estimate that errs as much as a guess without a sensor, empty for a better one."""
    if beats_clock(tracks, loaded_nm):
        return ""
    return "The sensor does not beat the place in the sequence: record the levels in random order."


def draw_slices(axes: "Axes", track: EstimateTrack, name: str) -> None:
    """Draw truth and estimate of each slice with its interval: the torque, or the diameter of cylinders."""
    from matplotlib.ticker import MaxNLocator

    is_torque = not np.isfinite(track.series.diameter_mm).any()
    frames = Frames.of(track, "torque" if is_torque else "diameter")
    t_s = track.series.t_s
    known = "load cell" if is_torque else "known diameter"
    axes.plot(t_s, frames.truth, "ko", linewidth=1.0, markersize=5, label=known)
    shown = "estimate with its 95 % interval"
    ends = [frames.value - frames.low, frames.high - frames.value]
    axes.errorbar(t_s, frames.value, ends, fmt="s", markersize=4, label=shown)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_title(name + (loaded_text(track) if is_torque else ""), loc="left", fontsize="medium")
    axes.set_xlabel("slice")
    axes.set_ylabel("torque in N·m" if is_torque else "diameter in mm")
