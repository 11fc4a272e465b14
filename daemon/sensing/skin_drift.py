"""Learns a skin's drift from its zeros. No I/O; times are passed in.

Two zeros of a skin that does not drift differ too: friction leaves a tension of either sign after a load, the curve
has its hysteresis, and resistances have noise. A larger change is drift. It lies between what exceeds these and the
whole change, and the rate is that change over the time between the zeros.
"""

import math
from dataclasses import dataclass
from statistics import median

# Zeros closer together than this give no rate: a hand on the skin would look like a fast drift.
SHORTEST_S = 300.0
# Within this time a change that goes back again is no drift: it is that hand.
CONTRADICTED_WITHIN_S = 1800.0
# How long a zero counts. The last two always do.
MEMORY_S = 7200.0


@dataclass(slots=True)
class _Zero:
    """A zero: its time, ln(R₁/R₂), the noise in it, and its value as the zeros before and after it allow."""

    time_s: float
    response: float
    noise: float
    settled: float


class DriftLearner:
    """Bounds the drift of the response by the zeros of the last two hours, and at least by the configured drift."""

    def __init__(self, configured_per_hour: float, explained: float) -> None:
        """Take the configured bound (95 %), and the change between two zeros that friction and hysteresis explain."""
        self._configured_per_s = configured_per_hour / 3600.0
        self._explained = explained
        self._zeros: list[_Zero] = []
        self._per_s = self._configured_per_s

    @property
    def per_s(self) -> float:
        """The bound of the response's drift, 1/s."""
        return self._per_s

    @property
    def has_learned(self) -> bool:
        """Whether the zeros show more than the configured drift."""
        return self._per_s > self._configured_per_s

    def add(self, time_s: float, response: float, noise: float) -> None:
        """Take the next zero: its ln(R₁/R₂), and the 95 % bound of the noise in it."""
        zeros = self._zeros
        zeros.append(_Zero(time_s, response, noise, response))
        if len(zeros) >= 3 and time_s - zeros[-3].time_s <= CONTRADICTED_WITHIN_S:
            self._settle(*zeros[-3:])
        while len(zeros) > 2 and time_s - zeros[0].time_s > MEMORY_S:
            del zeros[0]
        pairs = ((zeros[i], later) for j, later in enumerate(zeros) for i in range(j))
        self._per_s = max([self._configured_per_s, *(self._rate(*pair) for pair in pairs)])

    def _settle(self, before: _Zero, zero: _Zero, after: _Zero) -> None:
        """Correct a zero that both its neighbours contradict: something touched the skin while it was taken."""
        zero.settled = median((before.response, zero.response, after.response))
        if before is self._zeros[0] and self._beyond(before, zero) > 0 >= self._beyond(zero, after):
            before.settled = zero.settled

    def _beyond(self, before: _Zero, after: _Zero) -> float:
        """Return how much of the change between two zeros nothing but drift explains; negative for a small change."""
        return abs(after.settled - before.settled) - self._explained - before.noise - after.noise

    def _rate(self, before: _Zero, after: _Zero) -> float:
        """Return the drift between two zeros, 1/s: at most twice the rate that is proved."""
        elapsed_s = after.time_s - before.time_s
        beyond = self._beyond(before, after)
        if elapsed_s < SHORTEST_S or beyond <= 0:
            return 0.0
        return min(abs(after.settled - before.settled), 2.0 * beyond) / elapsed_s


def zeros_differ_by(friction_response: float, response_half_width: float) -> float:
    """Return the change between two zeros of a skin that does not drift.

    Friction leaves a response of up to `friction_response`, of either sign. The half width is of one response (95 %).
    """
    return 2.0 * friction_response + math.sqrt(2.0) * response_half_width
