"""Evaluates a calibration on recordings: every frame in order through a session, against the truth."""

import csv
import io
import math
import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.estimation import Calibration, Estimate, FrameSeries, Session
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.learned_frames import CANNOT_TELL_FRAMES, LearnedFrames
from shearloop.estimation.load_delay import load_delay_warning
from shearloop.estimation.values import winkler_scores
from shearloop.files import replace_file
from shearloop.tools.frame_series import check_no_copies, part_of
from shearloop.tools.parallel import Executor
from shearloop.words import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Figures: TypeAlias = dict[str, float | int | None]
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
_UNITS = {"torque": "nm", "diameter": "mm"}
# Of the names of an estimate and of the ends of its interval.
_ENDS = ("", "_low", "_high")


@dataclass(frozen=True, slots=True, eq=False)
class EstimateTrack:
    """One series with an estimate per frame, and the time that each took."""

    series: FrameSeries
    estimates: tuple[Estimate, ...]
    latency_ms: FloatArray
    # The torque (n,) by the calibration's mean twist at the same phase, without a sensor.
    profile_nm: FloatArray | None = None
    # Why the held tool leaves no torque, though frames may have a diameter and be valid; empty where it does not.
    why_no_torque: str = ""

    def since(self, first_frame: int) -> "EstimateTrack":
        """Return the part from a frame of the recording on."""
        return self.between(first_frame - self.series.first_frame, len(self.estimates))

    def between(self, first: int, stop: int) -> "EstimateTrack":
        """Return rows `first` to `stop`."""
        profile_nm = None if self.profile_nm is None else self.profile_nm[first:stop]
        return replace(
            self,
            series=self.series.between(first, stop),
            estimates=self.estimates[first:stop],
            latency_ms=self.latency_ms[first:stop],
            profile_nm=profile_nm,
        )

    @property
    def without_torque(self) -> int:
        """The number of valid frames whose torque the held tool leaves out."""
        return sum(one.valid and one.torque_nm is None for one in self.estimates) if self.why_no_torque else 0


def estimate_series(calibration: Calibration, series: FrameSeries, bank: Bank | None = None) -> EstimateTrack:
    """Estimate every frame of a series in order, as live; raises CalibrationError for a series of other sides."""
    chosen = series.select_sides(calibration.sides)
    session = Session(calibration, bank)
    session.set_tool(chosen.tool_mm)
    estimates, latency = [], []
    for frame in chosen.frames():
        begun = time.perf_counter()
        estimates.append(session.estimate(frame))
        latency.append(1e3 * (time.perf_counter() - begun))
    profile_nm = None if calibration.profile is None else calibration.profile.predict(chosen)
    return EstimateTrack(chosen, tuple(estimates), np.array(latency), profile_nm, session.why_no_torque)


def estimate_in_worker(shared: tuple[Calibration, str | None], series: FrameSeries) -> EstimateTrack:
    """Return `estimate_series` for a calibration and the bank's path, which the worker opens."""
    calibration, path = shared
    return estimate_series(calibration, series, None if path is None else Bank.open(path))


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The tracks of parts of recordings, the path of each, and what to know of the calibration and the recordings.

    `title` describes the calibration, `assumptions` what the user guarantees. `draw` draws a track. With
    `no_better_than_clock` guesses without a sensor err less. `left_out` is what of the recordings was not used;
    `emulated` names those of emulated devices.
    """

    tracks: Sequence[EstimateTrack]
    paths: Sequence[Path]
    title: str
    assumptions: str
    draw: "Callable[[Axes, EstimateTrack, str], None]"
    no_better_than_clock: Callable[[Sequence[EstimateTrack], float], str]
    doubts: Sequence[str] = ()
    left_out: Sequence[str] = ()
    emulated: Sequence[str] = ()


def evaluate_recordings(
    calibration: Calibration, named: Sequence[tuple[Path, FrameSeries]], bank: Path | None,
    time_range: tuple[float, float], pool: Executor,
) -> Evaluation:  # fmt: skip
    """Return a calibration's estimates of these shares (0 to 1) of recordings; raises UserError for copies."""
    start, stop = time_range
    parts = [part_of(one, start, stop) for _, one in named]
    check_no_copies([(str(path), part) for (path, _), part in zip(named, parts, strict=True)])
    if bank is not None:
        Bank.open(bank)
    shared = (calibration, None if bank is None else str(bank.resolve()))
    # Frames before the part show the idle fingertip, as live.
    estimated = pool.map(estimate_in_worker, shared, [part_of(one, 0.0, stop) for _, one in named])
    tracks = [track.since(part.first_frame) for track, part in zip(estimated, parts, strict=True)]
    warned = [(path.name, load_delay_warning(part)) for (path, _), part in zip(named, parts, strict=True)]
    return Evaluation(
        tracks,
        [path for path, _ in named],
        f"{calibration.estimator.name}, fitted to {calibration.source}",
        calibration.assumption_text,
        draw_stream,
        no_better_than_clock,
        known_data(calibration.learned, tracks, [path for path, _ in named])
        + [f"{name}: {warning}" for name, warning in warned if warning],
        [
            f"{path.name}: {'; '.join(one.left_out)}"
            for (path, _), one in zip(named, parts, strict=True)
            if one.left_out
        ],
        list(dict.fromkeys(path.name for (path, _), one in zip(named, parts, strict=True) if one.emulated)),
    )


