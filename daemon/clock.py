"""The two times of the daemon: CLOCK_MONOTONIC inside, Unix time on the wire and in recordings."""

import time
from dataclasses import dataclass
from typing import NamedTuple, Self

# A larger change of the offset is a step: NTP slews the clock by at most 0.5 ms a second.
STEP_S = 0.1


class ClockReading(NamedTuple):
    """Unix time minus CLOCK_MONOTONIC, and the time that the computer was suspended since it started, both in ns."""

    offset_ns: int
    suspended_ns: int


@dataclass(frozen=True, slots=True)
class ClockStep:
    """How far the wall clock was set, and how long the computer was suspended; 0 for what did not happen."""

    set_s: float
    suspended_s: float

    @classmethod
    def between(cls, before: ClockReading, after: ClockReading) -> Self | None:
        """Return what happened between two readings, or None if it is less than STEP_S."""
        suspended_s = (after.suspended_ns - before.suspended_ns) / 1e9
        # CLOCK_MONOTONIC stops while the computer is suspended.
        set_s = (after.offset_ns - before.offset_ns) / 1e9 - suspended_s
        step = cls(_beyond_step(set_s), _beyond_step(suspended_s))
        return step if step.set_s or step.suspended_s else None

    def __str__(self) -> str:
        """Return it in words, without a full stop."""
        parts = []
        if self.suspended_s:
            parts.append(f"the computer was suspended for {self.suspended_s:.1f} s")
        if self.set_s:
            parts.append(f"the wall clock was set {'back' if self.set_s < 0 else 'forward'} by {abs(self.set_s):.1f} s")
        return " and ".join(parts)


class Clock:
    """Reads the monotonic clock and translates its readings into Unix time.

    The offset between the two changes only in `synchronise`: stamps taken close together keep their distance even while
    the system's clock is being set.
    """

    def __init__(self) -> None:
        self._reading = self._measured()

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC in nanoseconds."""
        return time.monotonic_ns()

    def suspended_ns(self) -> int:
        """Return how long the computer was suspended since it started, in nanoseconds."""
        # In this order, so that the time between the two readings makes it no negative one.
        monotonic_ns = time.monotonic_ns()
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - monotonic_ns

    def unix_s(self, t_mono_ns: int) -> float:
        """Return the Unix time, in seconds, of a reading of the monotonic clock."""
        return (t_mono_ns + self.offset_ns) / 1e9

    @property
    def offset_ns(self) -> int:
        """Unix time minus the monotonic clock, in nanoseconds."""
        return self._reading.offset_ns

    @property
    def reading(self) -> ClockReading:
        """The latest measurement."""
        return self._reading

    def synchronise(self) -> ClockStep | None:
        """Measure the offset again, and return the step since the last time; the daemon calls this once a second."""
        before, self._reading = self._reading, self._measured()
        return ClockStep.between(before, self._reading)

    def _measured(self) -> ClockReading:
        return ClockReading(time.time_ns() - time.monotonic_ns(), self.suspended_ns())


def _beyond_step(change_s: float) -> float:
    return change_s if abs(change_s) > STEP_S else 0.0
