"""The clock of a board that sends a frame each period, from the arrivals of its frames. No I/O."""

from collections import deque
from collections.abc import Collection
from itertools import islice, pairwise
from statistics import median

# A busy computer delivers a frame up to this late to a reader that was not away.
LATE_NS = 500_000_000
# Frames behind the period: 35 s at 0.54 s, while a crystal drifts by microseconds.
PERIOD_WINDOW = 64
# Frames behind the phase: a board that paused is followed within 6 s.
PHASE_WINDOW = 12
# Spacings needed to learn a period. Each spans several frames, so that a burst of late ones does no harm.
LEARN_FROM = 16
SPACING_FRAMES = 4
# A longer pause, in periods, means that the board stopped and has a new phase.
LONGEST_GAP = 2.5
# A period further from the usual spacing is a burst of late frames. So are spacings whose middle half differs by more.
PLAUSIBLE = 0.05
# The number of frames in a row that are equally late, in periods, after a short pause of the board. A busy computer
# delays each frame by another time. A wrong period makes frames later than the phase by less than the minimum.
EQUALLY_LATE = 4
SAME_LATENESS = 0.05
MIN_LATENESS = 0.3
# Spacings that scatter by more than this fraction about their median are of a burst, or of a reader that was away.
STEADY = 0.25


