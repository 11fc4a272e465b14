"""Schur complements of many symmetric positive matrices of one pattern, by the multifrontal method.

Duff and Reid 1983; Liu 1992. A front is a small dense matrix of a few unknowns, its pivots, and of all unknowns that
they are coupled to when they are eliminated. The remainder is added to the front of the first unknown that is left, its
parent. The pattern decides all of this, so it is planned once; only arithmetic on dense tiles remains for each matrix
(`vector_kernel`). Fronts reuse each other's memory and stay in the processor's caches.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.eit.forward import Terms
from shearloop.bank.eit.vector_kernel import LANES, TILE, Plan, schur_complements

Records = NDArray[np.void]
_CACHE_LINE_BYTES = 64


class Elimination:
    """Eliminates all unknowns but the last `kept` of n; keeps no state between calls, and may run in several threads.

    The order of the unknowns decides the fill. Terms of symmetric pairs are given twice or below the diagonal.
    """

    def __init__(self, terms: Terms, n: int, kept: int) -> None:
        """Plan the elimination."""
        self._kept = kept
        self._last_factor = int(terms.source.max())
        self._plan, self._entries = plan_of(terms, n, kept)

    def schur_complements(self, factors: FloatArray) -> FloatArray:
        """Return the (n, kept, kept) Schur complements for the (n, F) factors of the entries; factor F is 1.

        The bits of one matrix do not depend on the others. A matrix that is not positive definite to rounding gives
        meaningless or infinite numbers. Raises ValueError for fewer factors than the pattern names: compiled code does
        not check them.
        """
        if factors.shape[1] < self._last_factor:
            raise ValueError(f"the pattern names factor {self._last_factor}, but there are {factors.shape[1]}")
        left = np.empty((len(factors), self._kept, self._kept))
        schur_complements(
            self._plan, np.ascontiguousarray(factors), _lanes(factors.shape[1] + 1), _lanes(self._entries), left
        )
        return left


def _lanes(entries: int) -> FloatArray:
    """Return memory for some entries, each aligned to a cache line or half of one."""
    raw = np.empty(entries * LANES + _CACHE_LINE_BYTES // 8)
    first = -raw.ctypes.data % _CACHE_LINE_BYTES // 8
    return raw[first : first + entries * LANES].reshape(entries, LANES)


def plan_of(terms: Terms, n: int, kept: int) -> tuple[Plan, int]:
    """Return the plan for matrices of n unknowns, the last `kept` of them kept, and its number of entries."""
    lower = terms.where(terms.rows >= terms.columns)
    layout = _Layout(_in_order(_tree(_structures(lower, n, n - kept), n - kept, n)), n)
    entry_terms, term_starts = layout.terms(lower)
    arrivals, arrival_starts, columns = layout.arrivals()
    fronts = _records(
        base=layout.base, first=layout.first, end=layout.end, size=layout.size,
        tile_row=np.searchsorted(layout.tile_rows, layout.apart),
    )  # fmt: skip
    tile_rows = _records(term=term_starts, arrival=arrival_starts)
    return Plan(fronts, tile_rows, entry_terms, arrivals, columns), layout.entries


def row_start(row: IntArray) -> IntArray:
    """Return where a row of a front begins."""
    tiles = row // TILE
    found: IntArray = TILE * TILE // 2 * tiles * (tiles + 1) + row % TILE
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Front:
    """Pivots and the unknowns below them, by number, and the fronts that add their remainder to it."""

    pivots: list[int]
    below: IntArray
    children: list["_Front"]

    @property
    def end(self) -> int:
        """The row where the pivots end: they fill whole tiles."""
        return _whole(len(self.pivots))

    @property
    def rows(self) -> int:
        """Its number of rows, with empty ones at both ends to fill whole tiles."""
        return _whole(self.end + len(self.below))

    @property
    def entries(self) -> int:
        """Its number of entries in memory."""
        return int(row_start(np.array(self.rows)))


def _structures(lower: Terms, n: int, eliminated: int) -> list[IntArray]:
    """Return the rows below every unknown in its column when it is eliminated (George and Liu 1981, chapter 5)."""
    matrix = sp.csc_array((np.ones(len(lower.rows)), (lower.rows, lower.columns)), shape=(n, n))
    matrix.sum_duplicates()
    found: list[IntArray] = []
    children: list[list[IntArray]] = [[] for _ in range(n)]
    for column in range(eliminated):
        own = matrix.indices[matrix.indptr[column] : matrix.indptr[column + 1]].astype(np.int64)
        below = np.unique(np.concatenate([own, *children[column]]))
        below = below[below > column]
        children[column].clear()
        # Its neighbours become coupled: the first of them inherits the rest.
        children[below[0]].append(below)
        found.append(below)
    return found


def _tree(below: list[IntArray], eliminated: int, n: int) -> _Front:
    """Return the last front, which has no pivots. A front absorbs children where that costs nothing."""
    waiting: list[list[_Front]] = [[] for _ in range(eliminated + 1)]
    for column, rows in enumerate(below):
        front = _Front([column], rows, [])
        for child in sorted(waiting[column], key=lambda each: -len(each.pivots)):
            pivots = child.pivots + front.pivots
            apart = _cost(len(front.pivots), len(rows)) + _cost(len(child.pivots), len(child.below))
            if _cost(len(pivots), len(rows)) <= apart:
                front = _Front(pivots, rows, front.children + child.children)
            else:
                front.children.append(child)
        waiting[min(int(rows[0]), eliminated)].append(front)
    return _Front([], np.arange(eliminated, n), waiting[eliminated])


def _cost(pivots: int, below: int) -> float:
    """Return the cost of a front in products: its own, adding its remainder (4 each), and overhead (200), roughly."""
    products = sum((below + left) * (below + left + 1) // 2 for left in range(pivots))
    return products + 4 * below * (below + 1) / 2 + 200


def _in_order(last: _Front) -> list[_Front]:
    """Return all fronts, children before their parents, one family after the other."""
    found, waiting = [], [last]
    while waiting:
        front = waiting.pop()
        found.append(front)
        waiting.extend(front.children)
    return found[::-1]


class _Layout:
    """Fronts in order, with all unknowns numbered as they are eliminated, and their places in memory.

    Each front begins at `base`. Fronts reuse memory; the places `apart`, where one follows the other, are unique. Rows
    of tiles begin at `tile_rows`, in places apart.
    """

    def __init__(self, fronts: list[_Front], n: int) -> None:
        self.fronts = fronts
        self.number = np.arange(n)
        pivots = [pivot for front in fronts for pivot in front.pivots]
        self.number[pivots] = np.arange(len(pivots))
        many = np.array([len(front.pivots) for front in fronts])
        self.owner = np.append(np.repeat(np.arange(len(fronts)), many), np.full(n - len(pivots), len(fronts) - 1))
        self.end = np.array([front.end for front in fronts])
        self.first = self.end - many
        self.below = [np.sort(self.number[front.below]) for front in fronts]
        members = [np.append(self.number[front.pivots], rows) for front, rows in zip(fronts, self.below, strict=True)]
        self.size = self.first + [len(each) for each in members]
        self._keys = np.concatenate([s * n + each for s, each in enumerate(members)])
        self._shift = self.size - np.cumsum([len(each) for each in members])
        self.base, self.entries = _places(fronts)
        sizes = [front.entries for front in fronts]
        self.apart = np.cumsum(sizes) - sizes
        self.tile_rows = np.concatenate(
            [self.apart[s] + row_start(np.arange(0, front.rows, TILE)) for s, front in enumerate(fronts)]
        )

    def row(self, front: IntArray, unknown: IntArray) -> IntArray:
        """Return the rows of unknowns in fronts."""
        found: IntArray = np.searchsorted(self._keys, front * len(self.number) + unknown) + self._shift[front]
        return found

    def terms(self, lower: Terms) -> tuple[Records, IntArray]:
        """Return the terms of the matrices' own entries, and where each row of tiles begins in them."""
        upper, under = np.sort([self.number[lower.rows], self.number[lower.columns]], axis=0)
        front = self.owner[upper]
        at = self.apart[front] + row_start(self.row(front, under)) + TILE * self.row(front, upper)
        # Terms of one place and one source are merged.
        n_sources = lower.source.max() + 1
        keys, which = np.unique(at * n_sources + lower.source, return_inverse=True)
        at, source = np.divmod(keys, n_sources)
        front = np.searchsorted(self.apart, at, side="right") - 1
        place = at + (self.base - self.apart)[front]
        terms = _records(place=place, source=source, value=np.bincount(which, lower.values))
        return terms, np.append(np.searchsorted(at, self.tile_rows), len(at))

    def arrivals(self) -> tuple[Records, IntArray, NDArray[np.int32]]:
        """Return where rows of fronts go in their parents, where each row of tiles begins in them, and the columns."""
        position = {id(front): s for s, front in enumerate(self.fronts)}
        parents = np.empty(len(self.fronts) - 1, dtype=np.int64)
        for s, front in enumerate(self.fronts):
            parents[[position[id(child)] for child in front.children]] = s
        many = np.array([len(rows) for rows in self.below[:-1]])
        child = np.repeat(np.arange(len(many)), many)
        parent = parents[child]
        nth = np.arange(len(child)) - np.repeat(np.cumsum(many) - many, many)
        row = self.row(parent, np.concatenate(self.below[:-1]))
        arrivals = _records(
            source=self.base[child] + row_start(self.end[child] + nth) + TILE * self.end[child],
            target=self.base[parent] + row_start(row),
            length=nth + 1,
            column=np.arange(len(child)) - nth,
        )
        at = self.apart[parent] + row_start(row)
        order = np.argsort(at, kind="stable")
        starts = np.append(np.searchsorted(at[order], self.tile_rows), len(at))
        return arrivals[order], starts, (TILE * row).astype(np.int32)