def known_data(learned: LearnedFrames, tracks: Sequence[EstimateTrack], paths: Sequence[Path]) -> list[str]:
    """Return a sentence for each track with judged frames that the calibration has learned from.

    The first one says so where its file does not tell them.
    """
    found = [] if learned.complete else [CANNOT_TELL_FRAMES]
    for track, path in zip(tracks, paths, strict=True):
        judged = track.series.channels[judged_frames(track)]
        if known := int(learned.include(judged).sum()):
            at_least, frames = "at least " if learned.is_sample else "", counted(len(judged), "judged frame")
            found.append(
                f"the calibration has learned from {at_least}{known} of {frames} of {path}; errors on known frames are "
                "smaller than on new ones, so judge it on others"
            )
    return found


def judged_frames(track: EstimateTrack) -> BoolArray:
    """Return which of the frames (n,) have an estimate and a known torque or diameter."""
    judged: BoolArray = np.zeros(len(track.estimates), dtype=np.bool_)
    for quantity in _UNITS:
        truth, value, *_ = frames_of(track, quantity)
        judged |= np.isfinite(truth) & np.isfinite(value)
    return judged


def figures_of(tracks: Sequence[EstimateTrack]) -> Figures:
    """Return the figures of all frames, by the names that `shearloop evaluate` prints.

    Only valid frames with a known truth are judged; with fewer than two of them, errors are None. interval_nm is the
    median width of the intervals. winkler_nm is their mean score. baseline_zero_rmse_nm is the error of always 0. Known
    diameters add diameter_rmse_mm, diameter_coverage_95 and diameter_interval_mm. Without a torque, coverage_95 is of
    the diameter.
    """
    torque, diameter = (_compare(_known_frames(tracks, quantity), unit) for quantity, unit in _UNITS.items())
    valid = [estimate.valid for track in tracks for estimate in track.estimates]
    latency = np.concatenate([track.latency_ms for track in tracks])
    figures = {name: value for name, value in torque.items() if name not in ("n", "gain")} | {
        "valid_fraction": float(np.mean(valid)) if valid else None,
        "latency_ms_p50": float(np.quantile(latency, 0.5)) if len(latency) else None,
        "latency_ms_p99": float(np.quantile(latency, 0.99)) if len(latency) else None,
        "frames": len(valid),
    }
    if not torque["valid_fraction"]:
        figures["coverage_95"] = diameter["coverage_95"]
    if any(np.isfinite(track.series.diameter_mm).any() for track in tracks):
        figures |= {f"diameter_{name}": diameter[name] for name in ("rmse_mm", "coverage_95", "interval_mm")}
    return figures


def figures_by_load(tracks: Sequence[EstimateTrack], loaded_nm: float = LOADED_NM) -> dict[str, Figures]:
    """Return the torque's figures of `loaded` frames, with a torque of loaded_nm or more in size, and of the others.

    n frames have a known truth, and valid_fraction of them an estimate. Only these are judged. gain is the mean
    estimate over the mean truth, both along the truth. baseline_zero_rmse_nm and, for loaded frames,
    baseline_profile_rmse_nm are errors without a sensor, and baseline_ratio is the estimate's over the smaller one.
    """
    frames = _known_frames(tracks, "torque")
    is_loaded = np.abs(frames[0]) >= loaded_nm
    found = {"loaded": _compare(frames[:, is_loaded], "nm"), "unloaded": _compare(frames[:, ~is_loaded], "nm")}
    for figures in found.values():
        del figures["r"]
    found["loaded"] |= _baselines(frames[:, is_loaded])
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
        return f"This fingertip ({sides[0]}) does not beat the stopwatch: use both."
    return "The sensor does not beat the stopwatch: grip harder, or record twists that differ."


