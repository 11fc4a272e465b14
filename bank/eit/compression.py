"""A bank compressed into a few numbers per cell, with bounds on what was left out.

Every unit signal b of the bank is split as b = Φ c + d: Φ (896 × r) an orthonormal basis fitted to the bank, d
orthogonal to it, ‖d‖ = ρ. With a frame y, g = Φᵀ y and t = ‖y − Φ g‖, the inequality of Cauchy and Schwarz gives

    b·y = c·g + d·(y − Φ g) ≤ c·g + ρ t,

and for all cells whose c lie within a radius e of a centre m, b·y ≤ m·g + e ‖g‖ + ρ t. The first direction of Φ is the
mean of the signals, which is negative nowhere, as these and the frames are: so g₁ ≥ 0, and with the largest c₁ of the
cells in place of m₁, e and ‖g‖ need only be of the other directions, in which a frame is far shorter. So a bound is the
product of a row (m, e, ρ) with a column (g, ‖g‖, t), and many bounds are one matrix product, in float32.
"""

import heapq
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from shearloop.bank.arrays import Float32Array, FloatArray, IntArray
from shearloop.bank.eit.channels import N_CHANNELS

# A basis is fitted to about so many cells, from all over the bank: a cell is much like its neighbours.
_FITTED_CELLS = 1024
# Cells whose signals are in memory at once: a process keeps most of the memory that it has once taken, which a daemon
# does not need.
COMPRESSED_CELLS = 128
# Numbers per cell: few to find the neighbourhood, more to tell its cells apart.
COARSE_RANK = 24
FINE_RANK = 96
# Cells are bounded in groups first, those in groups of theirs, of at least so many cells on average.
_N_GROUPS = (128, 512, 2048)
# The level whose groups are small enough to look for a high score in.
SEED_LEVEL = 1
_LEAST_CELLS = 4
# What a group is split for: its radius, and its ρ times a usual t.
_USUAL_T = 0.5
# Frames fall where the bank's cells stand close: groups of many cells are split a little sooner.
_CROWDING = 0.1
# What float32 may take from a bound, and from the square that t is the root of. Sums of 98 products and a Fourier
# transform of 1792 values, of norm 1, lose 5e-6 by the usual estimates; what is seen is 3e-7.
ROUNDING = 2e-5
SQUARE_ROUNDING = 4e-6
# The same for ρ, whose square is summed in float64.
_SQUARE_ROUNDING_64 = 1e-12


class Level(NamedTuple):
    """Groups of cells: their rows (m, r + 2), and the group of the level before, (m,), that each is a part of."""

    rows: Float32Array
    part_of: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class CompressedBank:
    """Rows of bounds, from coarse to fine; a bound is a row times a column of `columns`.

    basis (R, 896), its first directions the most important; fine (n, R + 2) and coarse (n, r + 2) rows of the n cells;
    levels of groups from few to many. overlaps (1792,) bound what of a signal's norm overlaps with a frame at the lags
    from −896 up. Cell i belongs to group group_of[i] of the last level; members[j] are the cells of group j of
    SEED_LEVEL, and centres[j] is the one nearest to its centre. estimators (r, n) and left_out (n,) are coarse again,
    its c and ρ, in the order of memory that suits products with all cells.
    """

    basis: Float32Array
    fine: Float32Array
    coarse: Float32Array
    levels: tuple[Level, ...]
    overlaps: FloatArray
    group_of: IntArray
    members: tuple[IntArray, ...]
    centres: IntArray
    estimators: Float32Array
    left_out: Float32Array


