"""One diameter of the tool, from fingertips and gripper. A plain object without I/O; times are passed in."""

from collections.abc import Callable
from typing import TypeAlias

from shearloop.bank.eit.polynomial import Interval
from shearloop.bank.estimation import Measured, fused
from shearloop.daemon.messaging.messages import stale_after_s

# Which source says a diameter, None for none, and when it said so.
HearDiameter: TypeAlias = Callable[[str, Interval | None, int], None]
STALE_AFTER_NS = round(stale_after_s("eit.estimate") * 1e9)


def unheard(_source: str, _diameter: Interval | None, _t_ns: int) -> None:
    """Let a diameter pass that nobody weighs."""


def unknown(_t_ns: int) -> Measured | None:
    """Return no diameter: nobody knows one."""


def as_text(frame: int, tool: Measured | None) -> bytes:
    """Return how a raw input says which tool is held from a frame on."""
    return (str(frame) if tool is None else f"{frame} {tool.value!r} {tool.half_width!r}").encode()


def from_text(text: bytes) -> tuple[int, Measured | None]:
    """Return the frame and the tool that a raw input says; raises ValueError for what `as_text` does not return."""
    frame, *tool = text.decode().split()
    if not tool:
        return int(frame), None
    value, half_width = map(float, tool)
    return int(frame), Measured(value, half_width)


class FingertipDiameters:
    """The latest diameter of each fingertip, and of both together."""

    def __init__(self, together: str) -> None:
        """Take the name of the source that holds what the fingertips say already."""
        self._together = together
        self._latest: dict[str, tuple[int, Measured]] = {}

    def hear(self, source: str, diameter: Interval | None, t_ns: int) -> None:
        """Take in what one source says at t_ns."""
        if diameter is None:
            self._latest.pop(source, None)
        else:
            self._latest[source] = (t_ns, Measured(diameter.value, 0.5 * (diameter.high - diameter.low)))

    def at(self, t_ns: int) -> Measured | None:
        """Return the fingertips' diameter at t_ns, None where none of them has said one lately."""
        fresh = {name: one for name, (then_ns, one) in self._latest.items() if t_ns - then_ns <= STALE_AFTER_NS}
        return fresh.get(self._together) or fused(*fresh.values())
