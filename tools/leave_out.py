"""Judges a recipe for a calibration by leave-one-out: each grip, twist or tool in turn.

The recipe is fitted to the other blocks, and judged on the block that is left out. Neither frames nor torques of a
block take part in its fit. Only the load cell's timing is measured on everything: it belongs to the load cell.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import CalibrationError
from shearloop.bank.mesh import load_mesh
from shearloop.estimation import Calibration, FrameSeries, LoadTiming, Physics, adapt, fit
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.tools.estimate_tracks import EstimateTrack, estimate_series
from shearloop.tools.figures import Figures, figures_by_load, figures_of, no_better_than_clock
from shearloop.tools.frame_series import Series
from shearloop.tools.left_out_blocks import Block, Kind, after_twists, find_blocks, kept, number_of_grips, tools_of
from shearloop.tools.parallel import Executor
from shearloop.words import CountedReasons, counted

# Grips that show how the gain changes from one to the next.
_ENOUGH_GRIPS = 3
# A tool that is left out needs three others, which determine the gain over the diameter.
_ENOUGH_TOOLS = 4
MEAN_TWIST = "a stopwatch with the mean twist"
ON_ANOTHER = "Judge it on another recording: `shearloop evaluate CAL REC`."
# Below this coverage of the 95 % intervals, the advice is more data.
_MIN_COVERAGE = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """The tracks of a block's spans by a calibration on the other rows.

    Where the gain was adapted to twists, `before` are the same without it.
    """

    tracks: tuple[EstimateTrack, ...]
    before: tuple[EstimateTrack, ...] = ()


class Judge(Protocol):
    """A recipe that judges a block by a calibration on the rest."""

    def judge(self, recordings: Sequence[Any], block: Block, /) -> Judged:
        """Return the block's tracks; raises CalibrationError naming it."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """The recipe of a calibration: estimator, files of bank and mesh, and the known facts of torques and their times.

    With `nested` each fit chooses its settings too. Otherwise it has the settings of `shearloop calibrate`.
    """

    estimator: EstimatorName
    bank: Path | None = None
    mesh: Path | None = None
    timing_uncertainty_s: float = 0.0
    nested: bool = False

    def fit(self, recordings: Sequence[FrameSeries]) -> Calibration:
        """Return the calibration of recordings; raises CalibrationError as `fit` does."""
        physics = Physics(bank=self.open_bank(), mesh=load_mesh(self.mesh) if self.mesh else None)
        timing = LoadTiming(uncertainty_s=self.timing_uncertainty_s)
        return fit(self.estimator, recordings, "left out", physics, timing=timing, nested=self.nested)

    def open_bank(self) -> Bank | None:
        """Return the bank, None without one."""
        return Bank.open(self.bank) if self.bank else None

    def judge(self, recordings: Sequence[FrameSeries], block: Block) -> Judged:
        """Return the block's tracks; raises CalibrationError naming it."""
        calibration = fit_without(self.fit, recordings, block)
        if block.adapted is None:
            return Judged(self._tracks(recordings, block, calibration))
        adapted = _adapted(self, recordings, block, calibration)
        before, after = (self._tracks(recordings, block, version) for version in (calibration, adapted))
        return Judged(after, before)

    def _tracks(
        self, recordings: Sequence[FrameSeries], block: Block, calibration: Calibration
    ) -> tuple[EstimateTrack, ...]:
        numbers, bank = {span.recording for span in block.judged}, self.open_bank()
        tracks = {number: estimate_series(calibration, recordings[number], bank) for number in sorted(numbers)}
        return tuple(tracks[span.recording].between(span.first, span.stop) for span in block.judged)


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """The names of the blocks, the tracks of each, a sentence of advice, and the name of the guess without a sensor.

    Where the gain was adapted to twists, `before` are the tracks of the same frames without it, and `without_rest` says
    why blocks have nothing left to be judged.
    """

    kind: str
    names: tuple[str, ...]
    tracks: tuple[tuple[EstimateTrack, ...], ...]
    advice: str
    clock: str
    before: tuple[EstimateTrack, ...] = ()
    without_rest: Sequence[str] = ()

    @property
    def all_tracks(self) -> list[EstimateTrack]:
        """The tracks of all blocks."""
        return [track for tracks in self.tracks for track in tracks]

    @property
    def not_judged(self) -> list[str]:
        """The blocks without a part in the figures, each with the reason."""
        blocks = zip(self.names, self.tracks, strict=True)
        refused = [f"{name}, because no torque was estimated on it" for name, tracks in blocks if _lacks_torque(tracks)]
        return [*self.without_rest, *refused]

    def figures(self, loaded_nm: float = LOADED_NM) -> dict[str, object]:
        """Return the figures by the names of `shearloop evaluate`, and the figures of each block's loaded frames."""
        blocks = [
            {"name": name, **figures_by_load(tracks, loaded_nm)["loaded"]}
            for name, tracks in zip(self.names, self.tracks, strict=True)
        ]
        tracks = self.all_tracks
        named: dict[str, object] = {
            "left_out": self.kind,
            "blocks": blocks,
            "not_judged": self.not_judged,
            "advice": self.advice,
        }
        if self.before:
            named["before_adapting"] = figures_by_load(self.before, loaded_nm)["loaded"]
        return {**figures_by_load(tracks, loaded_nm), **figures_of(tracks), **named}


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """A plan of fits: a recipe, recordings, and the blocks to leave out in turn.

    `advice` returns a sentence on the tracks of the blocks. `clock` names the guess without a sensor.
    `without_rest` says why blocks have nothing left to be judged.
    """

    kind: str
    recipe: Judge
    recordings: Sequence[FrameSeries]
    blocks: Sequence[Block]
    advice: Callable[[Sequence[Sequence[EstimateTrack]]], str]
    clock: str = MEAN_TWIST
    without_rest: Sequence[str] = ()

    def judge(self, pool: Executor) -> LeftOut:
        """Fit and judge each block; raises CalibrationError where the rest determines no calibration."""
        judged = list(pool.map(judge_block, (self.recipe, self.recordings), self.blocks))
        tracks, names = tuple(result.tracks for result in judged), tuple(block.name for block in self.blocks)
        before = tuple(track for result in judged for track in result.before)
        return LeftOut(self.kind, names, tracks, self.advice(tracks), self.clock, before, self.without_rest)


