"""Frames of several fingertips that belong together, as they come: a plain object without I/O or clock."""

from typing import Generic, TypeVar

Item = TypeVar("Item")

# Frames further apart than this share of the frame period do not make a set.
LARGEST_APART_PERIODS = 0.75


class Pairing(Generic[Item]):
    """Makes sets of one frame a side, each frame used once at most, as soon as one is complete.

    What comes out depends on the frames' own times and their order alone.
    """

    def __init__(self, sides: tuple[str, ...], period_ns: int) -> None:
        """Take the sides in the order that sets are wanted in, and the frame period."""
        self._sides = sides
        self._apart_ns = round(LARGEST_APART_PERIODS * period_ns)
        self._waiting: dict[str, tuple[int, Item]] = {}

    def take(self, side: str, t_ns: int, item: Item) -> tuple[int, tuple[Item, ...]] | None:
        """Return the mean time and the frames of a set that this one completes, or None.

        A side that is none of the set's is passed over.
        """
        if side not in self._sides:
            return None
        self._waiting[side] = (t_ns, item)
        # What is too old for this frame is too old for all that follow …
        self._waiting = {name: kept for name, kept in self._waiting.items() if t_ns - kept[0] <= self._apart_ns}
        # … and this one, where it was held up on its way, for what waits already.
        if any(kept_ns - t_ns > self._apart_ns for kept_ns, _ in self._waiting.values()):
            del self._waiting[side]
            return None
        if len(self._waiting) < len(self._sides):
            return None
        found = [self._waiting[name] for name in self._sides]
        self._waiting.clear()
        return sum(at_ns for at_ns, _ in found) // len(found), tuple(one for _, one in found)
