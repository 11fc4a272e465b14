"""Refuses requests that waited while the daemon's process stood still, because their age is unknown.

A client gives up after some seconds. Its request stays in the socket of a daemon that hangs. The daemon would carry it
out after the hang, when the operator may already stand at the robot.
"""

from typing import Final

# Shorter than the shortest time after which a client gives up.
LONGEST_STANDSTILL_S: Final = 1.5
# What waited in the socket is read within this time after the return.
READ_WITHIN_S: Final = 0.5


class LateRequests:
    """Knows for each time whether a request that is received then may be of before a standstill.

    All times are in ns of one clock that goes on while the computer is suspended.
    """

    def __init__(self, t_ns: int) -> None:
        self._alive_ns = t_ns
        self._stood_s = 0.0
        self._until_ns = t_ns

    def alive(self, t_ns: int) -> None:
        """Record that the event loop runs."""
        stood_s = (t_ns - self._alive_ns) / 1e9
        if stood_s > LONGEST_STANDSTILL_S:
            self._stood_s, self._until_ns = stood_s, t_ns + round(READ_WITHIN_S * 1e9)
        self._alive_ns = t_ns

    def why_late(self, t_ns: int) -> str | None:
        """Return why a request that is received now is not carried out, or None."""
        self.alive(t_ns)
        if t_ns >= self._until_ns:
            return None
        return (
            f"the daemon stood still for {self._stood_s:.1f} s, and this request may be as old: look at the rig, and "
            "send it again"
        )
