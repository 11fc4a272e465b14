"""Evaluates a calibration on recordings: every frame in order through a session, against the truth."""

import re
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.estimation import Calibration, Estimate, EstimatorSession, FrameSeries, TactileFrame

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


@dataclass(frozen=True, slots=True, eq=False)
class EstimateTrack:
    """One series with an estimate per frame, and the time that each took."""

    series: FrameSeries
    estimates: tuple[Estimate, ...]
    latency_ms: FloatArray


def estimate_series(calibration: Calibration, series: FrameSeries, bank: Bank | None = None) -> EstimateTrack:
    """Estimate every frame of a series in order, as live; raises CalibrationError for a series of other sides."""
    chosen = series.select_sides(calibration.sides)
    session = EstimatorSession(calibration, bank)
    session.set_tool(chosen.tool_mm)
    estimates, latency = [], []
    for t_s, channels in zip(chosen.t_s, chosen.channels, strict=True):
        begun = time.perf_counter()
        estimates.append(session.estimate(TactileFrame.of(float(t_s), channels)))
        latency.append(1e3 * (time.perf_counter() - begun))
    return EstimateTrack(chosen, tuple(estimates), np.array(latency))


def estimate_in_worker(shared: tuple[Calibration, str | None], series: FrameSeries) -> EstimateTrack:
    """Return `estimate_series` for a calibration and the bank's path, which the worker opens."""
    calibration, path = shared
    return estimate_series(calibration, series, None if path is None else Bank.open(path))


def figures_of(tracks: Sequence[EstimateTrack]) -> dict[str, float | int | None]:
    """Return the figures of `shearloop evaluate`, by the names that it prints.

    They are of valid frames with a known truth, None where there are too few. interval_nm is the median width of their
    intervals from end to end. With known diameters, diameter_rmse_mm, diameter_coverage_95 and diameter_interval_mm
    are added, and coverage_95 is the diameter's if there is no torque.
    """
    torque = _compare(tracks, "torque")
    diameter = _compare(tracks, "diameter")
    valid = [estimate.valid for track in tracks for estimate in track.estimates]
    latency = np.concatenate([track.latency_ms for track in tracks])
    figures: dict[str, float | int | None] = {
        "r": torque.r,
        "rmse_nm": torque.rmse,
        "bias_nm": torque.bias,
        "coverage_95": torque.coverage if torque.n else diameter.coverage,
        "interval_nm": torque.width,
        "valid_fraction": float(np.mean(valid)) if valid else None,
        "latency_ms_p50": float(np.quantile(latency, 0.5)) if len(latency) else None,
        "latency_ms_p99": float(np.quantile(latency, 0.99)) if len(latency) else None,
        "frames": len(valid),
    }
    if any(np.isfinite(track.series.diameter_mm).any() for track in tracks):
        figures["diameter_rmse_mm"] = diameter.rmse
        figures["diameter_coverage_95"] = diameter.coverage
        figures["diameter_interval_mm"] = diameter.width
    return figures


@dataclass(frozen=True, slots=True)
class InvalidReason:
    """Why `frames` were not valid: the most frequent sentence, an example if the numbers in it `differ`."""

    frames: int
    sentence: str
    differ: bool


def invalid_reasons(tracks: Sequence[EstimateTrack]) -> list[InvalidReason]:
    """Return why frames were not valid, the most frequent first; sentences that differ in numbers count as one."""
    kinds: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for reason in (reason for track in tracks for estimate in track.estimates for reason in estimate.reasons):
        kinds[_NUMBER.sub("#", reason)][reason] += 1
    found = [InvalidReason(counts.total(), counts.most_common(1)[0][0], len(counts) > 1) for counts in kinds.values()]
    return sorted(found, key=lambda reason: -reason.frames)


@dataclass(frozen=True, slots=True)
class _Comparison:
    n: int
    r: float | None = None
    rmse: float | None = None
    bias: float | None = None
    coverage: float | None = None
    width: float | None = None


def _compare(tracks: Sequence[EstimateTrack], quantity: str) -> _Comparison:
    unit = {"torque": "nm", "diameter": "mm"}[quantity]
    rows = []
    for track in tracks:
        truths = track.series.torque_at_frames() if quantity == "torque" else track.series.diameter_mm
        for estimate, truth in zip(track.estimates, truths, strict=True):
            value = getattr(estimate, f"{quantity}_{unit}")
            if value is not None and np.isfinite(truth):
                low, high = getattr(estimate, f"{quantity}_low_{unit}"), getattr(estimate, f"{quantity}_high_{unit}")
                rows.append((value, float(truth), low <= truth <= high, high - low))
    if len(rows) < 2:
        return _Comparison(len(rows))
    value, truth, inside, width = np.array(rows, dtype=np.float64).T
    error = value - truth
    changing = value.std() > 0 and truth.std() > 0
    return _Comparison(
        len(rows),
        float(np.corrcoef(value, truth)[0, 1]) if changing else None,
        float(np.sqrt((error**2).mean())),
        float(error.mean()),
        float(inside.mean()),
        float(np.median(width)),
    )


def draw_tracks(tracks: Sequence[EstimateTrack], names: Sequence[str], title: str, path: Path) -> None:
    """Write a figure with a named row per series: truth, estimates with intervals, and where none is valid."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(11, 3.2 * len(tracks)), layout="constrained")
    FigureCanvasAgg(figure)
    rows = np.ravel(figure.subplots(len(tracks), 1, squeeze=False))
    for axes, track, row_name in zip(rows, tracks, names, strict=True):
        truth, quantity = track.series.torque_at_frames(), "torque_nm"
        label, bounds = "torque in N·m", ("torque_low_nm", "torque_high_nm")
        if np.isfinite(track.series.diameter_mm).any():
            truth, quantity = track.series.diameter_mm, "diameter_mm"
            label, bounds = "diameter in mm", ("diameter_low_mm", "diameter_high_mm")
        t_s = track.series.t_s
        value, low, high = (
            np.array([getattr(one, key) if getattr(one, key) is not None else np.nan for one in track.estimates])
            for key in (quantity, *bounds)
        )
        slices = track.series.kind == "difference"
        style = "o" if slices else "-"
        axes.plot(t_s, truth, f"k{style}", linewidth=1.0, markersize=5, label="truth")
        if slices:
            axes.errorbar(t_s, value, [value - low, high - value], fmt="s", markersize=4, label="estimate, 95 %")
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        else:
            axes.fill_between(t_s, low, high, alpha=0.25, linewidth=0)
            axes.plot(t_s, value, linewidth=1.2, label="estimate, 95 %")
            axes.fill_between(
                t_s, 0, 1, where=np.isnan(value), transform=axes.get_xaxis_transform(), color="0.92", linewidth=0,
                label="no valid estimate",
            )  # fmt: skip
        axes.set_title(row_name, loc="left", fontsize="medium")
        axes.set_xlabel("slice" if slices else "time in s")
        axes.set_ylabel(label)
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0, ncols=3, frameon=False, fontsize="small")
    figure.suptitle(title)
    figure.savefig(path, dpi=110)