def _places(fronts: list[_Front]) -> tuple[IntArray, int]:
    """Return where fronts begin, and the number of entries of all.

    There are two stacks: a front lies on one, and its children, which it replaces, on top of the other.
    """
    side = {id(fronts[-1]): 0}
    for front in reversed(fronts):
        side.update((id(child), 1 - side[id(front)]) for child in front.children)
    begin: dict[int, int] = {}
    top, most = [0, 0], [0, 0]
    for front in fronts:
        on = side[id(front)]
        begin[id(front)] = top[on]
        top[on] += front.entries
        most[on] = max(most[on], top[on])
        top[1 - on] = min([begin[id(child)] for child in front.children], default=top[1 - on])
    return np.array([begin[id(front)] + side[id(front)] * most[0] for front in fronts]), sum(most)


def _whole(rows: int) -> int:
    """Return a number of rows rounded up to whole tiles."""
    return -(-rows // TILE) * TILE


def _records(**fields: IntArray | FloatArray) -> Records:
    """Return a record array of the fields, with 32-bit integers."""
    kinds = [(name, np.float64 if values.dtype.kind == "f" else np.int32) for name, values in fields.items()]
    found = np.empty(len(next(iter(fields.values()))), dtype=kinds)
    for name, values in fields.items():
        found[name] = values
    return found
