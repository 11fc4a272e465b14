"""Fits how much the gain of a torque changes: between grips, between twists of a grip, and between tools."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.estimation.gain import FIRST_SPREAD, MIN_WITHIN, PRIOR_RECORDINGS, GainSpread, ToolLaw, pooled
from shearloop.estimation.twists import find_twists, log_gain

# Standard deviation of the logarithm of the gain between recordings, for one fingertip and for two. Cylinders and days
# recorded twice differ by factors of 0.44 to 1.4 for one fingertip, of 0.86 and 1.2 for two (docs/decisions/0046).
PRIOR_SPREADS = {1: 0.28, 2: 0.16}
# The same for a calibration on fewer twists, which do not show that the torque repeats. The gains of two recordings
# with one twist each differ by factors of 3.0 (right), 2.2 (left) and 1.1 (both).
_REPEATING_TWISTS, _UNREPEATED_SPREADS = 3, {1: 0.9, 2: 0.24}
# As many grips as the prior mean of 0 for the first twist after a grip counts as.
_PRIOR_GRIPS = 1
# Standard deviation of the gain's logarithm for a tool that was not calibrated, against the law over the diameter: a
# factor of 4 either way.
TOOL_SPREAD = 0.7
# The minimum noise, as a fraction of the largest torque.
_MIN_NOISE = 1e-3


def fit_gain_spread(
    predicted: FloatArray,
    truth: FloatArray,
    grips: IntArray,
    is_first: BoolArray,
    left_out: Sequence[float],
    halves: Sequence[float],
    fingertips: int,
) -> GainSpread:
    """Return the spread from (n,) predictions of left-out frames and their truth, in the order of time.

    `grips` are the number of each frame's grip, `is_first` whether the frame belongs to the grip's first twist.
    `left_out` are logarithms of the gains of grips that were left out of the fit, `halves` of the gains of the halves
    of a grip's twists. The fingertips have one prior.
    """
    rows_of_grips = [np.flatnonzero(grips == grip) for grip in np.unique(grips)]
    found = [_GripGains.of(predicted[rows], truth[rows], is_first[rows]) for rows in rows_of_grips]
    errors_nm = [error_nm for grip in found for error_nm in grip.errors_nm]
    noise_nm = float(np.sqrt(np.mean(np.concatenate(errors_nm) ** 2))) if errors_nm else 0.0
    least_noise_nm = _MIN_NOISE * float(np.abs(truth).max(initial=0.0))
    # A tool's own gain is not a difference between twists, so each grip counts from its own mean.
    compared = [grip for grip in found if grip.later]
    freedom = sum(len(grip.later) - 1 for grip in compared)
    squares = sum(sum((gain - grip.mean) ** 2 for gain in grip.later) for grip in compared)
    within = math.sqrt(squares / freedom) if freedom else 0.0
    firsts = [gain - grip.mean for grip in compared for gain in grip.first]
    first = sum(firsts) / (_PRIOR_GRIPS + len(firsts))
    first_prior = FIRST_SPREAD / math.sqrt(fingertips)
    n_twists = sum(len(grip.errors_nm) for grip in found)
    spreads = _UNREPEATED_SPREADS if 0 < n_twists < _REPEATING_TWISTS else PRIOR_SPREADS
    prior = GainSpread(
        spreads[fingertips],
        max(within, MIN_WITHIN),
        max(noise_nm, least_noise_nm),
        first=first,
        first_spread=pooled(first_prior, PRIOR_RECORDINGS, [(deviation - first) ** 2 for deviation in firsts]),
    )
    spread = prior.with_recordings([logarithm**2 for logarithm in left_out])
    between_halves = float(np.mean(np.square(halves))) if len(halves) else 0.0
    return replace(spread, drift=math.sqrt(max(between_halves - spread.between**2, 0.0)))


@dataclass(frozen=True, slots=True)
class _GripGains:
    """The logarithms of the gains of a grip's twists, the first after the grip apart from the later ones.

    `errors_nm` has one row for each twist: the errors that its gain does not explain.
    """

    first: Sequence[float]
    later: Sequence[float]
    errors_nm: Sequence[FloatArray]

    @classmethod
    def of(cls, predicted: FloatArray, truth: FloatArray, is_first: BoolArray) -> Self:
        """Return the gains of (n,) predictions of one grip; a twist that they do not follow has none."""
        first: list[float] = []
        later: list[float] = []
        errors_nm: list[FloatArray] = []
        for rows in find_twists(truth):
            gain = log_gain(predicted[rows], truth[rows])
            if gain is None:
                errors_nm.append(truth[rows])
                continue
            errors_nm.append(truth[rows] - math.exp(gain) * predicted[rows])
            (first if is_first[rows[0]] else later).append(gain)
        return cls(first, later, errors_nm)

    @property
    def mean(self) -> float:
        """The mean of the later twists."""
        return float(np.mean(self.later))


def fit_tool_law(diameters_mm: FloatArray, gains: FloatArray) -> ToolLaw:
    """Fit to (n,) gains of tools of three diameters or more."""
    x, y = np.log(diameters_mm), np.log(gains)
    slope, intercept = np.polyfit(x, y, 1)
    tools = np.unique(x).tolist()
    squares = [
        float(np.mean((y[x == tool] - np.polyval(np.polyfit(x[x != tool], y[x != tool], 1), tool)) ** 2))
        for tool in tools
    ]
    # A line through two points says little of how far a third one lies, so the prior stays.
    spread = max(pooled(TOOL_SPREAD, PRIOR_RECORDINGS, squares), TOOL_SPREAD)
    return ToolLaw(float(intercept), float(slope), spread, float(diameters_mm.min()), float(diameters_mm.max()))
