"""Judges a recipe for a calibration by leave-one-out: each grip, twist, tool or level of torque in turn.

A recipe is fitted to the rest, and judged on the block that it has not seen. Neither frames nor torques of a block
take part in its fit. Only the load cell's timing is measured on everything: it belongs to the load cell.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias, get_args

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import CalibrationError
from shearloop.bank.mesh import load_mesh
from shearloop.errors import UserError
from shearloop.estimation import Calibration, FrameSeries, LoadTiming, Physics, fit
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.estimation.fingertip_validator import segment_grip
from shearloop.estimation.gain import find_twists
from shearloop.estimation.left_out import NEAR_LEVEL, later_levels
from shearloop.estimation.torque_profile import TorqueProfile
from shearloop.estimation.values import Measured, distinct
from shearloop.tools.evaluate import EstimateTrack, estimate_series, figures_by_load, figures_of, no_better_than_clock
from shearloop.tools.parallel import Executor
from shearloop.words import counted

Kind: TypeAlias = Literal["grips", "twists", "levels", "tools"]
KINDS: tuple[Kind, ...] = get_args(Kind)
# Recordings, and so grips, that show how the gain changes from one to the next.
_ENOUGH_GRIPS = 3
# A tool that is left out needs three others, which determine the gain over the diameter.
_ENOUGH_TOOLS = 4
# Below this coverage of the 95 % intervals, the advice is more data.
_LEAST_COVERAGE = 0.9


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a calibration is made: estimator, files of bank and mesh, and the known facts of torques and their times.

    With `nested` each fit chooses its settings too, which else are those of `shearloop calibrate`.
    """

    estimator: EstimatorName
    bank: Path | None = None
    mesh: Path | None = None
    timing_uncertainty_s: float = 0.0
    full_range: bool = False
    nested: bool = False

    def fit(self, recordings: Sequence[FrameSeries]) -> Calibration:
        """Return the calibration of recordings; raises CalibrationError as `fit` does."""
        physics = Physics(bank=self.open_bank(), mesh=load_mesh(self.mesh) if self.mesh else None)
        timing = LoadTiming(uncertainty_s=self.timing_uncertainty_s)
        return fit(
            self.estimator, recordings, "left out", physics,
            timing=timing, full_range=self.full_range, nested=self.nested,
        )  # fmt: skip

    def open_bank(self) -> Bank | None:
        """Return the bank, None without one."""
        return Bank.open(self.bank) if self.bank else None


@dataclass(frozen=True, slots=True)
class Span:
    """Rows `first` to `stop` of the recording with this number."""

    recording: int
    first: int
    stop: int


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One block left out: its name, the rows (n,) of each recording that are fitted, and the judged spans.

    `timed` are the rows that the stopwatch knows, where these are others.
    """

    name: str
    fitted: tuple[BoolArray, ...]
    judged: tuple[Span, ...]
    timed: tuple[BoolArray, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """The names of the blocks, the tracks of each, and a sentence of advice."""

    kind: Kind
    names: tuple[str, ...]
    tracks: tuple[tuple[EstimateTrack, ...], ...]
    advice: str

    @property
    def all_tracks(self) -> list[EstimateTrack]:
        """The tracks of all blocks."""
        return [one for tracks in self.tracks for one in tracks]

    def figures(self, loaded_nm: float = LOADED_NM) -> dict[str, object]:
        """Return the figures by the names of `shearloop evaluate`, and the figures of each block's loaded frames."""
        blocks = [
            {"name": name, **figures_by_load(tracks, loaded_nm)["loaded"]}
            for name, tracks in zip(self.names, self.tracks, strict=True)
        ]
        tracks = self.all_tracks
        named = {"left_out": self.kind, "blocks": blocks, "advice": self.advice}
        return {**figures_by_load(tracks, loaded_nm), **figures_of(tracks), **named}


