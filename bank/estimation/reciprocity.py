"""How far off a slice is by what opposite injections say twice: `ReciprocityCheck`.

Injection i + 16 drives the current of injection i backwards, so that every voltage is measured twice in a frame. The
means of the two have half of the noise, and what is not noise stands out. A gel's drift is large in some channels,
where a foreign frame is in all of them: the median of the channels tells the two apart better than their mean
(docs/charts.md).
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray
from shearloop.bank.eit.channels import CHANNELS, N_CHANNELS, N_ELECTRODES
from shearloop.bank.estimation.directions import coordinates
from shearloop.bank.estimation.regressors import left_out_blocks

# Directions in which slices vary, which are looked away from.
_DIRECTIONS = 12
# Beyond the largest misfit of blocks left out: later slices stay within 1.39 times of it after two repeats, and within
# 0.8 times after four.
_MARGIN = 1.5
_ALL = np.ones(N_CHANNELS, dtype=np.bool_)

_FIRST = np.flatnonzero(CHANNELS[:, 0] < N_ELECTRODES // 2)
_PLACE = {(sink, positive): i for i, (sink, _, positive, _) in enumerate(CHANNELS.tolist())}
_SECOND = np.array([_PLACE[sink + N_ELECTRODES // 2, positive] for sink, _, positive, _ in CHANNELS[_FIRST].tolist()])


@dataclass(frozen=True, slots=True, eq=False)
class ReciprocityCheck:
    """Mean (448,) and spread (448,) in volts of the means of two, and directions (r, 448) in units of the spread."""

    mean: FloatArray
    spread: FloatArray
    directions: FloatArray
    largest_misfit: float

    @classmethod
    def fit(cls, differences: FloatArray) -> Self:
        """Fit to (n, 896) differences in time order; the limit comes from blocks of time that were left out in turn."""
        misfits = []
        for rest, block in left_out_blocks(len(differences)):
            part = cls._explaining(differences[rest], np.inf)
            misfits += [part.misfit(one, _ALL) for one in differences[block]]
        return cls._explaining(differences, _MARGIN * max(misfits))

    @classmethod
    def _explaining(cls, differences: FloatArray, largest_misfit: float) -> Self:
        pairs = paired(differences)
        mean, variance = pairs.mean(axis=0), pairs.var(axis=0)
        # Half is everybody's: of few slices a channel's own variance says little.
        spread = np.sqrt(0.5 * variance + 0.5 * np.median(variance) + np.finfo(np.float64).tiny)
        directions = np.linalg.svd((pairs - mean) / spread, full_matrices=False)[2]
        return cls(mean, spread, directions[: min(_DIRECTIONS, len(pairs) // 2)], largest_misfit)

    def misfit(self, difference: FloatArray, usable: BoolArray) -> float:
        """Return the median square by which a (896,) difference is off to the side of the directions."""
        both = usable[_FIRST] & usable[_SECOND]
        x = (paired(difference) - self.mean) / self.spread
        return float(np.median((x - coordinates(self.directions, x, both) @ self.directions)[both] ** 2))


def paired(differences: FloatArray) -> FloatArray:
    """Return the (…, 448) means of what is measured twice in (…, 896) differences."""
    return np.asarray((differences[..., _FIRST] + differences[..., _SECOND]) / 2)
