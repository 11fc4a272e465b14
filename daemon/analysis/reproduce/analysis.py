"""The analysis of Trehan et al. 2025 on recorded slices: what torque and diameter follow from the best matches.

Sensors 2025, 25, 5159. Every number that the paper reports is computed anew; what the recordings do not determine
stays None, with a sentence that says so.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.bank_file import Bank
from shearloop.bank.eit.channels import smoothed_along_channels
from shearloop.bank.eit.forward import ForwardModel
from shearloop.bank.eit.grouping import group_means, kmeans_groups, place_in_series
from shearloop.bank.eit.matching import Match, ReferenceMatcher, best_match
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.eit.model_scores import (
    centred_settings,
    matching_scores,
    mean_envelope_score,
    searched_settings,
    simulated_signals,
)
from shearloop.bank.eit.models import MODELS
from shearloop.bank.eit.polynomial import Polynomial
from shearloop.bank.errors import CalibrationError, MatchingError
from shearloop.bank.estimation.calibration import DIAMETER_DEGREE, TORQUE_DEGREE
from shearloop.daemon.recording.matlab_streams import DiameterSlices, TorqueSlices

# Called with how many slices have been matched since the last call.
Progress = Callable[[int], object]

FEWEST_SLICES = 3
# The paper sorts its torques into ten groups.
_GROUPS = 10
# Where the slices are no repeats, the held-out parts are so many stretches of time.
_STRETCHES = 5
_BATCH = 8


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """The best matches of n slices on one bank: heatmaps (n, K, S), k (n,), sigma (n,) in cm, scores (n,)."""

    heatmaps: FloatArray
    k: FloatArray
    sigma: FloatArray
    scores: FloatArray
    best: tuple[Match, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TorqueResult:
    """What the torque slices say. Correlations are Pearson's, between torque and the best match's sigma.

    groups (n,) are levels of torque, found as `grouping` says; r_clustered is between the groups' means; fit is the
    parabola through these means; rmse_nm is that of single slices, each predicted by a parabola fitted without its
    part of the recording, parts being as `held_out` says.
    """

    slices: TorqueSlices
    focused: Matches
    wide: Matches
    r_focused: float | None
    r_wide: float | None
    groups: IntArray
    grouping: str
    r_clustered: float | None
    fit: Polynomial | None
    rmse_nm: float | None
    held_out: str
    notes: tuple[str, ...]

    @property
    def group_torque_nm(self) -> FloatArray:
        """The mean torque of each group."""
        return group_means(self.slices.torque_nm, self.groups)

    @property
    def group_sigma(self) -> FloatArray:
        """The mean sigma of each group, on the focused bank."""
        return group_means(self.focused.sigma, self.groups)


@dataclass(frozen=True, slots=True, eq=False)
class DiameterResult:
    """What the diameter slices say: Pearson's correlation between diameter and the best match's k.

    single is slice by slice; accumulated has one match for each of diameters_mm (d,), of the mean of its heatmaps
    (d, K, S); fit is the line through accumulated_k (d,).
    """

    slices: DiameterSlices
    single: Matches
    r_single: float | None
    diameters_mm: FloatArray
    heatmaps: FloatArray
    accumulated_k: FloatArray
    accumulated: tuple[Match, ...]
    r_accumulated: float | None
    fit: Polynomial | None
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ModelScores:
    """The score of each basis model by name, in two measures (see shearloop.bank.eit.model_scores), None where none
    is possible.

    envelope needs the raw frame; matching is over the torque slices.
    """

    envelope: dict[str, float | None] | None
    matching: dict[str, float | None]

    @property
    def chosen(self) -> dict[str, float | None]:
        """The paper's measure where the raw frame is there, else that of the matching."""
        return self.matching if self.envelope is None else self.envelope


def match_slices(differences: FloatArray, bank: Bank, progress: Progress) -> Matches:
    """Return the best matches of (n, 896) differences, over all lags."""
    matcher = ReferenceMatcher.from_bank(bank)
    parts = []
    for start in range(0, len(differences), _BATCH):
        parts.append(matcher.heatmaps(differences[start : start + _BATCH]))
        progress(len(parts[-1]))
    heatmaps = np.concatenate(parts)
    best = tuple(best_match(heatmap, bank.k_grid, bank.sigma_grid) for heatmap in heatmaps)
    return Matches(
        heatmaps=heatmaps,
        k=np.array([match.k for match in best]),
        sigma=np.array([match.sigma for match in best]),
        scores=np.array([match.score for match in best]),
        best=best,
    )


def analyse_torque(slices: TorqueSlices, on_focused: Matches, on_wide: Matches) -> TorqueResult:
    """Relate the sigma of torque slices, at least three of them, to torque, by their matches on both banks."""
    torque = slices.torque_nm
    sigma = on_focused.sigma
    groups, grouping = _levels(torque)
    parts, held_out = _held_out_parts(torque)
    group_sigma, group_torque = group_means(sigma, groups), group_means(torque, groups)
    r_clustered = correlation(group_sigma, group_torque)
    notes: list[str] = []
    fit = _fit_or_note(group_sigma, group_torque, TORQUE_DEGREE, "torque over sigma", notes)
    rmse_nm = _cross_validated_rmse(sigma, torque, parts, notes)
    if r_clustered is None:
        notes.append("the groups of torque slices are too few or too alike for a correlation")
    return TorqueResult(
        slices=slices,
        focused=on_focused,
        wide=on_wide,
        r_focused=correlation(sigma, torque),
        r_wide=correlation(on_wide.sigma, torque),
        groups=groups,
        grouping=grouping,
        r_clustered=r_clustered,
        fit=fit,
        rmse_nm=rmse_nm,
        held_out=held_out,
        notes=tuple(notes),
    )