def judge_left_out(
    kind: Kind, recipe: Recipe, recordings: Sequence[FrameSeries], names: Sequence[str], pool: Executor
) -> LeftOut:
    """Fit a recipe without each block of named recordings, and judge it there.

    Raises UserError for recordings without two such blocks, and CalibrationError where the rest determines no
    calibration.
    """
    sides = [side for side in recordings[0].sides if all(side in one.sides for one in recordings)]
    chosen = tuple(one.select_sides(tuple(sides)) for one in recordings) if sides else tuple(recordings)
    blocks = find_blocks(kind, chosen, names)
    tracks = tuple(pool.map(judge_block, (recipe, chosen), blocks))
    return LeftOut(kind, tuple(one.name for one in blocks), tracks, _advice(kind, chosen, tracks))


def judge_block(shared: tuple[Recipe, Sequence[FrameSeries]], block: Block) -> tuple[EstimateTrack, ...]:
    """Return the tracks of a block's spans by a calibration on the other rows; raises CalibrationError naming it."""
    recipe, recordings = shared
    calibration = fit_without(recipe, recordings, block)
    bank, estimated = recipe.open_bank(), dict[int, EstimateTrack]()
    for number in sorted({span.recording for span in block.judged}):
        track = estimate_series(calibration, recordings[number], bank)
        if block.timed:
            profile = TorqueProfile.fit(_kept(recordings, block.timed))
            track = replace(track, profile_nm=None if profile is None else profile.predict(recordings[number]))
        estimated[number] = track
    return tuple(estimated[span.recording].between(span.first, span.stop) for span in block.judged)


def fit_without(recipe: Recipe, recordings: Sequence[FrameSeries], block: Block) -> Calibration:
    """Return the calibration on all but a block; raises CalibrationError, naming the block, where that fails."""
    try:
        return recipe.fit(_kept(recordings, block.fitted))
    except CalibrationError as error:
        raise CalibrationError(f"without {block.name} the rest gives no calibration: {error}") from error


def find_blocks(kind: Kind, recordings: Sequence[FrameSeries], names: Sequence[str]) -> list[Block]:
    """Return the blocks of a kind; raises UserError for recordings that have fewer than two."""
    is_raw = all(one.kind == "raw" for one in recordings)
    if kind == "levels":
        if is_raw:
            raise UserError("twists of a recording have no levels; leave out grips, twists or tools")
        return _levels(recordings)
    if not is_raw:
        raise UserError(f"slices show no {kind}; use --leave-out levels")
    if kind == "twists":
        return _twists(recordings, names)
    return _grips(recordings, names) if kind == "grips" else _tools(recordings, names)


def usual_kind(recordings: Sequence[FrameSeries]) -> Kind:
    """Return the widest kind that recordings allow: tools, else grips, else twists; of slices, levels."""
    if recordings[0].kind != "raw":
        return "levels"
    tools = [one.tool_mm for one in recordings]
    if len(_known_tools(tools)) > 1 and None not in tools:
        return "tools"
    return "grips" if len(recordings) > 1 else "twists"


def _grips(recordings: Sequence[FrameSeries], names: Sequence[str]) -> list[Block]:
    """Return a block for each recording: one grip."""
    if len(recordings) < 2:
        raise UserError(
            "there is one recording, and so one grip, which leaves nothing to fit; record three, or use --leave-out "
            "twists"
        )
    return [_without_recordings(recordings, [number], name) for number, name in enumerate(names)]


