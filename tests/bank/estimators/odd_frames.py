"""Frames as no sound board sends them, and looking at any by NumPy instead of in compiled calls."""

from unittest import mock

import numpy as np

from shearloop.bank.eit import compiled
from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation.values import FloatArray

# What a channel reads, or all of a side's.
ODD = {
    "nan": np.nan, "infinite": np.inf, "zero": 0.0, "subnormal": 5e-324, "negative": -0.2, "huge": 1e300,
    "tiny": 1e-300, "rail": 3.3,
}  # fmt: skip
BY_NUMPY = mock.patch.object(compiled, "IS_COMPILED", False)


def spoilt(frame: FloatArray, kind: str, n: int, random: np.random.Generator) -> FloatArray:
    """Return a frame with n of the channels of one of its sides odd."""
    frame, odd = frame.copy(), random.permutation(N_CHANNELS)[:n]
    side = random.integers(len(frame))
    match kind:
        case "shuffled":
            frame[side, odd] = frame[side, np.roll(odd, 1)]
        case "clipped":
            frame[side] = np.minimum(frame[side], np.sort(frame[side])[-max(n, 1)])
        case _:
            frame[side, odd] = ODD[kind]
    return frame
