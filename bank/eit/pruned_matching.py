"""The same match as from the whole heatmap, from a few of its cells: cells that cannot be the maximum are not scored.

A compressed bank (`compression`) bounds the scores of groups of cells, then of cells. Cells bounded below a score that
another cell reaches are dropped; the rest is scored in float64. The compression decides the time, never the result.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from shearloop.bank.arrays import BoolArray, Float32Array, FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.compression import (
    COARSE_RANK,
    ROUNDING,
    SEED_LEVEL,
    CompressedBank,
    columns,
    compress,
)
from shearloop.bank.eit.matching import (
    CHUNK_CELLS,
    RUNNER_UP_RADIUS,
    TIE,
    Match,
    Matcher,
    ReferenceMatcher,
    ZeroLagMatcher,
    unit_magnitudes,
)

# Rounding of a sum of 896 products in float64; where a tie hangs on less, the reference decides. And in float32.
_ROUNDING_64 = 1e-14
_ROUNDING_32 = 6e-5
# With more lags than this, a transform costs less per cell than the products.
_FEW_LAGS = 128
# With fewer cells, a first look in float32 costs more than it saves.
_FEW_CELLS = 48
# With fewer cells, the whole heatmap at all lags is faster than pruning.
MIN_PRUNED_CELLS = 300
# Transform lengths: the shorter where only small lags can matter.
_LENGTHS = (1280, 2 * N_CHANNELS)
_CHANNELS = np.arange(N_CHANNELS)
# Lags at which groups are searched for a cell with a high score.
_SEED_LAGS = 8
# The runner-up may be this much worse than the best cell at lag 0 before groups are bounded a second time.
_SLACK = 0.01
# More bounds than this (16 MB) are not computed: all cells and lags remain.
_MAX_BOUNDS = 1 << 22

# The conjugate transforms of the basis's first directions, (r, n // 2 + 1), by length n.
Spectra = Mapping[int, NDArray[np.complex64]]


class _UndecidedError(Exception):
    """Rounding of float64 decides which cells tie."""


class Candidates(NamedTuple):
    """Cells (n,) that may win, bounds of their scores (n,), and the (m, 896) frame at the lags that matter."""

    cells: IntArray
    bounds: Float32Array
    frames: FloatArray


class ZeroLagBounds:
    """A unit frame (896,), bounded at lag 0 for all cells; frames (1, 896) is that frame."""

    def __init__(self, bank: CompressedBank, frame: FloatArray) -> None:
        self._bank, self.frames = bank, frame[None]
        parts = (bank.basis @ frame.astype(np.float32))[:, None]
        self._fine = columns(parts, np.ones(1))[:, 0]
        self._bounds = bank.coarse @ columns(parts[:COARSE_RANK], np.ones(1))[:, 0]

    def leave_out(self, cells: BoolArray) -> None:
        """Exclude some of all cells (n,) from now on."""
        self._bounds[cells] = -np.inf

    def seed(self) -> int:
        """Return the cell of the highest bound."""
        return int(self._bounds.argmax())

    def candidates(self, score: float) -> Candidates:
        """Return the cells that may reach a score."""
        cells = np.flatnonzero(self._bounds >= score - ROUNDING)
        return Candidates(cells, self._bank.fine.take(cells, axis=0) @ self._fine, self.frames)


class AllLagsBounds:
    """A unit frame (896,), bounded at all lags: lags are dropped first, then groups, then cells.

    A lag is the place in the padded frame where the shifted frame begins: 896 for no shift. `score(cell, frames)`
    returns the highest score of a cell at (m, 896) frames. `reached` is a promising cell and a score that it reaches.
    """

    def __init__(
        self, bank: CompressedBank, spectra: Spectra, frame: FloatArray, score: Callable[[int, FloatArray], float]
    ) -> None:
        self._bank, self._spectra, self._score = bank, spectra, score
        self._single = frame.astype(np.float32)
        self._padded = np.zeros(3 * N_CHANNELS)
        self._padded[N_CHANNELS : 2 * N_CHANNELS] = frame
        # The squared norm of the frame's overlap with the channels at each lag.
        self._energies = np.zeros(2 * N_CHANNELS)
        np.cumsum((frame * frame)[:-1], out=self._energies[1:N_CHANNELS])
        self._energies[N_CHANNELS:] = np.maximum(1.0 - self._energies[:N_CHANNELS], 0.0)
        self._centres = bank.levels[SEED_LEVEL].rows[:, :-2]
        at_0 = bank.basis[: self._centres.shape[1]] @ self._single
        cell = self._likeliest(bank.members[int((self._centres @ at_0).argmax())], at_0)
        reached = cell, score(cell, frame[None])
        self._bound_groups(reached[1] - _SLACK)
        # The likeliest lags (m,), the frame's numbers there (r, m), and the groups' estimates (m, n).
        n_seeds = min(_SEED_LAGS, len(self._lags))
        likeliest = np.argpartition(self._highest, -n_seeds)[-n_seeds:]
        at_lags = self._columns[:-2, likeliest]
        self._seeds = self._lags[likeliest], at_lags, at_lags.T @ self._centres.T
        self.reached = max(reached, self.seed() or reached, key=itemgetter(1))

    def seed(self, outside: BoolArray | None = None) -> tuple[int, float] | None:
        """Return a promising cell among those (n,) outside a neighbourhood, and a score that it reaches.

        It has the highest estimate in the group of the highest estimate, at the likeliest lags. None where none is
        found at once.
        """
        lags, at_lags, estimates = self._seeds
        if outside is not None:
            estimates = np.where(outside[self._bank.centres], estimates, -np.inf)
        lag, group = divmod(int(np.argmax(estimates)), estimates.shape[1])
        if estimates[lag, group] == -np.inf:
            return None
        cells = self._bank.members[group]
        if outside is not None:
            cells = cells[outside[cells]]
        cell = self._likeliest(cells, at_lags[:, lag])
        return cell, self._score(cell, self._frames(lags[lag, None]))

    def candidates(self, score: float) -> Candidates:
        """Return the cells that may reach a score: groups are bounded first, then their parts, then cells."""
        if score < self._bounded_down_to:
            self._bound_groups(score)
        bank, least = self._bank, np.float32(score - ROUNDING)
        (at,) = (self._highest >= least).nonzero()
        alive = (self._group_bounds.take(at, axis=1) >= least).any(axis=1)
        for level in bank.levels[1:]:
            groups = np.flatnonzero(alive.take(level.part_of))
            alive = np.zeros(len(level.rows), dtype=np.bool_)
            alive[groups] = True
            if len(groups) * len(at) <= _MAX_BOUNDS:
                reach = least <= self._columns.take(at, axis=1).T @ level.rows.take(groups, axis=0).T
                alive[groups] = reach.any(axis=0)
                at = at[reach.any(axis=1)]
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
        return int(cells[np.argmax(self._bank.coarse.take(cells, axis=0)[:, :-2] @ parts)])

    def _bound_groups(self, score: float) -> None:
        """Bound the first level's groups at all lags that let any cell reach the score."""
        self._bounded_down_to = score
        overlap = self._bank.overlaps * np.sqrt(self._energies) >= score - ROUNDING
        first, end = int(overlap.argmax()), 2 * N_CHANNELS - int(overlap[::-1].argmax())
        length = next(n for n in self._spectra if n >= max(2 * N_CHANNELS - first, end))
        parts = fft.irfft(fft.rfft(self._single, length) * self._spectra[length], length)
        self._lags = np.arange(first, end)
        numbers = np.concatenate([parts[:, length + first - N_CHANNELS :], parts[:, : end - N_CHANNELS]], axis=1)
        self._columns = columns(numbers, self._energies[first:end])
        self._group_bounds = self._bank.levels[0].rows @ self._columns
        self._highest = self._group_bounds.max(axis=0)

    def _frames(self, lags: IntArray) -> FloatArray:
        return self._padded.take(lags[:, None] + _CHANNELS)


