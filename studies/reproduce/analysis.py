"""The analysis of Trehan et al. 2025 (Sensors 25, 5159): torque and diameter from best matches of recorded slices."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.polynomial import Polynomial
from scipy.optimize import linear_sum_assignment

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.design import (
    PAPER_ENVELOPE,
    EnvelopeSettings,
    centred_settings,
    envelope_score,
    matching_scores,
    searched_settings,
    simulated_signals,
)
from shearloop.bank.errors import MatchingError
from shearloop.bank.forward import BatchForwardModel
from shearloop.bank.matching import Match, ReferenceMatcher, best_match
from shearloop.bank.mesh import Mesh
from shearloop.bank.models import MODELS
from shearloop.errors import UserError
from shearloop.estimation.ridge import sign_of_loads
from shearloop.tools.recordings.intact_records import Progress
from shearloop.tools.recordings.matlab_import import (
    DIAMETER_FOLDER,
    RAW_FRAME,
    RAW_HOMOGENEOUS,
    TORQUE_FOLDER,
    Slices,
    read_diameter_slices,
    read_line,
    read_torque_slices,
)
from shearloop.words import counted

# Torque is a parabola over σ and diameter a line over k (Trehan et al. 2025, figures 8 and 9).
_TORQUE_DEGREE, _DIAMETER_DEGREE = 2, 1


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """The slices of a folder, None where they are missing; `raw_difference` (896,) is of one raw frame."""

    torque: Slices | None
    diameter: Slices | None
    raw_difference: FloatArray | None


def read_inputs(recordings: Path) -> Inputs:
    """Read torque_slices and diameter_slices of a folder.

    Raises UserError when both are absent, a file cannot be used, or there are fewer than three torque slices.
    """
    torque_folder, diameter_folder = recordings / TORQUE_FOLDER, recordings / DIAMETER_FOLDER
    if not torque_folder.is_dir() and not diameter_folder.is_dir():
        raise UserError(f"{recordings} has neither a folder {TORQUE_FOLDER} nor a folder {DIAMETER_FOLDER}")
    torque = read_torque_slices(torque_folder) if torque_folder.is_dir() else None
    if torque is not None and len(torque.torque_nm) < MIN_SLICES:
        found = counted(len(torque.torque_nm), "slice")
        raise UserError(f"{torque_folder} has {found}; a correlation needs at least {MIN_SLICES}")
    raw, paths = None, [torque_folder / name for name in (RAW_FRAME, RAW_HOMOGENEOUS)]
    if all(path.exists() for path in paths):
        frame, homogeneous = (PAPER_TABLE.channels_of_line(read_line(path)) for path in paths)
        raw = np.abs(frame - homogeneous)
    return Inputs(torque, read_diameter_slices(diameter_folder) if diameter_folder.is_dir() else None, raw)


MIN_SLICES = 3
# The paper sorts its torques into ten groups.
_GROUPS = 10
# Without repeats, the held-out parts are stretches of time.
_STRETCHES = 5
_BATCH = 8
# A fall by more than this fraction of the whole range begins a new series.
_RESTART_FRACTION = 0.5
# This share of a series' steps must rise: noise may swap neighbouring levels.
_RISING_FRACTION = 0.8
# The paper does not give the settings of its envelope. These show how the ranking depends on them.
ENVELOPES = tuple(
    EnvelopeSettings(distance, averaged) for distance in (30, 40, 50, 60, 70) for averaged in (1, 3, 5, 7, 9)
)
# A model is tried at these fractions of the height for the matching score. More change it by less than 0.001.
_PLACES = np.linspace(0.02, 0.98, 49)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """The best matches of n slices in a bank: heatmaps (n, K, S), k (n,) and sigma (n,) in cm, scores (n,)."""

    heatmaps: FloatArray
    k: FloatArray
    sigma: FloatArray
    scores: FloatArray
    best: tuple[Match, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TorqueResult:
    """The torque slices' results. Correlations are Pearson's, between torque and the best match's sigma.

    `groups` (n,) are levels of torque. `r_clustered` is between the means of these, and `fit` is the parabola through
    the means. `parts` (n,) are parts of the recording.
    `rmse_nm` is of single slices, each predicted by a parabola that was fitted without its part. `grouping` and
    `held_out` describe the groups and the parts. What the slices do not determine is None.
    """

    slices: Slices
    focused: Matches
    wide: Matches
    r_focused: float | None
    r_wide: float | None
    groups: IntArray
    grouping: str
    r_clustered: float | None
    parts: IntArray
    fit: Polynomial | None
    rmse_nm: float | None
    held_out: str

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
    """The diameter slices' results: Pearson's correlation between diameter and the best match's k.

    `single` is slice by slice. `accumulated` has one match per diameter (d,), of its mean heatmap; `fit` is the line
    through its k. `running_k` (n,) are of the sum of a cylinder's heatmaps up to each slice. What the slices do not
    determine is None.
    """

    slices: Slices
    single: Matches
    r_single: float | None
    diameters_mm: FloatArray
    accumulated: Matches
    r_accumulated: float | None
    running_k: FloatArray
    r_running_sum: float | None
    fit: Polynomial | None


@dataclass(frozen=True, slots=True, eq=False)
class ModelScores:
    """The score of each basis model in two measures (see bank.eit.design), None where it is undefined.

    `envelope` needs the raw frame, and `matching` is over the torque slices. `n_slices` counts the slices that a model
    matches best. `n_envelopes` counts the settings of the envelope that make it first.
    """

    envelope: dict[str, float | None] | None
    matching: dict[str, float | None]
    n_slices: dict[str, int]
    n_envelopes: dict[str, int]

    @property
    def chosen(self) -> dict[str, float | None]:
        """The paper's measure where the raw frame exists, else the matching's."""
        return self.matching if self.envelope is None else self.envelope


def match_slices(differences: FloatArray, bank: Bank, progress: Progress) -> Matches:
    """Return the best matches of (n, 896) differences, over all lags; `progress` receives the slices so far."""
    matcher = ReferenceMatcher.from_bank(bank)
    parts = []
    for start in range(0, len(differences), _BATCH):
        parts.append(matcher.heatmaps(differences[start : start + _BATCH]))
        progress(min(start + _BATCH, len(differences)))
    return _best_matches(np.concatenate(parts), bank)


def _best_matches(heatmaps: FloatArray, bank: Bank) -> Matches:
    best = tuple(best_match(heatmap, bank.k_grid, bank.sigma_grid) for heatmap in heatmaps)
    k, sigma, scores = np.array([(match.k, match.sigma, match.score) for match in best]).T
    return Matches(heatmaps, k, sigma, scores, best)


def analyse_torque(slices: Slices, on_focused: Matches, on_wide: Matches) -> TorqueResult:
    """Relate sigma to torque, from the matches of at least three slices in both banks."""
    torque = slices.torque_nm
    sigma = on_focused.sigma
    groups, grouping, parts, held_out = _groups(torque)
    group_sigma, group_torque = group_means(sigma, groups), group_means(torque, groups)
    return TorqueResult(
        slices=slices,
        focused=on_focused,
        wide=on_wide,
        r_focused=correlation(sigma, torque),
        r_wide=correlation(on_wide.sigma, torque),
        groups=groups,
        grouping=grouping,
        r_clustered=correlation(group_sigma, group_torque),
        parts=parts,
        fit=_curve(group_sigma, group_torque, _TORQUE_DEGREE),
        rmse_nm=_cross_validated_rmse(sigma, torque, parts),
        held_out=held_out,
    )


def analyse_diameter(slices: Slices, single: Matches, wide: Bank) -> DiameterResult:
    """Relate k to diameter, from the matches of slices, smoothed along the channels, in the wide bank."""
    diameters = np.unique(slices.diameter_mm)
    heatmaps = np.array([single.heatmaps[slices.diameter_mm == diameter].mean(axis=0) for diameter in diameters])
    accumulated = _best_matches(heatmaps, wide)
    sums = [single.heatmaps[slices.diameter_mm == diameter].cumsum(axis=0) for diameter in diameters]
    # Slices stand by rising diameter.
    running_k = _best_matches(np.concatenate(sums), wide).k
    return DiameterResult(
        slices=slices,
        single=single,
        r_single=correlation(single.k, slices.diameter_mm),
        diameters_mm=diameters,
        accumulated=accumulated,
        r_accumulated=correlation(accumulated.k, diameters),
        running_k=running_k,
        r_running_sum=correlation(running_k, slices.diameter_mm),
        fit=_curve(accumulated.k, diameters, _DIAMETER_DEGREE),
    )


def score_models(slices: Slices, raw_difference: FloatArray | None, mesh: Mesh) -> ModelScores:
    """Score the five basis models on a mesh against the slices and, if given, a raw (896,) difference."""
    forward = BatchForwardModel(mesh)
    middle = float(mesh.nodes[:, 1].min() + mesh.nodes[:, 1].max()) / 2
    of_slices: dict[str, FloatArray] = {}
    envelopes: dict[str, dict[EnvelopeSettings, float]] = {}
    for model in MODELS:
        searched = simulated_signals(forward, model, searched_settings(model, mesh.height_cm, _PLACES))
        if len(searched):
            of_slices[model] = matching_scores(slices.differences, searched)
        if raw_difference is not None:
            envelopes[model] = _envelope_scores(
                raw_difference, simulated_signals(forward, model, centred_settings(model, middle))
            )
    by_slice = [{model: float(found[i]) for model, found in of_slices.items()} for i in range(len(slices.numbers))]
    by_envelope = [
        {model: found[settings] for model, found in envelopes.items() if settings in found} for settings in ENVELOPES
    ]
    return ModelScores(
        envelope={model: found.get(PAPER_ENVELOPE) for model, found in envelopes.items()} or None,
        matching={model: float(of_slices[model].mean()) if model in of_slices else None for model in MODELS},
        n_slices=_times_first(by_slice),
        n_envelopes=_times_first(by_envelope),
    )


def _envelope_scores(difference: FloatArray, signals: FloatArray) -> dict[EnvelopeSettings, float]:
    """Return the scores of (m, n) signals by the envelope's settings, without those that are undefined."""
    found = {}
    for settings in ENVELOPES if len(signals) else ():
        # A signal without peaks has no score.
        with suppress(MatchingError):
            found[settings] = envelope_score(difference, signals, settings)
    return found


