"""What is compiled of the bank's work, where there was a C compiler when this was installed.

The compiled code is `search.c`; numpy does the same without, and the tests compare the two. Its one purpose is the
time from a frame to its estimate.
"""

from pathlib import Path
from types import ModuleType
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas

from bank.compression import ROUNDING, SQUARE_ROUNDING, CompressedBank, FloatArray, Indices, Single

try:
    from bank import _search
except ImportError:
    # No compiler, or none that could build it; docs/speed.md tells what that costs.
    _search = None  # type: ignore[assignment]


def is_stale(module: ModuleType, *names: str) -> bool:
    """Return whether a module is compiled from other sources than lie beside it, for they have changed since.

    Where none lie there, as after an installation from a wheel, they have not.
    """
    sources = [Path(__file__).with_name(name) for name in names]
    there = all(source.exists() for source in sources)
    return there and crc32(b"".join(source.read_bytes() for source in sources)) != getattr(module, "SOURCES", None)


Starts = NDArray[np.int32]
# BLAS as scipy hands it to compiled code.
_SGEMM = getattr(cython_blas, "__pyx_capi__", {}).get("sgemm")
IS_COMPILED = (
    _search is not None and not is_stale(_search, "_search.c", "search.c", "search.h") and _search.is_sgemm(_SGEMM)
)


def search_of(
    bank: CompressedBank,
    signals: Single,
    places: Indices,
    norms: FloatArray,
    grid: tuple[NDArray[np.int32], NDArray[np.int32]],
    *,
    tie: float,
    tie_rounding: float,
    radius: int,
) -> "_search.Search | None":
    """Return what finds the best cell of a compressed bank; None where nothing is compiled, or not for such signals.

    signals (m, 896) hold cell i of n in row places[i], with the norm norms[i]; `grid` are the rows and columns (n,) of
    the cells. Scores that differ by less than `tie` are the same, and a difference within `tie_rounding` of that is
    left undecided; a runner-up is more than `radius` rows or columns away.
    """
    flags = signals.flags
    if not (IS_COMPILED and signals.dtype == np.float32 and flags.c_contiguous and flags.aligned):
        return None
    levels, cells = _in_order(bank)
    return _search.Search(
        *(bank.basis, bank.coarse[cells], bank.fine, signals, places, norms, *grid, bank.overlaps, cells, levels),
        *(_SGEMM, ROUNDING, SQUARE_ROUNDING, tie, tie_rounding, radius),
    )


def energy(difference: FloatArray, noise: FloatArray) -> float | None:
    """Return Σ (difference/noise)² of two (896,) arrays, or None.

    None: nothing is compiled, or a value is not finite, or a noise is not above zero.
    """
    if not IS_COMPILED:
        return None
    found = _search.energy(np.ascontiguousarray(difference), np.ascontiguousarray(noise))
    return None if found < 0 else found


def _in_order(bank: CompressedBank) -> tuple[tuple[tuple[Single, Starts], ...], Starts]:
    """Return each level's groups so that the parts of each lie one after the other, and the cells (n,) likewise.

    A level is its rows, (m, r + 2), and where the parts of each group begin in what comes next, (m + 1,).
    """
    levels = []
    order = np.arange(len(bank.levels[0].rows))
    for level, group_of in zip(bank.levels, [*(each.part_of for each in bank.levels[1:]), bank.group_of], strict=True):
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        placed = place[group_of]
        parts = np.argsort(placed, kind="stable")
        starts = np.searchsorted(placed[parts], np.arange(len(order) + 1))
        levels.append((level.rows[order], starts.astype(np.int32)))
        order = parts
    return tuple(levels), order.astype(np.int32)