def _tools(recordings: Sequence[FrameSeries], names: Sequence[str]) -> list[Block]:
    """Return a block for each diameter, with all of its recordings."""
    unnamed = [name for name, one in zip(names, recordings, strict=True) if one.tool_mm is None]
    if unnamed:
        raise UserError(f"{unnamed[0]} does not name its tool's diameter; name it with --tool-mm")
    sizes = [one.tool_mm.value for one in recordings if one.tool_mm is not None]
    tools = [one.value for one in _known_tools([one.tool_mm for one in recordings])]
    if len(tools) < 2:
        raise UserError(
            f"there is one tool, of {tools[0]:.3g} mm, which leaves nothing to fit; record four tools, or use "
            "--leave-out grips or twists"
        )
    of = [min(tools, key=lambda tool: abs(tool - size)) for size in sizes]
    return [
        _without_recordings(
            recordings, [number for number, own in enumerate(of) if own == tool], f"the tool of {tool:.3g} mm"
        )
        for tool in tools
    ]


def _known_tools(tools: Sequence[Measured | None]) -> list[Measured]:
    return distinct([one for one in tools if one is not None])


def _without_recordings(recordings: Sequence[FrameSeries], left_out: Sequence[int], name: str) -> Block:
    fitted = tuple(np.full(len(one.t_s), number not in left_out) for number, one in enumerate(recordings))
    return Block(name, fitted, tuple(Span(number, 0, len(recordings[number].t_s)) for number in left_out))


