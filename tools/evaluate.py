"""Evaluates a calibration on recordings: every frame in order through a session, against the truth."""

import csv
import io
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from shearloop.bank.bank_file import Bank
from shearloop.estimation import Calibration, FrameSeries
from shearloop.estimation.learned_frames import CANNOT_TELL_FRAMES, LearnedFrames
from shearloop.estimation.load_delay import load_delay_warning
from shearloop.files import replace_file
from shearloop.tools.estimate_tracks import ENDS, UNITS, EstimateTrack, estimate_in_worker
from shearloop.tools.evaluation_figure import draw_stream
from shearloop.tools.figures import Frames, judged_frames, no_better_than_clock
from shearloop.tools.frame_series import check_no_copies, part_of
from shearloop.tools.parallel import Executor
from shearloop.words import counted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# How the table begins that `write_estimates` writes.
ESTIMATES_MAGIC = b"recording,frame,"
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The tracks of parts of recordings with their paths, and facts on the calibration and the recordings.

    `title` describes the calibration, `assumptions` are the user's guarantees. `draw` draws a track. With
    `no_better_than_clock`, guesses without a sensor have smaller errors. `left_out` names unused parts of the
    recordings, `emulated` the recordings of emulated devices.
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
    """Return a calibration's estimates of these fractions (0 to 1) of recordings; raises UserError for copies."""
    start, stop = time_range
    parts = [part_of(series, start, stop) for _, series in named]
    check_no_copies([(str(path), part) for (path, _), part in zip(named, parts, strict=True)])
    if bank is not None:
        Bank.open(bank)
    shared = (calibration, None if bank is None else str(bank.resolve()))
    # Frames before the part show the idle fingertip, as live.
    estimated = pool.map(estimate_in_worker, shared, [part_of(series, 0.0, stop) for _, series in named])
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
        + [f"{name}: {warning}" for name, warning in warned if warning]
        + unknown_tools(calibration, [(path.name, part) for (path, _), part in zip(named, parts, strict=True)]),
        [
            f"{path.name}: {'; '.join(part.left_out)}"
            for (path, _), part in zip(named, parts, strict=True)
            if part.left_out
        ],
        list(dict.fromkeys(path.name for (path, _), part in zip(named, parts, strict=True) if part.emulated)),
    )


def unknown_tools(calibration: Calibration, named: Sequence[tuple[str, FrameSeries]]) -> list[str]:
    """Return a sentence for each named recording whose tool is not known, if the calibration holds for one alone."""
    if math.isnan(calibration.tool_mm):
        return []
    source, cure = " and ".join(calibration.sides), "name it with --tool-mm"
    note = calibration.tool_note(source, tool_known=False, cure=cure)
    return [f"{name}: {note}" for name, part in named if note and part.tool_mm is None]


def known_data(learned: LearnedFrames, tracks: Sequence[EstimateTrack], paths: Sequence[Path]) -> list[str]:
    """Return a sentence for each track with judged frames that the calibration has learned from.

    If the file does not know its frames, the first sentence says so.
    """
    found = [] if learned.complete else [CANNOT_TELL_FRAMES]
    for track, path in zip(tracks, paths, strict=True):
        judged = track.series.channels[judged_frames(track)]
        if known := int(learned.include(judged).sum()):
            at_least, frames = "at least " if learned.is_sample else "", counted(len(judged), "judged frame")
            found.append(
                f"the calibration has learned from {at_least}{known} of {frames} of {path}; errors on known frames are "
                "smaller than on new ones, so take other recordings"
            )
    return found


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


def why_nothing_judged(tracks: Sequence[EstimateTrack]) -> str:
    """Return why no frame has both an estimate and a known torque or diameter, with the cure."""
    frames = {quantity: [Frames.of(track, quantity) for track in tracks] for quantity in UNITS}
    estimated = [quantity for quantity, found in frames.items() if any(one.is_estimated.any() for one in found)]
    known = [quantity for quantity, found in frames.items() if any(np.isfinite(one.truth).any() for one in found)]
    if not estimated:
        cure = "give recordings, or a part of one (`--time-range`), of the fingertip and the grip that were calibrated"
        reasons = [reason.sentence for reason in invalid_reasons(tracks)]
        reasons += [track.why_no_torque for track in tracks if track.why_no_torque]
        return f"no frame has an estimate: {reasons[0] if reasons else 'there are no frames'}; {cure}"
    if not known:
        return "no frame has a known torque or diameter; give recordings with a load cell"
    found = f"there are estimates of {' and '.join(estimated)}, and known values of {' and '.join(known)}"
    cure = "give recordings with a load cell, of the grip that was calibrated"
    return f"no frame has both an estimate and a known torque or diameter: {found}; {cure}"


def _joined(reasons: Sequence[str]) -> str:
    return "; ".join(reasons)


def write_estimates(tracks: Sequence[EstimateTrack], names: Sequence[str], path: Path) -> None:
    """Write a CSV row for every frame of each named series; cells without a truth or an estimate are empty.

    A valid frame without a torque has a reason too.
    """
    values = [f"{quantity}{end}_{unit}" for quantity, unit in UNITS.items() for end in ENDS]
    with replace_file(path) as binary, io.TextIOWrapper(binary, newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["recording", "frame", "t_s", "truth_nm", *values, "valid", "reason"])
        for track, name in zip(tracks, names, strict=True):
            series = track.series
            truths = [None if math.isnan(truth) else truth for truth in series.torque_at_frames().tolist()]
            frames = enumerate(zip(series.t_s.tolist(), truths, track.estimates, strict=True), series.first_frame)
            for number, (t_s, truth, estimate) in frames:
                cells = [getattr(estimate, column) for column in values]
                reason = _joined(estimate.reasons)
                if estimate.valid and estimate.torque_nm is None:
                    reason = track.why_no_torque
                table.writerow([name, number, t_s, truth, *cells, estimate.valid, reason])
