"""One frame against a compressed bank: estimates of scores, and what their bounds leave, at lag 0 or at all lags.

What is computed here, in float32, decides only where it is worth while to score exactly.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from bank.channels import N_CHANNELS
from bank.compression import (
    COARSE_RANK,
    ROUNDING,
    SEED_LEVEL,
    CompressedBank,
    FloatArray,
    Indices,
    Single,
    column,
    columns,
)

Mask = NDArray[np.bool_]

# Lags from 0 up, then from −896 up; at −896 nothing overlaps.
_LAGS = np.concatenate([np.arange(N_CHANNELS), np.arange(-N_CHANNELS, 0)])
_CHANNELS = np.arange(N_CHANNELS)
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

    cells: Indices
    bounds: Single
    frames: FloatArray

    def among(self, allowed: Mask) -> "Left":
        """Return what is left of some cells."""
        return Left(self.cells[allowed], self.bounds[allowed], self.frames)


class Neighbourhood:
    """The cells at most `radius` away from one, in k and in σ; rows and columns (n,) are the places of all cells."""

    def __init__(self, rows: NDArray[np.int32], columns: NDArray[np.int32], cell: int, radius: int) -> None:
        self._rows, self._columns, self._cell, self._radius = rows, columns, cell, radius

    def lacks(self, cells: Indices | slice) -> Mask:
        """Return which of some cells are outside."""
        rows = np.abs(self._rows[cells] - self._rows[self._cell])
        columns = np.abs(self._columns[cells] - self._columns[self._cell])
        outside: Mask = np.maximum(rows, columns) > self._radius
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

    def leave_out(self, cells: Indices) -> None:
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
    """Lags are left out first, then groups, then cells. Lags are numbered as in _LAGS.

    spectra (r, 897) are the conjugate transforms of the basis's first directions, from `spectra_of`. With `quick`,
    `left` raises TakesLongError where little can be left out.
    """

    def __init__(
        self, bank: CompressedBank, spectra: NDArray[np.complex64], frame: FloatArray, *, quick: bool = False
    ) -> None:
        self._bank = bank
        self._quick = quick
        self._padded = np.zeros(3 * N_CHANNELS)
        self._padded[N_CHANNELS : 2 * N_CHANNELS] = frame
        parts = fft.irfft(fft.rfft(frame.astype(np.float32), len(_LAGS)) * spectra, len(_LAGS))
        before = np.concatenate([[0.0], np.cumsum(frame * frame)[:-1]])
        self._columns = columns(parts, np.concatenate([1.0 - before, before]))
        self._groups = bank.levels[SEED_LEVEL].rows
        self._bound_first(self._reached_at_0() - _SLACK)
        n_seeds = min(_SEED_LAGS, len(self._lags))
        self._seed_lags = self._lags[np.argpartition(self._highest, -n_seeds)[-n_seeds:]]
        self._estimates = _products(self._groups[:, :-2], self._columns[:-2, self._seed_lags])

    def seed(self, around: Neighbourhood | None) -> tuple[int, FloatArray] | None:
        """Return a cell outside a neighbourhood that is likely to score high, and the (1, 896) frame at its lag.

        It is the one of the highest estimate in the group of the highest estimate, at the likeliest lags; None where
        there is no such cell, or none is found at once.
        """
        estimates = self._estimates
        if around is not None:
            estimates = np.where(around.lacks(self._bank.centres), estimates, -np.inf)
        lag, group = divmod(int(np.argmax(estimates)), estimates.shape[1])
        if estimates[lag, group] == -np.inf:
            return None
        cells = self._bank.members[group]
        if around is not None:
            cells = cells[around.lacks(cells)]
        return self._best_of(cells, self._seed_lags[lag]), self._frames(self._seed_lags[lag, None])

    def left(self, score: float) -> Left:
        """Return the cells that may have a score, or a higher one.

        Groups are bounded first, then their parts, then the cells of those that are left, at the lags that are left.
        """
        if score < self._bounded_down_to:
            self._bound_first(score)
        bank, least = self._bank, score - ROUNDING
        chosen = self._highest >= least
        lags = self._lags[chosen]
        alive = (self._first_bounds[chosen] >= least).any(axis=0)
        for level in bank.levels[1:]:
            groups = np.flatnonzero(alive.take(level.part_of))
            if not self._are_few(len(groups) * len(lags)):
                reach = np.ones((1, len(groups)), dtype=np.bool_)
            else:
                reach = _products(level.rows.take(groups, axis=0), self._columns[:, lags]) >= least
                lags = lags[reach.any(axis=1)]
            alive = np.zeros(len(level.rows), dtype=np.bool_)
            alive[groups] = reach.any(axis=0)
        cells = np.flatnonzero(alive.take(bank.group_of))
        if self._are_few(len(cells) * len(lags)):
            reach = _products(bank.coarse.take(cells, axis=0), self._columns[:, lags]) >= least
            cells, lags = cells[reach.any(axis=0)], lags[reach.any(axis=1)]
        frames = self._frames(lags)
        if not self._are_few(len(cells) * len(lags)):
            return Left(cells, np.full(len(cells), np.inf, dtype=np.float32), frames)
        at_lags = columns(bank.basis @ frames.T.astype(np.float32), np.einsum("ij,ij->i", frames, frames))
        return Left(cells, _products(bank.fine.take(cells, axis=0), at_lags).max(axis=0), frames)

    def _are_few(self, n_bounds: int) -> bool:
        if self._quick and n_bounds > _QUICK_BOUNDS:
            raise TakesLongError
        return n_bounds <= _MOST_BOUNDS

    def _reached_at_0(self) -> float:
        """Return a score that some cell surely has at lag 0."""
        at_0 = self._columns[:, 0]
        cell = self._best_of(self._bank.members[np.argmax(self._groups[:, :-2] @ at_0[:-2])], 0)
        row = self._bank.coarse[cell]
        return float(row[:-2] @ at_0[:-2] - row[-1] * at_0[-1])

    def _best_of(self, cells: Indices, lag: int) -> int:
        return int(cells[np.argmax(self._bank.coarse[cells, :-2] @ self._columns[:-2, lag])])

    def _bound_first(self, score: float) -> None:
        """Bound the first level's groups at all lags at which any cell may reach a score."""
        self._bounded_down_to = score
        self._lags = np.flatnonzero(self._bank.widest @ self._columns[-2:] >= score - ROUNDING)
        self._first_bounds = _products(self._bank.levels[0].rows, self._columns[:, self._lags])
        self._highest = self._first_bounds.max(axis=1)

    def _frames(self, lags: Indices) -> FloatArray:
        return self._padded.take(N_CHANNELS + _LAGS[lags, None] + _CHANNELS)


def spectra_of(bank: CompressedBank) -> NDArray[np.complex64]:
    """Return what `AllLagsBounds` needs of a bank."""
    spectra: NDArray[np.complex64] = np.conj(fft.rfft(bank.basis[:COARSE_RANK], len(_LAGS)))
    return spectra


def _products(rows: Single, at_lags: Single) -> Single:
    """Return the bounds or estimates (lags, rows): reducing over either axis then runs along the memory."""
    return at_lags.T @ rows.T