@dataclass(frozen=True, slots=True)
class InvalidReason:
    """Why `frames` were not valid: all reasons of the most frequent such frame, an example if numbers `differ`."""

    frames: int
    sentence: str
    differ: bool


def invalid_reasons(tracks: Sequence[EstimateTrack]) -> list[InvalidReason]:
    """Return why frames were not valid, the most frequent first; sentences that differ in numbers count as one.

    A frame counts once, with all of its reasons.
    """
    kinds: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for estimate in (estimate for track in tracks for estimate in track.estimates):
        if estimate.reasons:
            sentence = _joined(estimate.reasons)
            kinds[_NUMBER.sub("#", sentence)][sentence] += 1
    found = [InvalidReason(counts.total(), counts.most_common(1)[0][0], len(counts) > 1) for counts in kinds.values()]
    return sorted(found, key=lambda reason: -reason.frames)


def _joined(reasons: Sequence[str]) -> str:
    return "; ".join(reasons)


def _baselines(frames: FloatArray) -> Figures:
    """Return `baseline_profile_rmse_nm` and `baseline_ratio` of frames (5, n), None for fewer than two estimates."""
    truth, value, _, _, profile = frames[:, np.isfinite(frames[1])]
    if len(truth) < 2:
        return dict.fromkeys(("baseline_profile_rmse_nm", "baseline_ratio"))
    known = bool(np.isfinite(profile).all())
    zero_nm, profile_nm, own_nm = (float(np.sqrt(((one - truth) ** 2).mean())) for one in (0.0, profile, value))
    least_nm = min(zero_nm, profile_nm) if known else zero_nm
    return {
        "baseline_profile_rmse_nm": profile_nm if known else None,
        "baseline_ratio": own_nm / least_nm if least_nm else None,
    }


def values_of(estimates: Sequence[Estimate], quantity: str = "torque") -> FloatArray:
    """Return estimate and the interval's ends (3, n) in N·m or mm, NaN without an estimate."""
    names = [f"{quantity}{end}_{_UNITS[quantity]}" for end in _ENDS]
    # None becomes NaN.
    return np.array([[getattr(estimate, name) for estimate in estimates] for name in names], dtype=np.float64)


def frames_of(track: EstimateTrack, quantity: str) -> FloatArray:
    """Return truth, estimate, the interval's ends and the profile (5, n) of all frames, NaN for unknown ones."""
    truth = track.series.torque_at_frames() if quantity == "torque" else track.series.diameter_mm
    profile = track.profile_nm if quantity == "torque" and track.profile_nm is not None else np.full(len(truth), np.nan)
    return np.array([truth, *values_of(track.estimates, quantity), profile])


def _known_frames(tracks: Sequence[EstimateTrack], quantity: str) -> FloatArray:
    """Return truth, estimate, the interval's ends and the profile (5, n) of the frames with a known truth."""
    frames = np.concatenate([frames_of(track, quantity) for track in tracks], axis=1)
    return frames[:, np.isfinite(frames[0])]


def _compare(frames: FloatArray, unit: str) -> Figures:
    """Return the figures of a quantity's frames (5, n), None where fewer than two of them are estimated."""
    truth, value, low, high, _ = frames[:, np.isfinite(frames[1])]
    n = frames.shape[1]
    counts: Figures = {"n": n, "valid_fraction": len(truth) / n if n else None}
    if len(truth) < 2:
        errors = (f"{name}_{unit}" for name in ("rmse", "baseline_zero_rmse", "bias", "interval", "winkler"))
        return counts | dict.fromkeys(("r", "gain", "coverage_95", *errors))
    error, size = value - truth, float(np.abs(truth).sum())
    changing = value.std() > 0 and truth.std() > 0
    return {
        "r": float(np.corrcoef(value, truth)[0, 1]) if changing else None,
        "gain": float((value * np.sign(truth)).sum()) / size if size else None,
        f"rmse_{unit}": float(np.sqrt((error**2).mean())),
        f"baseline_zero_rmse_{unit}": float(np.sqrt((truth**2).mean())),
        f"bias_{unit}": float(error.mean()),
        "coverage_95": float(((low <= truth) & (truth <= high)).mean()),
        f"interval_{unit}": float(np.median(high - low)),
        f"winkler_{unit}": float(winkler_scores(truth, low, high).mean()),
        **counts,
    }