class _PruningMatcher(Matcher):
    """The search, and the exact scores of the candidates that it leaves."""

    # With fewer cells the whole heatmap is computed.
    _min_cells = 0

    def __init__(self, signals: Float32Array, valid: BoolArray, k_grid: FloatArray, sigma_grid: FloatArray) -> None:
        """Compress the bank, in about half a second for 10⁴ cells; arguments and errors as `Matcher`.

        A valid cell without signal raises MatchingError here, not at the first frame.
        """
        super().__init__(signals, valid, k_grid, sigma_grid)
        self._bank = compress(self._unit_signals, self._cells)
        self._norms = np.concatenate([np.linalg.norm(self._magnitudes(cells), axis=1) for cells in self._chunks()])
        self._row, self._column = np.divmod(self._cells, valid.shape[1])

    def match(self, difference: ArrayLike, *, runner_up: bool = True) -> Match:
        """Return what `best_match` finds in the heatmap of one (896,) difference, at a fraction of its cost.

        Without `runner_up`, that is None. Raises MatchingError as `heatmap` does.
        """
        if len(self._cells) >= self._min_cells:
            (frame,) = unit_magnitudes(np.asarray(difference)[None])
            with suppress(_UndecidedError):
                return self._search(frame, runner_up)
        match = super().match(difference)
        return match if runner_up else replace(match, runner_up=None, runner_up_cell=None)

    @abstractmethod
    def _search(self, frame: FloatArray, runner_up: bool) -> Match: ...

    def _best_candidate(
        self, frame: FloatArray, candidates: Candidates, reached: float, seed: int = -1
    ) -> tuple[int, float]:
        """Return the cell of the highest score, the lowest of those that tie, and the score.

        One of the candidates must reach the score `reached`: `seed`, where that is known.
        """
        likeliest = int(candidates.cells[candidates.bounds.argmax()])
        if likeliest != seed:
            reached = max(reached, self._score(likeliest, candidates.frames))
        cells = candidates.cells[candidates.bounds >= reached - ROUNDING]
        parts = [
            self._contenders(frame, cells[i : i + CHUNK_CELLS], candidates.frames, reached)
            for i in range(0, len(cells), CHUNK_CELLS)
        ]
        cells, scores = parts[0] if len(parts) == 1 else (np.concatenate(each) for each in zip(*parts, strict=True))
        behind = scores.max() - scores
        if (np.abs(behind - TIE) < _ROUNDING_64).any():
            raise _UndecidedError
        winner = int(np.argmax(behind <= TIE))
        return int(cells[winner]), min(float(scores[winner]), 1.0)

    def _contenders(
        self, frame: FloatArray, cells: IntArray, frames: FloatArray, reached: float
    ) -> tuple[IntArray, FloatArray]:
        """Return the cells that may score `reached`, and their scores at the lags of (m, 896) frames."""
        if len(frames) > _FEW_LAGS:
            return cells, self._scores(frame[None], self._unit_signals(self._cells[cells]))[0]
        magnitudes = np.abs(self._signals.take(self._cells[cells], axis=0))
        if len(cells) > _FEW_CELLS:
            nearly = (frames.astype(np.float32) @ magnitudes.T).max(axis=0) / self._norms[cells]
            close = np.flatnonzero(nearly >= reached - _ROUNDING_32)
            cells, magnitudes = cells[close], magnitudes[close]
        return cells, (frames @ magnitudes.astype(np.float64).T).max(axis=0) / self._norms[cells]

    def _score(self, cell: int, frames: FloatArray) -> float:
        """Return a cell's highest score at the lags of (m, 896) frames."""
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

    def _search(self, frame: FloatArray, runner_up: bool) -> Match:
        bounds = ZeroLagBounds(self._bank, frame)
        best = self._best(frame, bounds)
        outside = self._outside(best[0], RUNNER_UP_RADIUS)
        if not (runner_up and outside.any()):
            return self._match(best, None)
        bounds.leave_out(~outside)
        return self._match(best, self._best(frame, bounds))

    def _best(self, frame: FloatArray, bounds: ZeroLagBounds) -> tuple[int, float]:
        """Return the cell of the highest score among those not left out, and the score."""
        seed = bounds.seed()
        reached = self._score(seed, bounds.frames)
        return self._best_candidate(frame, bounds.candidates(reached), reached, seed)