def _times_first(rankings: list[dict[str, float]]) -> dict[str, int]:
    """Return how often each model has the largest score."""
    first = [max(scores, key=lambda model: scores[model]) for scores in rankings if scores]
    return {model: first.count(model) for model in MODELS}


def correlation(x: FloatArray, y: FloatArray) -> float | None:
    """Return Pearson's r of (n,) x and y, None for fewer than three points or constant values."""
    if len(x) < MIN_SLICES or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    return float(np.corrcoef(x, y)[0, 1])


def _groups(torque: FloatArray) -> tuple[IntArray, str, IntArray, str]:
    """Return each slice's level of torque and part of the recording, and how both were found.

    Parts are stretches of time, as neighbours in time are not independent.
    """
    series = place_in_series(torque)
    if series is not None:
        level, repeat = series
        repeats = f"by place in {int(repeat.max()) + 1} repeated series"
        return level, repeats, repeat, "one repeat of the series left out at a time"
    n_levels = min(_GROUPS, max(MIN_SLICES, len(torque) // 3), len(np.unique(torque)))
    n_parts = min(_STRETCHES, len(torque))
    return (
        kmeans_groups(torque, n_levels),
        f"by k-means of the torques into {n_levels} (no repeated series found)",
        (np.arange(len(torque)) * n_parts // len(torque)).astype(np.int64),
        f"one of {n_parts} stretches of time left out at a time",
    )


def _cross_validated_rmse(sigma: FloatArray, torque: FloatArray, parts: IntArray) -> float | None:
    errors = np.empty_like(torque)
    for part in np.unique(parts):
        out = parts == part
        fit = _curve(sigma[~out], torque[~out], _TORQUE_DEGREE)
        if fit is None:
            return None
        errors[out] = fit(sigma[out]) - torque[out]
    return float(np.sqrt(np.mean(errors**2)))


def _curve(x: FloatArray, y: FloatArray, degree: int) -> Polynomial | None:
    """Return the fit of y over x, None where the points leave nothing to judge it by."""
    enough = len(np.unique(x)) > degree and len(x) > degree + 1
    return Polynomial.fit(x, y, degree) if enough else None


def place_in_series(values: FloatArray) -> tuple[IntArray, IntArray] | None:
    """Return the level and the repeat (n,) of values, in order of time, that repeat one rising series; else None.

    Negative values rise away from 0. A series restarts where the value falls by more than half of the whole range.
    There must be two series, of three levels or more. The longest series have all levels, and their means define the
    levels. A shorter series keeps its order; its values go to the levels with the least sum of squared differences.
    """
    values = sign_of_loads(values) * values
    falls = np.diff(values) < -_RESTART_FRACTION * np.ptp(values)
    repeat = np.concatenate([[0], np.cumsum(falls)]).astype(np.int64)
    length = np.bincount(repeat)
    steps = np.diff(values)[~falls]
    if len(length) < 2 or length.max() < 3 or np.mean(steps > 0) < _RISING_FRACTION:
        return None
    complete = [values[repeat == number] for number in np.flatnonzero(length == length.max())]
    means = np.mean(complete, axis=0)
    level = np.empty(len(values), dtype=np.int64)
    for number in range(len(length)):
        members = np.flatnonzero(repeat == number)
        level[members] = np.sort(linear_sum_assignment((values[members, None] - means) ** 2)[1])
    return level, repeat


def kmeans_groups(values: FloatArray, n_groups: int) -> IntArray:
    """Return the group of each of (n,) values, numbered from 0 by rising mean: the k-means groups of least squares.

    Groups of numbers are intervals, so the best ends are found exactly (Wang and Song 2011, dynamic programming).
    `n_groups` may be at most the number of distinct values.
    """
    distinct, of_value, weight = np.unique(values, return_inverse=True, return_counts=True)
    centred, n = distinct - distinct.mean(), len(distinct)
    sums = (np.append(0.0, np.cumsum(weight * centred**power)) for power in (0, 1, 2))
    count, total, squares = (running_sum[:, None] - running_sum for running_sum in sums)
    # squared[j, i]: the sum of squares around the mean of the values from i to before j.
    squared = np.where(count > 0, squares - total**2 / np.maximum(count, 1), np.inf)
    # least[j]: the least sum of squares of the first j values in the groups so far; begin[g][j] begins the last group.
    least, begin = np.where(np.arange(n + 1) == 0, 0.0, np.inf), []
    for _ in range(n_groups):
        cost = least + squared
        begin.append(cost.argmin(axis=1))
        least = cost.min(axis=1)
    groups, end = np.empty(n, dtype=np.int64), n
    for group in reversed(range(n_groups)):
        start = int(begin[group][end])
        groups[start:end], end = group, start
    return groups[of_value]


def group_means(values: FloatArray, groups: IntArray) -> FloatArray:
    """Return the mean of (n,) values in each group, by rising number."""
    means: FloatArray = np.bincount(groups, values) / np.bincount(groups)
    return means