def write_estimates(tracks: Sequence[EstimateTrack], names: Sequence[str], path: Path) -> None:
    """Write a CSV row for every frame of each named series; cells without a truth or an estimate are empty.

    The reason is also that of a valid frame without a torque.
    """
    values = [f"{quantity}{end}_{unit}" for quantity, unit in _UNITS.items() for end in _ENDS]
    with replace_file(path) as binary, io.TextIOWrapper(binary, newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["recording", "frame", "t_s", "truth_nm", *values, "valid", "reason"])
        for track, name in zip(tracks, names, strict=True):
            series = track.series
            truths = [None if math.isnan(one) else one for one in series.torque_at_frames().tolist()]
            frames = enumerate(zip(series.t_s.tolist(), truths, track.estimates, strict=True), series.first_frame)
            for number, (t_s, truth, estimate) in frames:
                cells = [getattr(estimate, one) for one in values]
                reason = _joined(estimate.reasons)
                if estimate.valid and estimate.torque_nm is None:
                    reason = track.why_no_torque
                table.writerow([name, number, t_s, truth, *cells, estimate.valid, reason])


def draw_tracks(
    tracks: Sequence[EstimateTrack],
    names: Sequence[str],
    title: str,
    path: Path,
    draw: "Callable[[Axes, EstimateTrack, str], None]",
) -> None:
    """Write a figure with a named row per series, which `draw` draws."""
    from shearloop.tools.drawing import figure

    made = figure(11, 3.2 * len(tracks))
    rows = np.ravel(made.subplots(len(tracks), 1, squeeze=False))
    for axes, track, row_name in zip(rows, tracks, names, strict=True):
        draw(axes, track, row_name)
    labelled = {label: handle for axes in rows for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    made.legend(labelled.values(), labelled, loc="outside lower left", ncols=3, frameon=False, fontsize="small")
    made.suptitle(title)
    made.savefig(path, dpi=110)


def draw_stream(axes: "Axes", track: EstimateTrack, name: str) -> None:
    """Draw truth and estimates of a stream over time, with intervals, and where none is valid."""
    truth, value, low, high, _ = frames_of(track, "torque")
    t_s = track.series.t_s
    axes.plot(t_s, truth, "k-", linewidth=1.0, markersize=5, label="load cell")
    _draw_intervals(axes, t_s, value, low, high)
    emulated = "EMULATED: " if track.series.emulated else ""
    axes.set_title(emulated + name + loaded_text(track), loc="left", fontsize="medium")
    axes.set_xlabel("time in s")
    axes.set_ylabel("torque in N·m")


def _draw_intervals(axes: "Axes", t_s: FloatArray, value: FloatArray, low: FloatArray, high: FloatArray) -> None:
    """Draw a stream's estimates and intervals, hatched where a load cell is not pushed."""
    axes.plot(t_s, value, linewidth=1.2, label="estimate")
    axes.fill_between(t_s, low, high, alpha=0.25, linewidth=0, label="95 % interval of the estimate")
    axes.fill_between(
        t_s, 0, 1, where=np.isnan(value), transform=axes.get_xaxis_transform(), color="0.92", linewidth=0,
        label="no valid estimate",
    )  # fmt: skip
    hanging = (value == 0) & ~np.isclose(low, -high)
    if hanging.any():
        label = "no load on a load cell that is pushed from one side: the tool may be twisted this far the other way"
        axes.fill_between(
            t_s, low, high, where=hanging, facecolor="none", edgecolor="0.6", hatch="///", linewidth=0, label=label
        )


def loaded_text(track: EstimateTrack) -> str:
    """Return the errors of a track's loaded frames as the end of a title, empty without any."""
    loaded = figures_by_load([track])["loaded"]
    error, zero = loaded["rmse_nm"], loaded["baseline_zero_rmse_nm"]
    if error is None or zero is None:
        return ""
    return f"; {loaded['n']} loaded frames: RMSE {error:.2g} N·m (always saying 0: {zero:.2g})"
