"""A bank compressed to a few numbers per cell, with bounds on the remainder.

Every unit signal b of the bank is split as b = Φ c + d, with Φ (896 × r) an orthonormal basis fitted to the bank, d
orthogonal to it and ‖d‖ = ρ. For a frame y with g = Φᵀ y and t = ‖y − Φ g‖, Cauchy and Schwarz give

    b·y = c·g + d·(y − Φ g) ≤ c·g + ρ t,

and for all cells with c within a radius e of a centre m, b·y ≤ m·g + e ‖g‖ + ρ t. The first direction of Φ is the mean
signal. It is nowhere negative, and neither are the frames, so g₁ ≥ 0. With the largest c₁ of the cells in place of m₁,
e and ‖g‖ need only cover the other directions, where a frame is far shorter. A bound is the product of a row (m, e, ρ)
and a column (g, ‖g‖, t), so many bounds are one matrix product in float32.
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

# Number of cells, spread over the bank, that the basis is fitted to: neighbouring cells are alike.
_FITTED_CELLS = 1024
# Cells in memory at a time.
_CHUNK_CELLS = 128
# Numbers per cell: few to find the neighbourhood, more to separate its cells.
COARSE_RANK = 24
FINE_RANK = 96
# Number of groups in each level of the hierarchy, and the mean number of cells in a group at least.
_N_GROUPS = (128, 512, 2048)
_MIN_GROUP_CELLS = 4
# Level with groups small enough to search for a high score.
SEED_LEVEL = 1
# Groups are split by their radius plus ρ times a usual t.
_USUAL_T = 0.5
# Frames fall where cells are dense, so groups of many cells are split slightly sooner.
_CROWDING = 0.1
# Rounding of float32 in a bound, and in the square of t. Sums of 98 products and a transform of 1792 values of norm 1
# lose 5e-6 by the usual estimates; 3e-7 is observed.
ROUNDING = 2e-5
SQUARE_ROUNDING = 4e-6
# Rounding of float64 in the square of ρ.
_SQUARE_ROUNDING_64 = 1e-12


class GroupLevel(NamedTuple):
    """Groups of cells: their rows (m, r + 2), and (m,) the group of the previous level that contains each."""

    rows: Float32Array
    part_of: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class CompressedBank:
    """Rows of bounds, from coarse to fine; a bound is a row times a column of `columns`.

    basis (R, 896), most important directions first; fine (n, R + 2) and coarse (n, r + 2) rows of the n cells; levels
    of groups from few to many. overlaps (1792,) bound the norm of a signal's overlap with a frame at the lags from
    −896 up. Cell i belongs to group group_of[i] of the last level. members[j] are the cells of group j of SEED_LEVEL,
    and centres[j] is the cell nearest to its centre.
    """

    basis: Float32Array
    fine: Float32Array
    coarse: Float32Array
    levels: tuple[GroupLevel, ...]
    overlaps: FloatArray
    group_of: IntArray
    members: tuple[IntArray, ...]
    centres: IntArray


def compress(unit_signals: Callable[[IntArray], FloatArray], cells: IntArray) -> CompressedBank:
    """Compress the unit signals of n cells; `unit_signals` returns the (m, 896) signals of some of them."""
    gram, total = np.zeros((N_CHANNELS, N_CHANNELS)), np.zeros(N_CHANNELS)
    fitted = cells[:: max(len(cells) // _FITTED_CELLS, 1)]
    for some in _chunks(fitted):
        part = unit_signals(some)
        gram += part.T @ part
        total += part.sum(axis=0)
    rank = min(FINE_RANK, len(fitted), N_CHANNELS)
    mean = total / np.linalg.norm(total)
    at_mean = gram @ mean
    # Remove the mean from the Gram matrix and put it back with the largest weight, so that it comes first.
    above = mean @ at_mean + 2 * len(fitted)
    gram -= np.outer(mean, at_mean) + np.outer(at_mean, mean) - above * np.outer(mean, mean)
    _, ascending = linalg.eigh(gram, subset_by_index=[N_CHANNELS - rank, N_CHANNELS - 1])
    basis = np.column_stack([mean, ascending[:, -2::-1]])
    found = []
    least, most = np.ones(N_CHANNELS), np.zeros(N_CHANNELS)
    for some in _chunks(cells):
        part = unit_signals(some)
        found.append(part @ basis)
        energy = np.cumsum(np.square(part), axis=1)
        least, most = np.minimum(least, energy.min(axis=0)), np.maximum(most, energy.max(axis=0))
    numbers = np.vstack(found)
    coarse = _cell_rows(numbers[:, :COARSE_RANK])
    group_of = np.zeros(len(cells), dtype=np.int64)
    levels = []
    partitions = _partitions(coarse, [min(size, len(cells) // _MIN_GROUP_CELLS) for size in _N_GROUPS])
    for groups in partitions:
        part_of = np.array([group_of[chosen[0]] for chosen, _ in groups])
        levels.append(GroupLevel(np.array([row for _, row in groups]), part_of))
        for group, (chosen, _) in enumerate(groups):
            group_of[chosen] = group
    members = tuple(chosen for chosen, _ in partitions[SEED_LEVEL])
    return CompressedBank(
        basis=np.ascontiguousarray(basis.T, dtype=np.float32),
        fine=_cell_rows(numbers),
        coarse=coarse,
        levels=tuple(levels),
        overlaps=np.sqrt(np.maximum(np.concatenate([1 - least[::-1], most[::-1]]), 0.0)),
        group_of=group_of,
        members=members,
        centres=np.array([_central_cell(coarse, chosen) for chosen in members]),
    )


def columns(parts: NDArray[np.floating[Any]], squared_norms: FloatArray) -> Float32Array:
    """Return the (r + 2, n) columns of n frames y: parts (r, n) are Φᵀ y, squared_norms (n,) are ‖y‖²."""
    across = np.einsum("ij,ij->j", parts[1:], parts[1:])
    found = np.empty((len(parts) + 2, parts.shape[1]), dtype=np.float32)
    found[:-2] = parts
    found[-2] = np.sqrt(across)
    found[-1] = np.sqrt(np.maximum(squared_norms - parts[0] ** 2 - across, 0.0) + SQUARE_ROUNDING)
    return found


def _chunks(cells: IntArray) -> Iterable[IntArray]:
    return (cells[start : start + _CHUNK_CELLS] for start in range(0, len(cells), _CHUNK_CELLS))


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


def _partitions(cells: Float32Array, sizes: Sequence[int]) -> list[list[tuple[IntArray, Float32Array]]]:
    """Split the cells into groups, as many as each ascending size, or fewer where cells are alike.

    Returns, for each size, every group's cells and the row that bounds them. The group with the widest bound is split
    in two, between the cell farthest from its centre and the cell farthest from that one. Every group is therefore part
    of one group of the previous partition.
    """
    order = count()

    def entry(chosen: IntArray) -> tuple[float, int, IntArray, Float32Array]:
        row = _group_row(cells[chosen])
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


def _central_cell(cells: Float32Array, chosen: IntArray) -> int:
    points = cells[chosen, :-2]
    return int(chosen[np.argmin(_squared_distances(points, points.mean(axis=0)))])


def _squared_distances(points: Float32Array, place: Float32Array) -> Float32Array:
    apart = points - place
    squares: Float32Array = np.einsum("ij,ij->i", apart, apart)
    return squares
