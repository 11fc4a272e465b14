"""Gain of a torque, and how much it changes between recordings.

The same twist moves the gel differently in another grip, so the estimates of a recording have an error in common that
grows with the torque. Its size is a random effect: `gain_fit.py` estimates it from several recordings, with a prior
that counts as some more. `gain_correction.py` corrects the gain by twists of known torque.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

from shearloop.estimation.values import TWO_SIDED_95

# As many recordings as a prior counts as.
PRIOR_RECORDINGS = 3
# The minimum spread of a recording's twists: a few equal ones are chance.
MIN_WITHIN = 0.05
# Standard deviation of the gain's logarithm for the first twist after a grip against the later ones.
FIRST_SPREAD = 0.2
# Furthest diameter beyond the calibrated ones, as a ratio.
_REACH = 1.5


@dataclass(frozen=True, slots=True)
class GainSpread:
    """Standard deviations of the gain's logarithm, and of the rest of a loaded frame's error in N·m.

    `between` is of one grip to the next, and as certain as from this number of `recordings`; `within` is of twists
    of one grip. The first twist after a grip differs from the later ones by `first`, with the deviation `first_spread`.
    `drift` is by how much more one half of a grip's twists deviates from the other than grips from each other.
    `zero` is of the torque without motion, as a fraction of the load: 0 for the calibration's tool.
    """

    between: float = 0.0
    within: float = MIN_WITHIN
    noise_nm: float = 0.0
    recordings: int = PRIOR_RECORDINGS
    zero: float = 0.0
    first: float = 0.0
    first_spread: float = FIRST_SPREAD
    drift: float = 0.0

    @property
    def is_of_another_tool(self) -> bool:
        """Whether the torque is of a tool that was not calibrated, so that nothing is known of its own gain."""
        return self.zero > 0.0

    def with_recordings(self, squares: Sequence[float]) -> Self:
        """Return the spread after recordings with these squares of the gain's logarithm."""
        between = pooled(self.between, self.recordings, squares)
        return replace(self, between=between, recordings=self.recordings + len(squares))

    def reach(self, value: float) -> tuple[float, float]:
        """Return how far the truth may lie below and above a value, at 95 %, because of the gain."""
        factor = math.exp(TWO_SIDED_95 * self.between)
        inward, outward = abs(value) * (1.0 - 1.0 / factor), abs(value) * (factor - 1.0)
        return (inward, outward) if value > 0 else (outward, inward)


@dataclass(frozen=True, slots=True)
class ToolLaw:
    """Gain over the tool's diameter: ln gain = intercept + slope · ln diameter, and the spread of a tool left out.

    The diameters in mm reach from low_mm to high_mm.
    """

    intercept: float
    slope: float
    spread: float
    low_mm: float
    high_mm: float

    @property
    def factor(self) -> float:
        """How far a torque may be off either way before a twist of known torque, at 95 %."""
        return math.exp(TWO_SIDED_95 * self.spread)

    def gain(self, diameter_mm: float) -> float | None:
        """Return the gain on a tool, None too far from the calibrated ones."""
        if not self.low_mm / _REACH <= diameter_mm <= self.high_mm * _REACH:
            return None
        return math.exp(self.intercept + self.slope * math.log(diameter_mm))


def pooled(prior: float, counts_as: int, squares: Sequence[float]) -> float:
    """Return the root mean square of deviations, with a prior that counts as some."""
    return math.sqrt((counts_as * prior**2 + sum(squares)) / (counts_as + len(squares)))
