"""Twists in recorded torques, and the gain that fits them."""

import math
from collections.abc import Iterator

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray

# A frame is loaded above this fraction of the largest torque.
LOADED_FRACTION = 0.1


def runs(chosen: BoolArray) -> Iterator[tuple[int, int]]:
    """Yield the first row and the end of each unbroken stretch of chosen rows (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    return zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def find_twists(torque_nm: FloatArray, largest_nm: float | None = None) -> list[IntArray]:
    """Return the rows of each stretch of loaded frames in (n,) torques; the largest torque is given or found."""
    largest_nm = float(np.abs(torque_nm).max(initial=0.0)) if largest_nm is None else largest_nm
    return [np.arange(first, end) for first, end in runs(np.abs(torque_nm) > LOADED_FRACTION * largest_nm)]


def first_twists(torque_nm: FloatArray, grips: IntArray) -> BoolArray:
    """Return which of (n,) frames belong to the first twist of their grip, from the number of each frame's grip."""
    found: BoolArray = np.zeros(len(torque_nm), dtype=np.bool_)
    for rows in (np.flatnonzero(grips == grip) for grip in np.unique(grips)):
        for first in find_twists(torque_nm[rows])[:1]:
            found[rows[first]] = True
    return found


def loaded_log_gain(predicted: FloatArray, truth: FloatArray) -> float | None:
    """Return the logarithm of the factor on (n,) predictions that fits the truth of the loaded frames best."""
    rows = np.abs(truth) > LOADED_FRACTION * float(np.abs(truth).max())
    return log_gain(predicted[rows], truth[rows])


def log_gain(predicted: FloatArray, truth: FloatArray) -> float | None:
    """Return the logarithm of the factor on (n,) predictions that fits the truth best.

    None where they do not follow the truth: a load that was missed, or of the other sign, has no gain.
    """
    along = float(predicted @ truth)
    return math.log(along / float(predicted @ predicted)) if along > 0 else None
