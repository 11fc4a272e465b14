"""Pairs the frames of several fingertips by their times of measurement: live, in a replay, and for a fit."""

from collections import Counter, deque
from typing import Generic, Protocol, TypeVar


class TimedFrame(Protocol):
    """A frame of one board."""

    @property
    def t_mid_ns(self) -> int:
        """The middle of its acquisition."""


Timed = TypeVar("Timed", bound=TimedFrame)

# A partner is within half a frame period: each frame of another board is then nearer to it than the frames before and
# after. Boards that are half a period apart keep their order against the jitter of their times, by this fraction.
_NEAREST, _KEPT = 0.5, 0.05
# Frames of a board that wait for another board's, 4 s: a longer stall of one board costs frames of the others.
_MAX_WAITING = 8


class FramePairing(Generic[Timed]):
    """Makes sets of one frame per side, each used at most once, as soon as they are complete.

    The sets depend on the frames' times and on their order on each side. They do not depend on which side arrives
    first, unless one is more than `_MAX_WAITING` frames late.
    """

    def __init__(self, sides: tuple[str, ...], period_s: float) -> None:
        """Take the sides in the order of a set, and the frame period."""
        self._period_ns = 1e9 * period_s
        self._waiting: dict[str, deque[Timed]] = {side: deque() for side in sides}
        # The sides of the earliest and the latest frame of the last set.
        self._order: tuple[str, str] | None = None
        # How many frames of each side were left without a partner.
        self.unpaired: Counter[str] = Counter(dict.fromkeys(sides, 0))

    def add(self, side: str, frame: Timed) -> tuple[Timed, ...] | None:
        """Return the frames of the set that this one completes, or None."""
        waiting = self._waiting.get(side)
        if waiting is None:
            return None
        # Where the times of a board step back, pairing begins again: nothing that comes later fits the frames before.
        while waiting and waiting[-1].t_mid_ns >= frame.t_mid_ns:
            self._leave_out(side)
        waiting.append(frame)
        if len(waiting) > _MAX_WAITING:
            self._leave_out(side)
        while all(self._waiting.values()):
            next_ns = {name: frames[0].t_mid_ns for name, frames in self._waiting.items()}
            order = min(next_ns, key=next_ns.__getitem__), max(next_ns, key=next_ns.__getitem__)
            earliest, latest = order
            if next_ns[latest] - next_ns[earliest] <= self._largest_apart_ns(order):
                self._order = order
                return tuple(frames.popleft() for frames in self._waiting.values())
            # All later frames are further from this one.
            self._leave_out(earliest)
        return None

    def _largest_apart_ns(self, order: tuple[str, str]) -> float:
        """Return how far the frames of a set may be apart in this order of their sides."""
        periods = _NEAREST
        if self._order == order:
            periods += _KEPT
        elif self._order == order[::-1]:
            periods -= _KEPT
        return periods * self._period_ns

    def _leave_out(self, side: str) -> None:
        self._waiting[side].popleft()
        self.unpaired[side] += 1

    def end(self) -> None:
        """Leave out the frames that wait, where no more frames come."""
        for side, frames in self._waiting.items():
            self.unpaired[side] += len(frames)
            frames.clear()
