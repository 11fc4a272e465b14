"""Following a shear force through time: which way it goes, and where it is while the response tells only a band.

Friction makes one response belong to a band of forces. A response that rises or falls proves that the skin slips, and
then the force is at an end of the band. One that stays leaves it anywhere within: then the force is taken to be where
it was last known to be, moved no further than the band demands (the inverse of a play).
"""

import math
from collections import deque

from shearloop.bank.skin.calibration import SkinCalibration
from shearloop.bank.skin.membrane import Direction, ShearInterval, direction_of

# A response counts as having moved when it differs by so many standard deviations of what is compared: by chance about
# once in a week at ten responses a second.
STANDARD_DEVIATIONS = 5.0
# Responses averaged before they are compared.
AVERAGED = 3
# For so long a slip that was seen tells the direction. Longer would be taken in by a hand that turns back meanwhile,
# shorter would forget a slow loading between two responses.
MEMORY_S = 0.2
# While the skin sticks, the response that later ones are compared with is averaged over about so many: the first one
# was chosen by its noise.
SETTLES_OVER = 20.0


class DirectionFinder:
    """Tells from responses, one after the other, whether the magnitude of the force rises, falls, or may do either."""

    def __init__(self, noise: float) -> None:
        """Take the standard deviation of one response."""
        self.threshold = STANDARD_DEVIATIONS * noise * math.sqrt(2.0 / AVERAGED)
        self.restart()

    def restart(self) -> None:
        """Forget the past: responses are missing."""
        self._latest: deque[float] = deque(maxlen=AVERAGED)
        self._turning: float | None = None
        self._direction = Direction.UNKNOWN
        self._seen_s = -math.inf

    def update(self, time_s: float, response: float) -> Direction:
        """Return the direction at this time; calls must be in order of time."""
        self._latest.append(response)
        if len(self._latest) < AVERAGED:
            return Direction.UNKNOWN
        mean = sum(self._latest) / AVERAGED
        if self._turning is None:
            self._turning = mean
        elif self._turning * mean < 0:
            # Between two opposite forces lies none, and from there it rises.
            self._turning = 0.0
        moved = direction_of(self._turning, mean, self.threshold)
        if moved is not Direction.UNKNOWN:
            self._turning, self._direction, self._seen_s = mean, moved, time_s
        elif time_s - self._seen_s > MEMORY_S:
            self._direction = Direction.UNKNOWN
            self._turning += (mean - self._turning) / SETTLES_OVER
        return self._direction


class ForceFollower:
    """Keeps the most plausible force of the band that each response leaves open; begins at no force."""

    def __init__(self, calibration: SkinCalibration, slack: float) -> None:
        """Take a calibration, and the change of response that may be noise."""
        self._calibration = calibration
        self._slack_n = slack / calibration.slope_per_n
        self._shear_n = 0.0

    def update(self, response: float, normal_n: float, direction: Direction) -> ShearInterval:
        """Return the shear force (N) that a response most plausibly belongs to, within the band that friction leaves.

        The band is that of an exact response; where the direction is known it has no width.
        """
        band = self._calibration.band(response, normal_n, direction)
        if direction is not Direction.UNKNOWN:
            self._shear_n = band.shear_n
            return band
        low_n, high_n = band.low_n - self._slack_n, band.high_n + self._slack_n
        self._shear_n = min(max(self._shear_n, low_n), high_n)
        return ShearInterval(self._shear_n, low_n, high_n)
