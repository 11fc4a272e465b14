"""What estimators ask of a frame, by compiled code where there is some, and by numpy where there is none."""

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.eit import compiled
from shearloop.bank.eit.channels import N_CHANNELS

if TYPE_CHECKING:
    from shearloop.bank.eit._frames import Fingertips

FloatArray: TypeAlias = NDArray[np.float64]


def medians(rows: FloatArray, counts: NDArray[np.int64]) -> list[float]:
    """Return the medians of the first `counts` (n,) values of each of (…, 896) rows, in order with NaN last; 0 of none.

    Frames come when the processor's caches hold other things, and numpy sorts by long code for wide registers: where
    nothing is compiled a median costs twice to five times as much, cold and hot.
    """
    if compiled.IS_COMPILED:
        return compiled.frames.medians(np.ascontiguousarray(rows, dtype=np.float64), counts)
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
    if compiled.IS_COMPILED:
        off = np.empty(known.shape)
        return off, compiled.frames.compared(known, np.ascontiguousarray(frame, dtype=np.float64), counts, off)
    frame = frame[..., None, :]
    gains = np.array([gain if gain > 0 else np.nan for gain in medians(frame / known, counts)])
    off = np.abs(frame / gains.reshape(*known.shape[:-1], 1) - known) / known
    return off, medians(off, counts)


def n_largest(rows: FloatArray) -> list[int]:
    """Return how many values of each of (n, 896) rows without NaN are its largest."""
    if not compiled.IS_COMPILED:
        return [int(np.count_nonzero(one == one.max())) for one in rows]
    return compiled.frames.n_largest(np.ascontiguousarray(rows, dtype=np.float64))


def all_finite(values: FloatArray) -> bool:
    """Return whether all values are finite."""
    found = compiled.frames.all_finite(values) if compiled.IS_COMPILED else None
    return bool(np.count_nonzero(np.isfinite(values)) == values.size) if found is None else found


def deviation(values: FloatArray, mean: FloatArray, weights: FloatArray) -> float:
    """Return (values − mean) · weights of (n,) arrays."""
    found = compiled.frames.deviation(values, mean, weights) if compiled.IS_COMPILED else None
    return float((values - mean) @ weights) if found is None else found


def n_beyond(values: FloatArray, centre: FloatArray, reach: FloatArray, times: float) -> int:
    """Return how many of (n,) values are further from the centre than so many times their reach."""
    found = compiled.frames.beyond(values, centre, reach, times) if compiled.IS_COMPILED else None
    return int(np.count_nonzero(np.abs(values - centre) > times * reach)) if found is None else found


def follow(mean: FloatArray, values: FloatArray, n: int) -> None:
    """Make a mean, in its place, that of n arrays of which `values` are the last."""
    if not (compiled.IS_COMPILED and compiled.frames.follow(mean, values, n)):
        mean += (values - mean) / n


def motion(places: tuple[FloatArray, ...], at: FloatArray | None) -> FloatArray:
    """Return how far the last of (n,) places is from each before it, the nearest first, and then `at` (n,), flat."""
    features = np.empty((len(places) - (at is None)) * len(places[-1]))
    if compiled.IS_COMPILED and compiled.frames.motion(places, at, features):
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
) -> "Fingertips | None":
    """Return what looks at frames of m fingertips in a few calls while the same channels are usable.

    None where nothing is compiled. known (m, 2, 896) frames, of which counts (m·2,) values are no NaN; jumps_v and
    weights (m, 896) of a jump and of the grip's score; directions (m, p, 896). masks are which (m, 896) channels are
    told to be usable, and which are lost; moves are `Motion.readings` (m, 2p + 1, 896), of nothing (m, 0, 896) where
    nothing is to be filled in. An ordinary frame has fewer than fewest_at_rail usable channels at their largest value,
    off by more than lost_share from both known frames those that are lost and no others, and of one of them, where at
    least fewest_compared are compared, more than half off by no more than largest_deviation. The score divides by
    voltages + small_v.
    """
    if not compiled.IS_COMPILED:
        return None
    values = [np.ascontiguousarray(one, dtype=np.float64) for one in (known, jumps_v, weights, directions, *moves)]
    limits = fewest_at_rail, fewest_compared, largest_deviation, lost_share, small_v
    m, p = directions.shape[:2]
    arrays = (*values, counts, *map(np.ascontiguousarray, masks))
    return compiled.frames.Fingertips(m, p, moves[0].shape[1], arrays, *limits)