def judge_block(shared: tuple[Judge, Sequence[FrameSeries]], block: Block) -> Judged:
    """Return the tracks of a block, in a worker."""
    recipe, recordings = shared
    return recipe.judge(recordings, block)


def plan_left_out(
    kind: Kind, recipe: Recipe, recordings: Sequence[FrameSeries], names: Sequence[str], *, adapt_twists: int = 0
) -> Plan:
    """Return the plan for named recordings.

    With `adapt_twists` the gain is adapted to as many twists at the beginning of each judged recording, which are
    neither fitted nor judged. Raises UserError for recordings without two such blocks.
    """
    sides = [side for side in recordings[0].sides if all(side in recording.sides for recording in recordings)]
    chosen = tuple(recording.select_sides(tuple(sides)) for recording in recordings) if sides else tuple(recordings)
    blocks = find_blocks(kind, chosen, names)
    advice = partial(advice_on, kind, chosen, adapted=bool(adapt_twists))
    if not adapt_twists:
        return Plan(kind, recipe, chosen, blocks, advice)
    later = after_twists(blocks, chosen, adapt_twists)
    return Plan(kind, recipe, chosen, later.blocks, advice, without_rest=later.not_judged)


Fitted = TypeVar("Fitted")


def fit_without(fit_rest: Callable[[list[Series]], Fitted], recordings: Sequence[Series], block: Block) -> Fitted:
    """Return the calibration on all but a block; raises CalibrationError, naming the block, where that fails."""
    try:
        return fit_rest(kept(recordings, block.fitted))
    except CalibrationError as error:
        raise CalibrationError(f"without {block.name} the rest gives no calibration: {error}") from error


def _adapted(recipe: Recipe, recordings: Sequence[FrameSeries], block: Block, calibration: Calibration) -> Calibration:
    """Return a calibration with its gain adapted to the block's first twists.

    Raises CalibrationError, naming the block, where that fails.
    """
    to = block.adapted
    if to is None:
        return calibration
    twists = recordings[to.recording].between(to.first, to.stop)
    try:
        return adapt(calibration, [twists], "left out", Physics(bank=recipe.open_bank()))[0]
    except CalibrationError as error:
        raise CalibrationError(f"{block.name} is not judged after its first twists: {error}") from error


def advice_on(
    kind: Kind, recordings: Sequence[FrameSeries], tracks: Sequence[Sequence[EstimateTrack]], *, adapted: bool
) -> str:
    """Return one sentence of advice for a better calibration; `adapted`: its gain was adapted to twists."""
    judged = [track for block_tracks in tracks for track in block_tracks]
    loaded = figures_by_load(judged)["loaded"]
    if loaded["baseline_ratio"] is None:
        return without_estimate(judged)
    if few_tools := _few_tools(kind, recordings):
        return few_tools
    if kind == "tools" and not adapted:
        return "Another tool has a gain of its own: correct it with `shearloop adapt` on two twists of known torque."
    if (n_grips := number_of_grips(recordings)) < _ENOUGH_GRIPS:
        grips = "One grip" if n_grips == 1 else "Two grips"
        return f"{grips} only: record three, because the gain changes from grip to grip."
    if against := no_better_than_clock(judged):
        return against
    return advice_of_coverage(judged, kind)


