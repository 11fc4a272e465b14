"""Schur complements of many symmetric positive matrices of one pattern, by sparse Cholesky factorisation.

The pattern decides where the factor has entries (George and Liu 1981, chapter 5), so that is planned once. numba
compiles the arithmetic, which treats a few matrices side by side.
"""

from typing import Any, Final, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from shearloop.bank.arrays import FloatArray, IntArray, compiled
from shearloop.bank.mesh import Terms

# Matrices that are factorised together, each in its lane of a vector register.
LANES: Final = 8


class _Plan(NamedTuple):
    """The factor's entries, column by column from the diagonal down: their rows, and where each column starts.

    by_row holds the entries of eliminated columns below the diagonal, row by row; each row starts at row_starts, and
    the column of each ends at ends.
    """

    rows: NDArray[np.uint32]
    starts: NDArray[np.uint32]
    by_row: NDArray[np.uint32]
    row_starts: NDArray[np.uint32]
    ends: NDArray[np.uint32]


class Elimination:
    """Eliminates all unknowns but the last `kept` of n; keeps no state between calls, and may run in several threads.

    The order of the unknowns decides the fill. Terms of symmetric pairs are given twice or below the diagonal.
    """

    def __init__(self, terms: Terms, n: int, kept: int) -> None:
        """Plan the elimination."""
        self._kept = kept
        lower = terms.where(terms.rows >= terms.columns)
        structures = _structures(lower, n, n - kept)
        sizes = [len(structure) for structure in structures]
        rows, columns = np.concatenate(structures), np.repeat(np.arange(n), sizes)
        # Entry p of the factor begins as Σ_t shares[p, t] · (factors, 1)_t.
        place = np.searchsorted(columns * n + rows, lower.columns * n + lower.rows)
        entries: Any = lower.values, (place, lower.source)
        self._shares = sp.csr_array(entries, shape=(len(rows), int(terms.source.max()) + 1))
        starts = np.append(0, np.cumsum(sizes))
        by_row = np.argsort(rows, kind="stable")
        by_row = by_row[(columns[by_row] < n - kept) & (columns[by_row] < rows[by_row])]
        row_starts = np.searchsorted(rows[by_row], np.arange(n + 1))
        plan = rows, starts, by_row, row_starts, starts[columns[by_row] + 1]
        self._plan = _Plan(*(array.astype(np.uint32) for array in plan))

    def schur_complements(self, factors: FloatArray) -> FloatArray:
        """Return the (n, kept, kept) Schur complements for the (n, F) factors of the entries; factor F is 1.

        The bits of one matrix do not depend on the others. A matrix that is not positive definite to rounding gives
        meaningless or infinite numbers. Raises ValueError unless the pattern names F factors.
        """
        left = np.empty((len(factors), self._kept, self._kept))
        column, row = np.triu_indices(self._kept)
        for begin in range(0, len(factors), LANES):
            some = factors[begin : begin + LANES]
            lanes = np.ones((some.shape[1] + 1, LANES))
            lanes[:-1, : len(some)] = some.T
            work = self._shares @ lanes
            _factorise(self._plan, work, self._kept)
            last = work[-len(row) :, : len(some)].T
            left[begin : begin + LANES, row, column] = left[begin : begin + LANES, column, row] = last
        return left


def _structures(lower: Terms, n: int, eliminated: int) -> list[IntArray]:
    """Return the rows of every unknown's column, ascending from the diagonal, when it is eliminated."""
    matrix = sp.csc_array((np.ones(len(lower.rows)), (lower.rows, lower.columns)), shape=(n, n))
    found: list[IntArray] = []
    children: list[list[IntArray]] = [[] for _ in range(n)]
    for column in range(eliminated):
        own = matrix.indices[matrix.indptr[column] : matrix.indptr[column + 1]].astype(np.int64)
        rows = np.unique(np.concatenate([own, *children[column]]))
        children[column].clear()
        # Its neighbours become coupled: the first of them inherits the rest.
        children[rows[1]].append(rows[1:])
        found.append(rows)
    return found + [np.arange(column, n) for column in range(eliminated, n)]


@compiled
def _factorise(plan: _Plan, work: FloatArray, kept: int) -> None:
    """Factorise the (entries, LANES) lower triangles in `work` in place; the last columns become Schur complements.

    A column begins as its own entries; each earlier column with an entry in its row then subtracts its products.
    """
    rows, starts, by_row, row_starts, ends = plan
    n = len(starts) - 1
    column = np.empty((n, LANES))
    for k in range(n):
        for p in range(starts[k], starts[k + 1]):
            column[rows[p]] = work[p]
        for m in range(row_starts[k], row_starts[k + 1]):
            q = by_row[m]
            a, b, c, d, e, f, g, h = work[q]
            for p in range(q, ends[m]):
                to, by = column[rows[p]], work[p]
                to[0], to[1], to[2], to[3] = to[0] - a * by[0], to[1] - b * by[1], to[2] - c * by[2], to[3] - d * by[3]
                to[4], to[5], to[6], to[7] = to[4] - e * by[4], to[5] - f * by[5], to[6] - g * by[6], to[7] - h * by[7]
        inverse_root = 1.0 / np.sqrt(column[k]) if k < n - kept else np.ones(LANES)
        for p in range(starts[k], starts[k + 1]):
            for lane in range(LANES):
                work[p, lane] = column[rows[p], lane] * inverse_root[lane]
