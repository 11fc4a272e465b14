"""The same match as from the whole heatmap, from a few of its cells: cells that cannot be the maximum are not scored.

A compressed bank bounds the scores of groups of cells, then of cells. Cells bounded below a score that another cell
reaches are dropped; the rest is scored in float64. The compression decides the time, never the result.

Every unit signal b of the bank is split as b = Φ c + d, with Φ (n × r) an orthonormal basis fitted to the bank, d
orthogonal to it and ‖d‖ = ρ. For a frame y with g = Φᵀ y and t = ‖y − Φ g‖, Cauchy and Schwarz give

    b·y = c·g + d·(y − Φ g) ≤ c·g + ρ t,

and for all cells with c within a radius e of a centre m, b·y ≤ m·g + e ‖g‖ + ρ t. The first direction of Φ is the mean
signal. It is nowhere negative, and neither are the frames, so g₁ ≥ 0. With the largest c₁ of the cells in place of m₁,
e and ‖g‖ need only cover the other directions, where a frame is far shorter. A bound is the product of a row (m, e, ρ)
and a column (g, ‖g‖, t): one matrix product in float32 gives many bounds.
"""

import heapq
import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, linalg

from shearloop.bank.arrays import BoolArray, Float32Array, FloatArray, IntArray
from shearloop.bank.matching import (
    RUNNER_UP_RADIUS,
    TIE,
    Match,
    Matcher,
    ReferenceMatcher,
    ZeroLagMatcher,
    in_chunks,
    unit_magnitudes,
)

# Number of cells, spread over the bank, that the basis is fitted to: neighbouring cells are alike.
_FITTED_CELLS = 1024
# A signal has this many times as many numbers as there are cells: an SVD of these takes a tenth of the time that the
# eigenvectors of their Gram matrix take.
_FEW_CELLS = 4
# Cells in memory at a time while a bank is compressed.
_COMPRESSED_CELLS = 128
# Numbers per cell: few to find the neighbourhood, more to separate its cells.
COARSE_RANK = 24
FINE_RANK = 96
# Number of groups, and the mean number of cells in a group at least.
_N_GROUPS = 512
_MIN_GROUP_CELLS = 4
# Rounding of float32 in a bound, and in the square of t. Sums of 98 products and a transform of 1792 values of norm 1
# lose 5e-6 by the usual estimates; 3e-7 is observed.
ROUNDING = 2e-5
_SQUARE_ROUNDING = 4e-6
# Rounding of float64 in the square of ρ.
_SQUARE_ROUNDING_64 = 1e-12
# The runner-up may be this much worse than the best cell at lag 0 before groups are bounded a second time.
_SLACK = 0.01
# More bounds than this (16 MB) are not computed: all cells and lags remain.
_MAX_BOUNDS = 1 << 22


class Candidates(NamedTuple):
    """Cells (n,) that may win, bounds of their scores (n,), and the (m, n) frame at the lags that matter."""

    cells: IntArray
    bounds: Float32Array
    frames: FloatArray

    def where(self, keep: BoolArray) -> "Candidates":
        """Return those that are among some of the bank's cells."""
        kept = keep[self.cells]
        return Candidates(self.cells[kept], self.bounds[kept], self.frames)


@dataclass(frozen=True, slots=True, eq=False)
class CompressedBank:
    """Rows of bounds; a bound is a row times a column of `columns`.

    basis (R, n), most important directions first; fine (n, R + 2) and coarse (n, r + 2) rows of the n cells; groups
    (m, r + 2), the rows of groups of cells. overlaps (2n,) bound the norm of a signal's overlap with a frame at the
    lags from −n up. Cell i belongs to group group_of[i]; members[j] are the cells of group j, and centres[j] is the
    cell nearest to its centre.
    """

    basis: Float32Array
    fine: Float32Array
    coarse: Float32Array
    groups: Float32Array
    overlaps: FloatArray
    group_of: IntArray
    members: tuple[IntArray, ...]
    centres: IntArray


