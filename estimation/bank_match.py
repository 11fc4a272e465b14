"""A bank's match of a difference: the paper's, and a refined one.

`PaperMatcher` takes the largest cross-correlation over all lags. `RefinedMatcher` uses no lags. The electrode numbering
is found once, at calibration. Frame and bank are smoothed alike along the channels, as the paper did with its
cylinders, the position is refined between grid cells, and the amplitude is kept.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.channels import ChannelTable, smoothed_along_channels
from shearloop.bank.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher

# Searches a whole bank. It has no state, so sessions may share one.
BankSearch: TypeAlias = PrunedMatcher | PrunedZeroLagMatcher
# A match is ambiguous if a cell scores within the first number of the best and lies further away in k (an eighth of
# the fingertip) or in sigma (this ratio).
_ALIKE, _FAR_K_CM, _FAR_SIGMA = 0.002, 0.55, 1.5
# A cell's weight falls by e with this drop of its score. Chosen on synthetic and recorded slices: from 0.0003 to 0.001
# the error stays the same and the largest jump falls to a fifth.
_SCORE_SCALE, _MIN_WEIGHT = 0.0005, 1e-9
# A weighted mean finds a sampled Gaussian peak if its standard deviation is at least 0.6 cells, so weights reach this
# share of the drop to the next cell. On grids with a larger drop than _COARSE a parabola through the maximum is used.
_RESOLVED, _COARSE = 0.7, 0.005
# Numberings correlate alike, by the symmetry of the fingertip, within this difference.
_SYMMETRIC = 0.01


@dataclass(frozen=True, slots=True)
class BankMatch:
    """Position of a difference in the bank; ambiguous if another position far away fits as well."""

    k: float
    sigma: float
    log_amplitude: float
    score: float
    runner_up: float | None
    ambiguous: bool

    @property
    def features(self) -> FloatArray:
        """Features of torque and diameter."""
        return np.array([self.k, self.sigma, self.sigma**2, self.log_amplitude])


class PaperMatcher:
    """The paper's method: the heatmap's maximum, by default over all lags, found without the rest of the heatmap."""

    def __init__(self, bank: Bank | BankSearch) -> None:
        """Take the bank, or a matcher on it that several fingertips share."""
        self._matcher = PrunedMatcher.from_bank(bank) if isinstance(bank, Bank) else bank

    def match(self, difference: FloatArray) -> BankMatch:
        """Return the position of the heatmap's maximum for a (c,) difference of any sign."""
        found = self._matcher.match(difference)
        size = float(np.log(np.linalg.norm(difference)))
        return BankMatch(found.k, found.sigma, size, found.score, found.runner_up, ambiguous=False)


@dataclass(frozen=True, slots=True)
class ElectrodeNumbering:
    """The model's electrode for each of the board's: e becomes rotation + e, or rotation − e when reflected.

    score is the correlation of the idle frame with the homogeneous voltages.
    """

    rotation: int
    reflected: bool
    score: float = 1.0

    def model_channels(self, table: ChannelTable) -> IntArray:
        """Return (c,) the number of the model's channel for each of the board's channels."""
        sink, source, positive, negative = table.electrodes.T
        turn = -1 if self.reflected else 1

        def electrode(number: IntArray) -> IntArray:
            return np.asarray((self.rotation + turn * number) % table.n_electrodes)

        # A reflected pair is driven and measured the other way round; opposite electrodes stay opposite.
        first = electrode(negative if self.reflected else positive)
        driven = electrode(source if self.reflected and table.injection == "adjacent" else sink)
        position = np.full((table.n_electrodes, table.n_electrodes), -1)
        position[sink, positive] = np.arange(table.n_channels)
        return np.asarray(position[driven, first])


NOT_TURNED = ElectrodeNumbering(0, reflected=False)


