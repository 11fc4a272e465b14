"""What is compiled of the bank's work, where there was a C compiler when this was installed.

The compiled code is `search.c`, for matchers, and `look.c` and `medians.c`, for what estimators ask of a frame; numpy
does the same without, and the tests compare the two. Its one purpose is the time from a frame to its estimate.
"""

from pathlib import Path
from types import ModuleType
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.linalg import cython_blas

from bank.channels import N_CHANNELS
from bank.compression import ROUNDING, SQUARE_ROUNDING, CompressedBank, FloatArray, Indices, Single

try:
    from bank import _frames, _search
except ImportError:
    # No compiler, or none that could build it; docs/speed.md tells what that costs.
    _frames = _search = None  # type: ignore[assignment]


def is_stale(module: ModuleType, *names: str) -> bool:
    """Return whether a module is compiled from other sources than lie beside it, for they have changed since.

    Where none lie there, as after an installation from a wheel, they have not.
    """
    sources = [Path(__file__).with_name(name) for name in names]
    there = all(source.exists() for source in sources)
    return there and crc32(b"".join(source.read_bytes() for source in sources)) != getattr(module, "SOURCES", None)


# Rows in blocks, the numbers of what they bound, and where those of each group begin.
Blocks = tuple[Single, NDArray[np.int32], NDArray[np.int32]]
# In the order of setup.py.
_SEARCH = ("_search.c", "candidates.c", "lags.c", "search.c", "eight.h", "search.h")
_FRAMES = ("_frames.c", "look.c", "medians.c", "look.h", "medians.h")
# Numbers that compiled code takes side by side, and the length of its transforms.
_LANES = 8
_LENGTH = 2048
# The norm of what is left out of nothing, so that its bound is below everything.
_NEVER = -1e6
# BLAS as scipy hands it to compiled code.
_SGEMM = getattr(cython_blas, "__pyx_capi__", {}).get("sgemm")
_FRESH = _search is not None and not is_stale(_search, *_SEARCH) and not is_stale(_frames, *_FRAMES)
IS_COMPILED = _FRESH and _search.is_sgemm(_SGEMM)


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
    levels = _levels_of(bank)
    return _search.Search(
        *(bank.basis, bank.fine, signals, places, norms, *grid, bank.overlaps, _spectra_of(bank), _rows_of(levels[0])),
        *(levels, _SGEMM, bank.coarse.shape[1] - 2, ROUNDING, SQUARE_ROUNDING, tie, tie_rounding, radius),
    )


def energy(difference: FloatArray, noise: FloatArray) -> float | None:
    """Return Σ (difference/noise)² of two (896,) arrays, or None.

    None: nothing is compiled, or a value is not finite, or a noise is not above zero.
    """
    if not IS_COMPILED:
        return None
    found = _search.energy(np.ascontiguousarray(difference), np.ascontiguousarray(noise))
    return None if found < 0 else found


