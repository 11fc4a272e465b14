"""Eliminating the inner unknowns of many symmetric positive matrices of one pattern, all at the same steps.

The pattern decides where entries arise and which meet, so that is found out once (George and Liu 1981, chapter 5);
what is left for each matrix is multiplying and subtracting, and sixteen matrices stand side by side in memory, so that
every step of it is one of whole vector registers.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Indices = NDArray[np.int64]

# Matrices side by side: two registers of eight, or four of four.
LANES = 16

_F = TypeVar("_F", bound=Callable[..., Any])


class Pattern(NamedTuple):
    """What the entries of the matrices are made of: entry (rows, columns)[p] gets Σ values[p] · factors[source[p]].

    All are (P,); several p of one place add up. Of symmetric pairs both or the lower one are given.
    """

    rows: Indices
    columns: Indices
    values: FloatArray
    source: Indices


class Elimination:
    """Eliminates all unknowns but the last `kept` of n; keeps no state between calls, and may run in several threads.

    Unknowns are eliminated in their order, so that order decides how many entries arise.
    """

    def __init__(self, pattern: Pattern, n: int, kept: int) -> None:
        """Find out which entries arise, and which meet."""
        self._kept = kept
        lower = pattern.rows >= pattern.columns
        rows, columns = pattern.rows[lower], pattern.columns[lower]
        below = _structures(rows, columns, n, n - kept)
        counts = np.array([len(each) + 1 for each in below])
        self._starts = np.concatenate([[0], np.cumsum(counts)])
        # Every entry's place is found by its column and row, which ascend with it.
        keys = np.concatenate([column * n + np.append(column, each) for column, each in enumerate(below)])
        self._targets = np.searchsorted(keys, _meetings(below[: n - kept], n)).astype(np.int32)
        terms = sp.coo_array(
            (pattern.values[lower], (np.searchsorted(keys, columns * n + rows), pattern.source[lower])),
            shape=(len(keys), int(pattern.source.max()) + 1),
        ).tocsr()
        self._term_starts = terms.indptr.astype(np.int64)
        self._term_sources = terms.indices.astype(np.int32)
        self._term_values = terms.data
        self._lower = np.tril_indices(kept)

    def schur_complements(self, factors: FloatArray) -> FloatArray:
        """Return what is left of n matrices, (n, kept, kept), for the (n, F) factors that their entries are made of.

        The bits of one matrix do not depend on those that it is eliminated with. A matrix that is not positive
        definite, or not to rounding, gives numbers that mean nothing, or are not finite.
        """
        left = np.empty((len(factors), self._kept, self._kept))
        entries = np.empty((self._starts[-1], LANES))
        for first in range(0, len(factors), LANES):
            some = factors[first : first + LANES]
            lanes = np.ones((factors.shape[1], LANES))
            lanes[:, : len(some)] = some.T
            _sum_terms(self._term_starts, self._term_sources, self._term_values, lanes, entries)
            _eliminate(self._starts[: -self._kept], self._targets, entries)
            # Columns of the lower half follow each other: the upper half's rows.
            tail = entries[self._starts[-self._kept - 1] :, : len(some)].T
            rows, columns = self._lower
            order = np.lexsort((rows, columns))
            left[first : first + LANES, rows[order], columns[order]] = tail
            left[first : first + LANES, columns[order], rows[order]] = tail
        return left


def _structures(rows: Indices, columns: Indices, n: int, n_eliminated: int) -> list[Indices]:
    """Return for every unknown the rows below it in its column when it is eliminated; those kept have all."""
    matrix = sp.csc_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    matrix.sum_duplicates()
    found: list[Indices] = []
    children: list[list[Indices]] = [[] for _ in range(n)]
    for column in range(n_eliminated):
        own = matrix.indices[matrix.indptr[column] : matrix.indptr[column + 1]].astype(np.int64)
        below = np.unique(np.concatenate([own, *children[column]]))
        below = below[below > column]
        children[column].clear()
        # Its neighbours become neighbours of each other: the first of them takes over the rest.
        children[below[0]].append(below)
        found.append(below)
    found.extend(np.arange(column + 1, n) for column in range(n_eliminated, n))
    return found


def _meetings(below: list[Indices], n: int) -> Indices:
    """Return the keys of the entries that change at every step, in the order of the steps."""
    found = []
    triangles: dict[int, tuple[Indices, Indices]] = {}
    for rows in below:
        upper = triangles.setdefault(len(rows), np.triu_indices(len(rows)))
        found.append(rows[upper[0]] * n + rows[upper[1]])
    return np.concatenate(found)


def _compiled(function: _F) -> _F:
    """Compile a function, and keep the result on the disk where there is a place for it."""
    # Products and differences may be fused; nothing else may be reordered. Without the lock of the interpreter, several
    # threads eliminate at once.
    options: dict[str, Any] = {"nogil": True, "fastmath": {"contract"}}
    try:
        kept: _F = njit(cache=True, **options)(function)
    except RuntimeError:  # neither beside this file nor in the user's cache may anything be written
        kept = njit(**options)(function)
    return kept


@_compiled
def _sum_terms(
    starts: Indices, sources: NDArray[np.int32], values: FloatArray, lanes: FloatArray, out: FloatArray
) -> None:
    for entry in range(len(starts) - 1):
        for lane in range(LANES):
            out[entry, lane] = 0.0
        for term in range(starts[entry], starts[entry + 1]):
            value, source = values[term], sources[term]
            for lane in range(LANES):
                out[entry, lane] += value * lanes[source, lane]


@_compiled
def _eliminate(starts: Indices, targets: NDArray[np.int32], entries: FloatArray) -> None:
    inverse, share = np.empty(LANES), np.empty(LANES)
    at = 0
    for column in range(len(starts) - 1):
        start, end = starts[column], starts[column + 1]
        for lane in range(LANES):
            inverse[lane] = 1.0 / entries[start, lane]
        for row in range(start + 1, end):
            for lane in range(LANES):
                share[lane] = entries[row, lane] * inverse[lane]
            for other in range(row, end):
                target = targets[at]
                at += 1
                for lane in range(LANES):
                    entries[target, lane] -= share[lane] * entries[other, lane]
