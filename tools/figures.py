"""Computes figures of estimates against the truth: errors, intervals, and the errors of guesses without a sensor."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self, TypeAlias

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.errors import UserError
from shearloop.estimation.defaults import LOADED_NM
from shearloop.tools.estimate_tracks import UNITS, EstimateTrack, values_of

Figures: TypeAlias = dict[str, float | int | None]


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Truth, estimate, the ends of its interval, and the profile of n frames (n,), in N·m or mm; NaN for unknown ones.

    `profile` is the torque by the calibration's mean twist at the same phase, without a sensor.
    """

    truth: FloatArray
    value: FloatArray
    low: FloatArray
    high: FloatArray
    profile: FloatArray

    @classmethod
    def of(cls, track: EstimateTrack, quantity: str) -> Self:
        """Return all frames of a track."""
        truth = track.series.torque_at_frames() if quantity == "torque" else track.series.diameter_mm
        profile = np.full(len(truth), np.nan)
        if quantity == "torque" and track.profile_nm is not None:
            profile = track.profile_nm
        value, low, high = values_of(track.estimates, quantity)
        return cls(truth, value, low, high, profile)

    @property
    def is_estimated(self) -> BoolArray:
        """Which of them have an estimate."""
        return np.isfinite(self.value)

    def where(self, chosen: BoolArray) -> Self:
        """Return some of them."""
        return type(self)(*(getattr(self, column.name)[chosen] for column in fields(self)))

    def with_more(self, others: Sequence[Self]) -> Self:
        """Return these frames and others after them."""
        columns = ([getattr(frames, column.name) for frames in (self, *others)] for column in fields(self))
        return type(self)(*map(np.concatenate, columns))


def judged_frames(track: EstimateTrack) -> BoolArray:
    """Return which of the frames (n,) have an estimate and a known torque or diameter."""
    judged: BoolArray = np.zeros(len(track.estimates), dtype=np.bool_)
    for quantity in UNITS:
        frames = Frames.of(track, quantity)
        judged |= np.isfinite(frames.truth) & frames.is_estimated
    return judged


def figures_of(tracks: EstimateTrack | Sequence[EstimateTrack]) -> Figures:
    """Return the figures of all frames, by the names that `shearloop evaluate` prints.

    Only valid frames with a known truth are judged; with fewer than two of them, errors are None. valid_fraction is
    the fraction of the frames with a known torque that have an estimated one; without a known torque, it is the
    diameter's. interval_nm is the median width of the intervals. winkler_nm is their mean score. baseline_zero_rmse_nm
    is the error of an estimate that is always 0. Known diameters add diameter_rmse_mm, diameter_coverage_95 and
    diameter_interval_mm. Without an estimated torque, coverage_95 is the diameter's.
    """
    tracks = _several(tracks)
    torque, diameter = (_compare(_known_frames(tracks, quantity), unit) for quantity, unit in UNITS.items())
    judged = torque if torque["n"] else diameter
    latency = np.concatenate([track.latency_ms for track in tracks])
    figures = {name: value for name, value in torque.items() if name not in ("n", "gain")} | {
        "valid_fraction": judged["valid_fraction"],
        "latency_ms_p50": float(np.quantile(latency, 0.5)) if len(latency) else None,
        "latency_ms_p99": float(np.quantile(latency, 0.99)) if len(latency) else None,
        "frames": sum(len(track.estimates) for track in tracks),
    }
    if not torque["valid_fraction"]:
        figures["coverage_95"] = diameter["coverage_95"]
    if any(np.isfinite(track.series.diameter_mm).any() for track in tracks):
        figures |= {f"diameter_{name}": diameter[name] for name in ("rmse_mm", "coverage_95", "interval_mm")}
    return figures


def figures_by_load(
    tracks: EstimateTrack | Sequence[EstimateTrack], loaded_nm: float = LOADED_NM
) -> dict[str, Figures]:
    """Return the torque's figures of `loaded` frames, with a torque of loaded_nm or more in size, and of the others.

    n frames have a known truth, and valid_fraction of them an estimate. Only these are judged. gain is the mean
    estimate over the mean truth, both along the truth. baseline_zero_rmse_nm and, for loaded frames,
    baseline_profile_rmse_nm are errors without a sensor, and baseline_ratio is the estimate's over the smaller one.
    Raises UserError without a track.
    """
    frames = _known_frames(_several(tracks), "torque")
    is_loaded = np.abs(frames.truth) >= loaded_nm
    loaded = frames.where(is_loaded)
    found = {"loaded": _compare(loaded, "nm"), "unloaded": _compare(frames.where(~is_loaded), "nm")}
    for figures in found.values():
        del figures["r"]
    found["loaded"] |= _baselines(loaded)
    del found["unloaded"]["gain"]
    return found


