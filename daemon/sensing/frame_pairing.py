"""Pairs the frames of several fingertips by their times."""

from shearloop.drivers.eit_kit import Frame

# Largest distance in time of a pair of frames, as a fraction of the frame period.
_MAX_APART_PERIODS = 0.75


class FramePairing:
    """Makes sets of one frame per side, each used at most once, as soon as they are complete.

    The result depends only on the frames' own times and their order.
    """

    def __init__(self, sides: tuple[str, ...], period_s: float) -> None:
        """Take the sides in the order of a set, and the frame period."""
        self._sides = sides
        self._apart_ns = round(_MAX_APART_PERIODS * period_s * 1e9)
        self._latest: dict[str, Frame] = {}

    def add(self, side: str, frame: Frame) -> tuple[Frame, ...] | None:
        """Return the frames of the set that this one completes, or None."""
        if side not in self._sides:
            return None
        self._latest[side] = frame
        oldest_ns, newest_ns = frame.t_mid_ns - self._apart_ns, frame.t_mid_ns + self._apart_ns
        # Frames too old for this one are too old for all later ones.
        self._latest = {name: kept for name, kept in self._latest.items() if kept.t_mid_ns >= oldest_ns}
        # A frame that was delayed is too old for those already here.
        if any(kept.t_mid_ns > newest_ns for kept in self._latest.values()):
            del self._latest[side]
            return None
        if len(self._latest) < len(self._sides):
            return None
        found = tuple(self._latest[name] for name in self._sides)
        self._latest.clear()
        return found
