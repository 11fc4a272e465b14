"""The board's clock: when a frame was measured, from when it was read.

A board with a steady period sends each frame as soon as it is complete. A busy reader or bus sees it later, never
earlier. The board's clock is therefore the line closest below all (frame number, arrival) points. That line is the edge
of their lower convex hull that spans the middle (Moon, Skelly and Towsley 1999, "Estimation and removal of clock skew
from network delay measurements"). Its slope is the period; its height over the last few frames is the phase.
"""

from collections import deque
from collections.abc import Iterable
from itertools import islice, pairwise
from statistics import median

# Frames behind the period: 35 s at 0.54 s, while a crystal drifts by microseconds.
PERIOD_WINDOW = 64
# Frames between updates of the period, which hardly moves.
LEARN_EVERY = 4
# Frames behind the phase: a board that paused is followed within 6 s.
PHASE_WINDOW = 12
# Spacings needed to learn a period. Each spans several frames, so that a burst of late ones does no harm.
LEARN_FROM = 16
SPACING_FRAMES = 4
# A longer pause, in periods, means that the board stopped and has a new phase.
LONGEST_GAP = 2.5
# A period further from the usual spacing is a burst of late frames.
PLAUSIBLE = 0.05


class FrameClock:
    """Straightens the arrival times of frames, causally, and learns the board's period.

    All times are integer nanoseconds of one monotonic clock. A straightened time is never later than the arrival. The
    nominal period applies until the real one is `learned`.
    """

    def __init__(self, nominal_period_ns: int) -> None:
        self._period_ns = float(nominal_period_ns)
        self.learned = False
        # (frame number, arrival) of the last frames across restarts, and the last spacings.
        self._latest: deque[tuple[int, int]] = deque(maxlen=SPACING_FRAMES + 1)
        self._spacings: deque[float] = deque(maxlen=LEARN_FROM)
        # (frame number, arrival) since the last restart.
        self._seen: deque[tuple[int, int]] = deque(maxlen=PERIOD_WINDOW)
        self._straight_ns = 0

    @property
    def period_ns(self) -> int:
        """The learned period, or the nominal one until it is learned."""
        return round(self._period_ns)

    def restart(self) -> None:
        """Forget the phase and keep the period: the board was restarted."""
        self._seen.clear()

    def arrived(self, arrival_ns: int, missed: bool = False) -> int:
        """Return when the next frame would have arrived at a reader that is never late.

        After a rejected line (`missed`) the number of periods follows from the time; otherwise a late frame is the
        next one.
        """
        number, steps = 0, 1
        if self._seen:
            number, last_ns = self._seen[-1]
            elapsed = (arrival_ns - self._straight_ns) / self._period_ns
            steps = max(1, round(elapsed)) if missed and self.learned else 1
            number += steps
            late = elapsed - steps
            late_before = (last_ns - self._straight_ns) / self._period_ns
            # Waiting frames come in a burst, each less late than the one before; a constant delay means a pause of the
            # board. Half a period early means that the last one was counted as two.
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
        if len(self._spacings) < LEARN_FROM or (self.learned and not due):
            return
        spacing = median(self._spacings)
        if spacing <= 0:
            return
        if abs(self._period_ns - spacing) > PLAUSIBLE * spacing:
            self._period_ns, self.learned = spacing, True
        if due and len(self._seen) >= LEARN_FROM:
            slope = slope_below(self._seen)
            if abs(slope - spacing) <= PLAUSIBLE * spacing:
                self._period_ns, self.learned = slope, True


def slope_below(points: Iterable[tuple[int, int]]) -> float:
    """Return the slope of the line closest below all points, which are in order of their abscissa."""
    points = list(points)
    hull: list[tuple[int, int]] = []
    for n, t in points:
        # Drop a corner on or above the chord past it.
        while len(hull) > 1 and (hull[-1][1] - hull[-2][1]) * (n - hull[-2][0]) >= (t - hull[-2][1]) * (
            hull[-1][0] - hull[-2][0]
        ):
            hull.pop()
        hull.append((n, t))
    middle = sum(n for n, _ in points) / len(points)
    (n0, t0), (n1, t1) = next(edge for edge in pairwise(hull) if edge[1][0] >= middle)
    return (t1 - t0) / (n1 - n0)
