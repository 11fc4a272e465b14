"""How good a calibration is on recordings: every frame in order through the tracker, against the truth."""

import re
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.estimation import Calibration, Estimate, EstimatorSession, FrameSeries, TactileFrame

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


@dataclass(frozen=True, slots=True, eq=False)
class EstimateTrack:
    """One series with its estimates, one for each frame, and how long each took."""

    series: FrameSeries
    estimates: tuple[Estimate, ...]
    latency_ms: FloatArray


def follow(calibration: Calibration, series: FrameSeries, bank: Bank | None = None) -> EstimateTrack:
    """Estimate every frame of a series in order, as live; raises CalibrationError for a series of other sides."""
    chosen = series.of_sides(calibration.sides)
    tracker = EstimatorSession(calibration, bank)
    tracker.hold(chosen.tool_mm)
    estimates, latency = [], []
    for t_s, channels in zip(chosen.t_s, chosen.channels, strict=True):
        begun = time.perf_counter()
        estimates.append(tracker.estimate(TactileFrame.of(float(t_s), channels)))
        latency.append(1e3 * (time.perf_counter() - begun))
    return EstimateTrack(chosen, tuple(estimates), np.array(latency))


def followed(shared: tuple[Calibration, str | None], series: FrameSeries) -> EstimateTrack:
    """Return `follow` of a calibration and the bank's path: a task for a worker, which has to reach the file."""
    calibration, path = shared
    return follow(calibration, series, None if path is None else Bank.open(path))


def judge(tracks: Sequence[EstimateTrack]) -> dict[str, float | int | None]:
    """Return the figures of `shearloop evaluate`, by the names that it prints.

    Torque is judged on valid frames with a known truth; a figure is None where there are too few of them. interval_nm
    is the median width of their intervals, from end to end: wide enough ones hold every truth and tell nothing. Where
    diameters are known, diameter_rmse_mm, diameter_coverage_95 and diameter_interval_mm are given, and coverage_95 is
    theirs if there is no torque to judge.
    """
    torque = _compared(tracks, "torque")
    diameter = _compared(tracks, "diameter")
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
class Reason:
    """Why `frames` were not valid: the sentence that was said most often, or, where they `differ`, first of them."""

    frames: int
    sentence: str
    differ: bool


def reasons(tracks: Sequence[EstimateTrack]) -> list[Reason]:
    """Return why frames were not valid, what differs in its numbers alone together; the most frequent come first."""
    kinds: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for why in (why for track in tracks for estimate in track.estimates for why in estimate.why):
        kinds[_NUMBER.sub("#", why)][why] += 1
    found = [Reason(said.total(), said.most_common(1)[0][0], len(said) > 1) for said in kinds.values()]
    return sorted(found, key=lambda reason: -reason.frames)


@dataclass(frozen=True, slots=True)
class _Compared:
    n: int
    r: float | None
    rmse: float | None
    bias: float | None
    coverage: float | None
    width: float | None


def _compared(tracks: Sequence[EstimateTrack], quantity: str) -> _Compared:
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
        return _Compared(len(rows), None, None, None, None, None)
    value, truth, inside, width = np.array(rows, dtype=np.float64).T
    error = value - truth
    changing = value.std() > 0 and truth.std() > 0
    return _Compared(
        len(rows),
        float(np.corrcoef(value, truth)[0, 1]) if changing else None,
        float(np.sqrt((error**2).mean())),
        float(error.mean()),
        float(inside.mean()),
        float(np.median(width)),
    )
