"""The items that a device has sent, and the wait for more: the only loop in which a commissioning measures.

The clock is an argument. In a simulation a wait advances the time.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, Generic, Protocol, TypeVar

from shearloop.errors import UserError

T = TypeVar("T")
ResultT = TypeVar("ResultT")


class Clock(Protocol):
    """The time, and waits in it."""

    def now_ns(self) -> int:
        """Return the monotonic time in ns."""

    def sleep(self, seconds: float) -> None:
        """Let this time pass."""

    def wait(self, changed: threading.Condition, seconds: float) -> None:
        """Let at most this time pass until `changed`, which the caller holds, is notified."""


class MonotonicClock:
    """The computer's clock."""

    def now_ns(self) -> int:
        """Return the monotonic time in ns."""
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Let this time pass."""
        time.sleep(max(0.0, seconds))

    def wait(self, changed: threading.Condition, seconds: float) -> None:
        """Let at most this time pass until `changed`, which the caller holds, is notified."""
        changed.wait(seconds)


REAL_CLOCK: Final = MonotonicClock()


class Arrivals(Generic[T]):
    """The items of one device, in the order of their arrival. `time_of` returns when an item was made (monotonic, ns).

    `silent` is the sentence for an operator whose device sends nothing.
    """

    def __init__(self, time_of: Callable[[T], int], clock: Clock = REAL_CLOCK, silent: str = "") -> None:
        """Begin with none."""
        self.clock = clock
        self._time_of = time_of
        self._silent = silent
        self._items: list[T] = []
        self._changed = threading.Condition()

    def add(self, item: T) -> None:
        """Take the next item; any thread may call it."""
        with self._changed:
            self._items.append(item)
            self._changed.notify_all()

    def latest(self) -> T:
        """Return the newest item; there has to be one."""
        with self._changed:
            return self._items[-1]

    def forget(self) -> None:
        """Drop all items but the newest: an hour of a robot's states takes half a gigabyte."""
        with self._changed:
            del self._items[:-1]

    def since(self, t_ns: int, until_ns: float = math.inf) -> list[T]:
        """Return the items that were made in this time."""
        with self._changed:
            return [item for item in self._items if t_ns <= self._time_of(item) < until_ns]

    def wait_until(self, found: Callable[[Sequence[T]], ResultT | None], within_s: float) -> ResultT | None:
        """Return what `found` returns of all items, as soon as that is something; None if it is not in time."""
        until_ns = self.clock.now_ns() + round(1e9 * within_s)
        with self._changed:
            while (result := found(self._items)) is None:
                left_ns = until_ns - self.clock.now_ns()
                if left_ns <= 0:
                    return None
                self.clock.wait(self._changed, left_ns / 1e9)
            return result

    def wait_for(self, condition: Callable[[T], bool], since_ns: int, within_s: float) -> T | None:
        """Return the first item since a moment that meets a condition, or None after `within_s`.

        The condition sees each item once, in order.
        """
        looked = 0

        def found(items: Sequence[T]) -> T | None:
            nonlocal looked
            fresh = items[looked:]
            looked = len(items)
            return next((item for item in fresh if self._time_of(item) >= since_ns and condition(item)), None)

        return self.wait_until(found, within_s)

    def take(self, count: int, silent_s: float) -> list[T]:
        """Return the next items that are made from now on; raises UserError after a silence of `silent_s`."""
        since_ns = self.clock.now_ns()
        while len(found := self.since(since_ns)) < count:
            if self._more_than(len(found), since_ns, silent_s) is None:
                raise UserError(self._silent)
        return found[:count]

    def _more_than(self, count: int, since_ns: int, within_s: float) -> bool | None:
        return self.wait_until(lambda _: len(self.since(since_ns)) > count or None, within_s)

    def listen(self, seconds: float) -> list[T]:
        """Return the items of the next seconds; waits a second longer for the last of them."""
        begun_ns = self.clock.now_ns()
        end_ns = begun_ns + round(1e9 * seconds)
        self.wait_for(lambda item: self._time_of(item) >= end_ns, begun_ns, seconds + 1.0)
        return self.since(begun_ns, end_ns)
