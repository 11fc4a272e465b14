"""Judges a recipe for a calibration by leave-one-out: each grip, twist, tool or level of torque in turn.

A recipe is fitted to the rest, and judged on the block that it has not seen. Neither frames nor torques of a block
take part in its fit. Only the load cell's timing is measured on everything: it belongs to the load cell.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from shearloop.bank.bank_file import Bank
from shearloop.bank.errors import CalibrationError
from shearloop.bank.mesh import load_mesh
from shearloop.estimation import Calibration, FrameSeries, LoadTiming, Physics, adapt, fit
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.estimation.torque_profile import TorqueProfile
from shearloop.tools.evaluate import EstimateTrack, estimate_series, figures_by_load, figures_of, no_better_than_clock
from shearloop.tools.left_out_blocks import Block, Kind, after_twists, find_blocks, kept, tools_of
from shearloop.tools.parallel import Executor
from shearloop.words import counted

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


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """The names of the blocks, the tracks of each, and a sentence of advice.

    Where the gain was adapted to twists, `before` are the tracks of the same frames without it.
    """

    kind: Kind
    names: tuple[str, ...]
    tracks: tuple[tuple[EstimateTrack, ...], ...]
    advice: str
    before: tuple[EstimateTrack, ...] = ()

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
        named: dict[str, object] = {"left_out": self.kind, "blocks": blocks, "advice": self.advice}
        if self.before:
            named["before_adapting"] = figures_by_load(self.before, loaded_nm)["loaded"]
        return {**figures_by_load(tracks, loaded_nm), **figures_of(tracks), **named}


def judge_left_out(
    kind: Kind,
    recipe: Recipe,
    recordings: Sequence[FrameSeries],
    names: Sequence[str],
    pool: Executor,
    *,
    adapt_twists: int = 0,
) -> LeftOut:
    """Fit a recipe without each block of named recordings, and judge it there.

    With `adapt_twists` the gain is adapted to as many twists at the beginning of each judged recording, which are
    neither fitted nor judged. Raises UserError for recordings without two such blocks, and CalibrationError where the
    rest determines no calibration.
    """
    sides = [side for side in recordings[0].sides if all(side in one.sides for one in recordings)]
    chosen = tuple(one.select_sides(tuple(sides)) for one in recordings) if sides else tuple(recordings)
    blocks = find_blocks(kind, chosen, names)
    before: list[EstimateTrack] = []
    if adapt_twists:
        blocks = after_twists(blocks, chosen, adapt_twists)
        pairs = list(pool.map(judge_before_and_after, (recipe, chosen), blocks))
        before = [track for tracks, _ in pairs for track in tracks]
        tracks = tuple(tracks for _, tracks in pairs)
    else:
        tracks = tuple(pool.map(judge_block, (recipe, chosen), blocks))
    advice = advice_on(kind, chosen, tracks, adapted=bool(adapt_twists))
    return LeftOut(kind, tuple(one.name for one in blocks), tracks, advice, tuple(before))


def judge_block(shared: tuple[Recipe, Sequence[FrameSeries]], block: Block) -> tuple[EstimateTrack, ...]:
    """Return the tracks of a block's spans by a calibration on the other rows; raises CalibrationError naming it."""
    recipe, recordings = shared
    return _tracks(recipe, recordings, block, fit_without(recipe, recordings, block))


def judge_before_and_after(
    shared: tuple[Recipe, Sequence[FrameSeries]], block: Block
) -> tuple[tuple[EstimateTrack, ...], tuple[EstimateTrack, ...]]:
    """Return `judge_block`, and the same after the gain is adapted to the block's first twists."""
    recipe, recordings = shared
    calibration = fit_without(recipe, recordings, block)
    adapted = _adapted(recipe, recordings, block, calibration)
    before, after = (_tracks(recipe, recordings, block, one) for one in (calibration, adapted))
    return before, after


def _tracks(
    recipe: Recipe, recordings: Sequence[FrameSeries], block: Block, calibration: Calibration
) -> tuple[EstimateTrack, ...]:
    bank, estimated = recipe.open_bank(), dict[int, EstimateTrack]()
    for number in sorted({span.recording for span in block.judged}):
        track = estimate_series(calibration, recordings[number], bank)
        if block.timed:
            profile = TorqueProfile.fit(kept(recordings, block.timed))
            track = replace(track, profile_nm=None if profile is None else profile.predict(recordings[number]))
        estimated[number] = track
    return tuple(estimated[span.recording].between(span.first, span.stop) for span in block.judged)


def fit_without(recipe: Recipe, recordings: Sequence[FrameSeries], block: Block) -> Calibration:
    """Return the calibration on all but a block; raises CalibrationError, naming the block, where that fails."""
    try:
        return recipe.fit(kept(recordings, block.fitted))
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
    """Return one sentence: what to do first for a better calibration, whose gain may be `adapted` to twists."""
    judged = [one for each in tracks for one in each]
    loaded = figures_by_load(judged)["loaded"]
    if loaded["baseline_ratio"] is None:
        return "No loaded frame has an estimate: see why with `shearloop evaluate CAL REC`."
    if kind == "tools" and (n_tools := len(tools_of(recordings))) < _ENOUGH_TOOLS:
        return f"{counted(n_tools, 'tool')} only: record four, because three others tell the gain of one left out."
    if kind == "tools" and not adapted:
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
        *_before_adapting(result, loaded_nm),
        result.advice,
    ]


def _before_adapting(result: LeftOut, loaded_nm: float) -> list[str]:
    if not result.before:
        return []
    before = figures_by_load(result.before, loaded_nm)["loaded"]
    return [f"Before adapting: {_milli(before['rmse_nm'])} mN·m, a score of {_milli(before['winkler_nm'])} mN·m."]


def _milli(value_nm: float | None) -> str:
    return "unknown" if value_nm is None else f"{1e3 * value_nm:.3g}"
