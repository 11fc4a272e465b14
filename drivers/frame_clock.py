"""When a frame was measured, from when it was read.

A board with a steady period sends each frame as soon as it is complete, but the reader sees it later whenever the
reader (or the bus) was busy: delays are never negative. The straight line that runs below all (frame number, arrival)
points and as close to them as it can is therefore the board's own clock (Moon, Skelly and Towsley 1999, "Estimation
and removal of clock skew from network delay measurements": the line is the edge of the lower convex hull that
spans the middle of the points). Its slope is the period; its height, over the last few frames, is the phase.
"""

from collections import deque
from collections.abc import Iterable
from itertools import islice, pairwise
from statistics import median

# Frames from which the period is learned: at 0.54 s the last 35 s, in which a crystal drifts by microseconds.
PERIOD_WINDOW = 64
# The period is learned anew at every so many frames only: that is most of the cost, and it hardly moves.
LEARN_EVERY = 4
# Frames whose earliest fixes the phase: short, so that a board that paused for a moment is followed within 6 s.
PHASE_WINDOW = 12
# Fewer spacings than this say nothing about the period that the nominal one does not say better. Each is taken over
# so many frames that a burst of late ones within it does no harm.
LEARN_FROM = 16
SPACING_FRAMES = 4
# A longer pause than this, in periods, is a board that stopped; its new phase has nothing to do with the old one.
LONGEST_GAP = 2.5
# A period further than this from the usual spacing of frames is a burst of late frames, not a clock.
PLAUSIBLE = 0.05


class FrameClock:
    """Straightens the arrival stamps of frames, causally, and learns the board's period.

    All times are integer nanoseconds of one monotonic clock. A straightened stamp is never later than the arrival.
    The nominal period serves until enough frames have come to learn the real one.
    """

    def __init__(self, nominal_period_ns: int) -> None:
        self._period_ns = float(nominal_period_ns)
        self._learned = False
        # (frames counted, arrival) of the last frames, restarts included, and the last spacings, each over some of
        # them: their usual one is the period, roughly.
        self._latest: deque[tuple[int, int]] = deque(maxlen=SPACING_FRAMES + 1)
        self._spacings: deque[float] = deque(maxlen=LEARN_FROM)
        # (frame number, arrival), one run of the board without a gap.
        self._seen: deque[tuple[int, int]] = deque(maxlen=PERIOD_WINDOW)
        self._straight_ns = 0

    @property
    def period_ns(self) -> int:
        """The learned period, or the nominal one until it is learned."""
        return round(self._period_ns)

    @property
    def learned(self) -> bool:
        """Whether the period comes from frames rather than from the nominal value."""
        return self._learned

    def restart(self) -> None:
        """Forget the phase (the board was started anew); the period is kept."""
        self._seen.clear()

    def arrived(self, arrival_ns: int, missed: bool = False) -> int:
        """Take the next frame's arrival and return when it would have arrived at a reader that is never late.

        `missed` says that something came since the last frame which was no frame (a refused line): the number of
        periods is then read from the time. Without it a late frame counts as the next one.
        """
        number, steps = 0, 1
        if self._seen:
            number, last_ns = self._seen[-1]
            elapsed = (arrival_ns - self._straight_ns) / self._period_ns
            steps = max(1, round(elapsed)) if missed and self._learned else 1
            number += steps
            late = elapsed - steps
            late_before = (last_ns - self._straight_ns) / self._period_ns
            # Frames that waited for the reader come in a burst, each less late than the one before. Frames that stay
            # as late come from a board that paused. Half a period early: the one before was counted as two.
            paused = min(late, late_before) > 0.5 and late > late_before - 0.5
            if elapsed > LONGEST_GAP or late < -0.5 or paused:
                self.restart()
        self._seen.append((number, arrival_ns))
        self._latest.append((self._latest[-1][0] + steps if self._latest else 0, arrival_ns))
        if len(self._latest) > SPACING_FRAMES:
            (n, before_ns), (m, _) = self._latest[0], self._latest[-1]
            self._spacings.append((arrival_ns - before_ns) / (m - n))
        self._learn(number)
        recent = islice(reversed(self._seen), PHASE_WINDOW)
        self._straight_ns = round(min([arrival + (number - n) * self._period_ns for n, arrival in recent]))
        return self._straight_ns

    def _learn(self, number: int) -> None:
        due = number % LEARN_EVERY == 0
        if len(self._spacings) < LEARN_FROM or (self._learned and not due):
            return
        spacing = median(self._spacings)
        if spacing <= 0:
            return
        if abs(self._period_ns - spacing) > PLAUSIBLE * spacing:
            self._period_ns, self._learned = spacing, True
        if due and len(self._seen) >= LEARN_FROM:
            slope = slope_below(self._seen)
            if abs(slope - spacing) <= PLAUSIBLE * spacing:
                self._period_ns, self._learned = slope, True


def slope_below(points: Iterable[tuple[int, int]]) -> float:
    """Return the slope of the line below all points, in order of their abscissa, that is closest to them in total."""
    points = list(points)
    hull: list[tuple[int, int]] = []
    for n, t in points:
        # The last corner leaves the lower hull when it lies on or above the chord past it.
        while len(hull) > 1 and (hull[-1][1] - hull[-2][1]) * (n - hull[-2][0]) >= (t - hull[-2][1]) * (
            hull[-1][0] - hull[-2][0]
        ):
            hull.pop()
        hull.append((n, t))
    middle = sum(n for n, _ in points) / len(points)
    (n0, t0), (n1, t1) = next(edge for edge in pairwise(hull) if edge[1][0] >= middle)
    return (t1 - t0) / (n1 - n0)