def compress(unit_signals: Callable[[IntArray], FloatArray], cells: IntArray) -> CompressedBank:
    """Compress the unit signals of n cells; `unit_signals` returns the (m, n) signals of some of them."""
    basis = _basis(unit_signals, cells[:: max(len(cells) // _FITTED_CELLS, 1)])
    n = len(basis)
    found = []
    least, most = np.ones(n), np.zeros(n)
    for some in in_chunks(cells, _COMPRESSED_CELLS):
        part = unit_signals(some)
        found.append(part @ basis)
        energy = np.cumsum(np.square(part), axis=1)
        least, most = np.minimum(least, energy.min(axis=0)), np.maximum(most, energy.max(axis=0))
    numbers = np.vstack(found)
    coarse = _cell_rows(numbers[:, :COARSE_RANK])
    members, rows = zip(*_partition(coarse, min(_N_GROUPS, len(cells) // _MIN_GROUP_CELLS)), strict=True)
    group_of, centres = np.empty(len(cells), dtype=np.int64), []
    for group, chosen in enumerate(members):
        points = coarse[chosen, :-2]
        group_of[chosen] = group
        centres.append(int(chosen[np.argmin(_squared_distances(points, points.mean(axis=0)))]))
    return CompressedBank(
        basis=np.ascontiguousarray(basis.T, dtype=np.float32),
        fine=_cell_rows(numbers),
        coarse=coarse,
        groups=np.array(rows),
        overlaps=np.sqrt(np.maximum(np.concatenate([1 - least[::-1], most[::-1]]), 0.0)),
        group_of=group_of,
        members=members,
        centres=np.array(centres),
    )


def _basis(unit_signals: Callable[[IntArray], FloatArray], fitted: IntArray) -> FloatArray:
    """Return the orthonormal basis (n, r) of some cells: their mean signal, then the main directions of the rest."""
    n = unit_signals(fitted[:1]).shape[1]
    rank = min(FINE_RANK, len(fitted), n)
    # The mean gets the largest weight of all directions, so that it comes first.
    weight = 2 * len(fitted)
    if _FEW_CELLS * len(fitted) <= n:
        signals = unit_signals(fitted)
        total = signals.sum(axis=0)
        mean = total / np.linalg.norm(total)
        _, _, descending = np.linalg.svd(
            np.vstack([np.sqrt(weight) * mean, signals - np.outer(signals @ mean, mean)]), full_matrices=False
        )
        return np.column_stack([mean, descending[1:rank].T])
    gram, total = np.zeros((n, n)), np.zeros(n)
    for some in in_chunks(fitted, _COMPRESSED_CELLS):
        part = unit_signals(some)
        gram += part.T @ part
        total += part.sum(axis=0)
    mean = total / np.linalg.norm(total)
    at_mean = gram @ mean
    # Remove the mean from the Gram matrix and put it back with its weight.
    above = mean @ at_mean + weight
    gram -= np.outer(mean, at_mean) + np.outer(at_mean, mean) - above * np.outer(mean, mean)
    _, ascending = linalg.eigh(gram, subset_by_index=[n - rank, n - 1])
    return np.column_stack([mean, ascending[:, -2::-1]])


def columns(parts: NDArray[np.floating[Any]], squared_norms: FloatArray) -> Float32Array:
    """Return the (r + 2, n) columns of n frames y: parts (r, n) are Φᵀ y, squared_norms (n,) are ‖y‖²."""
    across = np.einsum("ij,ij->j", parts[1:], parts[1:])
    found = np.empty((len(parts) + 2, parts.shape[1]), dtype=np.float32)
    found[:-2] = parts
    found[-2] = np.sqrt(across)
    found[-1] = np.sqrt(np.maximum(squared_norms - parts[0] ** 2 - across, 0.0) + _SQUARE_ROUNDING)
    return found


def _cell_rows(numbers: FloatArray) -> Float32Array:
    rows = np.zeros((len(numbers), numbers.shape[1] + 2), dtype=np.float32)
    rows[:, :-2] = numbers
    rows[:, -1] = np.sqrt(np.maximum(1 - np.einsum("ij,ij->i", numbers, numbers), 0.0) + _SQUARE_ROUNDING_64)
    return rows


def _group_row(cells: Float32Array) -> Float32Array:
    """Return the row that bounds all of some cells' rows."""
    centre = cells[:, :-2].mean(axis=0)
    # The largest along the first direction and of ρ.
    row: Float32Array = cells.max(axis=0)
    row[1:-2] = centre[1:]
    row[-2] = math.sqrt(_squared_distances(cells[:, 1:-2], centre[1:]).max())
    return row


def _partition(cells: Float32Array, size: int) -> list[tuple[IntArray, Float32Array]]:
    """Split the cells into as many groups as `size`, or fewer where cells are alike.

    Returns every group's cells and the row that bounds them. The group of the largest radius is split in two, between
    the cell farthest from its centre and the cell farthest from that one.
    """
    order = count()

    def entry(chosen: IntArray) -> tuple[float, int, IntArray, Float32Array]:
        row = _group_row(cells[chosen])
        radius = float(row[-2])
        return -radius if radius > ROUNDING else 0.0, next(order), chosen, row

    heap = [entry(np.arange(len(cells)))]
    while len(heap) < size and heap[0][0] < 0:
        _, _, chosen, _ = heapq.heappop(heap)
        points = cells[chosen, :-2]
        one = points[np.argmax(_squared_distances(points, points.mean(axis=0)))]
        other = points[np.argmax(_squared_distances(points, one))]
        nearer = np.einsum("ij,j->i", points - (one + other) / 2, one - other) > 0
        heapq.heappush(heap, entry(chosen[nearer]))
        heapq.heappush(heap, entry(chosen[~nearer]))
    return [(chosen, row) for _, _, chosen, row in heap]


def _squared_distances(points: Float32Array, place: Float32Array) -> Float32Array:
    apart = points - place
    squares: Float32Array = np.einsum("ij,ij->i", apart, apart)
    return squares


class AllLagsBounds:
    """A unit frame (n,), bounded at all lags for a matcher: lags are dropped first, then groups, then cells.

    A lag is the place in the padded frame where the shifted frame begins: n for no shift. `reached` is a promising
    cell and a score that it reaches.
    """

    def __init__(self, matcher: "PrunedMatcher", frame: FloatArray) -> None:
        self._matcher, bank = matcher, matcher.compressed
        n = frame.size
        self._padded = np.zeros(3 * n)
        self._padded[n : 2 * n] = frame
        # The frame at all lags, as a view: only rows that are chosen take memory.
        self._shifted = np.lib.stride_tricks.sliding_window_view(self._padded, n)
        # The squared norm of the frame's overlap with the channels at each lag.
        self._energies = np.zeros(2 * n)
        np.cumsum((frame * frame)[:-1], out=self._energies[1:n])
        self._energies[n:] = np.maximum(1.0 - self._energies[:n], 0.0)
        at_0 = bank.basis[:COARSE_RANK] @ frame.astype(np.float32)
        cell = self._likeliest(bank.members[int((bank.groups[:, :-2] @ at_0).argmax())], at_0)
        reached = cell, matcher.score(cell, frame[None])
        self._bound_groups(reached[1] - _SLACK)
        self.reached = max(reached, self.seed() or reached, key=itemgetter(1))

    def seed(self, outside: BoolArray | None = None) -> tuple[int, float] | None:
        """Return a promising cell among those (n,) outside a neighbourhood, and a score that it reaches.

        It has the highest estimate in the group of the highest bound. None where no group's centre lies outside.
        """
        bank, bounds = self._matcher.compressed, self._group_bounds
        if outside is not None:
            bounds = np.where(outside[bank.centres, None], bounds, -np.inf)
        group, lag = divmod(int(bounds.argmax()), bounds.shape[1])
        if bounds[group, lag] == -np.inf:
            return None
        cells = bank.members[group]
        if outside is not None:
            cells = cells[outside[cells]]
        cell = self._likeliest(cells, self._columns[:-2, lag])
        return cell, self._matcher.score(cell, self._frames(self._lags[lag, None]))

    def candidates(self, score: float) -> Candidates:
        """Return the cells that may reach a score: groups are bounded first, then cells."""
        if score < self._bounded_down_to:
            self._bound_groups(score)
        bank, least = self._matcher.compressed, np.float32(score - ROUNDING)
        (at,) = (self._highest >= least).nonzero()
        alive = (self._group_bounds.take(at, axis=1) >= least).any(axis=1)
        cells = np.flatnonzero(alive.take(bank.group_of))
        if len(cells) * len(at) > _MAX_BOUNDS:
            return Candidates(cells, np.full(len(cells), np.inf, dtype=np.float32), self._frames(self._lags[at]))
        reach = least <= self._columns.take(at, axis=1).T @ bank.coarse.take(cells, axis=0).T
        cells, at = cells[reach.any(axis=0)], at[reach.any(axis=1)]
        lags = self._lags[at]
        frames = self._frames(lags)
        finest = columns(bank.basis @ frames.T.astype(np.float32), self._energies.take(lags))
        return Candidates(cells, (finest.T @ bank.fine.take(cells, axis=0).T).max(axis=0), frames)

    def _likeliest(self, cells: IntArray, parts: Float32Array) -> int:
        return int(cells[np.argmax(self._matcher.compressed.coarse.take(cells, axis=0)[:, :-2] @ parts)])

    def _bound_groups(self, score: float) -> None:
        """Bound the groups at all lags that let any cell reach the score."""
        bank, n = self._matcher.compressed, self._matcher.n_channels
        self._bounded_down_to = score
        overlap = bank.overlaps * np.sqrt(self._energies) >= score - ROUNDING
        first, end = int(overlap.argmax()), 2 * n - int(overlap[::-1].argmax())
        single = self._padded[n : 2 * n].astype(np.float32)
        parts = fft.irfft(fft.rfft(single, 2 * n) * self._matcher.spectra, 2 * n)
        self._lags = np.arange(first, end)
        numbers = np.concatenate([parts[:, n + first :], parts[:, : end - n]], axis=1)
        self._columns = columns(numbers, self._energies[first:end])
        self._group_bounds = bank.groups @ self._columns
        self._highest = self._group_bounds.max(axis=0)

    def _frames(self, lags: IntArray) -> FloatArray:
        return self._shifted[lags]


class _PruningMatcher(Matcher):
    """The search, and the exact scores of the candidates that it leaves."""

    def __init__(self, signals: Float32Array, valid: BoolArray, k_grid: FloatArray, sigma_grid: FloatArray) -> None:
        """Compress the bank, in about half a second for 10⁴ cells; arguments and errors as `Matcher`.

        A valid cell without signal raises MatchingError here, not at the first frame.
        """
        super().__init__(signals, valid, k_grid, sigma_grid)
        self.compressed = compress(self._unit_signals, self._cells)
        self._norms = np.concatenate(
            [np.linalg.norm(self._magnitudes(cells), axis=1) for cells in in_chunks(self._cells)]
        )
        self._row, self._column = np.divmod(self._cells, valid.shape[1])

    def match(self, difference: ArrayLike) -> Match:
        """Return what `best_match` finds in the heatmap of one (n,) difference, at a fraction of its cost.

        Raises MatchingError as `heatmap` does.
        """
        (frame,) = unit_magnitudes(np.asarray(difference)[None], self.n_channels)
        return self._search(frame)

    @abstractmethod
    def _search(self, frame: FloatArray) -> Match: ...

    def _best_candidate(self, candidates: Candidates, reached: float) -> tuple[int, float]:
        """Return the cell of the highest score, the lowest of those that tie, and the score.

        One of the candidates must reach the score `reached`.
        """
        likeliest = int(candidates.cells[candidates.bounds.argmax()])
        reached = max(reached, self.score(likeliest, candidates.frames))
        cells = candidates.cells[candidates.bounds >= reached - ROUNDING]
        scores = np.concatenate([self.highest_scores(some, candidates.frames) for some in in_chunks(cells)])
        winner = int(np.argmax(scores >= scores.max() - TIE))
        return int(cells[winner]), min(float(scores[winner]), 1.0)

    def highest_scores(self, cells: IntArray, frames: FloatArray) -> FloatArray:
        """Return the highest scores of cells at the lags of (m, n) frames."""
        return np.asarray((frames @ self._magnitudes(self._cells[cells]).T).max(axis=0) / self._norms[cells])

    def score(self, cell: int, frames: FloatArray) -> float:
        """Return a cell's highest score at the lags of (m, n) frames."""
        magnitudes = np.abs(self._signals[self._cells[cell]], dtype=np.float64)
        return float((frames @ magnitudes).max() / self._norms[cell])

    def _match(self, best: tuple[int, float], runner_up: tuple[int, float] | None) -> Match:
        row, column = cell = self._place(best[0])
        return Match(
            k=float(self.k_grid[row]),
            sigma=float(self.sigma_grid[column]),
            cell=cell,
            score=best[1],
            runner_up=None if runner_up is None else runner_up[1],
            runner_up_cell=None if runner_up is None else self._place(runner_up[0]),
        )

    def _place(self, cell: int) -> tuple[int, int]:
        return int(self._row[cell]), int(self._column[cell])

    def _outside(self, cell: int, radius: int) -> BoolArray:
        """Return which cells (n,) are more than `radius` away from one, in k or in σ."""
        row, column = self._place(cell)
        away: BoolArray = np.maximum(np.abs(self._row - row), np.abs(self._column - column)) > radius
        return away


class PrunedZeroLagMatcher(_PruningMatcher, ZeroLagMatcher):
    """Matches at lag 0 alone. All cells are bounded at once: one lag takes few operations per cell."""

    def _search(self, frame: FloatArray) -> Match:
        bounds = self.bounds(frame)
        best = self._best_candidate(bounds, 0.0)
        rest = bounds.where(self._outside(best[0], RUNNER_UP_RADIUS))
        return self._match(best, self._best_candidate(rest, 0.0) if len(rest.cells) else None)

    def bounds(self, frame: FloatArray) -> Candidates:
        """Return all cells with their bounds for a unit frame (n,)."""
        bank = self.compressed
        parts = (bank.basis @ frame.astype(np.float32))[:, None]
        bounds = bank.fine @ columns(parts, np.ones(1))[:, 0]
        return Candidates(np.arange(len(bounds)), bounds, frame[None])


class PrunedMatcher(_PruningMatcher, ReferenceMatcher):
    """Matches at all lags."""

    @cached_property
    def spectra(self) -> NDArray[np.complex64]:
        """The conjugate transforms (r, n + 1) of the basis's first directions."""
        return np.asarray(np.conj(fft.rfft(self.compressed.basis[:COARSE_RANK], 2 * self.n_channels)))

    def _search(self, frame: FloatArray) -> Match:
        bounds = AllLagsBounds(self, frame)
        near, reached = bounds.reached
        # A cell outside at twice the radius is outside the peak of every cell in this peak.
        far, least = bounds.seed(self._outside(near, 2 * RUNNER_UP_RADIUS)) or (-1, 0.0)
        candidates = bounds.candidates(min(reached, least))
        best = self._best_candidate(candidates, reached)
        outside = self._outside(best[0], RUNNER_UP_RADIUS)
        if far >= 0 and not outside[far]:
            _, least = bounds.seed(outside) or (-1, 0.0)
            candidates = bounds.candidates(least)
        rest = candidates.where(outside)
        return self._match(best, self._best_candidate(rest, least) if len(rest.cells) else None)
