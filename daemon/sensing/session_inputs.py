"""What a session has to know before a frame, as inputs of a recording: one for each thing, with the frame's number."""

from collections.abc import Iterator

import numpy as np

from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.estimation import BeforeFrame, HeldTool, KnownTorques, Measured

# The kinds of these inputs. A load cell and a skin have tares of another form.
SESSION_KINDS = frozenset({InputKind.TARE, InputKind.TOOL, InputKind.MOVED, InputKind.ADAPT})
_GIVEN_UP = " given up"
# Comes before the diameter that the experiment states.
_STATED = "stated"


def session_inputs(frame: int, before: BeforeFrame, t_ns: int) -> Iterator[RawEvent]:
    """Yield the inputs that say what comes before a frame, in the order in which a session applies it."""
    if before.begins_tare:
        yield _input(InputKind.TARE, t_ns, f"{frame}")
    if before.gives_up_tare:
        yield _input(InputKind.TARE, t_ns, f"{frame}{_GIVEN_UP}")
    if before.tool is not None:
        mm, stated_mm = before.tool.measured, before.tool.stated_mm
        measured = [] if mm is None else [repr(mm.value), repr(mm.half_width)]
        stated = [] if stated_mm is None else [_STATED, repr(stated_mm)]
        yield _input(InputKind.TOOL, t_ns, " ".join([f"{frame}", *measured, *stated]))
    if before.fingers_moved:
        yield _input(InputKind.MOVED, t_ns, f"{frame}")
    if before.known_torques is not None:
        torques = map(repr, before.known_torques.torque_nm.tolist())
        yield _input(InputKind.ADAPT, t_ns, " ".join([f"{frame}", before.known_torques.reference, *torques]))


def before_frame(event: RawEvent) -> tuple[int, BeforeFrame]:
    """Return a frame's number, and what an input of a session says of it; raises ValueError for another input."""
    match event.kind:
        case InputKind.TARE:
            text = event.data.decode()
            given_up = text.endswith(_GIVEN_UP)
            return int(text.removesuffix(_GIVEN_UP)), BeforeFrame(begins_tare=not given_up, gives_up_tare=given_up)
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
    if _STATED in values:
        *values, _, last = values
        stated_mm = float(last)
    if not values:
        return HeldTool(None, stated_mm)
    value, half_width = map(float, values)
    return HeldTool(Measured(value, half_width), stated_mm)


def _input(kind: InputKind, t_ns: int, text: str) -> RawEvent:
    return RawEvent(kind, t_ns, text.encode())