def without_estimate(tracks: Sequence[EstimateTrack]) -> str:
    """Return why left-out tracks cannot be judged: the most frequent reason against their loaded frames."""
    against = CountedReasons()
    for track in tracks:
        loaded = np.abs(track.series.torque_at_frames()) >= LOADED_NM
        for estimate in compress(track.estimates, loaded):
            reasons = estimate.reasons or (track.why_no_torque or "the rest gives no torque",)
            if estimate.torque_nm is None:
                against.add(reasons[0])
    if not against.total:
        return "No left-out frame with an estimate is under load: record twists of a tool."
    (count, why), *_ = against.most_frequent_first
    of_those = f"({count} of the {against.total} loaded frames without one)"
    return f"The rest gives too few estimates of the left-out frames: {why} {of_those}."


def advice_of_coverage(tracks: Sequence[EstimateTrack], kind: str) -> str:
    """Return the advice where the sensor helps: by how many truths lie within the intervals."""
    coverage = figures_by_load(tracks)["loaded"]["coverage_95"]
    if coverage is not None and coverage < _MIN_COVERAGE:
        return f"The intervals hold too few truths: record more {kind}."
    return "Nothing stands out: judge it on a recording of another day."


def sentences_of(result: LeftOut, loaded_nm: float = LOADED_NM) -> list[str]:
    """Return the loaded frames' figures, the figures without a sensor, and the advice."""
    loaded = figures_by_load(result.all_tracks, loaded_nm)["loaded"]
    blocks = f"{result.kind.capitalize()} left out in turn ({len(result.names)} fits)"
    if loaded["rmse_nm"] is None:
        return [f"{blocks}: too few loaded frames have an estimate.", result.advice]
    coverage, ratio = loaded["coverage_95"], loaded["baseline_ratio"]
    return [
        f"{blocks}: loaded frames have an RMSE of {_milli(loaded['rmse_nm'])} mN·m, intervals of "
        f"{_milli(loaded['interval_nm'])} mN·m (median), coverage {coverage:.2f} and a score of "
        f"{_milli(loaded['winkler_nm'])} mN·m.",
        f"Without a sensor: {_milli(loaded['baseline_zero_rmse_nm'])} mN·m for always 0, "
        f"{_milli(loaded['baseline_profile_rmse_nm'])} mN·m for {result.clock}. Ratio to the better: "
        f"{'unknown' if ratio is None else f'{ratio:.2f}'}.",
        *(f"Not judged: {why}." for why in result.not_judged),
        *_before_adapting(result, loaded_nm),
        result.advice,
    ]


def figures_on_fitted(tracks: Sequence[EstimateTrack]) -> Figures:
    """Return what frames of the fit show of a calibration: the width of intervals, and the errors without a sensor.

    Its own error on them shows nothing.
    """
    loaded = figures_by_load(tracks)["loaded"]
    return {name: loaded[name] for name in ("n", "interval_nm", "baseline_zero_rmse_nm", "baseline_profile_rmse_nm")}


def sentences_on_fitted(figures: Figures, clock: str) -> list[str]:
    """Return `figures_on_fitted` in words; `clock` names the guess without a sensor."""
    if figures["interval_nm"] is None:
        return ["Too few loaded frames of the fit have an estimate."]
    return [
        f"Loaded frames of the fit have intervals of {_milli(figures['interval_nm'])} mN·m (median). Without a sensor: "
        f"{_milli(figures['baseline_zero_rmse_nm'])} mN·m for always 0, "
        f"{_milli(figures['baseline_profile_rmse_nm'])} mN·m for {clock}, which knows these frames."
    ]


def advice_unjudged(kind: str, recordings: Sequence[FrameSeries]) -> str:
    """Return one sentence: what to do first where no block of a kind can be left out."""
    return _few_tools(kind, recordings) or ON_ANOTHER


def _few_tools(kind: str, recordings: Sequence[FrameSeries]) -> str:
    n_tools = len(tools_of(recordings))
    if kind != "tools" or n_tools >= _ENOUGH_TOOLS:
        return ""
    return f"{counted(n_tools, 'tool')} only: record four, because the gain of a left-out tool needs three others."


def _lacks_torque(tracks: Sequence[EstimateTrack]) -> bool:
    return all(estimate.torque_nm is None for track in tracks for estimate in track.estimates)


def _before_adapting(result: LeftOut, loaded_nm: float) -> list[str]:
    if not result.before:
        return []
    before = figures_by_load(result.before, loaded_nm)["loaded"]
    return [f"Before adapting: {_milli(before['rmse_nm'])} mN·m, a score of {_milli(before['winkler_nm'])} mN·m."]


def _milli(value_nm: float | None) -> str:
    return "unknown" if value_nm is None else f"{1e3 * value_nm:.3g}"
