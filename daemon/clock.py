"""The two times of the daemon: CLOCK_MONOTONIC inside, Unix time on the wire and in recordings."""

import time


class Clock:
    """Reads the monotonic clock and translates its readings into Unix time.

    The offset between the two changes only in `synchronise`: stamps taken close together keep their distance even while
    the system's clock is being set.
    """

    def __init__(self) -> None:
        self.synchronise()

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC in nanoseconds."""
        return time.monotonic_ns()

    def unix_s(self, t_mono_ns: int) -> float:
        """Return the Unix time, in seconds, of a reading of the monotonic clock."""
        return (t_mono_ns + self._offset_ns) / 1e9

    @property
    def offset_ns(self) -> int:
        """Unix time minus the monotonic clock, in nanoseconds."""
        return self._offset_ns

    def synchronise(self) -> None:
        """Measure the offset again; the daemon calls this once a second."""
        self._offset_ns = time.time_ns() - time.monotonic_ns()
