"""The same match as from the whole heatmap, but from a few of its cells: what cannot be the maximum is never scored.

A compressed bank (`shearloop.bank.eit.compression`) bounds the scores of groups of cells, then of cells; whatever is
bounded below a
score that some cell reaches is dropped (`shearloop.bank.eit.bounds`), and what is left is scored in float64. How
well the bank
compresses decides how long it takes, never what comes out.
"""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shearloop.bank.eit.bounds import (
    AllLagsBounds,
    Left,
    Mask,
    Neighbourhood,
    TakesLongError,
    ZeroLagBounds,
    spectra_of,
)
from shearloop.bank.eit.compression import COMPRESSED_CELLS, ROUNDING, Indices, compress
from shearloop.bank.eit.matching import (
    CHUNK_CELLS,
    RUNNER_UP_RADIUS,
    TIE,
    FloatArray,
    Match,
    Matcher,
    ReferenceMatcher,
    ZeroLagMatcher,
    unit_magnitude,
    unit_magnitudes,
)
from shearloop.bank.errors import MatchingError

# How far two ways of adding up 896 products in float64 may be apart: where a tie hangs on less, the reference decides.
_ROUNDING_64 = 1e-14
# And in float32: 896 roundings of 6e-8.
_ROUNDING_32 = 6e-5
# With more lags, a transform costs a cell less than its products.
_FEW_LAGS = 128
# With fewer cells, sorting them out in float32 costs more than scoring them.
_FEW_CELLS = 48
# So many frames of a batch are searched at once: with more, their bounds leave the cache.
_AT_ONCE = 8
# With fewer cells at all lags, leaving out what cannot be the maximum costs more than the whole heatmap.
FEWEST_PRUNED = 300
# Scoring more than this takes longer than about a millisecond.
_QUICK_SCORES = 1 << 13


class _Undecided(Exception):  # noqa: N818 - it is not an error
    """It hangs on the rounding of float64 which cells tie."""


class _PruningMatcher(Matcher):
    """What all lags and one have in common: the search, and settling in float64 what the bounds leave."""

    # With fewer cells nothing is searched: the whole heatmap is made.
    _fewest = 0

    def __init__(self, signals: NDArray[np.float32], valid: Mask, k_grid: FloatArray, sigma_grid: FloatArray) -> None:
        """Compress the bank, which takes about half a second for 10⁴ cells; arguments as of any matcher.

        Raises MatchingError as any matcher, and here, not at the first frame, where a valid cell has no signal.
        """
        super().__init__(signals, valid, k_grid, sigma_grid)
        self._bank = compress(self._unit_signals, self._cells)
        chunks = self._chunks(COMPRESSED_CELLS)
        self._norms = np.concatenate([np.linalg.norm(self._magnitudes(cells), axis=1) for cells in chunks])
        self._row, self._column = (each.astype(np.int32) for each in np.divmod(self._cells, valid.shape[1]))

    def match(self, difference: ArrayLike, *, runner_up: bool = True) -> Match:
        """Return what `best_match` finds in the heatmap of one (896,) difference, at a fraction of its cost.

        Without `runner_up`, that is None. Raises MatchingError as `heatmap` does.
        """
        if len(self._cells) >= self._fewest:
            frame = unit_magnitude(difference)
            with suppress(_Undecided):
                return self._search(frame, runner_up)
        match = super().match(difference)
        return match if runner_up else replace(match, runner_up=None, runner_up_cell=None)

    def match_quickly(self, difference: ArrayLike) -> Match | None:
        """Return what `match` returns, or None where that takes more than a few milliseconds.

        Frames unlike any of the bank's may leave most of its cells to be scored, which takes half a second.
        """
        if len(self._cells) < self._fewest:
            return super().match(difference)
        try:
            return self._search(unit_magnitude(difference), runner_up=True, quick=True)
        except (_Undecided, TakesLongError):
            return None

    def matches(self, differences: ArrayLike) -> list[Match]:
        """Return what `match` returns of each of (n, 896) differences, without the runner-ups.

        Raises MatchingError as `heatmaps` does.
        """
        frames = np.asarray(differences, dtype=np.float64)
        # Wrong input is told before any work.
        unit_magnitudes(frames)
        return [self.match(frame, runner_up=False) for frame in frames]

    @abstractmethod
    def _search(self, frame: FloatArray, runner_up: bool, *, quick: bool = False) -> Match: ...

    def _settled(
        self, frame: FloatArray, left: Left, reached: float, seed: int = -1, *, quick: bool = False
    ) -> tuple[int, float]:
        """Return the cell of the highest score, the lowest of those that tie, and the score.

        One of the cells that are left must reach the score `reached`: `seed`, where that is known.
        """
        likeliest = int(left.cells[left.bounds.argmax()])
        if likeliest != seed:
            reached = max(reached, self._score(likeliest, left.frames))
        cells = left.cells[left.bounds >= reached - ROUNDING]
        if quick and (len(cells) * len(left.frames) > _QUICK_SCORES or len(left.frames) > _FEW_LAGS):
            raise TakesLongError
        parts = [
            self._contenders(frame, cells[i : i + CHUNK_CELLS], left.frames, reached)
            for i in range(0, len(cells), CHUNK_CELLS)
        ]
        cells, scores = parts[0] if len(parts) == 1 else (np.concatenate(each) for each in zip(*parts, strict=True))
        behind = scores.max() - scores
        if (np.abs(behind - TIE) < _ROUNDING_64).any():
            raise _Undecided
        winner = int(np.argmax(behind <= TIE))
        return int(cells[winner]), min(float(scores[winner]), 1.0)

    def _contenders(
        self, frame: FloatArray, cells: Indices, frames: FloatArray, reached: float
    ) -> tuple[Indices, FloatArray]:
        """Return those of the cells that may score `reached`, and their scores at the lags of (m, 896) frames."""
        if len(frames) > _FEW_LAGS:
            return cells, self._scores(frame[None], self._unit_signals(self._cells[cells]))[0]
        magnitudes = np.abs(self._signals.take(self._cells[cells], axis=0))
        if len(cells) <= _FEW_CELLS:
            scores = (frames @ magnitudes.astype(np.float64).T).max(axis=0) / self._norms[cells]
            return cells, scores
        nearly = (frames.astype(np.float32) @ magnitudes.T).max(axis=0) / self._norms[cells]
        close = np.flatnonzero(nearly >= reached - _ROUNDING_32)
        scores = (frames @ magnitudes[close].astype(np.float64).T).max(axis=0) / self._norms[cells[close]]
        return cells[close], scores

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


