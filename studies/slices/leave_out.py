"""Judges a recipe for a calibration of slices with each level of torque left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import BoolArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.mesh import load_mesh
from shearloop.errors import UserError
from shearloop.estimation import Physics
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.evaluate import estimate_slices, no_better_than_place
from shearloop.studies.slices.fitting import fit_slices
from shearloop.studies.slices.levels import NEAR_LEVEL, later_levels
from shearloop.studies.slices.profile import SliceProfile
from shearloop.studies.slices.series import SliceSeries, torques_of
from shearloop.tools.estimate_tracks import EstimateTrack
from shearloop.tools.figures import figures_by_load
from shearloop.tools.leave_out import Judged, Plan, advice_of_coverage, fit_without, without_estimate
from shearloop.tools.left_out_blocks import Block, Span, kept
from shearloop.words import counted

LEVELS = "levels"
MEAN_OF_PLACE = "the mean of the place in the sequence"


@dataclass(frozen=True, slots=True)
class SliceRecipe:
    """How a calibration of slices is made: estimator, files of bank and mesh, and whether larger torques can occur."""

    estimator: EstimatorName
    bank: Path | None = None
    mesh: Path | None = None
    full_range: bool = False

    def fit(self, recordings: Sequence[SliceSeries]) -> SliceCalibration:
        """Return the calibration of slices; raises CalibrationError as `fit_slices` does."""
        physics = Physics(bank=self.open_bank(), mesh=load_mesh(self.mesh) if self.mesh else None)
        return fit_slices(self.estimator, recordings, "left out", physics, full_range=self.full_range)

    def open_bank(self) -> Bank | None:
        """Return the bank, None without one."""
        return Bank.open(self.bank) if self.bank else None

    def judge(self, recordings: Sequence[SliceSeries], block: Block) -> Judged:
        """Return the tracks of a block's spans by a calibration on the other rows; CalibrationError names it."""
        calibration = fit_without(self.fit, recordings, block)
        profile = SliceProfile.fit(kept(recordings, block.timed))
        bank, tracks = self.open_bank(), dict[int, EstimateTrack]()
        for number in sorted({span.recording for span in block.judged}):
            track = estimate_slices(calibration, recordings[number], bank)
            profile_nm = None if profile is None else profile.predict(recordings[number])
            tracks[number] = replace(track, profile_nm=profile_nm)
        return Judged(tuple(tracks[span.recording].between(span.first, span.stop) for span in block.judged))


def plan_levels(kind: str, recipe: SliceRecipe, recordings: Sequence[SliceSeries]) -> Plan:
    """Return the plan of levels left out; raises UserError for another kind, and for slices without two levels."""
    if kind != LEVELS:
        raise UserError(f"slices show no {kind}; use --leave-out {LEVELS}")
    blocks = find_levels(recordings)
    return Plan(LEVELS, recipe, tuple(recordings), blocks, _advice, MEAN_OF_PLACE)


def find_levels(recordings: Sequence[SliceSeries]) -> list[Block]:
    """Return a block for each level of later slices: fitted to earlier slices of other levels.

    The stopwatch knows the earlier slices of all levels: it reads the place in the sequence, and no sensor.
    """
    torque = np.concatenate([torques_of(recording) for recording in recordings])
    places = [(number, row) for number, recording in enumerate(recordings) for row in range(len(recording.t_s))]
    known = np.flatnonzero(np.isfinite(torque))
    parts = later_levels(torque[known]) if len(known) else []
    if not parts:
        raise UserError(f"{counted(len(known), 'slice')} with a torque cannot be split; record 20 or more")
    blocks: list[Block] = []
    near_nm = NEAR_LEVEL * float(np.ptp(torque[known]))
    for rest, later in parts:
        own = torque[known[later]]
        if np.abs(torque[known[rest], None] - own).min() <= near_nm:
            raise UserError("too few slices remain without those of one level; record ten levels, three times or more")
        level = f"slices of {1e3 * float(own.mean()):.3g} mN·m after the first {int(rest[-1]) + 1}"
        earlier = known[: int(rest[-1]) + 1]
        fitted = _rows_of(recordings, np.isin(np.arange(len(torque)), known[rest]))
        timed = _rows_of(recordings, np.isin(np.arange(len(torque)), earlier))
        spans = tuple(Span(number, row, row + 1) for number, row in (places[index] for index in known[later].tolist()))
        blocks.append(Block(level, fitted, spans, timed))
    return blocks


def _rows_of(recordings: Sequence[SliceSeries], rows: BoolArray) -> tuple[BoolArray, ...]:
    """Return rows of all recordings together as rows (n,) of each."""
    ends = np.cumsum([len(recording.t_s) for recording in recordings])
    return tuple(np.split(rows, ends[:-1]))


def _advice(tracks: Sequence[Sequence[EstimateTrack]]) -> str:
    """Return one sentence: what to do first for a better calibration."""
    judged = [track for block_tracks in tracks for track in block_tracks]
    if figures_by_load(judged)["loaded"]["baseline_ratio"] is None:
        return without_estimate(judged)
    return no_better_than_place(judged) or advice_of_coverage(judged, LEVELS)
