"""How old a controller's sample is by its own clock. No clock here: both times are arguments.

That a sample is new to us does not say that it is new: it may have waited in a socket while the network or this
process stalled. What the controller's clock and ours differ by is not known, but the least difference seen so far is
that of the sample that came soonest; what comes later than it has waited for so much longer.
"""

import math

# The least difference may rise by so much of the time. Clocks drift apart by less (quartzes by tens of ppm, one that
# is being set by up to 500), but a simulator's may be slow by some thousandths on a busy computer. A controller whose
# clock has stood still is believed again in time: a tenth of a second is forgotten after 10 s. A delay of two tenths is
# stale for nearly as long, and stops the wrist.
RISES = 1e-2


class SampleAge:
    """Tells the age of each sample; the controller's may be begun anew."""

    def __init__(self) -> None:
        """Know nothing of the controller's clock yet."""
        self._timestamp_s = math.nan
        self._made_ns = 0
        self._offset_ns = self._seen_ns = 0

    def age_ns(self, timestamp_s: float, now_ns: int) -> int:
        """Return how long before now_ns (monotonic) the sample with this timestamp was made, in ns; 0 of the first.

        A timestamp that is no number tells of nothing new.
        """
        if timestamp_s != self._timestamp_s and math.isfinite(timestamp_s):
            self._take(timestamp_s, now_ns)
        return max(0, now_ns - self._made_ns)

    def _take(self, timestamp_s: float, now_ns: int) -> None:
        stamped_ns = round(timestamp_s * 1e9)
        offset_ns = now_ns - stamped_ns
        # Another run of the controller has another clock, as the first one has.
        if timestamp_s > self._timestamp_s:
            risen_ns = self._offset_ns + round(RISES * (now_ns - self._seen_ns))
            offset_ns = min(offset_ns, risen_ns)
        self._timestamp_s, self._offset_ns, self._seen_ns = timestamp_s, offset_ns, now_ns
        self._made_ns = stamped_ns + offset_ns