def beats_clock(tracks: Sequence[EstimateTrack], loaded_nm: float = LOADED_NM) -> bool:
    """Return whether the estimate errs less than guesses without a sensor, or has no loaded frame."""
    ratio = figures_by_load(tracks, loaded_nm)["loaded"]["baseline_ratio"]
    return ratio is None or ratio < 1.0


def no_better_than_clock(tracks: Sequence[EstimateTrack], loaded_nm: float = LOADED_NM) -> str:
    """Return a sentence against an estimate that errs as much as a guess without a sensor, empty for a better one."""
    if beats_clock(tracks, loaded_nm):
        return ""
    sides = tracks[0].series.sides
    if len(sides) == 1:
        return (
            f"This fingertip ({sides[0]}) alone does not beat the stopwatch: record and use both, grip harder, or "
            "record twists that differ."
        )
    return "The sensor does not beat the stopwatch: grip harder, or record twists that differ."


def _baselines(frames: Frames) -> Figures:
    """Return `baseline_profile_rmse_nm` and `baseline_ratio` of frames, None for fewer than two estimates."""
    estimated = frames.where(frames.is_estimated)
    if not _enough(estimated):
        return dict.fromkeys(("baseline_profile_rmse_nm", "baseline_ratio"))
    known = bool(np.isfinite(estimated.profile).all())
    zero_nm, profile_nm, own_nm = (
        _rmse(guess - estimated.truth) for guess in (0.0, estimated.profile, estimated.value)
    )
    least_nm = min(zero_nm, profile_nm) if known else zero_nm
    return {
        "baseline_profile_rmse_nm": profile_nm if known else None,
        "baseline_ratio": own_nm / least_nm if least_nm else None,
    }


def _several(tracks: EstimateTrack | Sequence[EstimateTrack]) -> Sequence[EstimateTrack]:
    """Return one track or several as a list; raises UserError where there is none."""
    if isinstance(tracks, EstimateTrack):
        return [tracks]
    if not tracks:
        raise UserError("there is no track to judge; `estimate_series` makes one of a recording's frames")
    return tracks


def _known_frames(tracks: Sequence[EstimateTrack], quantity: str) -> Frames:
    """Return the frames with a known truth."""
    first, *others = (Frames.of(track, quantity) for track in tracks)
    frames = first.with_more(others)
    return frames.where(np.isfinite(frames.truth))


def _compare(frames: Frames, unit: str) -> Figures:
    """Return the figures of a quantity's frames, None where fewer than two of them are estimated."""
    estimated = frames.where(frames.is_estimated)
    truth, value, low, high = estimated.truth, estimated.value, estimated.low, estimated.high
    n = len(frames.truth)
    counts: Figures = {"n": n, "valid_fraction": len(truth) / n if n else None}
    if not _enough(estimated):
        errors = (f"{name}_{unit}" for name in ("rmse", "baseline_zero_rmse", "bias", "interval", "winkler"))
        return counts | dict.fromkeys(("r", "gain", "coverage_95", *errors))
    size = float(np.abs(truth).sum())
    changing = value.std() > 0 and truth.std() > 0
    return {
        "r": float(np.corrcoef(value, truth)[0, 1]) if changing else None,
        "gain": float((value * np.sign(truth)).sum()) / size if size else None,
        f"rmse_{unit}": _rmse(value - truth),
        f"baseline_zero_rmse_{unit}": _rmse(truth),
        f"bias_{unit}": float((value - truth).mean()),
        "coverage_95": float(((low <= truth) & (truth <= high)).mean()),
        f"interval_{unit}": float(np.median(high - low)),
        f"winkler_{unit}": float(winkler_scores(truth, low, high).mean()),
        **counts,
    }


def winkler_scores(truth: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the scores of (n,) 95 % intervals: their widths and 40 times the distance of a truth outside.

    Less is better (Winkler 1972; Gneiting and Raftery 2007, equation 43).
    """
    outside = np.maximum(low - truth, 0.0) + np.maximum(truth - high, 0.0)
    return high - low + 2 / (1 - 0.95) * outside


def _enough(frames: Frames) -> bool:
    """Return whether there are frames enough for figures."""
    return len(frames.truth) >= 2


def _rmse(error: FloatArray) -> float:
    return float(np.sqrt((error**2).mean()))
