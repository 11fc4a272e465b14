"""The tool that another program has left in a robot, in words, for the person who goes on at the rig."""

from shearloop.daemon.control.grip import NO_GRIP
from shearloop.daemon.rig_memory import Remembered


def left_tool(state: Remembered) -> str:
    """Return a sentence on a tool that may be held, without a capital letter and a full stop; empty without a grip."""
    if not state.grips:
        return ""
    if state.grip == NO_GRIP:
        # Only zeros are kept, because the fingers were not known to be empty.
        return "no grip is known, but a tool may be held: nothing had shown that none is"
    known = [
        text.format(value)
        for text, value in (
            ("gripped with at most {:g} N", state.force_n),
            ("{:.1f} mm wide", state.width_mm),
            ("with a stated diameter of {:g} mm", state.stated_tool_mm),
            ("its angle counts from {:.3f} rad of wrist 3", state.origin_rad),
        )
        if value is not None
    ]
    return ", ".join(["a tool may be held", *known])