class FastZeroLagMatcher(_PruningMatcher, ZeroLagMatcher):
    """Matches at lag 0 alone; its heatmaps are those of `ZeroLagMatcher`, at that one's price.

    All cells are estimated at once, for with one lag that is a few operations on one number per cell.
    """

    def __init__(self, signals: NDArray[np.float32], valid: Mask, k_grid: FloatArray, sigma_grid: FloatArray) -> None:
        """Compress the bank; arguments and errors as of any pruning matcher."""
        super().__init__(signals, valid, k_grid, sigma_grid)
        # Every place of the grid has the number of its cell; those that are not valid share one that is none.
        self._numbers = np.full(valid.shape, len(self._cells))
        self._numbers[valid] = np.arange(len(self._cells))

    def _search(self, frame: FloatArray, runner_up: bool, *, quick: bool = False) -> Match:
        bounds = ZeroLagBounds(self._bank, frame)
        best = self._best(frame, bounds, quick)
        if best is None:
            raise MatchingError("no cell of the bank is valid")
        if not runner_up:
            return self._match(best, None)
        row, column = self._place(best[0])
        rows = slice(max(row - RUNNER_UP_RADIUS, 0), row + RUNNER_UP_RADIUS + 1)
        columns = slice(max(column - RUNNER_UP_RADIUS, 0), column + RUNNER_UP_RADIUS + 1)
        bounds.leave_out(self._numbers[rows, columns])
        return self._match(best, self._best(frame, bounds, quick))

    def _best(self, frame: FloatArray, bounds: ZeroLagBounds, quick: bool) -> tuple[int, float] | None:
        """Return the cell of the highest score among those not left out, and the score."""
        seed = bounds.seed()
        if seed is None:
            return None
        reached = self._score(seed, bounds.frames)
        return self._settled(frame, bounds.left(reached), reached, seed, quick=quick)


class FastMatcher(_PruningMatcher, ReferenceMatcher):
    """Matches at all lags; its heatmaps are those of the reference, at the reference's price."""

    _fewest = FEWEST_PRUNED

    def __init__(self, signals: NDArray[np.float32], valid: Mask, k_grid: FloatArray, sigma_grid: FloatArray) -> None:
        """Compress the bank; arguments and errors as of `FastZeroLagMatcher`."""
        super().__init__(signals, valid, k_grid, sigma_grid)
        self._spectra = spectra_of(self._bank)

    def matches(self, differences: ArrayLike) -> list[Match]:
        """Return what `match` returns of each of (n, 896) differences, without the runner-ups; errors as `heatmaps`."""
        if len(self._cells) < self._fewest:
            return super().matches(differences)
        frames = unit_magnitudes(differences)
        return [match for i in range(0, len(frames), _AT_ONCE) for match in self._several(frames[i : i + _AT_ONCE])]

    def _several(self, frames: FloatArray) -> Iterator[Match]:
        bounds = AllLagsBounds(self._bank, self._spectra, frames, self._score, quick=True)
        scores = [score for _, score in bounds.reached]
        try:
            lefts = bounds.left(scores)
        except TakesLongError:
            # A frame unlike the bank's leaves much to be bounded: not for the others too.
            yield from (self.match(frame, runner_up=False) for frame in frames)
            return
        for frame, left, score in zip(frames, lefts, scores, strict=True):
            try:
                yield self._match(self._settled(frame, left, score), None)
            except _Undecided:
                yield self.match(frame, runner_up=False)

    def _search(self, frame: FloatArray, runner_up: bool, *, quick: bool = False) -> Match:
        bounds = AllLagsBounds(self._bank, self._spectra, frame[None], self._score, quick=quick)
        ((near, reached),) = bounds.reached
        if not runner_up:
            (left,) = bounds.left([reached])
            return self._match(self._settled(frame, left, reached, quick=quick), None)
        # What is outside at twice the radius is outside of the peak of every cell in this one's peak.
        far, least = bounds.seed(self._around(near, 2 * RUNNER_UP_RADIUS)) or (-1, 0.0)
        (left,) = bounds.left([min(reached, least)])
        best = self._settled(frame, left, reached, quick=quick)
        peak = self._around(best[0], RUNNER_UP_RADIUS)
        if far >= 0 and not peak.lacks(np.array([far]))[0]:
            _, least = bounds.seed(peak) or (-1, 0.0)
            (left,) = bounds.left([least])
        left = left.among(peak.lacks(left.cells))
        return self._match(best, self._settled(frame, left, least, quick=quick) if len(left.cells) else None)

    def _around(self, cell: int, radius: int) -> Neighbourhood:
        return Neighbourhood(self._row, self._column, cell, radius)