def analyse_diameter(slices: DiameterSlices, wide: Bank, progress: Progress) -> DiameterResult:
    """Match diameter slices, smoothed along the channels, on the wide bank and relate k to diameter."""
    single = match_slices(smoothed_along_channels(slices.differences), wide, progress)
    diameters = np.unique(slices.diameter_mm)
    heatmaps = np.array([single.heatmaps[slices.diameter_mm == each].mean(axis=0) for each in diameters])
    accumulated = tuple(best_match(heatmap, wide.k_grid, wide.sigma_grid) for heatmap in heatmaps)
    accumulated_k = np.array([match.k for match in accumulated])
    r_accumulated = correlation(accumulated_k, diameters)
    notes: list[str] = []
    if r_accumulated is None:
        notes.append(f"{len(diameters)} diameters, or too few distinct k, do not make a correlation of k with diameter")
    return DiameterResult(
        slices=slices,
        single=single,
        r_single=correlation(single.k, slices.diameter_mm),
        diameters_mm=diameters,
        heatmaps=heatmaps,
        accumulated_k=accumulated_k,
        accumulated=accumulated,
        r_accumulated=r_accumulated,
        fit=_fit_or_note(accumulated_k, diameters, DIAMETER_DEGREE, "diameter over k", notes),
        notes=tuple(notes),
    )


def score_models(slices: TorqueSlices, raw_difference: FloatArray | None, mesh: Mesh) -> ModelScores:
    """Score the five basis models on a mesh against the slices and, where it is there, a raw (896,) difference."""
    forward = ForwardModel(mesh)
    middle = float(mesh.nodes[:, 1].min() + mesh.nodes[:, 1].max()) / 2
    envelope: dict[str, float | None] = {}
    matching: dict[str, float | None] = {}
    for model in MODELS:
        searched = simulated_signals(forward, model, searched_settings(model, mesh.height_cm))
        matching[model] = float(matching_scores(slices.differences, searched).mean()) if len(searched) else None
        if raw_difference is not None:
            centred = simulated_signals(forward, model, centred_settings(model, middle))
            envelope[model] = _envelope_score_or_none(raw_difference, centred)
    return ModelScores(envelope or None, matching)


def correlation(x: FloatArray, y: FloatArray) -> float | None:
    """Return Pearson's r of (n,) x and y, None for fewer than three points or where one of them does not vary."""
    if len(x) < FEWEST_SLICES or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    return float(np.corrcoef(x, y)[0, 1])


def _levels(torque: FloatArray) -> tuple[IntArray, str]:
    series = place_in_series(torque)
    if series is not None:
        return series.level, f"by place in {int(series.repeat.max()) + 1} repeated series"
    count = min(_GROUPS, max(FEWEST_SLICES, len(torque) // 3), len(np.unique(torque)))
    return kmeans_groups(torque[:, None], count), f"by k-means of the torques into {count} (no repeated series found)"


def _held_out_parts(torque: FloatArray) -> tuple[IntArray, str]:
    """Return the part of time that each slice belongs to: neighbours in time are not independent of each other."""
    series = place_in_series(torque)
    if series is not None:
        return series.repeat, "one repeat of the series left out at a time"
    count = min(_STRETCHES, len(torque))
    stretches = (np.arange(len(torque)) * count // len(torque)).astype(np.int64)
    return stretches, f"one of {count} stretches of time left out at a time"


def _cross_validated_rmse(sigma: FloatArray, torque: FloatArray, parts: IntArray, notes: list[str]) -> float | None:
    errors = np.empty_like(torque)
    for part in np.unique(parts):
        out = parts == part
        fit = _fit_or_note(sigma[~out], torque[~out], TORQUE_DEGREE, "torque over sigma with a part left out", notes)
        if fit is None:
            return None
        errors[out] = [fit(value) for value in sigma[out]] - torque[out]
    return float(np.sqrt(np.mean(errors**2)))


def _fit_or_note(x: FloatArray, y: FloatArray, degree: int, what: str, notes: list[str]) -> Polynomial | None:
    try:
        return Polynomial.fit(x, y, degree)
    except CalibrationError as error:
        notes.append(f"no fit of {what}: {error}")
        return None


def _envelope_score_or_none(raw_difference: FloatArray, signals: FloatArray) -> float | None:
    try:
        return mean_envelope_score(raw_difference, signals) if len(signals) else None
    except MatchingError:  # a signal without peaks: nothing to compare
        return None


def all_notes(results: Iterable[TorqueResult | DiameterResult | None]) -> list[str]:
    """Return the notes of the results that there are."""
    return [note for result in results if result is not None for note in result.notes]
