"""A zero that was asked of a sensor: which measurements belong to it, and how it ended."""

import asyncio
from collections.abc import Callable
from enum import Enum

import structlog

from shearloop.timeouts import timeout

# The longest time of a zero, which takes two seconds; a slow sensor gets more.
ZERO_TIMEOUT_S = 15.0
# The reason for a waiting step, if the later request that replaced its own was cancelled.
_CALLED_OFF = "the zero was asked for again, and that was called off"


class ZeroState(Enum):
    """How far a zero that was asked for is; the last four end it."""

    REQUESTED = "requested"  # no measurement belongs to it yet
    COLLECTING = "collecting"  # its measurements are being collected
    TAKEN = "taken"
    FAILED = "failed"  # its measurements are of no zero
    EXPIRED = "expired"  # it was not taken in time, and later measurements could be of any load
    REPLACED = "replaced"  # another one was asked for meanwhile


class ZeroRequest:
    """One request for a zero. Only a request that has not ended changes its state."""

    def __init__(self, from_ns: int, until_ns: int, earlier: "ZeroRequest | None" = None) -> None:
        """Ask for a zero of measurements from `from_ns` to `until_ns`; it replaces the sensor's earlier request."""
        self.from_ns = from_ns
        self.until_ns = until_ns
        self.state = ZeroState.REQUESTED
        # Why it failed or expired; may be empty.
        self.reason = ""
        self._later: ZeroRequest | None = None
        self._ended = asyncio.Event()
        if earlier is not None:
            earlier.replace(self)

    @property
    def is_open(self) -> bool:
        """Whether it has not ended."""
        return self.state in (ZeroState.REQUESTED, ZeroState.COLLECTING)

    def is_under_way(self, now_ns: int) -> bool:
        """Return whether the next measurements belong to it."""
        return self.is_open and now_ns <= self.until_ns

    def collect(self) -> None:
        """Note that a measurement belongs to it."""
        if self.is_open:
            self.state = ZeroState.COLLECTING

    def take(self) -> None:
        """End it with a zero."""
        self._end(ZeroState.TAKEN)

    def fail(self, reason: str) -> None:
        """End it without a zero: its measurements are of none."""
        self._end(ZeroState.FAILED, reason)

    def expire(self, reason: str = "") -> None:
        """End it without a zero, after its time or when its step has ended."""
        self._end(ZeroState.EXPIRED, reason)

    def expire_if_late(self, t_ns: int, why: Callable[[], str]) -> None:
        """End it if a measurement of this time is too late for it; the reason is logged."""
        if self.is_open and t_ns > self.until_ns:
            self.expire(why())
            structlog.get_logger().warning(self.reason)

    def replace(self, later: "ZeroRequest") -> None:
        """End it by a later request; a step that waits for this one then waits for that one."""
        if self.is_open:
            self._later = later
        self._end(ZeroState.REPLACED)

    async def wait(self, within_s: float, why_not: Callable[[], str]) -> str | None:
        """Wait until it has ended, or the later one that replaced it; return None for a zero, else why there is none.

        It expires after `within_s`, for the reason that `why_not` returns then, and where the wait is cancelled.
        """
        try:
            async with timeout(within_s):
                last = self
                await last._ended.wait()
                while last._later is not None:
                    last = last._later
                    await last._ended.wait()
        except TimeoutError:
            reason = why_not()
            self.expire(reason)
            return reason
        finally:
            self.expire()
        return None if last.state is ZeroState.TAKEN else last.reason or _CALLED_OFF

    def _end(self, state: ZeroState, reason: str = "") -> None:
        if self.is_open:
            self.state, self.reason = state, reason
            self._ended.set()