def find_numberings(idle: FloatArray, homogeneous: FloatArray, table: ChannelTable) -> list[ElectrodeNumbering]:
    """Return the numberings under which a (c,) idle frame correlates best with the homogeneous voltages, best first.

    A symmetric fingertip has several: half a turn changes no magnitude of a rectangle's, any turn none of a disc's.
    """
    model, measured = np.abs(homogeneous), np.abs(idle)
    found = []
    for reflected, rotation in product((False, True), range(table.n_electrodes)):
        turned = ElectrodeNumbering(rotation, reflected)
        score = float(np.corrcoef(model[turned.model_channels(table)], measured)[0, 1])
        found.append(replace(turned, score=score))
    best = max(found, key=lambda numbering: (round(numbering.score, 9), -numbering.rotation))
    half_turn = best.reflected, (best.rotation + table.n_electrodes // 2) % table.n_electrodes
    alike = [
        numbering
        for numbering in found
        if numbering.score > best.score - _SYMMETRIC or (numbering.reflected, numbering.rotation) == half_turn
    ]
    return sorted(alike, key=lambda numbering: numbering is not best)


def resolve_symmetry(numberings: list[ElectrodeNumbering], touch: FloatArray, bank: Bank) -> ElectrodeNumbering:
    """Return the numbering under which a touch matches best, the first unless another is clearly better.

    touch (c,) is the change of the idle frame by a grip, in volts.
    """
    scores = [RefinedMatcher(bank, numbering).match(touch).score for numbering in numberings]
    best = int(np.argmax(scores))
    return numberings[best] if scores[best] > scores[0] + _ALIKE else numberings[0]


class RefinedMatcher:
    """The refined match: no lags, fixed numbering, smoothed alike, mean of the cells that fit nearly alike."""

    def __init__(self, bank: Bank, numbering: ElectrodeNumbering, *, mean_of_alike: bool = True) -> None:
        """Take the bank and the numbering; without `mean_of_alike` a parabola refines the maximum."""
        self._coarse = _COARSE if mean_of_alike else -np.inf
        self._k_grid, self._sigma_grid = bank.k_grid, bank.sigma_grid
        self._valid = np.asarray(bank.valid).ravel()
        signals = bank.signals.reshape(-1, bank.table.n_channels)[self._valid]
        signals = np.abs(signals[:, numbering.model_channels(bank.table)])
        smooth = smoothed_along_channels(signals.astype(np.float64))
        self._norms = np.linalg.norm(smooth, axis=1)
        self._shapes = (smooth / self._norms[:, None]).astype(np.float32)
        self._cells = np.flatnonzero(self._valid)

    def match(self, difference: FloatArray) -> BankMatch:
        """Return the refined position of the best cell for a (c,) difference of any sign."""
        (x,) = smoothed_along_channels(np.abs(difference)[None])
        norm = float(np.linalg.norm(x))
        scores = np.full(len(self._valid), -np.inf)
        scores[self._cells] = self._shapes @ (x / norm).astype(np.float32)
        heatmap = scores.reshape(len(self._k_grid), len(self._sigma_grid))
        row, column = (int(i) for i in np.unravel_index(int(np.argmax(heatmap)), heatmap.shape))
        best = float(heatmap[row, column])
        if (drop := _drop(heatmap, row, column)) <= self._coarse:
            width = max(_SCORE_SCALE, _RESOLVED * drop)
            k, sigma, amplitude = self._weighted_mean(scores[self._cells], best, norm, width)
        else:
            k = parabola_top(heatmap[:, column], row, self._k_grid)
            sigma = parabola_top(heatmap[row], column, self._sigma_grid)
            cell = int(np.searchsorted(self._cells, row * heatmap.shape[1] + column))
            amplitude = float(np.log(norm * best / self._norms[cell]))
        ratio = np.abs(np.log(self._sigma_grid / self._sigma_grid[column]))
        far = (np.abs(self._k_grid - self._k_grid[row]) > _FAR_K_CM)[:, None] | (ratio > np.log(_FAR_SIGMA))
        runner_up = float(heatmap[far].max()) if far.any() and np.isfinite(heatmap[far]).any() else None
        return BankMatch(k, sigma, amplitude, best, runner_up, runner_up is not None and best - runner_up < _ALIKE)

    def _weighted_mean(self, scores: FloatArray, best: float, norm: float, width: float) -> tuple[float, float, float]:
        """Return mean k, σ and log amplitude of the cells that score nearly as well as the best.

        The maximum jumps between ridges for the smallest change of a frame; a mean with weights from the scores does
        not (docs/charts.md).
        """
        weights = np.exp((scores - best) / width)
        near = np.flatnonzero(weights > _MIN_WEIGHT)
        weights = weights[near] / weights[near].sum()
        row, column = np.divmod(self._cells[near], len(self._sigma_grid))
        k = float(weights @ self._k_grid[row])
        sigma = float(np.exp(weights @ np.log(self._sigma_grid[column])))
        return k, sigma, float(weights @ np.log(norm * scores[near] / self._norms[near]))


BankMatcher: TypeAlias = PaperMatcher | RefinedMatcher


def parabola_top(scores: FloatArray, i: int, grid: FloatArray) -> float:
    """Return the top of a parabola through a maximum and its neighbours."""
    if i in (0, len(grid) - 1) or not np.isfinite(scores[[i - 1, i + 1]]).all():
        return float(grid[i])
    bend = float(scores[i - 1] - 2 * scores[i] + scores[i + 1])
    shift = 0.5 * float(scores[i - 1] - scores[i + 1]) / bend if bend < 0 else 0.0
    return float(grid[i] + shift * (grid[1] - grid[0]))


def _drop(heatmap: FloatArray, row: int, column: int) -> float:
    """Return by how much the neighbours of a heatmap's maximum score lower, along the steeper of its two axes."""
    around = np.pad(heatmap, 1, constant_values=-np.inf)[row : row + 3, column : column + 3]
    drops = [around[1, 1] - pair[np.isfinite(pair)] for pair in (around[[0, 2], 1], around[1, [0, 2]])]
    return max((float(drop.mean()) for drop in drops if len(drop)), default=0.0)
