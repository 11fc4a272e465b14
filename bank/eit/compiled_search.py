"""The compiled search of a compressed bank, and how it is handed what it works on; None where nothing is compiled."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from shearloop.bank.eit import compiled
from shearloop.bank.eit.compression import ROUNDING, SQUARE_ROUNDING, CompressedBank, FloatArray, Indices, Single

if TYPE_CHECKING:
    from shearloop.bank.eit._search import Search

# Rows in blocks, the numbers of what they bound, and where those of each group begin.
Blocks = tuple[Single, NDArray[np.int32], NDArray[np.int32]]
# Numbers that compiled code takes side by side, and the length of its transforms.
_LANES = 8
_LENGTH = 2048
# The norm of what is left out of nothing, so that its bound is below everything.
_NEVER = -1e6


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
) -> "Search | None":
    """Return what finds the best cell of a compressed bank; None where nothing is compiled, or not for such signals.

    signals (m, 896) hold cell i of n in row places[i], with the norm norms[i]; `grid` are the rows and columns (n,) of
    the cells. Scores that differ by less than `tie` are the same, and a difference within `tie_rounding` of that is
    left undecided; a runner-up is more than `radius` rows or columns away.
    """
    flags = signals.flags
    if not (compiled.IS_COMPILED and signals.dtype == np.float32 and flags.c_contiguous and flags.aligned):
        return None
    levels = _levels_of(bank)
    return compiled.search.Search(
        *(bank.basis, bank.fine, signals, places, norms, *grid, bank.overlaps, _spectra_of(bank), _rows_of(levels[0])),
        *(levels, compiled.SGEMM, bank.coarse.shape[1] - 2, ROUNDING, SQUARE_ROUNDING, tie, tie_rounding, radius),
    )


def energy(difference: FloatArray, noise: FloatArray) -> float | None:
    """Return Σ (difference/noise)² of two (896,) arrays, or None.

    None: nothing is compiled, or a value is not finite, or a noise is not above zero. Raises ValueError for arrays of
    different lengths.
    """
    if not compiled.IS_COMPILED:
        return None
    found = compiled.search.energy(*(np.ascontiguousarray(one, dtype=np.float64) for one in (difference, noise)))
    return None if found < 0 else found


def _levels_of(bank: CompressedBank) -> tuple[Blocks, ...]:
    """Return each level's groups, and the cells after them, in blocks of eight that are parts of the same group.

    A level is its rows in blocks (m, w + 2, 8), filled up with zeros to w numbers, a multiple of eight; the numbers of
    the groups or cells there (m, 8); and where the blocks of each group of the level before begin (n + 1,).
    """
    part_of = [*(level.part_of for level in bank.levels), bank.group_of]
    rows = [*(level.rows for level in bank.levels), bank.coarse]
    n_before = [1, *(len(level.rows) for level in bank.levels)]
    return tuple(_blocks(*each) for each in zip(rows, part_of, n_before, strict=True))


def _blocks(rows: Single, part_of: Indices, n_before: int) -> Blocks:
    counts = np.bincount(part_of, minlength=n_before)
    starts = np.concatenate([[0], np.cumsum(-(-counts // _LANES))])
    order = np.argsort(part_of, kind="stable")
    # The place of each part in its group.
    within = np.arange(len(order)) - (np.cumsum(counts) - counts)[part_of[order]]
    places = starts[part_of[order]] * _LANES + within
    parts = np.zeros(starts[-1] * _LANES, dtype=np.int32)
    parts[places] = order
    width = rows.shape[1] - 2
    filled = np.zeros((len(parts), -(-width // _LANES) * _LANES + 2), dtype=np.float32)
    # Where there is no part, nothing is reached: what is left of a frame is never 0.
    filled[:, -1] = _NEVER
    filled[places, :width], filled[places, -2:] = rows[order, :width], rows[order, -2:]
    blocks = filled.reshape(-1, _LANES, filled.shape[1]).transpose(0, 2, 1)
    return np.ascontiguousarray(blocks), parts.reshape(-1, _LANES), starts.astype(np.int32)


def _rows_of(level: Blocks) -> Single:
    return np.ascontiguousarray(level[0].transpose(0, 2, 1)).reshape(-1, level[0].shape[1])


def _spectra_of(bank: CompressedBank) -> Single:
    """Return the conjugate transforms of the basis's first directions, eight side by side: (m, n, 2, 8), scaled."""
    spectra = np.conj(fft.rfft(bank.basis[: bank.coarse.shape[1] - 2].astype(np.float64), _LENGTH)) / _LENGTH
    filled = np.zeros((-(-len(spectra) // _LANES) * _LANES, spectra.shape[1]), dtype=np.complex128)
    filled[: len(spectra)] = spectra
    parts = filled.reshape(-1, _LANES, spectra.shape[1]).transpose(0, 2, 1)
    return np.ascontiguousarray(np.stack([parts.real, parts.imag], axis=2), dtype=np.float32)
