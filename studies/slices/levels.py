"""Levels of torque: slices repeat them, so a level is left out of the fit with its slices."""

import numpy as np

from shearloop.bank.arrays import FloatArray, IntArray
from shearloop.estimation.left_out import MIN_BEFORE_ORIGIN, later_origins

# Values within this fraction of their range have one level: a little more than half the distance between ten levels.
NEAR_LEVEL = 0.06


def later_levels(values: FloatArray) -> list[tuple[IntArray, IntArray]]:
    """Return (earlier, later) parts of (n,) values as `later_origins`, without earlier values near the later one.

    Torques repeat. With the same level among the earlier ones, a flexible curve learns the levels and not the torque.
    Where too few other values remain, the level stays.
    """
    near = NEAR_LEVEL * float(np.ptp(values))
    found: list[tuple[IntArray, IntArray]] = []
    for earlier, later in later_origins(len(values)):
        # Later rows with the same earlier ones are one part.
        parts: dict[bytes, tuple[IntArray, list[int]]] = {}
        for row in later.tolist():
            rest = earlier[np.abs(values[earlier] - values[row]) > near]
            kept = rest if len(rest) >= MIN_BEFORE_ORIGIN else earlier
            _, rows = parts.setdefault(kept.tobytes(), (kept, []))
            rows.append(row)
        found += [(kept, np.array(rows)) for kept, rows in parts.values()]
    return found
