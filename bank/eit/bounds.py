"""One frame against a compressed bank: estimates of scores, and what their bounds leave, at lag 0 or at all lags.

What is computed here, in float32, decides only where it is worth while to score exactly.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from shearloop.bank.arrays import BoolArray, Float32Array, FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.eit.compression import COARSE_RANK, ROUNDING, SEED_LEVEL, CompressedBank, column, columns

Spectra = Mapping[int, NDArray[np.complex64]]
Score = Callable[[int, FloatArray], float]

# Transforms of so many values: the shorter where only small lags can matter, the longer for all.
_LENGTHS = (1280, 2 * N_CHANNELS)
_CHANNELS = np.arange(N_CHANNELS)
# A frame, with as many zeros before and after it.
_WIDTH = 3 * N_CHANNELS
# Lags at which groups are compared for a cell of a high score.
_SEED_LAGS = 8
# The runner-up may be this much worse than the best cell at lag 0 before groups are bounded a second time.
_SLACK = 0.01
# More bounds than this (16 MB) are not computed: all cells and lags are left.
_MOST_BOUNDS = 1 << 22
# More than this take longer than about a millisecond.
_QUICK_BOUNDS = 1 << 20


class TakesLongError(Exception):
    """There is more left to score than a few milliseconds are enough for, and no more were allowed."""


class Left(NamedTuple):
    """Cells (n,), bounds of their scores (n,), and the (m, 896) frame at the lags where they may have those scores."""

    cells: IntArray
    bounds: Float32Array
    frames: FloatArray

    def among(self, allowed: BoolArray) -> "Left":
        """Return what is left of some cells."""
        return Left(self.cells[allowed], self.bounds[allowed], self.frames)


class Neighbourhood:
    """The cells at most `radius` away from one, in k and in σ; rows and columns (n,) are the places of all cells."""

    def __init__(self, rows: NDArray[np.int32], columns: NDArray[np.int32], cell: int, radius: int) -> None:
        self._rows, self._columns, self._cell, self._radius = rows, columns, cell, radius

    def lacks(self, cells: IntArray | slice) -> BoolArray:
        """Return which of some cells are outside."""
        rows = np.abs(self._rows[cells] - self._rows[self._cell])
        columns = np.abs(self._columns[cells] - self._columns[self._cell])
        outside: BoolArray = np.maximum(rows, columns) > self._radius
        return outside


class ZeroLagBounds:
    """A unit frame, (896,), estimated and bounded at lag 0; frames (1, 896) is that frame."""

    def __init__(self, bank: CompressedBank, frame: FloatArray) -> None:
        self._bank = bank
        self.frames = frame[None]
        parts = bank.basis @ frame.astype(np.float32)
        self._fine, t = column(parts, COARSE_RANK)
        n = len(bank.left_out)
        # One place more, for what is no cell.
        self._estimates = np.empty(n + 1, dtype=np.float32)
        np.dot(parts[:COARSE_RANK], bank.estimators, out=self._estimates[:n])
        self._bounds = np.empty(n + 1, dtype=np.float32)
        np.multiply(bank.left_out, t, out=self._bounds[:n])
        self._bounds[:n] += self._estimates[:n]
        self._estimates[n] = self._bounds[n] = -np.inf

    def leave_out(self, cells: IntArray) -> None:
        """Find these cells no more."""
        self._estimates[cells] = self._bounds[cells] = -np.inf

    def seed(self) -> int | None:
        """Return the cell of the highest estimate; None where all are left out."""
        cell = int(self._estimates.argmax())
        return None if self._estimates[cell] == -np.inf else cell

    def left(self, score: float) -> Left:
        """Return the cells that may have a score, or a higher one."""
        (cells,) = (self._bounds >= score - ROUNDING).nonzero()
        return Left(cells, self._bank.fine.take(cells, axis=0) @ self._fine, self.frames)


class AllLagsBounds:
    """Unit frames, (n, 896): one, or several at once, which share what each call of numpy costs.

    Lags are left out first, then groups, then cells. A frame at a lag is a column; what no column reaches is left out
    for all frames. spectra are from `spectra_of`; score(cell, frames) is the highest score of a cell at (m, 896)
    frames. With `quick`, `left` raises TakesLongError where little can be left out.

    reached is of each frame a cell that is likely to score high, and a score that it reaches.
    """

    # Within: `lags` are places in the padded frames, one after the other, where a frame at that lag begins: lag −896 of
    # frame i is i · _WIDTH. The columns of frame i are those from _parts[i] to _parts[i + 1]; `at` are some columns.

    def __init__(
        self, bank: CompressedBank, spectra: Spectra, frames: FloatArray, score: Score, *, quick: bool = False
    ) -> None:
        self._bank, self._spectra, self._score, self._quick = bank, spectra, score, quick
        self._single = frames.astype(np.float32)
        self._padded = np.zeros((len(frames), _WIDTH))
        self._padded[:, N_CHANNELS : 2 * N_CHANNELS] = frames
        self._energies = np.zeros((len(frames), _WIDTH))
        before, after = self._energies[:, : N_CHANNELS + 1], self._energies[:, N_CHANNELS : 2 * N_CHANNELS]
        np.cumsum(frames * frames, axis=1, out=before[:, 1:])
        np.maximum(1.0 - before[:, :-1], 0.0, out=after)
        self._centres = bank.levels[SEED_LEVEL].rows[:, :-2]
        at_0 = self._reached_at_0(frames)
        self._bound_first(np.array([score for _, score in at_0]) - _SLACK)
        self._seeds = [self._seeds_of(i) for i in range(len(frames))]
        self.reached = [max(each, self.seed(None, i) or each, key=itemgetter(1)) for i, each in enumerate(at_0)]

    def seed(self, around: Neighbourhood | None, of: int = 0) -> tuple[int, float] | None:
        """Return a cell outside a neighbourhood that is likely to score high, and a score that it reaches.

        It is the one of the highest estimate in the group of the highest estimate, at the likeliest lags; None where
        there is no such cell, or none is found at once.
        """
        lags, at_lags, estimates = self._seeds[of]
        if around is not None:
            estimates = np.where(around.lacks(self._bank.centres), estimates, -np.inf)
        lag, group = divmod(int(np.argmax(estimates)), estimates.shape[1])
        if estimates[lag, group] == -np.inf:
            return None
        cells = self._bank.members[group]
        if around is not None:
            cells = cells[around.lacks(cells)]
        cell = self._best_of(cells, at_lags[:, lag])
        return cell, self._score(cell, self._frames(lags[lag, None]))

    def left(self, scores: Sequence[float]) -> list[Left]:
        """Return of each frame the cells that may have its score, or a higher one.

        Groups are bounded first, then their parts, then the cells of those that are left, at the lags that are left.
        """
        if np.less(scores, self._bounded_down_to).any():
            self._bound_first(np.minimum(scores, self._bounded_down_to))
        bank = self._bank
        least = np.repeat((np.array(scores) - ROUNDING).astype(np.float32), np.diff(self._parts))
        (at,) = (self._highest >= least).nonzero()
        alive = (self._first_bounds.take(at, axis=1) >= least[at]).any(axis=1)
        for level in bank.levels[1:]:
            groups = np.flatnonzero(alive.take(level.part_of))
            alive = np.zeros(len(level.rows), dtype=np.bool_)
            if self._are_few(len(groups) * len(at)):
                reach = self._reach(level.rows.take(groups, axis=0), at, least)
                alive[groups] = reach.any(axis=0)
                at = at[reach.any(axis=1)]
            else:
                alive[groups] = True
        cells = np.flatnonzero(alive.take(bank.group_of))
        if few := self._are_few(len(cells) * len(at)):
            reach = self._reach(bank.coarse.take(cells, axis=0), at, least)
            some = reach.any(axis=1)
            at, reach = at[some], reach[some]
        lags = self._lags[at]
        frames = self._frames(lags)
        parts = np.searchsorted(at, self._parts).tolist()
        if not few:
            unbounded = np.full(len(cells), np.inf, dtype=np.float32)
            return [Left(cells, unbounded, frames[i:j]) for i, j in pairwise(parts)]
        finest = columns(bank.basis @ frames.T.astype(np.float32), self._energies.take(lags))
        found = []
        for i, j in pairwise(parts):
            chosen = cells[reach[i:j].any(axis=0)]
            bounds = (finest[:, i:j].T @ bank.fine.take(chosen, axis=0).T).max(axis=0)
            found.append(Left(chosen, bounds, frames[i:j]))
        return found

    def _reach(self, rows: Float32Array, at: IntArray, least: Float32Array) -> BoolArray:
        found = self._columns.take(at, axis=1).T @ rows.T
        reach: BoolArray = found >= least[at, None]
        return reach

    def _are_few(self, n_bounds: int) -> bool:
        if self._quick and n_bounds > min(_QUICK_BOUNDS * len(self._single), _MOST_BOUNDS):
            raise TakesLongError
        return n_bounds <= _MOST_BOUNDS

    def _reached_at_0(self, frames: FloatArray) -> list[tuple[int, float]]:
        """Return of each frame a cell that is likely to score high at lag 0, and its score there."""
        at_0 = self._bank.basis[: self._centres.shape[1]] @ self._single.T
        groups = (self._centres @ at_0).argmax(axis=0)
        cells = [self._best_of(self._bank.members[group], at_0[:, i]) for i, group in enumerate(groups)]
        return [(cell, self._score(cell, frame[None])) for cell, frame in zip(cells, frames, strict=True)]

    def _best_of(self, cells: IntArray, parts: Float32Array) -> int:
        return int(cells[np.argmax(self._bank.coarse.take(cells, axis=0)[:, :-2] @ parts)])

    def _seeds_of(self, frame: int) -> tuple[IntArray, Float32Array, Float32Array]:
        """Return the likeliest lags, (m,), the frame's numbers there (r, m), and the estimates of groups (m, n)."""
        start, end = self._parts[frame : frame + 2]
        n_seeds = min(_SEED_LAGS, end - start)
        likeliest = start + np.argpartition(self._highest[start:end], -n_seeds)[-n_seeds:]
        at_lags = self._columns[:-2, likeliest]
        return self._lags[likeliest], at_lags, at_lags.T @ self._centres.T

    def _bound_first(self, scores: FloatArray) -> None:
        """Bound the first level's groups at all lags at which any cell may reach the score of each frame."""
        self._bounded_down_to = scores
        overlap = self._bank.overlaps * np.sqrt(self._energies[:, : 2 * N_CHANNELS]) >= scores[:, None] - ROUNDING
        firsts, ends = overlap.argmax(axis=1).tolist(), (2 * N_CHANNELS - overlap[:, ::-1].argmax(axis=1)).tolist()
        length = next(n for n in self._spectra if n >= max(2 * N_CHANNELS - min(firsts), *ends))
        transforms = fft.rfft(self._single, length)[:, None] * self._spectra[length]
        pieces, lags = [], []
        for i, parts in enumerate(fft.irfft(transforms, length)):
            pieces += [parts[:, length + firsts[i] - N_CHANNELS :], parts[:, : ends[i] - N_CHANNELS]]
            lags.append(np.arange(i * _WIDTH + firsts[i], i * _WIDTH + ends[i]))
        self._parts = [0, *accumulate(map(len, lags))]
        self._lags = np.concatenate(lags)
        self._columns = columns(np.concatenate(pieces, axis=1), self._energies.take(self._lags))
        self._first_bounds = self._bank.levels[0].rows @ self._columns
        self._highest = self._first_bounds.max(axis=0)

    def _frames(self, lags: IntArray) -> FloatArray:
        return self._padded.take(lags[:, None] + _CHANNELS)


def spectra_of(bank: CompressedBank) -> Spectra:
    """Return the conjugate transforms of the basis's first directions, (r, n // 2 + 1), by length n."""
    return {length: np.conj(fft.rfft(bank.basis[:COARSE_RANK], length)) for length in _LENGTHS}
