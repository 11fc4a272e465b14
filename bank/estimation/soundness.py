"""Refuses slices that no board sends, and those of a board whose ribbon cable was loose."""

from collections.abc import Iterator

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.bank.errors import CalibrationError
from shearloop.bank.estimation.fingertip_validator import LARGEST_UNUSABLE_SHARE
from shearloop.bank.estimation.regressors import later_origins, left_out_blocks

# What is less than this share of a slice is rounding: a board's converter alone makes thousands of times as much.
LEAST_NOISE = 1e-6


def check_slices(differences: FloatArray) -> None:
    """Raise CalibrationError for (n, 896) differences that are alike, or of which too many channels stand still."""
    n = len(differences)
    with np.errstate(over="ignore"):
        rounding_v = LEAST_NOISE * np.sqrt((differences**2).mean())
    for rows in parts_of(n):
        still = np.ptp(differences[rows], axis=0) <= rounding_v
        if still.all():
            raise CalibrationError(f"{len(rows)} of the {n} slices are all alike; record slices as they come")
        if still.mean() > LARGEST_UNUSABLE_SHARE:
            raise CalibrationError(
                f"in {len(rows)} of the {n} slices {100 * still.mean():.0f} % of the channels never change: they are "
                "dead or saturated; look at the ribbon cable and the gel's contact with the electrodes, and record anew"
            )


def parts_of(n: int) -> Iterator[IntArray]:
    """Yield the rows of all slices, then of each part of them that something is fitted to by itself."""
    yield np.arange(n)
    for rest, _ in left_out_blocks(n):
        yield rest
    # All later ones hold the first.
    for earlier, _ in later_origins(n)[:1]:
        yield earlier
