"""Where the wrist has been: the angle that belongs to a torque which was measured a while ago."""

from bisect import bisect_right

# A history is cut back when it has grown by this much beyond what is asked of it, so that cutting stays cheap.
_SLACK = 512


class AngleHistory:
    """Angles over the last `span_ns`, linear between the samples, with their running integral.

    The mean over an interval then costs two look-ups, whatever its length: a frame that was acquired over half a
    second saw the mean of the torque, so the mean of the angle over that time is what belongs to it.
    """

    def __init__(self, span_ns: int) -> None:
        self.span_ns = span_ns
        self._t_ns: list[int] = []
        self._angle_rad: list[float] = []
        self._integral: list[float] = []  # rad·ns since the first sample ever

    def add(self, t_ns: int, angle_rad: float) -> bool:
        """Append an angle; return False, and forget it, where its time does not come after the last one."""
        if self._t_ns:
            step_ns = t_ns - self._t_ns[-1]
            if step_ns <= 0:
                return False
            self._integral.append(self._integral[-1] + 0.5 * (angle_rad + self._angle_rad[-1]) * step_ns)
        else:
            self._integral.append(0.0)
        self._t_ns.append(t_ns)
        self._angle_rad.append(angle_rad)
        if len(self._t_ns) % _SLACK == 0:
            self._forget(t_ns - self.span_ns)
        return True

    def mean(self, from_ns: int, to_ns: int) -> float | None:
        """Return the mean angle in rad between two times, the angle itself where they coincide.

        None where the history does not reach over the whole interval: an angle is never extrapolated.
        """
        if not self._t_ns or from_ns < self._t_ns[0] or to_ns > self._t_ns[-1] or to_ns < from_ns:
            return None
        if to_ns == from_ns:
            return self._at(from_ns)[0]
        return (self._at(to_ns)[1] - self._at(from_ns)[1]) / (to_ns - from_ns)

    def _at(self, t_ns: int) -> tuple[float, float]:
        """Return the angle and the running integral at a time within the history."""
        last = bisect_right(self._t_ns, t_ns) - 1
        angle, since_ns = self._angle_rad[last], t_ns - self._t_ns[last]
        if since_ns:
            following = self._angle_rad[last + 1]
            angle += (following - angle) * since_ns / (self._t_ns[last + 1] - self._t_ns[last])
        return angle, self._integral[last] + 0.5 * (angle + self._angle_rad[last]) * since_ns

    def _forget(self, before_ns: int) -> None:
        cut = max(bisect_right(self._t_ns, before_ns) - 1, 0)
        del self._t_ns[:cut], self._angle_rad[:cut], self._integral[:cut]