class FrameClock:
    """Straightens the arrival times of frames, causally, and learns the board's period.

    A board with a steady period sends each frame as soon as it is complete. A busy reader or bus sees it later, never
    earlier. The board's clock is therefore the line closest below all (frame number, arrival) points. That line is the
    edge of their lower convex hull that spans the middle (Moon, Skelly and Towsley 1999, "Estimation and removal of
    clock skew from network delay measurements"). Its slope is the period; its height over the last few frames is the
    phase. All times are integer nanoseconds of one monotonic clock. The nominal period applies until one is learned.

    A frame is late, or the board paused before it and has a new phase. A pause of more than `longest_gap` periods shows
    at once. One of more than LATE_NS shows by two frames that are later than that. A shorter one shows by EQUALLY_LATE
    frames in a row. The phase of the last frames follows still shorter pauses.
    """

    def __init__(self, nominal_period_ns: int, longest_gap: float = LONGEST_GAP) -> None:
        self._longest_gap = longest_gap
        # The period, and how many frames it is learned from: 0 for the nominal one.
        self.period_ns = nominal_period_ns
        self.learned_from = 0
        # How many frames were taken since it was learned.
        self._taken_since = 0
        self._exact_period_ns = float(nominal_period_ns)
        # The number of the last frame, and how many frames up to it waited for their reader.
        self._number = self._waited_in_a_row = 0
        # (frame number, arrival) of the last frames that did not wait, across restarts, and the last spacings.
        self._latest: deque[tuple[int, int]] = deque(maxlen=SPACING_FRAMES + 1)
        self._spacings: deque[float] = deque(maxlen=LEARN_FROM)
        # (frame number, arrival) of the frames that did not wait, since the last restart.
        self._seen: deque[tuple[int, int]] = deque(maxlen=PERIOD_WINDOW)
        # When the last frame would have arrived at a reader that is never late.
        self._straight_ns = 0
        # How late the last frames came, in periods.
        self._lateness: deque[float] = deque([0.0], maxlen=EQUALLY_LATE - 1)

    def restart(self) -> None:
        """Forget the phase and keep the period: the board was restarted."""
        self._seen.clear()

    def arrived(
        self, read_ns: int, rejected: int | None = 0, waited_since_ns: int | None = None, behind: int = 0
    ) -> int:
        """Return when the next frame would have arrived at a reader that is never late.

        `rejected` lines came before it, None if bytes were lost and it is not known how many. Then the number of
        periods follows from the time; otherwise a late frame is the next one. `waited_since_ns`: its reader was away,
        and it may have arrived since then. `behind`: so many frames were read together with it, and came after it.
        """
        # Frames that are read together were sent one period apart, the last one by now.
        arrival_ns = read_ns - behind * self.period_ns
        earliest_ns = arrival_ns if waited_since_ns is None else min(waited_since_ns, arrival_ns)
        waited = earliest_ns < arrival_ns
        # One that may have waited says nothing of a pause: it came in time if it can have.
        found_ns = earliest_ns if waited else read_ns
        steps = self._steps_to(arrival_ns, rejected, waited=waited)
        # A full buffer loses its newest bytes: this frame came after the reader was back, and its number is unknown.
        lost = waited and rejected is None
        # Half a period early means that the last one was counted as two, or stamped too late.
        early = self._periods_to(arrival_ns) < steps - 0.5
        if early or lost or self._has_paused(earliest_ns, found_ns, steps):
            self.restart()
        self._number += steps
        self._waited_in_a_row = self._waited_in_a_row + 1 if waited else 0
        # A frame that waited does not show the board's period, unless all frames wait.
        if not self._seen or not 0 < self._waited_in_a_row <= PERIOD_WINDOW:
            self._take(arrival_ns)
        phase = islice(reversed(self._seen), PHASE_WINDOW)
        by_phase = (seen_ns + (self._number - n) * self._exact_period_ns for n, seen_ns in phase)
        self._straight_ns = round(min([arrival_ns, *by_phase]))
        self._lateness.append((found_ns - self._straight_ns) / self._exact_period_ns)
        return self._straight_ns

    def _periods_to(self, t_ns: int) -> float:
        """Return the periods from the last frame to a time."""
        return (t_ns - self._straight_ns) / self._exact_period_ns

    def _steps_to(self, arrival_ns: int, rejected: int | None, *, waited: bool) -> int:
        """Return how many periods after the last frame the next one was sent."""
        if not self._seen or not self.learned_from or rejected == 0:
            return 1
        steps = max(1, round(self._periods_to(arrival_ns)))
        # For a frame that waited, the time is only an upper bound.
        return min(steps, 1 + rejected) if waited and rejected is not None else steps

    def _has_paused(self, earliest_ns: int, found_ns: int, steps: int) -> bool:
        """Return whether the board stopped before a frame, which came at `earliest_ns` at the earliest."""
        # All times here are in periods. A busy computer delays a frame by up to `largest_delay`.
        largest_delay = LATE_NS / self._exact_period_ns
        if self._periods_to(earliest_ns) > max(self._longest_gap, largest_delay):
            return True
        lateness, lateness_before = self._periods_to(found_ns) - steps, self._lateness[-1]
        two_are_late = min(lateness, lateness_before) > max(0.5, largest_delay)
        # Frames that waited come in a burst, each less late than the one before.
        in_burst = lateness <= lateness_before - 0.5
        latest = [*self._lateness, lateness]
        equally_late = max(latest) - min(latest) < SAME_LATENESS and min(latest) > MIN_LATENESS
        return (two_are_late and not in_burst) or (len(latest) == EQUALLY_LATE and equally_late)

    def _take(self, arrival_ns: int) -> None:
        """Take a frame that shows the board's phase and period."""
        self._taken_since += 1
        self._seen.append((self._number, arrival_ns))
        self._latest.append((self._number, arrival_ns))
        if len(self._latest) > SPACING_FRAMES:
            (n, before_ns), (m, _) = self._latest[0], self._latest[-1]
            self._spacings.append((arrival_ns - before_ns) / (m - n))
        self._learn()

    def _learn(self) -> None:
        if len(self._spacings) < LEARN_FROM:
            return
        spacing = median(self._spacings)
        if spacing <= 0:
            return
        # A burst of late frames has other spacings before and after it.
        middle = sorted(self._spacings)[LEARN_FROM // 4 : -LEARN_FROM // 4]
        steady = max(abs(one - spacing) for one in middle) <= STEADY * spacing
        # A late frame makes spacings wrong, too.
        plausible_ns = max(PLAUSIBLE * spacing, LATE_NS / SPACING_FRAMES)
        # A wrong period can make the board seem to pause again and again, and no slope confirms it.
        if steady and (self._taken_since > PERIOD_WINDOW or abs(self._exact_period_ns - spacing) > plausible_ns):
            self._exact_period_ns, self.learned_from, self._taken_since = spacing, LEARN_FROM, 0
        # Late frames make the slope of a few wrong, as after a restart: it is no better than that of more before it.
        if len(self._seen) >= max(LEARN_FROM, self.learned_from):
            slope = slope_below(self._seen)
            if abs(slope - spacing) <= PLAUSIBLE * spacing:
                self._exact_period_ns, self.learned_from, self._taken_since = slope, len(self._seen), 0
        self.period_ns = round(self._exact_period_ns)


def slope_below(points: Collection[tuple[int, int]]) -> float:
    """Return the slope of the line closest below all points, which are in order of their abscissa."""
    hull: list[tuple[int, int]] = []
    for n, t in points:
        while len(hull) > 1 and not _is_below_chord(hull[-1], hull[-2], (n, t)):
            hull.pop()
        hull.append((n, t))
    middle = sum(n for n, _ in points) / len(points)
    (n0, t0), (n1, t1) = next((start, end) for start, end in pairwise(hull) if end[0] >= middle)
    return (t1 - t0) / (n1 - n0)


def _is_below_chord(point: tuple[int, int], start: tuple[int, int], end: tuple[int, int]) -> bool:
    """Return whether a point lies below the line between two others, on both sides of it."""
    (n, t), (n0, t0), (n1, t1) = point, start, end
    return (t - t0) * (n1 - n0) < (t1 - t0) * (n - n0)