def compress(unit_signals: Callable[[IntArray], FloatArray], cells: IntArray) -> CompressedBank:
    """Compress the unit signals of n cells; `unit_signals` gives those, (m, 896), of m of these cells."""
    gram, total = np.zeros((N_CHANNELS, N_CHANNELS)), np.zeros(N_CHANNELS)
    n, fitted = len(cells), cells[:: max(len(cells) // _FITTED_CELLS, 1)]
    for some in _parts(fitted):
        part = unit_signals(some)
        gram += part.T @ part
        total += part.sum(axis=0)
    rank = min(FINE_RANK, len(fitted), N_CHANNELS)
    mean = total / np.linalg.norm(total)
    at_mean = gram @ mean
    # The gram of what is across the mean, and on the mean more than all of it: so the mean comes first.
    above = mean @ at_mean + 2 * len(fitted)
    gram -= np.outer(mean, at_mean) + np.outer(at_mean, mean) - above * np.outer(mean, mean)
    _, ascending = linalg.eigh(gram, subset_by_index=[N_CHANNELS - rank, N_CHANNELS - 1])
    basis = np.column_stack([mean, ascending[:, -2::-1]])
    found = []
    least, most = np.ones(N_CHANNELS), np.zeros(N_CHANNELS)
    for some in _parts(cells):
        part = unit_signals(some)
        found.append(part @ basis)
        up_to = np.square(part)
        np.cumsum(up_to, axis=1, out=up_to)
        least, most = np.minimum(least, up_to.min(axis=0)), np.maximum(most, up_to.max(axis=0))
    numbers = np.vstack(found)
    coarse = _rows_of_cells(numbers[:, :COARSE_RANK])
    group_of = np.zeros(n, dtype=np.int64)
    levels = []
    partitions = _partitions(coarse, [min(size, n // _LEAST_CELLS) for size in _N_GROUPS])
    for groups in partitions:
        part_of = np.array([group_of[chosen[0]] for chosen, _ in groups])
        levels.append(Level(np.array([row for _, row in groups]), part_of))
        for group, (chosen, _) in enumerate(groups):
            group_of[chosen] = group
    members = tuple(chosen for chosen, _ in partitions[SEED_LEVEL])
    return CompressedBank(
        basis=np.ascontiguousarray(basis.T, dtype=np.float32),
        fine=_rows_of_cells(numbers),
        coarse=coarse,
        levels=tuple(levels),
        overlaps=np.sqrt(np.maximum(np.concatenate([1 - least[::-1], most[::-1]]), 0.0)),
        group_of=group_of,
        members=members,
        centres=np.array([_central(coarse, chosen) for chosen in members]),
        estimators=np.ascontiguousarray(coarse[:, :-2].T),
        left_out=np.ascontiguousarray(coarse[:, -1]),
    )


def column(parts: Float32Array, rank: int) -> tuple[Float32Array, np.float32]:
    """Return the (r + 2,) column of a frame y of norm 1, and its t at a lower rank; parts (r,) are Φᵀ y."""
    along, coarse, rest = float(parts[0]) ** 2, parts[1:rank], parts[rank:]
    across = float(coarse @ coarse)
    t = np.float32(math.sqrt(max(1.0 - along - across, 0.0) + SQUARE_ROUNDING))
    across += float(rest @ rest)
    found = np.empty(len(parts) + 2, dtype=np.float32)
    found[:-2] = parts
    found[-2] = math.sqrt(across)
    found[-1] = math.sqrt(max(1.0 - along - across, 0.0) + SQUARE_ROUNDING)
    return found, t


def columns(parts: NDArray[np.floating[Any]], squared_norms: FloatArray) -> Float32Array:
    """Return the (r + 2, n) columns of n frames y: parts (r, n) are Φᵀ y, squared_norms (n,) are ‖y‖²."""
    across = np.einsum("ij,ij->j", parts[1:], parts[1:])
    found = np.empty((len(parts) + 2, parts.shape[1]), dtype=np.float32)
    found[:-2] = parts
    found[-2] = np.sqrt(across)
    found[-1] = np.sqrt(np.maximum(squared_norms - parts[0] ** 2 - across, 0.0) + SQUARE_ROUNDING)
    return found


def _parts(cells: IntArray) -> Iterable[IntArray]:
    return (cells[start : start + COMPRESSED_CELLS] for start in range(0, len(cells), COMPRESSED_CELLS))


def _rows_of_cells(numbers: FloatArray) -> Float32Array:
    rows = np.zeros((len(numbers), numbers.shape[1] + 2), dtype=np.float32)
    rows[:, :-2] = numbers
    rows[:, -1] = np.sqrt(np.maximum(1 - np.einsum("ij,ij->i", numbers, numbers), 0.0) + _SQUARE_ROUNDING_64)
    return rows


def _bounding(cells: Float32Array) -> Float32Array:
    """Return the row that bounds all of some cells."""
    centre = cells[:, :-2].mean(axis=0)
    # Of the first direction and of what is left out the largest.
    row: Float32Array = cells.max(axis=0)
    row[1:-2] = centre[1:]
    row[-2] = math.sqrt(_squared_distances(cells[:, 1:-2], centre[1:]).max())
    return row


def _partitions(cells: Float32Array, sizes: Sequence[int]) -> list[list[tuple[IntArray, Float32Array]]]:
    """Split the cells into groups, as many as each of the rising sizes says, or fewer where cells are alike.

    Returns of each size the groups' cells, and the row that bounds those.

    The group of the widest bound is split in two, between the cell farthest from its centre and the one farthest from
    that; so every group is a part of one of the partition before.
    """
    order = count()

    def entry(chosen: IntArray) -> tuple[float, int, IntArray, Float32Array]:
        row = _bounding(cells[chosen])
        radius, left_out = row[-2:].tolist()
        width = (radius + _USUAL_T * left_out) * len(chosen) ** _CROWDING if radius > ROUNDING else 0.0
        return -width, next(order), chosen, row

    heap = [entry(np.arange(len(cells)))]
    found = []
    for size in sizes:
        while len(heap) < size and heap[0][0] < 0:
            _, _, chosen, _ = heapq.heappop(heap)
            points = cells[chosen, :-2]
            one = points[np.argmax(_squared_distances(points, points.mean(axis=0)))]
            other = points[np.argmax(_squared_distances(points, one))]
            nearer = (points - (one + other) / 2) @ (one - other) > 0
            heapq.heappush(heap, entry(chosen[nearer]))
            heapq.heappush(heap, entry(chosen[~nearer]))
        found.append([(chosen, row) for _, _, chosen, row in heap])
    return found


def _central(cells: Float32Array, chosen: IntArray) -> int:
    points = cells[chosen, :-2]
    return int(chosen[np.argmin(_squared_distances(points, points.mean(axis=0)))])


def _squared_distances(points: Float32Array, place: Float32Array) -> Float32Array:
    apart = points - place
    squares: Float32Array = np.einsum("ij,ij->i", apart, apart)
    return squares
