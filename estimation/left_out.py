"""Ways to leave frames out of a fit: blocks of time, groups, and later parts."""

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np

from shearloop.bank.arrays import IntArray

# Pairs of rows to fit to and rows to validate on.
LeftOut: TypeAlias = Sequence[tuple[IntArray, IntArray]]

N_BLOCKS = 5
FIRST_ORIGIN, N_ORIGINS, MIN_BEFORE_ORIGIN = 0.6, 20, 12


def left_out_groups(numbers: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Return (rest, group) for each group of rows, from the group's number of each of (n,) rows."""
    return [(np.flatnonzero(numbers != number), np.flatnonzero(numbers == number)) for number in np.unique(numbers)]


def left_out_blocks(n: int) -> list[tuple[IntArray, IntArray]]:
    """Return (rest, block) for N_BLOCKS blocks of n rows, each one stretch of time."""
    return left_out_groups(np.arange(n) * N_BLOCKS // n)


def later_origins(n: int) -> list[tuple[IntArray, IntArray]]:
    """Return (earlier, all later) parts of n rows, from six tenths of the time on: rolling forecasts.

    The list is empty where the first part has too few rows to represent this calibration.
    """
    first = round(FIRST_ORIGIN * n)
    if first < MIN_BEFORE_ORIGIN:
        return []
    return [(np.arange(cut), np.arange(cut, n)) for cut in range(first, n - 1, max(1, n // N_ORIGINS))]


def later_splits(n: int) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield (earlier, later) parts of n rows in time order: fit on the one, validate on the other."""
    for share in (0.4, 0.6, 0.8):
        cut, end = round(n * share), round(n * min(share + 0.2, 1.0))
        if cut >= 2 and end > cut:
            yield np.arange(cut), np.arange(cut, end)
