"""The schedule of a board that sends a line for each conversion, and the readings that are missing in it. No I/O."""

import math
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from statistics import median

from shearloop.drivers.frame_clock import slope_below

# Arrivals behind the schedule, and those from which on it is learned.
WINDOW, LEARN_FROM = 64, 32
# Lines are missing once this many arrivals in a row were late. A reader that was busy is in time again before.
LATE_ARRIVALS = 12
# So many of them are about equally late.
REGULAR_ARRIVALS = 9
# A slope further from the usual spacing comes from late or missing lines.
PLAUSIBLE = 0.05
# A delay within this of a whole number of periods is that number.
TOLERANCE = 0.25
# Arrivals that follow each other within this, in periods, are one: lines that waited together say one thing.
TOGETHER = 0.5
# Arrivals behind the time of a line.
PHASE_ARRIVALS = 4
# A line that is later than this, in periods, follows a pause of the board.
LONGEST_GAP = 2.5


class LineClock:
    """Straightens the arrival times of lines, causally, and counts lines that never came.

    A board with a steady period sends each line at once. A busy reader or bus sees it later, never earlier, so the
    earliest arrivals tell the schedule (see `FrameClock`). One late line may have waited, or may follow lines that were
    lost. Later arrivals tell: those after a loss are all late by as many periods. All times are integer nanoseconds of
    one monotonic clock. The nominal period applies until the real one is learned.
    """

    def __init__(self, nominal_period_ns: int) -> None:
        self._exact_period_ns = float(nominal_period_ns)
        self._learned = False
        self._number = 0
        # (number, arrival) since the last restart, one for lines that arrive together. Lines that are known to be lost
        # are in the number.
        self._seen: deque[tuple[int, int]] = deque(maxlen=WINDOW)
        self._together_ns = 0
        # The same with the numbers that give the next line's time. They follow the board at once.
        self._phase: deque[tuple[int, int]] = deque(maxlen=PHASE_ARRIVALS)
        self._slot = 0
        self._refused = 0
        # When the last line was sent, and whether the port was opened since.
        self._sent_ns: int | None = None
        self._restarted = False

    @property
    def period_ns(self) -> int:
        """The learned period, or the nominal one until then."""
        return round(self._exact_period_ns)

    def restart(self) -> None:
        """Forget the phase and keep the period: the port was opened."""
        self._restarted = self._sent_ns is not None
        self._seen.clear()
        self._phase.clear()
        self._refused = 0

    def refused(self) -> None:
        """Take a line that was refused: it may have taken a period."""
        self._refused += 1

    def arrived(self, read_ns: int, waiting: int = 0) -> tuple[int, int]:
        """Take a line that was read at `read_ns`, with `waiting` lines behind it.

        Return when it would have arrived at a reader that is never late, and how many lines are found missing by it.
        """
        # Of lines that are read together, each was there a period before the next.
        sent_ns = self._straightened(read_ns - waiting * self.period_ns)
        missing = self._missing_since_restart(sent_ns)
        self._sent_ns = sent_ns
        self._number += 1 + missing
        self._add(read_ns)
        if waiting == 0 and missing == 0:
            self._learn()
            missing = self._find_missing()
        return sent_ns, missing

    def _straightened(self, arrival_ns: int) -> int:
        self._slot += 1
        late = (arrival_ns - self._due_ns()) / self._exact_period_ns if self._phase else 0.0
        # A refused line has taken its period where this one is late by it.
        taken = min(self._refused, max(round(late), 0))
        self._slot += taken
        self._refused = 0
        if late - taken > LONGEST_GAP:
            self._phase.clear()
        self._phase.append((self._slot, arrival_ns))
        return round(self._due_ns())

    def _due_ns(self) -> float:
        """Return when the line of the present slot was to arrive, by the earliest of the last arrivals."""
        return min(arrival + (self._slot - slot) * self._exact_period_ns for slot, arrival in self._phase)

    def _missing_since_restart(self, sent_ns: int) -> int:
        if not self._restarted or self._sent_ns is None:
            return 0
        self._restarted = False
        return max(round((sent_ns - self._sent_ns) / self._exact_period_ns) - 1, 0)

    def _add(self, arrival_ns: int) -> None:
        """Keep an arrival, or the earlier by the schedule of those that are together."""
        point = self._number, arrival_ns
        if self._seen and arrival_ns - self._together_ns < TOGETHER * self._exact_period_ns:
            number, before_ns = self._seen[-1]
            if arrival_ns - before_ns <= (self._number - number) * self._exact_period_ns:
                self._seen[-1] = point
        else:
            self._seen.append(point)
            self._together_ns = arrival_ns

    def _learn(self) -> None:
        if len(self._seen) < LEARN_FROM:
            return
        spacing = median((t - s) / (m - n) for (n, s), (m, t) in pairwise(self._seen))
        slope = slope_below(self._seen)
        if abs(slope - spacing) <= PLAUSIBLE * spacing:
            self._exact_period_ns, self._learned = slope, True

    def _find_missing(self) -> int:
        """Return how many lines are missing before the last arrivals, by what all of them are late; count them."""
        seen = list(self._seen)
        before, latest = seen[:-LATE_ARRIVALS], seen[-LATE_ARRIVALS:]
        if not self._learned or not before:
            return 0
        due_ns, latest_ns = min(self._on_schedule(before)), sorted(self._on_schedule(latest))
        # Lines that wait are not equally late.
        spread_ns = latest_ns[REGULAR_ARRIVALS - 1] - latest_ns[0]
        missing = math.floor((latest_ns[0] - due_ns) / self._exact_period_ns + TOLERANCE)
        if missing < 1 or spread_ns > TOLERANCE * self._exact_period_ns:
            return 0
        self._number += missing
        for place in range(-LATE_ARRIVALS, 0):
            number, arrival_ns = self._seen[place]
            self._seen[place] = number + missing, arrival_ns
        return missing

    def _on_schedule(self, points: Sequence[tuple[int, int]]) -> list[float]:
        """Return when the last line would have arrived by each of these arrivals, in ns."""
        return [arrival - (number - self._number) * self._exact_period_ns for number, arrival in points]