class PrunedMatcher(_PruningMatcher, ReferenceMatcher):
    """Matches at all lags."""

    _min_cells = MIN_PRUNED_CELLS

    def __init__(self, signals: Float32Array, valid: BoolArray, k_grid: FloatArray, sigma_grid: FloatArray) -> None:
        """Compress the bank; arguments and errors as `Matcher`."""
        super().__init__(signals, valid, k_grid, sigma_grid)
        self._spectra = {n: np.conj(fft.rfft(self._bank.basis[:COARSE_RANK], n)) for n in _LENGTHS}

    def _search(self, frame: FloatArray, runner_up: bool) -> Match:
        bounds = AllLagsBounds(self._bank, self._spectra, frame, self._score)
        near, reached = bounds.reached
        if not runner_up:
            return self._match(self._best_candidate(frame, bounds.candidates(reached), reached), None)
        # A cell outside at twice the radius is outside the peak of every cell in this peak.
        far, least = bounds.seed(self._outside(near, 2 * RUNNER_UP_RADIUS)) or (-1, 0.0)
        candidates = bounds.candidates(min(reached, least))
        best = self._best_candidate(frame, candidates, reached)
        outside = self._outside(best[0], RUNNER_UP_RADIUS)
        if far >= 0 and not outside[far]:
            _, least = bounds.seed(outside) or (-1, 0.0)
            candidates = bounds.candidates(least)
        kept = outside[candidates.cells]
        rest = Candidates(candidates.cells[kept], candidates.bounds[kept], candidates.frames)
        return self._match(best, self._best_candidate(frame, rest, least) if len(rest.cells) else None)