def _twists(recordings: Sequence[FrameSeries], names: Sequence[str]) -> list[Block]:
    """Return a block for each twist, from the middle between it and the one before to that between it and the next.

    The first begins with the grip, the last ends with it. A recording of one twist is left out whole.
    """
    blocks: list[Block] = []
    for number, (series, name) in enumerate(zip(recordings, names, strict=True)):
        grip = segment_grip(series)[1]
        twists = find_twists(np.nan_to_num(series.torque_at_frames()))
        middles = [(int(before[-1]) + int(after[0]) + 1) // 2 for before, after in itertools.pairwise(twists)]
        edges = [grip.start, *middles, grip.stop]
        for nth, (first, stop) in enumerate(itertools.pairwise(edges), 1):
            fitted = [np.ones(len(one.t_s), dtype=np.bool_) for one in recordings]
            if len(twists) > 1:
                fitted[number][first:stop] = False
            else:
                fitted[number][:] = False
            blocks.append(Block(f"twist {nth} of {name}", tuple(fitted), (Span(number, first, stop),)))
    if len(blocks) < 2:
        raise UserError("there is one twist, which leaves nothing to fit; record ten")
    return blocks


def _levels(recordings: Sequence[FrameSeries]) -> list[Block]:
    """Return a block for each level of later slices: fitted to earlier slices of other levels.

    The stopwatch knows the earlier slices of all levels: it reads the place in the sequence, and no sensor.
    """
    torque = np.concatenate([_torque_of_slices(one) for one in recordings])
    places = [(number, row) for number, one in enumerate(recordings) for row in range(len(one.t_s))]
    known = np.flatnonzero(np.isfinite(torque))
    parts = later_levels(torque[known]) if len(known) else []
    if not parts:
        raise UserError(f"{counted(len(known), 'slice')} with a torque cannot be split; record 20 or more")
    blocks: list[Block] = []
    near_nm = NEAR_LEVEL * float(np.ptp(torque[known]))
    for kept, later in parts:
        own = torque[known[later]]
        if np.abs(torque[known[kept], None] - own).min() <= near_nm:
            raise UserError("too few slices remain without those of one level; record ten levels, three times or more")
        level = f"slices of {1e3 * float(own.mean()):.3g} mN·m after the first {int(kept[-1]) + 1}"
        earlier = known[: int(kept[-1]) + 1]
        fitted = _rows_of(recordings, np.isin(np.arange(len(torque)), known[kept]))
        timed = _rows_of(recordings, np.isin(np.arange(len(torque)), earlier))
        spans = tuple(Span(number, row, row + 1) for number, row in (places[one] for one in known[later].tolist()))
        blocks.append(Block(level, fitted, spans, timed))
    return blocks


def _torque_of_slices(series: FrameSeries) -> FloatArray:
    """Return the (n,) torques of slices, NaN where a slice is of a cylinder: these are not fitted to a torque."""
    return np.where(np.isfinite(series.diameter_mm), np.nan, series.torque_at_frames())


def _rows_of(recordings: Sequence[FrameSeries], rows: BoolArray) -> tuple[BoolArray, ...]:
    """Return rows of all recordings together as rows (n,) of each."""
    ends = np.cumsum([len(one.t_s) for one in recordings])
    return tuple(np.split(rows, ends[:-1]))


def _kept(recordings: Sequence[FrameSeries], rows: Sequence[BoolArray]) -> list[FrameSeries]:
    """Return the recordings with only these rows and the torques nearest to them; drop recordings without rows."""
    found: list[FrameSeries] = []
    for one, own in zip(recordings, rows, strict=True):
        if not own.any():
            continue
        middles = one.t_s[:-1] + np.diff(one.t_s) / 2
        near = own[np.searchsorted(middles, one.torque_t_s)]
        found.append(
            replace(
                one,
                t_s=one.t_s[own],
                channels=one.channels[own],
                diameter_mm=one.diameter_mm[own],
                torque_t_s=one.torque_t_s[near],
                torque_nm=one.torque_nm[near],
            )
        )
    return found


def _advice(kind: Kind, recordings: Sequence[FrameSeries], tracks: Sequence[Sequence[EstimateTrack]]) -> str:
    """Return one sentence: what to do first for a better calibration."""
    judged = [one for each in tracks for one in each]
    loaded = figures_by_load(judged)["loaded"]
    if loaded["baseline_ratio"] is None:
        return "No loaded frame has an estimate: see why with `shearloop evaluate CAL REC`."
    if kind == "tools":
        if len(tracks) < _ENOUGH_TOOLS:
            tools = counted(len(tracks), "tool")
            return f"{tools} only: record four, because three others tell the gain of one left out."
        return "Another tool has a gain of its own: correct it with `shearloop adapt` on two twists of known torque."
    if against := no_better_than_clock(judged):
        return against
    if kind != "levels" and len(recordings) < _ENOUGH_GRIPS:
        grips = "One grip" if len(recordings) == 1 else "Two grips"
        return f"{grips} only: record three, because the gain changes from grip to grip."
    if (coverage := loaded["coverage_95"]) is not None and coverage < _LEAST_COVERAGE:
        return f"The intervals hold too few truths: record more {kind}."
    return "Nothing stands out: judge it on a recording of another day."


def sentences_of(result: LeftOut, loaded_nm: float = LOADED_NM) -> list[str]:
    """Return the loaded frames' figures, the figures without a sensor, and the advice."""
    loaded = figures_by_load(result.all_tracks, loaded_nm)["loaded"]
    blocks = f"{result.kind.capitalize()} left out in turn ({len(result.names)} fits)"
    if loaded["rmse_nm"] is None:
        return [f"{blocks}: too few loaded frames have an estimate.", result.advice]
    coverage, ratio = loaded["coverage_95"], loaded["baseline_ratio"]
    clock = "the mean of the place in the sequence" if result.kind == "levels" else "a stopwatch with the mean twist"
    return [
        f"{blocks}: loaded frames have an RMSE of {_milli(loaded['rmse_nm'])} mN·m, intervals of "
        f"{_milli(loaded['interval_nm'])} mN·m (median), coverage {coverage:.2f} and a score of "
        f"{_milli(loaded['winkler_nm'])} mN·m.",
        f"Without a sensor: {_milli(loaded['baseline_zero_rmse_nm'])} mN·m for always 0, "
        f"{_milli(loaded['baseline_profile_rmse_nm'])} mN·m for {clock}. Ratio to the better: "
        f"{'unknown' if ratio is None else f'{ratio:.2f}'}.",
        result.advice,
    ]


def _milli(value_nm: float | None) -> str:
    return "unknown" if value_nm is None else f"{1e3 * value_nm:.3g}"
