"""The age of the controller's samples, whose clock is not ours."""

import math

# The smallest clock offset may rise by this fraction of the time. Clocks drift by up to 500 ppm, and a simulator's may
# be slow by some thousandths on a busy computer. A delay of 0.1 s is forgotten after 10 s.
_OFFSET_RISE = 1e-2


class SampleAge:
    """The age of each sample by the controller's clock. No clock here: both times are arguments.

    A sample that is new to us may have waited in a socket. The offset between the two clocks is unknown, but its
    smallest value belongs to the fastest sample; later samples have waited for the difference.
    """

    def __init__(self) -> None:
        self._timestamp_s = math.nan
        self._made_ns = 0
        self._offset_ns = self._seen_ns = 0

    def age_ns(self, timestamp_s: float, now_ns: int) -> int:
        """Return the time in ns since the newest sample was made; 0 for the first.

        A sample without a timestamp, or with an earlier one, is not new. A restarted controller has a new clock, so it
        gets too old, is lost, and is connected again.
        """
        if math.isfinite(timestamp_s) and not timestamp_s <= self._timestamp_s:
            self._update(timestamp_s, now_ns)
        return max(0, now_ns - self._made_ns)

    def _update(self, timestamp_s: float, now_ns: int) -> None:
        stamped_ns = round(timestamp_s * 1e9)
        offset_ns = now_ns - stamped_ns
        if math.isfinite(self._timestamp_s):
            risen_ns = self._offset_ns + round(_OFFSET_RISE * (now_ns - self._seen_ns))
            offset_ns = min(offset_ns, risen_ns)
        self._timestamp_s, self._offset_ns, self._seen_ns = timestamp_s, offset_ns, now_ns
        self._made_ns = stamped_ns + offset_ns
