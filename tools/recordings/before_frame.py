"""Reads what a session has to know before a frame from the inputs of a recording."""

import numpy as np

from shearloop.daemon.sensing.session_inputs import GIVEN_UP, STATED
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.estimation import BeforeFrame, HeldTool, KnownTorques, Measured

# The kinds of these inputs. A load cell and a skin have tares of another form.
SESSION_KINDS = frozenset({InputKind.TARE, InputKind.TOOL, InputKind.MOVED, InputKind.ADAPT})


def before_frame(event: RawEvent) -> tuple[int, BeforeFrame]:
    """Return a frame's number, and what an input of a session says of it; raises ValueError for another input."""
    match event.kind:
        case InputKind.TARE:
            text = event.data.decode()
            given_up = text.endswith(GIVEN_UP)
            return int(text.removesuffix(GIVEN_UP)), BeforeFrame(begins_tare=not given_up, gives_up_tare=given_up)
        case InputKind.TOOL:
            frame, *values = event.data.decode().split()
            return int(frame), BeforeFrame(tool=_tool(values))
        case InputKind.MOVED:
            return int(event.data.decode()), BeforeFrame(fingers_moved=True)
        case InputKind.ADAPT:
            frame, reference, *torques = event.data.decode().split()
            return int(frame), BeforeFrame(known_torques=KnownTorques(reference, np.array(torques, dtype=np.float64)))
    raise ValueError(f"an input of the kind {event.kind.value} says nothing of a frame")


def _tool(values: list[str]) -> HeldTool:
    stated_mm = None
    if STATED in values:
        *values, _, last = values
        stated_mm = float(last)
    if not values:
        return HeldTool(None, stated_mm)
    value, half_width = map(float, values)
    return HeldTool(Measured(value, half_width), stated_mm)
