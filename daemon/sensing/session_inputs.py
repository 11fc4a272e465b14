"""What a session has to know before a frame, as inputs of a recording: one for each thing, with the frame's number."""

from collections.abc import Iterator

from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.estimation import BeforeFrame

GIVEN_UP = " given up"
# Comes before the diameter that the experiment states.
STATED = "stated"


def session_inputs(frame: int, before: BeforeFrame, t_ns: int) -> Iterator[RawEvent]:
    """Yield the inputs that say what comes before a frame, in the order in which a session applies it."""
    if before.begins_tare:
        yield _input(InputKind.TARE, t_ns, f"{frame}")
    if before.gives_up_tare:
        yield _input(InputKind.TARE, t_ns, f"{frame}{GIVEN_UP}")
    if before.tool is not None:
        mm, stated_mm = before.tool.measured, before.tool.stated_mm
        measured = [] if mm is None else [repr(mm.value), repr(mm.half_width)]
        stated = [] if stated_mm is None else [STATED, repr(stated_mm)]
        yield _input(InputKind.TOOL, t_ns, " ".join([f"{frame}", *measured, *stated]))
    if before.fingers_moved:
        yield _input(InputKind.MOVED, t_ns, f"{frame}")
    if before.known_torques is not None:
        torques = map(repr, before.known_torques.torque_nm.tolist())
        yield _input(InputKind.ADAPT, t_ns, " ".join([f"{frame}", before.known_torques.reference, *torques]))


def _input(kind: InputKind, t_ns: int, text: str) -> RawEvent:
    return RawEvent(kind, t_ns, text.encode())
