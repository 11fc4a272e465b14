"""Tracking a shear force over time: its direction, and its place within the band that a response leaves open.

Friction gives one response a band of forces. A rising or falling response proves slip, and the force is at an end of
the band. A constant one leaves it anywhere within: it is then taken to be at its last known place, moved no further
than the band demands (the inverse of a play).
"""

import math
from collections import deque

from shearloop.bank.skin.calibration import SkinCalibration
from shearloop.bank.skin.membrane import Direction, ShearInterval, direction_of

# A response has moved when it differs by this many standard deviations of the compared means: by chance about once a
# week at ten responses a second.
STANDARD_DEVIATIONS = 5.0
# Responses averaged before they are compared.
AVERAGED = 3
# A slip proves the direction for this long. A longer time misses a hand that turns back, a shorter one forgets a slow
# loading between two responses.
MEMORY_S = 0.2
# While the skin sticks, the reference response is averaged over about this many: noise chose the first one.
SETTLES_OVER = 20.0


class DirectionFinder:
    """Finds from successive responses whether the magnitude of the force rises, falls, or may do either."""

    def __init__(self, noise: float) -> None:
        """Take the standard deviation of one response."""
        self.threshold = STANDARD_DEVIATIONS * noise * math.sqrt(2.0 / AVERAGED)
        self.restart()

    def restart(self) -> None:
        """Forget the past after missing responses."""
        self._latest: deque[float] = deque(maxlen=AVERAGED)
        self._turning: float | None = None
        self._direction = Direction.UNKNOWN
        self._seen_s = -math.inf

    def update(self, time_s: float, response: float) -> Direction:
        """Return the direction at this time; call in order of time."""
        self._latest.append(response)
        if len(self._latest) < AVERAGED:
            return Direction.UNKNOWN
        mean = sum(self._latest) / AVERAGED
        if self._turning is None:
            self._turning = mean
        elif self._turning * mean < 0:
            # The force passed through zero and rises from there.
            self._turning = 0.0
        moved = direction_of(self._turning, mean, self.threshold)
        if moved is not Direction.UNKNOWN:
            self._turning, self._direction, self._seen_s = mean, moved, time_s
        elif time_s - self._seen_s > MEMORY_S:
            self._direction = Direction.UNKNOWN
            self._turning += (mean - self._turning) / SETTLES_OVER
        return self._direction


class ForceFollower:
    """Keeps the most plausible force of the band that each response leaves open; begins at zero force."""

    def __init__(self, calibration: SkinCalibration, slack: float) -> None:
        """Take a calibration, and the change of response that may be noise."""
        self._calibration = calibration
        self._slack_n = slack / calibration.slope_per_n
        self._shear_n = 0.0

    def update(self, response: float, normal_n: float, direction: Direction) -> ShearInterval:
        """Return the most plausible shear force (N) of a response, within the band that friction leaves.

        The band belongs to an exact response; a known direction gives it no width.
        """
        band = self._calibration.band(response, normal_n, direction)
        if direction is not Direction.UNKNOWN:
            self._shear_n = band.shear_n
            return band
        low_n, high_n = band.low_n - self._slack_n, band.high_n + self._slack_n
        self._shear_n = min(max(self._shear_n, low_n), high_n)
        return ShearInterval(self._shear_n, low_n, high_n)