def medians(rows: FloatArray, counts: NDArray[np.int64]) -> list[float]:
    """Return the medians of the first `counts` (n,) values of each of (…, 896) rows, in order with NaN last; 0 of none.

    Frames come when the processor's caches hold other things, and numpy sorts by long code for wide registers: where
    nothing is compiled a median costs twice to five times as much, cold and hot.
    """
    if IS_COMPILED:
        return _frames.medians(np.ascontiguousarray(rows, dtype=np.float64), counts)
    # Half the price of np.partition.
    ordered = np.sort(rows, axis=-1).reshape(-1, N_CHANNELS)
    return [
        (one.item((n - 1) // 2) + one.item(n // 2)) / 2 if n else 0.0
        for one, n in zip(ordered, counts.tolist(), strict=True)
    ]


def compared(known: FloatArray, frame: FloatArray, counts: NDArray[np.int64]) -> tuple[FloatArray, list[float]]:
    """Return by which shares (…, k, 896) a (…, 896) frame is off from known ones, and a flat list of their medians.

    After the gain in common: the median of the frame's ratios to a known one, of which `counts` (n,) values are
    no NaN. All is NaN without a gain.
    """
    if IS_COMPILED:
        off = np.empty(known.shape)
        return off, _frames.compared(known, np.ascontiguousarray(frame, dtype=np.float64), counts, off)
    frame = frame[..., None, :]
    gains = np.array([gain if gain > 0 else np.nan for gain in medians(frame / known, counts)])
    off = np.abs(frame / gains.reshape(*known.shape[:-1], 1) - known) / known
    return off, medians(off, counts)


def n_largest(rows: FloatArray) -> list[int]:
    """Return how many values of each of (n, 896) rows without NaN are its largest."""
    if not IS_COMPILED:
        return [int(np.count_nonzero(one == one.max())) for one in rows]
    return _frames.n_largest(np.ascontiguousarray(rows, dtype=np.float64))


def all_finite(values: FloatArray) -> bool:
    """Return whether all values are finite."""
    found = _frames.all_finite(values) if IS_COMPILED else None
    return bool(np.count_nonzero(np.isfinite(values)) == values.size) if found is None else found


def deviation(values: FloatArray, mean: FloatArray, weights: FloatArray) -> float:
    """Return (values − mean) · weights of (n,) arrays."""
    found = _frames.deviation(values, mean, weights) if IS_COMPILED else None
    return float((values - mean) @ weights) if found is None else found


def n_beyond(values: FloatArray, centre: FloatArray, reach: FloatArray, times: float) -> int:
    """Return how many of (n,) values are further from the centre than so many times their reach."""
    found = _frames.beyond(values, centre, reach, times) if IS_COMPILED else None
    return int(np.count_nonzero(np.abs(values - centre) > times * reach)) if found is None else found


def follow(mean: FloatArray, values: FloatArray, n: int) -> None:
    """Make a mean, in its place, that of n arrays of which `values` are the last."""
    if not (IS_COMPILED and _frames.follow(mean, values, n)):
        mean += (values - mean) / n


def motion(places: tuple[FloatArray, ...], at: FloatArray | None) -> FloatArray:
    """Return how far the last of (n,) places is from each before it, the nearest first, and then `at` (n,), flat."""
    features = np.empty((len(places) - (at is None)) * len(places[-1]))
    if IS_COMPILED and _frames.motion(places, at, features):
        return features
    rows = np.array(places)
    moved = (rows[-1] - rows[-2::-1]).ravel()
    return moved if at is None else np.concatenate([moved, at])


def fingertips_of(
    known: FloatArray,
    jumps_v: FloatArray,
    weights: FloatArray,
    directions: FloatArray,
    counts: NDArray[np.int64],
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    moves: tuple[FloatArray, FloatArray],
    *,
    fewest_at_rail: int,
    fewest_compared: int,
    largest_deviation: float,
    lost_share: float,
    small_v: float,
) -> "_frames.Fingertips | None":
    """Return what looks at frames of m fingertips in a few calls while the same channels are usable.

    None where nothing is compiled. known (m, 2, 896) frames, of which counts (m·2,) values are no NaN; jumps_v and
    weights (m, 896) of a jump and of the grip's score; directions (m, p, 896). masks are which (m, 896) channels are
    told to be usable, and which are lost; moves are `Motion.readings` (m, 2p + 1, 896), of nothing (m, 0, 896) where
    nothing is to be filled in. An ordinary frame has fewer than fewest_at_rail usable channels at their largest value,
    off by more than lost_share from both known frames those that are lost and no others, and of one of them, where at
    least fewest_compared are compared, more than half off by no more than largest_deviation. The score divides by
    voltages + small_v.
    """
    if not IS_COMPILED:
        return None
    values = [np.ascontiguousarray(one, dtype=np.float64) for one in (known, jumps_v, weights, directions, *moves)]
    limits = fewest_at_rail, fewest_compared, largest_deviation, lost_share, small_v
    m, p = directions.shape[:2]
    arrays = (*values, counts, *map(np.ascontiguousarray, masks))
    return _frames.Fingertips(m, p, moves[0].shape[1], arrays, *limits)


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
